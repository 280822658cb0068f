"""The pages of the verification, as Markdown: the claims with their verdicts, and those beside it."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlencode

import numpy as np

from spherloc.datasets import load_scene, scene_path
from spherloc.datasets.variation import settings_of
from spherloc.experiments.sweep_plan import SweepPlan
from spherloc.solvers.epnp import VirtualPinhole
from spherloc.types import FloatArray, IntArray
from spherloc.verification.checks import PAPERS_CAMERA, Finding
from spherloc.verification.claims import Checked, Verdict
from spherloc.verification.experiments import (
    CASES,
    EXPERIMENTS,
    METHODS,
    NORMAL,
    OWN,
    SCENES,
    WIDE_SOLVERS,
    WIDE_VIEW,
)
from spherloc.verification.measured import Cell, Measured, SweepPoint, succeeded
from spherloc_viz.options import typed

PLAYGROUND = "http://127.0.0.1:8080/"
"""Address of ``spherloc play`` in the links of the page."""
WORDS: dict[Verdict, str] = {
    Verdict.REPRODUCES: "**reproduces**",
    Verdict.ONLY_IF: "**only if**",
    Verdict.DOES_NOT: "**does not**",
    Verdict.NEEDS_DATA: "data needed",
    Verdict.NOT_RUN: "not run",
}
COUNTED: dict[Verdict, str] = {
    Verdict.REPRODUCES: "reproduce",
    Verdict.ONLY_IF: "hold only if something else is chosen",
    Verdict.DOES_NOT: "do not hold",
    Verdict.NEEDS_DATA: "need data that are not bundled",
    Verdict.NOT_RUN: "were not run",
}
PAPER = "Robust Vehicle Localization for Spherical Camera Models: Solution, Framework, and Verification"
QUICK = "!!! warning\n    This is the quick form, with few runs: its intervals are wide.\n"
HEAD = f"""\
# Verification of the paper

Every claim, figure and table of *{PAPER}*, as it comes out here. `spherloc verify` makes these pages anew: about an
hour on two cores, two minutes with `--quick`; it goes on where it was stopped, and `--only` makes a part of them.

