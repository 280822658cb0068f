"""The list of recordings as HTML: a row a run, with its picture, what came out, and why."""

import base64
from collections.abc import Sequence
from datetime import datetime
from html import escape

from spherloc.diagnosis import Cause
from spherloc_viz import style
from spherloc_viz.app.review import words
from spherloc_viz.app.review.filters import PAGE, Look, keep_html, key_html, keyed, pill, sorting_html
from spherloc_viz.app.text import DIM, box, dot_html
from spherloc_viz.app.web.viewer import viewer_link
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.row_checks import is_thumbnail

DESK = "/desk"
"""Address of the desk (``app/web/desk.py``)."""
WIDTH_PX, HEIGHT_PX = 64, 46
"""Size of a row's picture."""
PREVIOUS_KEY, NEXT_KEY = "[", "]"
"""Open the run before and the next one: viser's canvas has letters and arrows."""
RULE = "border-top:1px solid rgba(128,140,160,.18)"
CUT = "white-space:nowrap;overflow:hidden;text-overflow:ellipsis"
WHOLE = "overflow-wrap:anywhere"
OPENED = "rgba(60,130,230,.2)"
"""Behind the row of the run that is open."""


def rows_html(
    rows: Sequence[RunRow],
    marked: frozenset[str],
    opened: str | None,
    total: int,
    look: Look,
    now: datetime,
    hidden: bool = False,
) -> str:
    """A page of the list and what turns it. ``opened`` is the file of the run that is open; ``hidden`` tells no
    answers."""
    if not rows:
        what = "No recorded run fits these filters." if look.filtered else "No run is recorded yet."
        return box(f'<div style="{DIM}">{what}</div>', "font-size:12.5px")
    body = "".join(row_html(row, row.file in marked, row.file == opened, now, hidden) for row in rows)
    top, below = pages_html(look, total, opened is None), pages_html(look, total, None)
    return box(f"{top}{body}{below if total > PAGE else ''}", "font-size:12px;line-height:1.35")


def row_html(row: RunRow, marked: bool, opened: bool, now: datetime, hidden: bool = False) -> str:
    """One run; ``hidden`` tells only how it was made."""
    file = escape(row.file)
    ground = f"background:{OPENED};box-shadow:inset 2px 0 0 {style.css(style.ESTIMATE)}" if opened else ""
    look = "background:rgba(20,24,32,.55);color:#fff;border-radius:3px;padding:0 .2em;font-size:12px;line-height:1.25"
    mark = (
        f'<span role="checkbox" aria-checked="{str(marked).lower()}" aria-label="Mark" tabindex="0" '
        f'data-touch="run-mark:{file}" title="Mark, to compare or export" '
        f'style="position:absolute;left:4px;top:4px;{look}">{"☑" if marked else "☐"}</span>'
    )
    address = escape(viewer_link(row.file, row.key_step + 1))
    link = (
        f'<a href="{address}" target="_blank" rel="noopener" '
        f'title="Open in Rerun\'s viewer at step {row.key_step + 1} of {row.steps}" '
        'style="color:inherit;text-decoration:none;padding:.4em .1em .4em .4em;opacity:.75;font-size:13px">↗</a>'
    )
    hint, picture = _hint(row), row.thumbnail
    if hidden:
        link, hint, picture = "", "Open this run", b""
    playing = row.source == "page" and not row.labels and not hidden
    keep = f'<div style="align-self:flex-end;padding-bottom:.2em">{keep_html(row.file)}</div>' if playing else ""
    about = f'<div style="flex:1;min-width:0">{_lines(row, now, hidden)}</div>'
    return (
        f'<div style="{RULE};position:relative;display:flex;align-items:flex-start;padding:2px 0;{ground}">'
        f'<div role="button" tabindex="0" class="touch-row" data-touch="run-open:{file}" title="{hint}" '
        f'style="flex:1;min-width:0;display:flex;gap:.6em;padding-left:2px">{picture_html(picture)}{about}</div>'
        f"{mark}{keep}{link}</div>"
    )


def _lines(row: RunRow, now: datetime, hidden: bool) -> str:
    """What the run is, what came out, and numbers; below, what a reviewer wrote."""
    title = words.untold_title_of(row) if hidden else words.title_of(row)
    name = (
        f'<div style="{WHOLE}"><span style="{DIM};float:right;padding-left:.5em">'
        f'{escape(words.moment(row.created, now))}</span><span style="font-weight:600">{escape(title)}</span></div>'
    )
    method = f"{escape(row.estimator)} #{row.seed}"
    if hidden:
        return f'{name}<div style="{CUT};{DIM}">{method} · {row.correspondences} matches</div>'
    changed = f" · {escape(row.changes)}" if row.changes else ""
    how = f'<div style="{WHOLE}">{verdict_html(row)}<span style="{DIM}"> · {method}{changed}</span></div>'
    facts = [f"{row.inliers}/{row.correspondences}"]
    estimated = "est. " if row.rotation_error_deg is None else ""  # by the front end, before the run
    facts += [] if row.outlier_rate is None else [f"{estimated}{100.0 * row.outlier_rate:.0f} % out"]
    errors = (words.angle(row.rotation_error_deg), words.distance(row.translation_error_m, row.metric))
    facts += [fact for fact in errors if fact != words.UNKNOWN]
    facts.append(words.duration(row.time_ms))
    return name + how + facts_html(facts) + _review(row)


