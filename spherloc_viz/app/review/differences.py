"""Two recorded runs side by side: what was asked of them, what came out, and where they differ."""

from html import escape

from spherloc_viz.app.review import words
from spherloc_viz.app.review.card import Line, errors_text, two_columns_html
from spherloc_viz.app.review.filters import pill
from spherloc_viz.app.review.rows import badge_html
from spherloc_viz.app.text import DIM, box
from spherloc_viz.recording.run_row import RunRow

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
    return box(head + two_columns_html(lines(one, other), *NAMES) + note, "font-size:11.5px")


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
            errors_text(one.rotation_error_deg, one.translation_error_m),
            errors_text(other.rotation_error_deg, other.translation_error_m),
        ),
        ("inliers", f"{one.inliers} of {one.correspondences}", f"{other.inliers} of {other.correspondences}"),
        ("certificate", _proof(one), _proof(other)),
        ("time", words.duration(one.time_ms), words.duration(other.time_ms)),
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
