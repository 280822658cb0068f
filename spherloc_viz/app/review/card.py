"""The run that is open as HTML: what was recorded beside what the page shows now."""

from collections.abc import Sequence
from html import escape

import numpy as np

from spherloc.diagnosis import Diagnosis
from spherloc.metrics import evaluate
from spherloc_viz import style
from spherloc_viz.app.catalog import Run
from spherloc_viz.app.history import changed_fields
from spherloc_viz.app.review import words
from spherloc_viz.app.review.filters import key_html, keyed, pill
from spherloc_viz.app.review.opened import Opened, is_same_pose
from spherloc_viz.app.review.rows import NEXT_KEY, PREVIOUS_KEY, badge_html, verdict_html
from spherloc_viz.app.text import DIM, box
from spherloc_viz.app.web.viewer import viewer_link
from spherloc_viz.layers import steps
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.run_summary import outcome

SOLVED = "solved in"
"""What the time of a run is called. That of the same run made again is another one, and no difference of the two."""
GROUND = "margin:0 .6em .4em;border:1px solid rgba(80,150,250,.45);border-radius:.4em"

Line = tuple[str, str, str]
"""Name, as recorded, now; values as HTML."""


def bar_html(place: int | None, total: int) -> str:
    """What opens the next run and the one before, and where in the list the open one is (from 0)."""
    where = "not in the list" if place is None else f"{place + 1:,} of {total:,}"
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


def said_html(sentence: str, wrong: bool) -> str:
    """A line about what the page is doing, or what went wrong."""
    look = f"color:{style.css_text(style.OUTLIER)}" if wrong else DIM
    return f'<div style="{look};padding-top:.2em;overflow-wrap:anywhere">{escape(sentence)}</div>' if sentence else ""


def card_html(opened: Opened, run: Run, diagnosis: Diagnosis | None, bar: str, reached: bool) -> str:
    """The whole card: the run as it was recorded, and as soon as it is changed, a table of both. ``reached`` says
    whether the page has shown the recorded run: until then its own run is another one and no change."""
    row = opened.recorded.row
    is_it = run.request == opened.request
    if not reached:
        return _card([bar, _title(words.title_of(row), row), _result(row), _dim("The page still shows another run.")])
    body = _result(row) if is_it else two_columns_html(lines_of(row, run, diagnosis), "as recorded", "now")
    remark = _remark(opened, run, is_it)
    parts = [bar, _title(words.title_of(row), row), body, remark]
    if opened.sentence:
        parts.append(_dim(opened.sentence))
    parts.append(_ways(row, run if is_it else None))
    return _card(parts)


def untold_html(opened: Opened, run: Run, bar: str) -> str:
    """The card of a run whose answers are hidden."""
    row = opened.recorded.row
    back = "" if run.request == opened.request else _way("run-return:", "back to the recorded run")
    return _card([bar, _title(words.untold_title_of(row), row, told=False), back])


def _card(parts: Sequence[str]) -> str:
    content = box("".join(parts), "font-size:12px;line-height:1.38;padding:.4em .7em")
    return f'<div class="review-card" style="{GROUND}">{content}</div>'


def _title(title: str, row: RunRow, told: bool = True) -> str:
    """A heading; unless answers are ``told``, without the name of the file, which has the problem's."""
    return (
        f'<div style="font-weight:600;padding-top:.3em;overflow-wrap:anywhere" '
        f'title="{escape(row.file) if told else ""}">{escape(title)}'
        f'<span style="font-weight:400;{DIM}"> · {escape(row.estimator)} #{row.seed}</span></div>'
    )


def _result(row: RunRow) -> str:
    """What came out of the recorded run, in a line, and what the diagnosis says."""
    errors = errors_of(row)
    facts = [f"{row.inliers}/{row.correspondences}", *([errors] if errors != words.UNKNOWN else [])]
    told = "".join(f' · <span style="white-space:nowrap">{fact}</span>' for fact in facts)
    line = f'{verdict_html(row)}<span style="{DIM}">{told}</span>'
    return f"<div>{line}</div>{_dim(row.summary)}"


def lines_of(row: RunRow, run: Run, diagnosis: Diagnosis | None) -> list[Line]:
    """The recorded run beside the one on the page."""
    trace, metrics = run.trace, evaluate(run.trace)
    cause = "…" if diagnosis is None else str(diagnosis.cause)
    turn, shift = metrics.rotation_error_deg, metrics.translation_error_m
    inliers = int(np.count_nonzero(trace.inlier_mask))
    return [
        ("outcome", badge_html(row.outcome), badge_html(outcome(metrics))),
        ("diagnosis", escape(row.diagnosis or words.UNKNOWN), escape(cause)),
        ("errors", errors_of(row), errors_text(turn, shift, trace.problem.metric)),
        ("inliers", f"{row.inliers} of {row.correspondences}", f"{inliers} of {len(trace.problem)}"),
        (SOLVED, words.duration(row.time_ms), words.duration(trace.timings_ms["total"])),
    ]


def errors_of(row: RunRow) -> str:
    """Both errors of a recorded run's pose."""
    return errors_text(row.rotation_error_deg, row.translation_error_m, row.metric)


def errors_text(rotation_deg: float | None, translation_m: float | None, metric: bool | None) -> str:
    """Both errors of a pose; if it is known not to be ``metric``, the position's in units of the map."""
    if rotation_deg is None and translation_m is None:
        return words.UNKNOWN
    return escape(f"{words.angle(rotation_deg)} · {words.distance(translation_m, metric)}")


