"""Start of the command line, before anything large is imported: lists all commands on one screen if none is named."""

import atexit
import difflib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from spherloc_viz.importing import importing


def main() -> None:
    """Entry point of ``spherloc``.

    Ctrl-C ends it without a word as long as it has nothing to keep, while it is importing and after its work is done.
    """
    _fill_standard_streams()
    # Where something else runs, threads of OpenBLAS wait for each other: a fit of a lens took six times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    told = answer(sys.argv[1:])
    if told is not None:
        _print(told[0])
        sys.exit(told[1])
    heard = signal.getsignal(signal.SIGINT)
    if heard is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        with importing():
            from spherloc_viz.commands import cli
    except OSError as error:  # no folder for temporary files
        why = f"cannot start ({error.strerror}); make room on the disk, or set TMPDIR to another folder."
        print(f"spherloc: {why}", file=sys.stderr)
        sys.exit(2)
    signal.signal(signal.SIGINT, heard)
    try:
        cli.main()
    except SystemExit as ended:
        if heard is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        if isinstance(ended.code, int):
            _end_with_threads(ended.code)
        raise


def _end_with_threads(code: int) -> None:
    """End the process if other threads are still at work; all that is worth keeping is on the disk.

    Python itself would wait for those of pools, and before 3.14 stop the others where they next need its lock, which
    aborts the process if C++ called them, as OpenCV and COLMAP do.
    """
    if threading.active_count() > 1:
        atexit._run_exitfuncs()
        os._exit(code)


def _print(text: str) -> None:
    """Print without a buffer, so that nothing is left to be written when Python ends; exits if that fails."""
    try:
        os.write(sys.stdout.fileno(), f"{text}\n".encode())
    except BrokenPipeError:
        sys.exit(141)
    except OSError as error:
        print(f"spherloc: the output cannot be written ({error.strerror}); check the disk.", file=sys.stderr)
        sys.exit(2)


def _fill_standard_streams() -> None:
    """Put the null device where a standard stream is closed: else the next file that is opened would get its number,
    and what is printed would be written into it."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
            if opened != number:
                os.dup2(opened, number)
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="backslashreplace"))


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
    if not words[0].startswith("-") and not any(words[0] in commands for commands in COMMANDS.values()):
        return f"spherloc: {_no_command(words)}", 2
    if list(words) == ["--version"]:
        from importlib.metadata import version

        return f"spherloc {version('spherloc')}", 0
    return None


def _no_command(words: Sequence[str]) -> str:
    """What may have been meant where the first word is no command."""
    known = [name for commands in COMMANDS.values() for name in commands]
    near = difflib.get_close_matches(words[0], known, 1)
    places = [word for word in words if word and Path(word).exists()]
    if places and not near:
        from spherloc.datasets.given_path import what_it_is  # only where it is needed: it takes a tenth of a second
        from spherloc_viz.given_files import is_recording

        path = Path(places[0])
        if not is_recording(path) and (told := what_it_is(path)):
            return told
        return f"{words[0]!r} is no command; to open {places[0]!r}: spherloc play {shlex.quote(places[0])}"
    meant = f"did you mean {near[0]!r}? " if near else ""
    return f"{words[0]!r} is no command; {meant}spherloc alone lists all commands."


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
