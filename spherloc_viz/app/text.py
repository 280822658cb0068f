"""Text and tables as HTML. viser puts HTML into the page as it is, so every string is escaped here."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from spherloc.diagnosis import Diagnosis
from spherloc.metrics import evaluate, extent_of
from spherloc.outcome import Outcome, known_judgement
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.said_together import SaidTogether
from spherloc_viz.layers.comparison import duration_text
from spherloc_viz.layers.frame import angle_text, length
from spherloc_viz.layers.outcome import UNKNOWABLE, verdict
from spherloc_viz.layers.primitives import Step, StepHeading, Table

DIM = "opacity:.65"
OPTIONS = {"bound_px": "Bound (px)", "noise_px": "Noise of an inlier (px)", "gravity_sd_deg": "Gravity sd (deg)"}
"""What the settings call options that advice names as code does."""
WITHHELD = "Answers are hidden, and this part would tell them. It is shown once they are revealed."
WORDS = {
    **{"success": style.INLIER, "failure": style.OUTLIER, "no pose": style.OUTLIER, UNKNOWABLE: style.OUTLIER},
    **{str(Outcome.LOCALIZED): style.INLIER, str(Outcome.DOUBTFUL): style.CLIQUE},
}
"""Values of a table that are shown in colour."""


def begun(sentence: str) -> str:
    """With a capital letter, unless it begins with the name of a file."""
    return sentence[:1].upper() + sentence[1:] if sentence.partition(" ")[0].isalpha() else sentence


def box(content: str, css: str = "") -> str:
    """A block with the page's margins and type size, which grows on a wide screen (``touch.css``)."""
    return f'<div class="words" style="padding:0 .8em .6em;font-size:13px;line-height:1.4;{css}">{content}</div>'


def step_html(step: Step, caption_html: Callable[[str], str] = escape, end: str = "", place: str = "") -> str:
    """Title, caption, equation and note of a step; ``caption_html`` makes HTML of the words of caption and note.
    ``end`` says that it is the "first" or the "last" one, so that the page's script can disable a button, and ``place``
    is its number of how many, such as "7/37", which the large captions show."""
    parts = [
        f'<div class="step-title" data-place="{place}" style="font-size:15px;font-weight:600;padding-bottom:.25em">'
        f"{escape(step.title)}</div>",
        f"<div>{caption_html(step.caption)}</div>",
    ]
    if step.equation:
        face = "font-family:Cambria,Georgia,serif;font-style:italic;font-size:14px"
        parts.append(f'<div class="step-equation" style="{face};padding-top:.4em;{DIM}">{escape(step.equation)}</div>')
    if step.note:
        parts.append(
            f'<div class="step-note" style="font-size:12px;padding-top:.35em;{DIM}">{caption_html(step.note)}</div>'
        )
    return box(f'<div class="step-words" data-end="{end}">{"".join(parts)}</div>')


def table_html(table: Table, name_html: Callable[[str], str] = escape) -> str:
    """A table: of names and values without headings, a wider one with them; ``name_html`` makes HTML of a name."""
    cell = "padding:.09em .9em .09em 0;vertical-align:top"
    name_css, value_css = f"{cell};white-space:nowrap;{DIM}", f"{cell};"
    head = ""
    if len(table.columns) > 2:
        head = "".join(f'<td style="{name_css}">{escape(name)}</td>' for name in table.columns)
    rows = "".join(
        f'<tr><td style="{name_css}">{name_html(str(row[0]))}</td>'
        + "".join(f'<td style="{value_css}{_value_css(value)}">{escape(str(value))}</td>' for value in row[1:])
        + "</tr>"
        for row in table.rows
    )
    return box(f'<table style="border-collapse:collapse;width:100%"><tr>{head}</tr>{rows}</table>')