**As printed** means Algorithms 1 and 2 with nothing added: a bound of 8 px, all pairs of the rotation clique, the exact
maximum clique, one 6-DoF fit without gravity as the last step, and |t_true − t| as the error. Where the paper leaves a
choice open, the one that serves it best is taken: the position of MC is the mean of its clique's balls weighted by
radius<sup>−2</sup> (the plain mean fails far more often), and its last step fits the matches that this pose explains
(fitting all matches of the clique's pairs fails at 50 % outliers already, since nearly every match is in some pair).

A claim *reproduces* if it holds as printed, *only if* something else is chosen if it holds then, and else *does not*. A
rate holds if Fisher's exact test at 5 %, shared by the points of a claim, does not tell the paper's 100 runs from ours;
an order of two methods if Wilcoxon's signed-rank test on the same problems shows it. Rates come with 95 % Wilson
intervals.

*Run* opens the run that decides the claim, in the playground that `spherloc play` has opened on this machine (at port
8080; after `spherloc play --port 9000`, write 9000 into the address). The same runs [as commands](#the-deciding-runs)
need no browser; `spherloc play` lists what they recorded.

| page | of the paper |
|---|---|
| [Figures](figures.md) | Figs. 5 to 7 through three cameras, with normal draws, and P3P beside them |
| [Table VI](table6.md) | its three problems, over 100 seeds each |
| [Tables](tables.md) | Tables I to VI as printed, what the text says of them, and your copies of the datasets |
| [Baselines](baselines.md) | the compared methods with wide views, sampling of their own and under equal terms |
| [Precision](precision.md) | each baseline's solver beside OpenCV, PoseLib and what its authors print |
| [Choice](choice.md) | which framework when (Sec. VI-C), and where no method can know |
| [Applications](applications.md) | MC that initialises and 2P that tracks, vehicle poses, Figs. 8 to 10 |
| [Numbers](numbers.md) | every number of the paper, and where it is |
| [Errata](../errata.md) | what is printed wrongly in its formulas |
"""


def verification_page(checked: Sequence[Checked], quick: bool, made: Sequence[str]) -> str:
    """The page of the claims. ``made`` are the keys of the experiments that were run for it."""
    parts = [HEAD]
    if quick:
        parts.append(QUICK)
    parts.append(_counts(checked))
    if any(item.earlier for item in checked):
        parts.append(
            "Findings marked ° are those of an earlier whole run, maybe of older code: this time only "
            f"{', '.join(made) or 'nothing'} was run.\n"
        )
    parts += [_table(checked), _commands(checked)]
    return "\n".join(parts)


def _counts(checked: Sequence[Checked]) -> str:
    found = Counter(item.verdict for item in checked)
    words = [f"{found[verdict]} {many}" for verdict, many in COUNTED.items() if found[verdict]]
    return f"Of {len(checked)} claims {', '.join(words)}.\n"


def _table(checked: Sequence[Checked]) -> str:
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
        verdict = f"{WORDS[item.verdict]}{'°' if item.earlier else ''} {item.condition}".strip()
        cells = (item.claim.place, item.claim.sentence, item.claim.paper, here, verdict, _links(item))
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _places(item: Checked) -> list[tuple[str, SweepPoint, int]]:
    """The deciding runs: in which form, where and the seed."""
    forms: list[tuple[str, Finding | None]] = [("as printed", item.printed), ("under the condition", item.other)]
    return [
        (words, finding.decided_by, finding.seed)
        for words, finding in forms
        if finding is not None and finding.decided_by is not None
    ]


def _links(item: Checked) -> str:
    return "<br>".join(f"[{words}]({address(place, seed)})" for words, place, seed in _places(item))


def _commands(checked: Sequence[Checked]) -> str:
    lines = ["## The deciding runs\n", "```sh"]
    for item in checked:
        for words, place, seed in _places(item):
            lines += [f"# {item.claim.place}: {item.claim.sentence} ({words})", command(place, seed), ""]
    return "\n".join([*lines[:-1], "```", ""])


def _changes(place: SweepPoint) -> list[str]:
    """Settings of the simulation at a place, as "KEY=VALUE"."""
    experiment = next(one for one in EXPERIMENTS if one.key == place.experiment)
    value = f"{int(place.value)}" if experiment.over == "correspondences" else f"{place.value:g}"
    return [*settings_of(experiment.plan(place.camera).variation), f"{experiment.over}={value}"]


def _options(place: SweepPoint) -> list[str]:
    return [f"{key}={typed(option)}" for key, option in METHODS[place.method].changes]


def address(place: SweepPoint, seed: int) -> str:
    """Address of a run on a playground of this machine."""
    pairs = [("v", "1"), ("scene", load_scene(scene_path(Path(SCENES[place.camera]))).name), ("seed", str(seed))]
    pairs += [("set", text) for text in _changes(place)]
    pairs.append(("estimator", METHODS[place.method].estimator))
    pairs += [("option", text) for text in _options(place)]
    return f"{PLAYGROUND}#{urlencode(pairs)}"


def command(place: SweepPoint, seed: int) -> str:
    """Command that does the same run in a terminal."""
    options = f" --option {' '.join(_options(place))}" if METHODS[place.method].changes else ""
    return (
        f"spherloc run {SCENES[place.camera]} --seed {seed} --set {' '.join(_changes(place))} "
        f"--estimator {METHODS[place.method].estimator}{options}"
    )


PHASES = "phases.svg"
"""File of the picture of when to choose which."""
CASE_CAMERA = "Kannala-Brandt"
WIDE_KEYS = ("wide-fig6", "alike")
"""Experiments of the page of the baselines, besides those whose keys end in ``WIDE_VIEW``."""
ENOUGH = 6
"""Number of right matches that a pinhole solver must see to have a chance: the least number for oDLT."""

WHEN = f"""\
# When to choose which framework

![The quickest estimator that is right in 95 % of the problems]({PHASES})

Sec. VI-C.3 takes 2P-RANSAC up to 80 % outliers and MC beyond. Here, as they are in this project: the colour of a cell
is the quickest of ransac-2p (1,000 samples), mc and mc-exact that is right in 95 % of the problems. Where a cell is
grey, chance gives sets of matches as large as the largest that agree (an NFA of 1 or more), so
no method that counts matches can know the answer.
"""
BESIDE_P3P = """\
## Beside P3P

SVD and MLPnP take 6 matches a sample, the pinhole solvers 5. What gravity is worth shows beside P3P, which takes 3 and
works on the whole sphere: success in % at each outlier rate, the same bound, samples and last step (6 DoF) for all.
"""

Plans = Mapping[tuple[str, str], SweepPlan]
"""Plans by the keys of experiment and camera."""


Page = str
"""Text of a page in Markdown."""


def part_pages(
    measured: Measured, plans: Plans, pictures: Mapping[tuple[str, str], str], quick: bool
) -> dict[str, str]:
    """The pages by file name; a page is made if one of its experiments is among the ``plans``.

    ``pictures`` are names of files beside them, by key of experiment and camera.
    """
    found = {
        "figures.md": "\n".join(
            [
                "# Figures 5 to 7\n",
                *(_figure(key, name, plans[key]) for key, name in pictures.items()),
                _beside_p3p(measured),
            ]
        ),
        "table6.md": _cases(measured),
        "choice.md": WHEN,
        "baselines.md": _baselines(measured),
    }
    pages: dict[str, str] = {}
    for file, text in found.items():
        own = {key: plan for key, plan in plans.items() if _file_of(key[0]) == file}
        if own:
            title, _, rest = text.partition("\n")
            pages[file] = "\n".join([title, "", *([QUICK] if quick else []), rest.strip("\n"), "", settings_table(own)])
    return pages


def _file_of(experiment: str) -> str:
    """The page of an experiment."""
    if experiment.startswith("phase-"):
        return "choice.md"
    if experiment.endswith(WIDE_VIEW) or experiment in WIDE_KEYS:
        return "baselines.md"
    return "table6.md" if experiment.startswith("case") else "figures.md"


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


BASELINES = """\
# Baselines

The paper gives EPnP, EPro-PnP and oDLT a rectified image whose field of view it does not print (Sec. VI-B.3; 120° is
taken for R+* on these pages), and lets EPnP draw their samples of five. That loses most matches of a wide camera. Here
they get what their authors would give them: **P3P for the samples** (three matches, compiled), their own solver for all
inliers of the best sample, and a view of **174°** or the **whole sphere**, where the equations are those of bearings
and nothing is rectified. Bound (8 px), number of samples and last step (6 DoF) are the same for all.

EPro-PnP is its solver alone: the **weights that its network learns are missing**, all matches weigh the same. MLPnP is
with the covariances of its bearings where "cov" or "alike" says so.
"""


def _baselines(measured: Measured) -> str:
    parts = [BASELINES]
    parts.append(_rates(measured, "wide-fig6", "## Fig. 6 with wide views: success (%) of 1,000 samples, 100 matches"))
    parts.append(
        _rates(
            measured,
            "alike",
            "## Under equal terms: success (%) and median time",
            "Every method stops at 99.9 % confidence of a clean sample (Eq. 28 with its own sample size), after 10,000 "
            "samples at most, fits the inliers of each improvement by its own solver (P3P by MLPnP), and ends as "
            "Algorithm 1 does. All work on the whole sphere in compiled loops (SVD and MLPnP solve 128 samples at "
            "once by LAPACK), so that their times may be compared: the same problems, workers beside each other "
            "on one machine.",
            times=True,
        )
    )
    if not measured.methods("alike", PAPERS_CAMERA):
        parts.append("## Under equal terms\n\nNot run for this page: `spherloc verify --only alike` adds it.\n")
    parts.append(_wide_cases(measured))
    return "\n".join(part for part in parts if part)


def _rates(measured: Measured, key: str, title: str, words: str = "", times: bool = False) -> str:
    """Table of the success of every method at every value, with Wilson's interval and the time at the last one."""
    values, names = measured.values(key, PAPERS_CAMERA), measured.methods(key, PAPERS_CAMERA)
    if not names:
        return ""
    columns = [f"{100 * value:g} %" for value in values]
    counts = sorted({cell.runs for name in names for cell in measured.curve(key, PAPERS_CAMERA, name)})
    done = f"{counts[0]}" + (f" to {counts[-1]}" if counts[1:] else "")
    lines = [f"{title}\n", *([words + "\n"] if words else []), f"{done} problems at each point.\n"]
    lines.append("| outliers | " + " | ".join(columns) + " |")
    lines.append("|---|" + "---|" * len(values))
    for name in names:
        cells = [measured.cell(key, PAPERS_CAMERA, name, value) for value in values]
        lines.append(f"| {name} | " + " | ".join(_rate(cell, times) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _rate(cell: Cell | None, time: bool) -> str:
    if cell is None:
        return "–"
    low, high = cell.interval
    took = f", {cell.median('time_ms'):.3g} ms" if time else ""
    return f"{100 * cell.rate:.0f} ({100 * low:.0f}–{100 * high:.0f}){took}"


def _wide_cases(measured: Measured) -> str:
    """Table VI for the baselines with wide views, and the numbers of matches in each view."""
    lines = ["## Table VI with wide views\n"]
    lines.append(
        "Success within 1° and 0.1 m, 10,000 samples; random problems with the numbers of Table VI, 3 px of noise.\n"
    )
    lines.append(_case_table(measured, {key: (key + WIDE_VIEW,) for key in CASES}))
    if len(lines[-1].splitlines()) <= 2:
        return ""
    lines.append("What a view sees of these problems, and success among those that have six right matches in it:\n")
    lines.append("| view | case | matches seen (median) | right ones seen (median) | problems with 6 right ones seen |")
    lines.append("|---|---|---|---|---|")
    seen = {(key, deg): _seen(key, deg) for key in CASES for deg in (120.0, 174.0)}
    for (key, deg), (all_seen, right_seen) in seen.items():
        enough = int(np.count_nonzero(right_seen >= ENOUGH))
        lines.append(
            f"| {deg:g}° | {key} | {np.median(all_seen):.0f} of {CASES[key][1]} | {np.median(right_seen):.0f} of "
            f"{CASES[key][0]} | {enough} of {len(right_seen)} |"
        )
    lines.append("\n| success of those visible | " + " | ".join(CASES) + " |")
    lines.append("|---|" + "---|" * len(CASES))
    for name, (_, deg) in WIDE_SOLVERS.items():
        row = [name]
        for key in CASES:
            cells = measured.curve(key + WIDE_VIEW, CASE_CAMERA, f"{name}, 10k")
            if not cells:
                row.append("–")
                continue
            right = seen[key, deg][1] if (key, deg) in seen else None
            rows = [line for line in cells[0].rows if right is None or right[line.seed] >= ENOUGH]
            row.append(f"{sum(succeeded(line) for line in rows)} of {len(rows)}")
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def _seen(key: str, view_deg: float) -> tuple[IntArray, IntArray]:
    """Numbers of matches, and of right ones, inside a view, for each problem of a case."""
    experiment = next(item for item in EXPERIMENTS if item.key == key + WIDE_VIEW)
    scene = load_scene(scene_path(Path(SCENES[CASE_CAMERA])))
    variation = replace(experiment.variation, correspondences=int(experiment.values[0]))
    found = []
    for seed in range(experiment.runs):
        problem = variation.problem(scene, seed)
        mask = VirtualPinhole(view_deg).sees(problem.bearings)
        assert problem.truth_inliers is not None
        found.append((np.count_nonzero(mask), np.count_nonzero(mask & problem.truth_inliers)))
    everything, right = np.array(found, dtype=np.int64).T
    return everything, right


CASE_WORDS = """\
# Table VI, over seeds

The paper shows one problem for each case. Here are random ones with the same numbers of matches and of right ones: how
often each method finds the pose within 1° and 0.1 m, and the quartiles of its error. Numbers behind a name are samples;
R+* draw 10,000 by EPnP and see the matches within a rectified view of 120° only, see [Baselines](baselines.md) for
wider ones. R+EPro is EPro-PnP's solver with equal weights, since the learned ones are not published for these features.
The noise is 3 px: the default bound of mc and mc-exact, 3 px, cuts right matches off, and 8 px does not.
"""


def _cases(measured: Measured) -> str:
    """Table VI as success over seeds."""
    return CASE_WORDS + "\n" + _case_table(measured, {key: (key, key + OWN) for key in CASES})


def _case_table(measured: Measured, keys: Mapping[str, Sequence[str]]) -> str:
    """Success and error of every method in the cases, each found in the experiments of these keys."""
    there = {name for several in keys.values() for key in several for name in measured.methods(key, CASE_CAMERA)}
    lines = [
        "| method | " + " | ".join(f"case {number}: success | error (m)" for number in range(1, len(keys) + 1)) + " |",
        "|---|" + "---|---|" * len(keys),
    ]
    for name in (name for name in METHODS if name in there):
        row = [name]
        for several in keys.values():
            cells = [cell for key in several for cell in measured.curve(key, CASE_CAMERA, name)]
            if not cells:
                row += ["–", "–"]
                continue
            low, high = cells[0].interval
            row.append(f"{100 * cells[0].rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})")
            row.append(_quartiles(cells[0].values("t_error_m")))
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def _quartiles(values: FloatArray) -> str:
    found = np.quantile(values, [0.25, 0.5, 0.75], method="inverted_cdf")
    return ", ".join(f"{value:.2g}" if np.isfinite(value) else "no pose" for value in found)


def settings_table(plans: Plans) -> str:
    """The exact settings of the runs: values, seeds, methods with their options."""
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
    used = {label for plan in plans.values() for label in plan.labels}
    lines += [f"| {name} | `{entrant.label}` |" for name, entrant in METHODS.items() if entrant.label in used]
    return "\n".join(lines) + "\n"
