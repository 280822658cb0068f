"""Reports on runs as one HTML file that can be sent: a list of runs, or the differences of two sets of runs."""

import math
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape

from spherloc_viz import style
from spherloc_viz.app.desk.comparison import Change, OutcomeChanges, Pair, causes
from spherloc_viz.app.review import words
from spherloc_viz.app.review.rows import badge_html, label_html, picture_html
from spherloc_viz.layers.primitives import true_minus
from spherloc_viz.recording.run_row import RunRow

CSS = """
:root{color-scheme:light dark}
body{font:14px/1.45 system-ui,sans-serif;margin:0 auto;max-width:76em;padding:1.5em;
background:light-dark(#fff,#16181c);color:light-dark(#1c1e22,#e4e6ea)}
h1{font-size:1.5em;margin:0 0 .2em}h2{font-size:1.05em;margin:1.4em 0 .3em}
.dim{opacity:.65}table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;vertical-align:top;padding:.45em .7em .45em 0;border-top:1px solid rgba(128,140,160,.25)}
th{font-weight:600;white-space:nowrap;border-top:0}code{font:12px ui-monospace,Menlo,Consolas,monospace}
td code{overflow-wrap:anywhere}.name{font-weight:600}.wide{min-width:15em}.num{white-space:nowrap}
.counts>span{display:inline-block;margin:0 1.4em .3em 0}
.bar{display:inline-block;height:.6em;border-radius:.3em;margin-right:.5em;vertical-align:.02em}
"""
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""The page needs no other files; no text of a recording can load or run anything."""
PICTURE_PX = 152, 104


def summary_html(rows: Sequence[RunRow], remark: str, now: datetime) -> str:
    """A page about the runs; their recordings are in the folder ``recordings`` beside the page's file."""
    plural = "s" if len(rows) != 1 else ""
    title = f"{len(rows):,} recorded run{plural}"
    made = now.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    body = "".join(_row(row) for row in rows)
    heads = ("", "run", "result", "diagnosis", "review")
    table = f"<table><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>{body}</table>"
    return (
        f'{_head(title)}<p class="dim">Exported by spherloc, {made}. {escape(remark)}</p>'
        f"{_counts(rows)}{table}{_how()}</body></html>\n"
    )


def _head(title: str) -> str:
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head><body><h1>{escape(title)}</h1>"
    )


def _counts(rows: Sequence[RunRow]) -> str:
    """Numbers of runs with each outcome and, with a bar, with each diagnosis."""
    outcomes = Counter(row.outcome for row in rows).most_common()
    causes = Counter(row.diagnosis or "not diagnosed" for row in rows).most_common()
    first = "".join(f"<span>{badge_html(outcome)} {count:,}</span>" for outcome, count in outcomes)
    most = max((count for _, count in causes), default=1)
    color = style.css(style.ESTIMATE)
    second = "".join(
        f'<div><span class="bar" style="width:{max(1.0, 160.0 * count / most):.0f}px;background:{color}"></span>'
        f'{escape(cause)} <span class="dim">{count:,}</span></div>'
        for cause, count in causes
    )
    return f'<div class="counts">{first}</div><h2>Diagnoses</h2>{second}<h2>Runs</h2>'


def _row(row: RunRow) -> str:
    about = [f"{row.estimator}, seed {row.seed}", words.clock(row.created)]
    result = [
        f"{row.inliers} of {row.correspondences} inliers",
        f"outliers {words.percent(row.outlier_rate)}",
        words.errors(row),
        words.duration(row.time_ms),
    ]
    review = "".join(map(label_html, row.labels)) + _note(row.note)
    cells = (
        picture_html(row.thumbnail, *PICTURE_PX),
        f'<div class="name">{escape(words.title_of(row))}</div><div class="dim">{escape(" · ".join(about))}</div>'
        f"<code>recordings/{escape(row.file)}</code>",
        f"{badge_html(row.outcome)}<div>{'<br>'.join(map(escape, result))}</div>",
        f'{escape(row.diagnosis)}<div class="dim">{escape(row.summary)}</div>',
        review,
    )
    classes = ("", "wide", "num", "wide", "")
    return (
        "<tr>" + "".join(f'<td class="{name}">{cell}</td>' for name, cell in zip(classes, cells, strict=True)) + "</tr>"
    )


def _note(note: str) -> str:
    return f'<div style="white-space:pre-wrap">{escape(note)}</div>' if note else ""


def _how() -> str:
    ways = (
        ("spherloc view FILE.rrd", "opens a run in the Rerun viewer, at the step where it was decided"),
        ("spherloc repeat FILE.rrd", "repeats a run and says whether it comes out the same"),
        ("spherloc run FILE.rrd", "solves the recorded problem again, with other options if you like"),
        ("spherloc play --recordings recordings", "reviews all of them on the playground's page"),
    )
    rows = "".join(f"<tr><td><code>{escape(code)}</code></td><td>{escape(what)}</td></tr>" for code, what in ways)
    return (
        f"<h2>How to open them</h2><table>{rows}</table>"
        '<p class="dim">Any Rerun viewer opens the files too. Labels and notes are in the files that end with '
        ".review.rrd; runs.csv has this table for other programs.</p>"
    )


MAX_PAIRS = 100
"""How many runs of each kind are shown with their pictures."""
TABLE_ROWS = 30
"""Largest number of causes and of scenes that are listed."""


