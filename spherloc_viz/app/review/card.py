"""The run that is open as HTML: what was recorded beside what the page shows now."""

from collections.abc import Sequence
from html import escape

import numpy as np

from spherloc.diagnosis import Diagnosis
from spherloc.metrics import evaluate
from spherloc_viz import style
from spherloc_viz.app.history import changed_fields
from spherloc_viz.app.review import words
from spherloc_viz.app.review.filters import key_html, keyed, pill
from spherloc_viz.app.review.opened import Opened, is_same_pose
from spherloc_viz.app.review.rows import NEXT_KEY, PREVIOUS_KEY, badge_html
from spherloc_viz.app.text import DIM, box
from spherloc_viz.app.web.viewer_room import viewer_link
from spherloc_viz.app.wish import Run
from spherloc_viz.layers import steps
from spherloc_viz.recording.properties import outcome
from spherloc_viz.recording.run_row import RunRow

GROUND = "margin:0 .6em .4em;border:1px solid rgba(80,150,250,.45);border-radius:.4em"

Line = tuple[str, str, str]
"""Name, as recorded, now; values as HTML."""


def bar_html(place: int | None, total: int) -> str:
    """What opens the next run and the one before, and where in the list the open one is (from 0)."""
    where = f"{total:,} runs" if place is None else f"{place + 1:,} of {total:,}"
    back = pill(
        f"‹ previous {key_html(PREVIOUS_KEY)}",
        "run-step:-1",
        False,
        f"Previous run, key {PREVIOUS_KEY}",
        keyed(PREVIOUS_KEY),
    )
    on = pill(f"next {key_html(NEXT_KEY)} ›", "run-step:1", False, f"Next run, key {NEXT_KEY}", keyed(NEXT_KEY))
    close = pill("✕", "run-close:", False, "Take the recorded run away; the page stays as it is")
    return (
        f'<div style="display:flex;align-items:center;gap:.4em">{back}{on}'
        f'<span style="flex:1;text-align:center;{DIM}">{where}</span>{close}</div>'
    )


def card_html(opened: Opened, run: Run | None, diagnosis: Diagnosis | None, bar: str) -> str:
    """The whole card; ``run`` is None until the page has one."""
    row = opened.recorded.row
    is_it = run is not None and run.wish == opened.wish
    title = (
        f'<div style="font-weight:600;padding:.35em 0 .1em;overflow-wrap:anywhere" title="{escape(row.file)}">'
        f"{escape(words.title_of(row))}</div>"
    )
    parts = [bar, title]
    if run is not None:
        lines = lines_of(row, run, diagnosis)
        parts += [_summary(row), _table(lines, "now"), _remark(opened, run, is_it)]
    if opened.sentence:
        parts.append(f'<div style="{DIM};padding-top:.2em">{escape(opened.sentence)}</div>')
    parts.append(_ways(row, run if is_it else None))
    return f'<div style="{GROUND}">{box("".join(parts), "font-size:11.5px;padding:.45em .7em")}</div>'


def _summary(row: RunRow) -> str:
    return f'<div style="{DIM};padding-bottom:.2em">{escape(row.summary)}</div>' if row.summary else ""


def lines_of(row: RunRow, run: Run, diagnosis: Diagnosis | None) -> list[Line]:
    """The recorded run beside the one on the page."""
    trace, metrics = run.trace, evaluate(run.trace)
    cause = "…" if diagnosis is None else str(diagnosis.cause)
    turn, shift = metrics.rotation_error_deg, metrics.translation_error_m
    inliers = int(np.count_nonzero(trace.inlier_mask))
    return [
        ("outcome", badge_html(row.outcome), badge_html(outcome(metrics))),
        ("diagnosis", escape(row.diagnosis or words.UNKNOWN), escape(cause)),
        ("errors", errors_text(row.rotation_error_deg, row.translation_error_m), errors_text(turn, shift)),
        ("inliers", f"{row.inliers} of {row.correspondences}", f"{inliers} of {len(trace.problem)}"),
        ("time", words.duration(row.time_ms), words.duration(trace.timings_ms["total"])),
    ]


def errors_text(rotation_deg: float | None, translation_m: float | None) -> str:
    """Both errors of a pose."""
    if rotation_deg is None and translation_m is None:
        return words.UNKNOWN
    return escape(f"{words.angle(rotation_deg)} · {words.distance(translation_m)}")


def _table(lines: Sequence[Line], heading: str) -> str:
    return two_columns_html(lines, "as recorded", heading)


def two_columns_html(lines: Sequence[Line], left: str, right: str) -> str:
    """Two runs side by side; values that differ stand out. All of it is HTML."""
    cell = "text-align:left;vertical-align:top;padding:.05em .8em .05em 0;overflow-wrap:anywhere"
    head = "".join(f'<th style="{cell};font-weight:400;{DIM}">{words}</th>' for words in ("", left, right))
    body = "".join(
        f'<tr><th scope="row" style="{cell};font-weight:400;white-space:nowrap;{DIM}">{name}</th>'
        f'<td style="{cell};width:45%">{one}</td>'
        f'<td style="{cell};width:45%;{"font-weight:600" if one != other else ""}">{other}</td></tr>'
        for name, one, other in lines
    )
    css = "border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums"
    return f'<table class="runs-beside" style="{css}"><tr>{head}</tr>{body}</table>'


def _remark(opened: Opened, run: Run, is_it: bool) -> str:
    """Whether the page repeats the run, or what was changed."""
    same = is_same_pose(opened.recorded.cam_from_map, run.trace.cam_from_map)
    if is_it:
        words_ = "This is the run as it was recorded." if same else "Repeated here, it finds another pose."
    else:
        fields = sorted(name.replace("_", " ") for name in changed_fields(opened.wish, run.wish))
        words_ = f"Changed: {', '.join(fields)}." if fields else "The page shows the run as it was recorded."
        words_ += " The pose is the same." if same else ""
    return f'<div style="{DIM};padding-top:.2em">{escape(words_)}</div>'


def _ways(row: RunRow, run: Run | None) -> str:
    """Where one can go from here: the step that decided, the run itself, the Rerun viewer."""
    ways = []
    if run is None:
        ways.append(_way("run-return:", "back to it"))
    elif 0 <= row.decisive_step < len(stops := steps(run.trace)):
        ways.append(_way(f"step:{stops[row.decisive_step].key}", f"decided at “{stops[row.decisive_step].title}”"))
    link = escape(viewer_link(row.file, row.decisive_step))
    ways.append(f'<a href="{link}" target="_blank" rel="noopener" style="color:inherit">Rerun viewer there ↗</a>')
    return f'<div style="padding-top:.3em;display:flex;flex-wrap:wrap;gap:.1em 1em">{"".join(ways)}</div>'


def _way(touch: str, words_: str) -> str:
    look = f"text-decoration:underline;text-decoration-color:{style.css(style.ESTIMATE)}"
    return f'<span role="button" tabindex="0" data-touch="{escape(touch)}" style="{look}">{escape(words_)}</span>'
