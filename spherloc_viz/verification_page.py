"""The page of the verification, as Markdown: the claims with their verdicts, the figures, the settings."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import urlencode

import numpy as np

from spherloc.datasets import load_scene, scene_path
from spherloc.datasets.variation import settings_of
from spherloc.experiments.sweep_plan import SweepPlan
from spherloc.types import FloatArray
from spherloc.verification.checks import PAPERS_CAMERA, Finding
from spherloc.verification.claims import Checked, Verdict
from spherloc.verification.experiments import EXPERIMENTS, METHODS, NORMAL, OWN, SCENES
from spherloc.verification.measured import Measured, Place
from spherloc_viz.options import typed

PLAYGROUND = "http://127.0.0.1:8080/"
"""Where ``spherloc play`` listens."""
PHASES = "phases.svg"
"""File of the picture of when to choose which."""
WHEN = f"""\
## When to choose which

![The quickest estimator that is right in 95 % of the problems]({PHASES})

Sec. VI-C.3 takes 2P-RANSAC up to 80 % outliers and MC beyond. Here, as they are in this project: the colour of a cell
is the quickest of ransac-2p (1,000 samples), mc and mc-exact that is right in 95 % of the problems. Where a cell is
grey, chance gives sets of matches as large as the largest that agree (expected false sets of that size: 1 or more), so
no method that counts matches can know the answer.
"""
BESIDE_P3P = """\
## Beside P3P

SVD and MLPnP take 6 matches a sample, the pinhole solvers 5. What gravity is worth shows beside P3P, which takes 3 and
works on the whole sphere: success in % at each outlier rate, the same bound, samples and last step (6 DoF) for all.
"""
WORDS: Mapping[Verdict, str] = {
    Verdict.REPRODUCES: "**reproduces**",
    Verdict.ONLY_IF: "**only if**",
    Verdict.DOES_NOT: "**does not**",
    Verdict.NEEDS_DATA: "data needed",
    Verdict.NOT_RUN: "not run",
}
COUNTED: Mapping[Verdict, str] = {
    Verdict.REPRODUCES: "reproduce",
    Verdict.ONLY_IF: "hold only if something else is chosen",
    Verdict.DOES_NOT: "do not hold",
    Verdict.NEEDS_DATA: "need data that are not bundled",
    Verdict.NOT_RUN: "were not run",
}
Plans = Mapping[tuple[str, str], SweepPlan]
PAPER = "Robust Vehicle Localization for Spherical Camera Models: Solution, Framework, and Verification"
HEAD = f"""\
# Verification of the paper

Every claim, figure and table of *{PAPER}*, as it comes out here. `spherloc verify` makes this page anew: about an
hour on two cores, two minutes with `--quick`; it goes on where it was stopped.

