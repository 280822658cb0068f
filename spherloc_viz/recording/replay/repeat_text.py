"""Repeats recorded runs and prints what that has shown, for people and as JSON."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from spherloc.errors import InputError, SpherlocError
from spherloc.estimators import warm_up
from spherloc_viz.options import json_text
from spherloc_viz.recording.replay.repeat import Repeated, Solve, repeat


def repeat_all(paths: Sequence[Path], as_json: bool, solve: Solve | None = None) -> int:
    """Repeat recordings and print the outcome of each; returns the exit code.

    0 if all are the same, 1 if one differs, 2 if one cannot be repeated, which is reported while the others still are.
    ``solve`` does it in the place of ``estimate``. Raises ``InputError`` if there is none.
    """
    if not paths:
        raise InputError("no recording given; name one or more files (.rrd).")
    warm_up(_say)
    worst = 0
    for done, path in enumerate(paths):
        try:
            repeated = repeat(path, solve)
        except KeyboardInterrupt:
            _say(f"stopped in {path}; {done} of {len(paths)} recordings were repeated.")
            raise
        except SpherlocError as error:
            _say(str(error))
            worst = 2
            continue
        print(json_text(as_record(repeated)) if as_json else as_text(repeated), flush=True)
        worst = max(worst, 0 if repeated.same else 1)
    return worst


def _say(sentence: str) -> None:
    print(f"spherloc: {sentence}", file=sys.stderr, flush=True)


def as_text(repeated: Repeated) -> str:
    """A few lines; the first says whether it is the same run."""
    run = repeated.run
    what = f"{run.problem.name}, {run.estimator}, seed {run.seed}"
    lines = [f"{repeated.path}: {verdict(repeated)}", f"  {what}"]
    lines += [f"  {item.what}: {item.sentence}" for item in repeated.differences]
    if repeated.assumed:
        lines.append(f"  the recording does not know {', '.join(repeated.assumed)}: taken as by default")
    for item in repeated.versions:
        if repeated.same and item.recorded is None:
            continue  # what an older recording does not say has changed nothing
        lines.append(f"  {item.name}: {item.recorded or 'not recorded'} then, {item.here or 'none'} now")
    # What an untrusted file says must not steer the terminal.
    return "\n".join("".join(letter if letter.isprintable() else " " for letter in line) for line in lines)


def verdict(repeated: Repeated) -> str:
    """Whether it is the same run, as the end of a sentence."""
    if repeated.same:
        return "the same to the last bit"
    return "differs by rounding only" if repeated.rounding else "differs"


def as_record(repeated: Repeated) -> dict[str, Any]:
    """The same as what ``json_text`` writes."""
    run, trace = repeated.run, repeated.trace
    poses = [None if pose is None else pose.tolist() for pose in (run.cam_from_map, trace.cam_from_map)]
    return {
        "recording": str(repeated.path),
        "name": run.problem.name,
        "estimator": run.estimator,
        "seed": run.seed,
        "options": asdict(trace.options),
        "same": repeated.same,
        "rounding": repeated.rounding,
        "differences": [asdict(item) for item in repeated.differences],
        "recorded_cam_from_map": poses[0],
        "cam_from_map": poses[1],
        "assumed_options": list(repeated.assumed),
        "versions": [asdict(item) for item in repeated.versions],
    }
