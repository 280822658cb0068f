"""The page of the verification, as Markdown: the claims with their verdicts."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlencode

from spherloc.datasets import load_scene, scene_path
from spherloc.datasets.variation import settings_of
from spherloc.verification.checks import Finding
from spherloc.verification.claims import Checked, Verdict
from spherloc.verification.experiments import EXPERIMENTS, METHODS, SCENES
from spherloc.verification.measured import Place
from spherloc_viz.options import typed

PLAYGROUND = "http://127.0.0.1:8080/"
"""Where ``spherloc play`` listens."""
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
    """The page. ``made`` are the keys of the experiments that were run for it."""
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


def _places(item: Checked) -> list[tuple[str, Place, int]]:
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


def _changes(place: Place) -> list[str]:
    """What is set of the simulation, as "KEY=VALUE"."""
    experiment = next(one for one in EXPERIMENTS if one.key == place.experiment)
    value = f"{int(place.value)}" if experiment.over == "correspondences" else f"{place.value:g}"
    return [*settings_of(experiment.plan(place.camera).variation), f"{experiment.over}={value}"]


def _options(place: Place) -> list[str]:
    return [f"{key}={typed(option)}" for key, option in METHODS[place.method].changes]


def address(place: Place, seed: int) -> str:
    """Of a run on a playground of this machine."""
    pairs = [("v", "1"), ("scene", load_scene(scene_path(Path(SCENES[place.camera]))).name), ("seed", str(seed))]
    pairs += [("set", text) for text in _changes(place)]
    pairs.append(("estimator", METHODS[place.method].estimator))
    pairs += [("option", text) for text in _options(place)]
    return f"{PLAYGROUND}#{urlencode(pairs)}"


def command(place: Place, seed: int) -> str:
    """The same run in a terminal."""
    options = f" --option {' '.join(_options(place))}" if METHODS[place.method].changes else ""
    return (
        f"spherloc run {SCENES[place.camera]} --seed {seed} --set {' '.join(_changes(place))} "
        f"--estimator {METHODS[place.method].estimator}{options}"
    )
