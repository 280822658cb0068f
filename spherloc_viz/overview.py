"""What ``spherloc`` prints if no command is named: all of them on one screen, before anything else is imported."""

from collections.abc import Mapping, Sequence

COMMANDS: Mapping[str, Mapping[str, str]] = {
    "Look": {
        "play": "open the playground in a browser",
        "lesson": "list the lessons, or export one as a file",
        "gallery": "run the failures worth seeing, each with its story",
    },
    "Localize": {
        "run": "solve problems and print pose, errors, proof and diagnosis",
        "localize": "localize a sequence of images in a map, by one or several estimators",
        "diagnose": "record and diagnose poses that another program found",
        "map": "make a map of your own photographs",
    },
    "Measure": {
        "sweep": "compare estimators over outlier rate, noise, number of matches or gravity error",
        "verify": "check the paper's claims",
    },
    "Recorded runs": {
        "runs": "list runs: which failed, and of what",
        "steps": "find the steps of runs for which a condition holds",
        "view": "open a recording in the Rerun viewer",
        "compare": "compare two sets of runs: what fails now, what no longer does",
        "rerun": "solve recorded problems again, with other options or another estimator",
        "repeat": "solve a recorded problem again and compare",
        "label": "give recordings labels and a note",
        "reindex": "make a folder's list of runs anew",
        "check-proof": "check the proof of a certificate, with numpy alone",
    },
    "More": {
        "scenes": "list the bundled scenes, or show how a kind of scene file is written",
        "plugins": "list what other packages add",
    },
}
"""Every command in a few words, by what it is for."""
HELP = ("-h", "--help")


def answer(words: Sequence[str]) -> tuple[str, int] | None:
    """What to print at once and the exit code, if the ``words`` of the command line name no command."""
    if not words:
        return overview(), 2
    if len(words) == 1 and words[0] in HELP:
        return overview(), 0
    if list(words) == ["--version"]:
        from importlib.metadata import version

        return f"spherloc {version('spherloc')}", 0
    return None


def overview() -> str:
    """All commands."""
    lines = [
        "usage: spherloc COMMAND ...",
        "",
        "See why visual localization with fisheye and 360-degree cameras succeeds or fails.",
    ]
    for title, commands in COMMANDS.items():
        lines += ["", title, *(f"  {name:<12}  {words}" for name, words in commands.items())]
    lines += [
        "",
        "spherloc COMMAND --help says all of a command; spherloc --version the version.",
        "Begin with: spherloc play",
    ]
    return "\n".join(lines)