**As printed** means Algorithms 1 and 2 with nothing added: a bound of 8 px, all pairs of the rotation clique, the exact
maximum clique, one 6-DoF fit without gravity as the last step, and |t_true − t| as the error. Where the paper leaves a
choice open, the one that serves it best is taken: the position of MC is the mean of its clique's balls weighted by
radius<sup>−2</sup> (the plain mean fails far more often), and its last step fits the matches that this pose explains
(fitting all matches of the clique's pairs fails at 50 % outliers already, since nearly every match is in some pair).

A claim *reproduces* if it holds as printed, *only if* something else is chosen if it holds then, and else *does not*. A
rate holds if Fisher's exact test at 5 %, shared by the points of a claim, does not tell the paper's 100 runs from ours;
an order of two methods if Wilcoxon's signed-rank test on the same problems shows it. Rates come with 95 % Wilson
intervals.

*Run* opens the run that decides the claim, in the playground that `spherloc play` has opened at port 8080. What is
printed wrongly in the paper's formulas is in the [errata](../errata.md).
"""


def verification_page(
    checked: Sequence[Checked],
    measured: Measured,
    plans: Plans,
    pictures: Mapping[tuple[str, str], str],
    tables: str,
    quick: bool,
) -> str:
    """The page. ``pictures`` are names of files beside it, by key of experiment and camera; ``tables`` are those of
    ``verification_datasets``."""
    parts = [HEAD]
    if quick:
        parts.append("!!! warning\n    This is the quick form, with few runs: its intervals are wide.\n")
    parts.append(_counts(checked))
    parts.append(_table(checked, plans))
    parts += [_figure(key, name, plans[key]) for key, name in pictures.items()]
    if any(experiment.startswith("phase-") for experiment, _ in plans):
        parts.append(WHEN)
    parts.append(_beside_p3p(measured))
    parts.append(_cases(measured))
    parts.append(tables)
    parts.append(_settings(plans))
    return "\n".join(parts)


def _counts(checked: Sequence[Checked]) -> str:
    found = Counter(item.verdict for item in checked)
    words = [f"{found[verdict]} {many}" for verdict, many in COUNTED.items() if found[verdict]]
    return f"Of {len(checked)} claims {', '.join(words)}.\n"


def _table(checked: Sequence[Checked], plans: Plans) -> str:
    lines = [
        "## Claims\n",
        "| where | claim | paper | here | verdict | run |",
        "|---|---|---|---|---|---|",
    ]
    for item in checked:
        here = "" if item.printed is None else item.printed.ours
        if item.other is not None:
            here += f"<br>under the condition: {item.other.ours}"
        if item.claim.note:
            here += f"{'<br>' if here else ''}*{item.claim.note}*"
        verdict = f"{WORDS[item.verdict]} {item.condition}".strip()
        cells = (item.claim.place, item.claim.sentence, item.claim.paper, here, verdict, _links(item, plans))
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _links(item: Checked, plans: Plans) -> str:
    found = [
        f"[{words}]({link})"
        for words, finding in (("as printed", item.printed), ("under the condition", item.other))
        if finding is not None and (link := _link(finding, plans))
    ]
    return "<br>".join(found)


def _link(finding: Finding, plans: Plans) -> str:
    """The address of the deciding run on a playground of this machine."""
    place = finding.decided_by
    if place is None:
        return ""
    entrant = METHODS[place.method]
    pairs = [("v", "1"), ("scene", load_scene(_path(place)).name), ("seed", str(finding.seed))]
    plan = plans[place.experiment, place.camera]
    pairs += [("set", text) for text in settings_of(plan.variation)]
    value = f"{int(place.value)}" if plan.over == "correspondences" else f"{place.value:g}"
    pairs.append(("set", f"{plan.over}={value}"))
    pairs.append(("estimator", entrant.estimator))
    pairs += [("option", f"{key}={typed(option)}") for key, option in entrant.changes]
    return f"{PLAYGROUND}#{urlencode(pairs)}"


def _path(place: Place) -> Path:
    return scene_path(Path(SCENES[place.camera]))


def _figure(key: tuple[str, str], name: str, plan: SweepPlan) -> str:
    experiment, camera = key
    title = next(item.place for item in EXPERIMENTS if item.key == experiment)
    words = (
        "boxes: quartiles; whiskers: 5 to 95 %"
        if experiment == "fig5"
        else ("solid: as printed; dashed: this project's own forms; bands: 95 % Wilson intervals")
    )
    title = title if camera == NORMAL else f"{title}, {camera}"
    return f"## {title}\n\n![{title}]({name})\n\n{plan.runs} problems at each point; {words}.\n"


def _beside_p3p(measured: Measured) -> str:
    """Success of 2P and of the 6-DoF solvers, P3P among them, at equal numbers of samples."""
    parts: list[str] = []
    for paper, own, names in (
        ("fig6", "p3p-fig6", ("2P100", "P3P100", "SVD100", "ML100", "2P1k", "P3P1k", "ML1k")),
        ("fig7", "p3p-fig7", ("2P1k", "P3P1k", "2P10k", "P3P10k", "SVD10k", "ML10k")),
    ):
        values = measured.values(own, PAPERS_CAMERA)
        if not values:
            continue
        count = next(item.correspondences for item in EXPERIMENTS if item.key == own)
        parts.append(f"| {count} matches | " + " | ".join(f"{100 * value:g} %" for value in values) + " |")
        parts.append("|---|" + "---|" * len(values))
        for name in names:
            key = own if name.startswith("P3P") else paper
            cells = [measured.cell(key, PAPERS_CAMERA, name, value) for value in values]
            rates = ["–" if cell is None else f"{100 * cell.rate:.0f}" for cell in cells]
            if any(cells):
                parts.append(f"| {name} | {' | '.join(rates)} |")
        parts.append("")
    return "\n".join([BESIDE_P3P, *parts]) if parts else ""


def _cases(measured: Measured) -> str:
    """Table VI as success over seeds."""
    keys = [item.key for item in EXPERIMENTS if item.place == "Table VI"]
    found = {key: _methods_of_case(measured, key) for key in keys}
    names = [name for name in METHODS if any(name in there for there in found.values())]
    if not names:
        return ""
    lines = [
        "## Table VI, over seeds\n",
        "The paper shows one problem for each case. Here are random ones with the same numbers of matches and of",
        "right ones: how often each method finds the pose within 1° and 0.1 m, and the quartiles of its error. R+*",
        "draw 10,000 samples by EPnP and see the matches within a rectified view of 120° only; R+EPro is EPro-PnP's",
        "solver with equal weights, since the learned ones are not published for these features. The noise is 3 px:",
        "the default bound of mc and mc-exact, 3 px, cuts right matches off, and 8 px does not.\n",
        "| method | " + " | ".join(f"case {number}: success | error (m)" for number in range(1, len(keys) + 1)) + " |",
        "|---|" + "---|---|" * len(keys),
    ]
    for name in names:
        row = [name]
        for key in keys:
            cells = measured.curve(key, "Kannala-Brandt", name) or measured.curve(key + OWN, "Kannala-Brandt", name)
            if not cells:
                row += ["–", "–"]
                continue
            low, high = cells[0].interval
            row.append(f"{100 * cells[0].rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
            row.append(_quartiles(cells[0].values("t_error_m")))
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def _methods_of_case(measured: Measured, key: str) -> tuple[str, ...]:
    return measured.methods(key, "Kannala-Brandt") + measured.methods(key + OWN, "Kannala-Brandt")


def _quartiles(values: FloatArray) -> str:
    found = np.quantile(values, [0.25, 0.5, 0.75], method="inverted_cdf")
    return ", ".join(f"{value:.2g}" if np.isfinite(value) else "no pose" for value in found)


def _settings(plans: Plans) -> str:
    lines = ["## Settings\n"]
    lines.append("| experiment | camera | over | set | problems a point | seeds | methods |")
    lines.append("|---|---|---|---|---|---|---|")
    names = {entrant.label: name for name, entrant in METHODS.items()}
    for (experiment, camera), plan in plans.items():
        values = f"{plan.over} {', '.join(f'{value:g}' for value in plan.values)}"
        settings = ", ".join(settings_of(plan.variation))
        seeds = f"{plan.first_seed} to {plan.first_seed + plan.runs - 1}"
        methods = ", ".join(names[label] for label in plan.labels)
        lines.append(f"| {experiment} | {camera} | {values} | {settings} | {plan.runs} | {seeds} | {methods} |")
    lines.append("\n| method | estimator and options |\n|---|---|")
    lines += [f"| {name} | `{entrant.label}` |" for name, entrant in METHODS.items()]
    return "\n".join(lines) + "\n"