def two_columns_html(lines: Sequence[Line], left: str, right: str) -> str:
    """Two runs side by side; values that differ stand out. All of it is HTML."""
    cell = "text-align:left;vertical-align:top;padding:.05em .8em .05em 0;overflow-wrap:anywhere"
    head = "".join(f'<th style="{cell};font-weight:400;{DIM}">{words}</th>' for words in ("", left, right))
    body = "".join(
        f'<tr><th scope="row" style="{cell};font-weight:400;white-space:nowrap;{DIM}">{name}</th>'
        f'<td style="{cell};width:45%">{one}</td>'
        f'<td style="{cell};width:45%;{"font-weight:600" if one != other and name != SOLVED else ""}">{other}</td></tr>'
        for name, one, other in lines
    )
    css = "border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums"
    return f'<table class="runs-beside" style="{css}"><tr>{head}</tr>{body}</table>'


def _remark(opened: Opened, run: Run, is_it: bool) -> str:
    """What was changed, or that the run cannot be repeated here; nothing where it was."""
    same = is_same_pose(opened.recorded.cam_from_map, run.trace.cam_from_map)
    if is_it and same:
        return ""
    sentence = "Repeated here, it finds another pose."
    if not is_it:
        fields = sorted(name.replace("_", " ") for name in changed_fields(opened.request, run.request))
        sentence = f"Changed: {', '.join(fields)}.{' The pose is the same.' if same else ''}"
    return _dim(sentence)


def _dim(sentence: str) -> str:
    return f'<div style="{DIM}">{escape(sentence)}</div>'


def _ways(row: RunRow, run: Run | None) -> str:
    """Buttons that lead from the card to the key step, to the run itself, and to the Rerun viewer."""
    ways = []
    if run is None:
        ways.append(_way("run-return:", "back to the recorded run"))
    elif 0 <= row.key_step < len(headings := steps(run.trace)):
        heading = headings[row.key_step]
        ways.append(_way(f"step:{heading.key}", f"step {row.key_step + 1}: {heading.title}"))
    link = escape(viewer_link(row.file, row.key_step + 1))
    ways.append(
        f'<a href="{link}" target="_blank" rel="noopener" title="Open in the Rerun viewer at the step where it was '
        f'decided, number {row.key_step + 1}" '
        'style="color:inherit;white-space:nowrap">Open in Rerun ↗</a>'
    )
    row_css = "padding-top:.25em;display:flex;justify-content:space-between;gap:1em"
    return f'<div style="{row_css}">{"".join(ways)}</div>'


def _way(touch: str, words_: str) -> str:
    look = f"text-decoration:underline;text-decoration-color:{style.css(style.ESTIMATE)}"
    return f'<span role="button" tabindex="0" data-touch="{escape(touch)}" style="{look}">{escape(words_)}</span>'


NAMES = "A", "B"
"""What the two are called, also on the canvas."""


def same_problem(one: RunRow, other: RunRow) -> bool:
    """Whether both solved the same problem."""
    return bool(one.problem_key) and one.problem_key == other.problem_key


def comparison_html(one: RunRow, other: RunRow) -> str:
    """Both runs as a table, with a remark if they are of different problems."""
    same = same_problem(one, other)
    close = pill("✕", "runs-uncompare:", False, "Close the comparison")
    head = (
        '<div style="display:flex;gap:.5em;padding-bottom:.3em"><b style="flex:1;font-weight:600">'
        f"{escape(NAMES[0])} and {escape(NAMES[1])}: {'the same problem' if same else 'two problems'}</b>{close}</div>"
    )
    remark = "" if same else "They solved different problems, so their cameras are not drawn together."
    note = f'<div style="{DIM};padding-top:.2em">{remark}</div>' if remark else ""
    return box(head + two_columns_html(lines(one, other), *NAMES) + note, "font-size:12px")


def lines(one: RunRow, other: RunRow) -> list[Line]:
    """What there is to compare; of the options only those that differ."""
    pairs = [
        ("run", words.title_of(one), words.title_of(other)),
        ("scene", one.scene, other.scene),
        ("matches", str(one.correspondences), str(other.correspondences)),
        ("outliers", words.percent(one.outlier_rate), words.percent(other.outlier_rate)),
    ]
    shown = [(name, escape(a), escape(b)) for name, a, b in pairs if a != b]
    shown += [
        ("estimator", escape(one.estimator), escape(other.estimator)),
        *_options(one, other),
        ("seed", str(one.seed), str(other.seed)),
        ("outcome", badge_html(one.outcome), badge_html(other.outcome)),
        ("diagnosis", escape(one.diagnosis or words.UNKNOWN), escape(other.diagnosis or words.UNKNOWN)),
        (
            "errors",
            errors_of(one),
            errors_of(other),
        ),
        ("inliers", f"{one.inliers} of {one.correspondences}", f"{other.inliers} of {other.correspondences}"),
        ("certificate", _proof(one), _proof(other)),
        (SOLVED, words.duration(one.time_ms), words.duration(other.time_ms)),
    ]
    return shown


def _options(one: RunRow, other: RunRow) -> list[Line]:
    """Options that differ; those that only one estimator has are no difference of the runs but of the estimators."""
    a, b = words.options_of(one), words.options_of(other)
    if not (a and b):
        return []
    known = [name for name in a if name in b] if one.estimator != other.estimator else dict.fromkeys((*a, *b))
    return [
        (escape(name.replace("_", " ")), escape(a.get(name, words.UNKNOWN)), escape(b.get(name, words.UNKNOWN)))
        for name in known
        if a.get(name) != b.get(name)
    ]


def _proof(row: RunRow) -> str:
    return {True: "proven largest", False: "gap left", None: words.UNKNOWN}[row.proven]