def facts_html(facts: Sequence[str]) -> str:
    """Numbers in one line; those that do not fit are left out whole."""
    parts = "".join(
        f'<span style="white-space:pre">{"" if place == 0 else " · "}{escape(fact)}</span>'
        for place, fact in enumerate(facts)
    )
    css = f"{DIM};display:flex;flex-wrap:wrap;height:1.35em;overflow:hidden;font-variant-numeric:tabular-nums"
    return f'<div style="{css}">{parts}</div>'


def verdict_html(row: RunRow) -> str:
    """What came out, and why: of a failure the cause alone, in its colour; a doubtful success is a success first."""
    if not row.diagnosis or row.diagnosis == Cause.OK:
        return badge_html(row.outcome)
    return (
        badge_html(row.outcome, row.diagnosis)
        if row.outcome == "failure"
        else (f"{badge_html(row.outcome)}, {escape(row.diagnosis)}?")
    )


def _review(row: RunRow) -> str:
    if not row.labels and not row.note:
        return ""
    labels = "".join(label_html(label) for label in row.labels)
    note = f'<span style="font-style:italic">{escape(row.note)}</span>' if row.note else ""
    return f'<div style="{CUT}">{labels}{note}</div>'


def label_html(label: str) -> str:
    """A word that a reviewer gave."""
    color = style.css(style.CLIQUE)
    return (
        f'<span style="border:1px solid {color};border-radius:.3em;padding:0 .35em;margin-right:.35em">'
        f"{escape(label)}</span>"
    )


def badge_html(outcome: str, said: str = "") -> str:
    """The outcome with its colour, or what is ``said`` of it instead."""
    color = words.COLORS.get(outcome, style.UNDECIDED)
    look = f"font-weight:600;color:{style.css_text(color)}"
    return f'{dot_html(color)}<b title="{escape(outcome)}" style="{look}">{escape(said or outcome)}</b>'


def picture_html(png: bytes, width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX) -> str:
    """A run's picture, or its place if it has none."""
    box_css = f"width:{width_px}px;height:{height_px}px;border-radius:3px;flex:none;background:rgba(128,140,160,.14)"
    if not png or not is_thumbnail(png):
        return f'<div style="{box_css}"></div>'
    data = base64.b64encode(png).decode()
    return f'<img alt="" src="data:image/png;base64,{data}" style="{box_css};object-fit:cover;display:block">'


def _hint(row: RunRow) -> str:
    solved = f"Solved in {words.duration(row.time_ms)} when it was recorded."
    return escape(" ".join(filter(None, (row.summary or row.message, solved, f"Seed {row.seed}, {row.file}."))))


def pages_html(look: Look, total: int, start: bool | None) -> str:
    """The position in the list, and the buttons that turn its pages.

    Above the list also how it is sorted, what exports it and, with ``start``, what opens one run after another; below
    it (``start`` is None) nothing more.
    """
    first, last = look.page * PAGE + 1, min((look.page + 1) * PAGE, total)
    back = pill("‹", f"runs-page:{look.page - 1}", False, "Previous page") if look.page > 0 else ""
    on = pill("›", f"runs-page:{look.page + 1}", False, "Next page") if last < total else ""
    where = f"{first:,}–{last:,} of {total:,}" if total > PAGE else f"{total:,} run{'s' if total != 1 else ''}"
    parts = [f'<span style="{DIM}">{where}</span>{back}{on}']
    if start is not None:
        parts += ['<span style="flex:1"></span>', sorting_html(look)]
        parts.append(
            f'<a href="{DESK}" target="_blank" rel="noopener" title="All runs on a page of their own: groups, plots, '
            'bulk labels, comparisons" style="color:inherit;white-space:nowrap">triage desk ↗</a>'
        )
        parts.append(pill("zip", "runs-export:", False, f"Export all {total:,} runs of this list, as far as they fit"))
    if start:
        hint = f"Open one after another, key {NEXT_KEY}"
        parts.append(pill(f"review {key_html(NEXT_KEY)}", "run-step:1", False, hint, keyed(NEXT_KEY)))
    row_css = "display:flex;flex-wrap:wrap;gap:.4em;align-items:center;padding:.1em 0 .4em"
    return f'<div style="{row_css}">{"".join(parts)}</div>'