def cause_html(diagnosis: Diagnosis) -> str:
    """Cause, summary and advice; nothing of a run that looks right."""
    if not diagnosis.doubtful:
        return ""
    color = style.css_text(style.OUTLIER)
    return box(
        f'<div class="diagnosis-words"><div style="font-weight:600;color:{color}">'
        f"{escape(diagnosis.cause.capitalize())}</div><div>{escape(diagnosis.summary)}</div></div>"
        f'<div style="padding-top:.25em">{escape(_by_label(diagnosis.advice))}</div>'
    )


def evidence_html(diagnosis: Diagnosis) -> str:
    """The evidence for the cause, and whether it was judged with the truth; of a run that looks right, the summary."""
    if not diagnosis.doubtful:
        return box(f'<div style="{DIM}">{escape(diagnosis.summary)}</div>', "font-size:12px")
    evidence = "".join(f'<li style="padding-bottom:.2em">{escape(line)}</li>' for line in diagnosis.evidence)
    known = "Judged with the truth." if diagnosis.used_truth else "Judged without the truth."
    parts = [
        f'<div>Evidence</div><ul style="margin:.2em 0;padding-left:1.2em">{evidence}</ul>' if evidence else "",
        f'<div style="{DIM}">{known}</div>',
    ]
    return box("".join(parts), "font-size:12px")


def key_step_html(steps: Sequence[StepHeading], key: int, here: int, failed: bool) -> str:
    """At a step before the last: a link to the step at which a run ``failed`` or became doubtful or, at that step, to
    the last one, which says why. ``key`` and ``here`` are indices in ``steps``."""
    last, goes = len(steps) - 1, "goes wrong" if failed else "becomes doubtful"
    if key == last:
        return _pointer(f"Why the run {'failed' if failed else 'is doubtful'}, ", steps[last], "the outcome says")
    if here == key:
        return _pointer(f"Here the run {goes}. ", steps[last], "The outcome says why")
    return _pointer(f"The run {goes} at step {key + 1}: ", steps[key], steps[key].title)


def _pointer(words: str, step: StepHeading, name: str) -> str:
    go = f'<span class="term" role="button" tabindex="0" data-touch="step:{escape(step.key)}">{escape(name)}</span>'
    return box(f'<span style="{DIM}">{escape(words)}</span>{go}.', "font-size:12px")


def _by_label(advice: str) -> str:
    for name, label in OPTIONS.items():
        advice = advice.replace(name, label)
    return advice


HIDDEN = "Answers are hidden"
OFFERS = {"outcome": "Show the outcome", "truth": "Show the truth"}


def hidden_html(withheld: frozenset[str], buttons: bool) -> str:
    """Which answers are hidden, each with a button that shows it."""
    line = HIDDEN if "outcome" in withheld else "The truth is hidden"
    offers = "".join(
        f'<button class="reveal" data-touch="reveal:{answer}">{words}</button>'
        for answer, words in OFFERS.items()
        if answer in withheld and buttons
    )
    told = f'<div class="offered-words"><span style="{DIM}">{line}.</span> {offers}</div>'
    return box(told, "font-size:12px;padding-top:.2em")


def opening_html(label: str) -> str:
    """Text that is shown in place of a run's summary while another scene is opened."""
    words = f"<b>Opening {escape(label)} …</b> What is below still belongs to the scene before."
    return box(words, "font-size:12.5px;padding-top:.2em")


def stale_html() -> str:
    """Text above the summary of a run that is not that of the settings."""
    words = "<b>These settings cannot be run</b>; what is shown is the run before them."
    return box(words, "font-size:12.5px;padding-top:.2em")


def opening_card_html(label: str, words: str, share: float | None) -> str:
    """Has the page's script (``opening.js``) show over the canvas how far the opening of a scene is, 0 to 1, or None
    where that is not known."""
    told = {"title": f"Opening {label} …", "words": words, "share": None if share is None else round(share, 3)}
    return f'<div hidden data-opening="{escape(json.dumps(told))}"></div>'


SOLVED = "solved in "
AGAIN = "this time; the same run made again takes a little more or less"