def comparison_html(comparison: OutcomeChanges, before: str, after: str, now: datetime) -> str:
    """A page about the changes from the runs called ``before`` to those called ``after``."""
    made = now.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    broken, mended = len(comparison.broken), len(comparison.mended)
    parts = [
        _head(f"{after} against {before}"),
        f'<p class="dim">Compared by spherloc, {made}.</p>',
        f"<p><b>{_count(broken, 'new failure')}, {mended:,} mended</b>, of {_count(len(comparison.pairs), 'pair')} of "
        f"runs on the same problem. Right before: {_share(comparison.right_before, comparison.judged)}; right after: "
        f"{_share(comparison.right_after, comparison.judged)}. McNemar's exact test of new failures against mended: "
        f"p = {p_text(comparison.p)}.</p>",
        f'<p class="dim">Without a partner: {comparison.only_before:,} before, {comparison.only_after:,} after.</p>',
        _changes(comparison.changes),
        _pairs("New failures", comparison.broken, "none"),
        _pairs("Mended", comparison.mended, "none"),
        "</body></html>\n",
    ]
    return "".join(parts)


def comparison_text(comparison: OutcomeChanges, before: str, after: str) -> str:
    """The same as text for a terminal, without pictures."""
    lines = [
        f"{after} against {before}: {_count(len(comparison.pairs), 'pair')} of runs on the same problem",
        f"  right        {_share(comparison.right_before, comparison.judged)} before, "
        f"{_share(comparison.right_after, comparison.judged)} after",
        f"  new failures {len(comparison.broken):,}, mended {len(comparison.mended):,} "
        f"(McNemar's exact test: p = {p_text(comparison.p)})",
        f"  unpaired     {comparison.only_before:,} before, {comparison.only_after:,} after",
    ]
    for change in comparison.changes:
        lines.append(
            f"  {change.title}: median {number(change.before)} -> {number(change.after)}, of the differences "
            f"{number(change.difference)} (Wilcoxon, {_count(change.pairs, 'pair')}: p = {p_text(change.p)})"
        )
    for title, pairs in (("new failures", comparison.broken), ("mended", comparison.mended)):
        for pair in pairs[:TABLE_ROWS]:
            cause = pair.after.diagnosis if title == "new failures" else pair.before.diagnosis
            lines.append(f"  {title}: {words.title_of(pair.after)}, {pair.after.estimator}: {cause or 'not diagnosed'}")
            lines.append(f"    {pair.before.file} -> {pair.after.file}")
        if len(pairs) > TABLE_ROWS:
            lines.append(f"  ... and {len(pairs) - TABLE_ROWS:,} more {title}; --report FILE.html has more of them")
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """A measured number with three digits."""
    return words.UNKNOWN if math.isnan(value) else f"{value:.3g}"


def p_text(p: float) -> str:
    """A p-value with two digits."""
    return words.UNKNOWN if math.isnan(p) else "< 1e-16" if p < 1e-16 else f"{p:.2g}"


def _count(count: int, noun: str) -> str:
    return f"1 {noun}" if count == 1 else f"{count:,} {noun}s"


def _share(part: int, whole: int) -> str:
    return f"{part:,} of {whole:,} ({part / whole:.1%})" if whole else "none can be judged"


def _changes(changes: Sequence[Change]) -> str:
    heads = ("", "pairs", "median before", "median after", "median difference", "p (Wilcoxon)")
    body = "".join(
        f"<tr><td>{escape(change.title)}</td><td>{change.pairs:,}</td><td>{number(change.before)}</td>"
        f"<td>{number(change.after)}</td><td>{true_minus(number(change.difference))}</td><td>{p_text(change.p)}</td></tr>"
        for change in changes
    )
    return f"<h2>Paired differences</h2><table><tr>{''.join(f'<th>{head}</th>' for head in heads)}</tr>{body}</table>"


def _pairs(title: str, pairs: Sequence[Pair], none: str) -> str:
    if not pairs:
        return f"<h2>{title}</h2><p>{none}</p>"
    counted = ", ".join(f"{escape(cause)} {count:,}" for cause, count in causes(pairs)[:TABLE_ROWS])
    rows = "".join(
        f'<tr><td><div class="name">{escape(words.title_of(pair.after))}</div>'
        f'<div class="dim">{escape(pair.after.estimator)}, seed {pair.after.seed}</div></td>'
        f"{_side(pair.before)}{_side(pair.after)}</tr>"
        for pair in pairs[:MAX_PAIRS]
    )
    more = f'<p class="dim">and {len(pairs) - MAX_PAIRS:,} more.</p>' if len(pairs) > MAX_PAIRS else ""
    return (
        f"<h2>{title}: {len(pairs):,}</h2><p>Diagnoses after: {counted}.</p>"
        f"<table><tr><th>run</th><th>before</th><th>after</th></tr>{rows}</table>{more}"
    )


def _side(row: RunRow) -> str:
    return (
        f'<td class="wide">{picture_html(row.thumbnail, *PICTURE_PX)}{badge_html(row.outcome)} {escape(row.diagnosis)}'
        f'<div class="dim">{row.inliers} of {row.correspondences} inliers · {escape(words.errors(row))}</div>'
        f"<code>{escape(row.file)}</code></td>"
    )