def summary_of(trace: Trace) -> tuple[str, list[str]]:
    """A run's verdict, and its errors, inliers and time. Without the truth the verdict is what the run is judged as,
    once that is known."""
    metrics = evaluate(trace)
    inliers = int(np.count_nonzero(trace.inlier_mask))
    facts = [f"{inliers} of {len(trace.problem)} inliers", f"{SOLVED}{duration_text(trace.timings_ms['total'])}"]
    if metrics.rotation_error_deg is not None and metrics.translation_error_m is not None:
        facts = [
            angle_text(metrics.rotation_error_deg),
            length(metrics.translation_error_m, trace.problem.metric, extent_of(trace.problem.points)),
            *facts,
        ]
    judged = known_judgement(trace)
    if trace.cam_from_map is not None and metrics.success is None and judged is not None:
        return str(judged.outcome), [*facts, "truth unknown"]
    return verdict(trace, metrics.success), facts


@dataclass(frozen=True)
class ToldBeside:
    """What is told of a run beside its own verdict."""

    cause: str = ""
    """What is wrong with it, if that is to be told."""
    where: str = ""
    """A sentence on where its query was taken."""
    together: SaidTogether | None = None
    """What other queries say of it."""


def summary_html(trace: Trace, beside: ToldBeside = ToldBeside()) -> str:
    """A run in one line, and sentences on where its query was taken and what other queries say of it."""
    cause, together = beside.cause, beside.together
    words, facts = summary_of(trace)
    doubt = ", but in doubt" if cause and words in ("success", Outcome.LOCALIZED) else ""
    told = f"{words.capitalize()}{doubt}: {cause}" if cause else words.capitalize()
    # In a narrow line the time stands alone; under a resting pointer it says what it is the time of.
    shown = (
        f'<span title="{SOLVED.capitalize()}{AGAIN}">{escape(fact.removeprefix(SOLVED))}</span>'
        if fact.startswith(SOLVED)
        else escape(fact)
        for fact in facts
    )
    line = f'<b style="{_value_css(words)}">{escape(told)}</b>'
    if together is not None:
        status = f'<b style="{_value_css(together.status)}">{escape(together.status)}</b>'
        line += f" by itself, {status} in the results of all queries"
    line = " · ".join((line, *shown))
    sentences = (beside.where, "" if together is None else together.why)
    more = "".join(f"<div>{escape(sentence)}</div>" for sentence in sentences if sentence)
    return box(line + more, "font-size:12.5px;padding-top:.2em")


def _value_css(value: object) -> str:
    color = WORDS.get(str(value))
    return f"color:{style.css_text(color)};font-weight:600" if color else "font-variant-numeric:tabular-nums"


def legend_html() -> str:
    """What each colour means."""
    items = "".join(
        '<span style="white-space:nowrap;margin-right:.9em;display:inline-block">'
        f"{dot_html(color)}{escape(meaning)}</span>"
        for color, meaning in style.LEGEND
    )
    return box(items, "font-size:12px")


def dot_html(color: style.RGB) -> str:
    """A dot of a colour before a name."""
    look = "display:inline-block;width:.7em;height:.7em;border-radius:50%;margin-right:.4em"
    return f'<span style="{look};background:{style.css(color)}"></span>'


def ramp_html(best: str, worst: str) -> str:
    """The colours of errors as a bar between two texts."""
    colors = ",".join(style.css(color) for color in style.ERROR_RAMP)
    bar = f'<span style="flex:1;height:.7em;border-radius:.35em;background:linear-gradient(90deg,{colors})"></span>'
    row = f'<span>{escape(best)}</span>{bar}<span style="white-space:nowrap">{escape(worst)}</span>'
    return box(f'<div style="display:flex;align-items:center;gap:.6em">{row}</div>', "font-size:12px")


def status_html(sentence: str, wrong: bool = False) -> str:
    """A line about what the page is doing; red if something went wrong."""
    color = f"color:{style.css_text(style.OUTLIER)}" if wrong else DIM
    return box(f'<div style="{color};overflow-wrap:anywhere">{escape(sentence)}</div>', "font-size:12px")
