"""``spherloc gallery``: runs the cases, records them, and says whether each fails as it is told."""

import os
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

from spherloc.datasets.map_scene import MapScene
from spherloc.diagnosis import Diagnosis
from spherloc.errors import InputError, RecordingError, show
from spherloc.metrics import evaluate
from spherloc.trace import Trace
from spherloc.warm_up import warm_up
from spherloc_viz.gallery.case import Beside, GalleryCase, Played, faults, origin_of, play
from spherloc_viz.given_files import no_such_name
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.origin import Origin
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import has_review
from spherloc_viz.recording.sandbox.examiner import examine, examine_review

WIDTH = 100
"""Width of stories on a terminal, characters."""


def chosen(cases: Sequence[GalleryCase], keys: Sequence[str]) -> tuple[GalleryCase, ...]:
    """The cases of these keys, or all if there are none. Raises ``InputError`` for an unknown key."""
    by_key = {case.key: case for case in cases}
    for key in keys:
        if key not in by_key:
            error = InputError(f"no case {show(key)} in the gallery; there are {', '.join(by_key)}.")
            raise no_such_name(key, error)
    return tuple(by_key[key] for key in keys) or tuple(cases)


def stories(cases: Sequence[GalleryCase]) -> str:
    """Key, title, cause and story of each case."""
    parts = [
        f"{case.key}: {case.title} ({case.cause}, {case.estimator})\n"
        + textwrap.fill(case.story, WIDTH, initial_indent="  ", subsequent_indent="  ")
        for case in cases
    ]
    return "\n\n".join(parts)


def regenerate(cases: Sequence[GalleryCase], folder: Path, say: Callable[[str], None]) -> int:
    """Run and record the cases and print a line for each; returns how many fail otherwise than they are told.

    ``say`` is told what takes a while, and what is not as it is told. Raises ``RecordingError`` if a recording cannot
    be written, or would replace a file that does not belong to the gallery.
    """
    for case in cases:
        _refuse_other(folder / f"{case.key}.rrd")
    warm_up(say)
    width = max(len(case.key) for case in cases)
    untrue = 0
    for case in cases:
        if isinstance(case.scene, MapScene):
            say(f"{case.key}: drawing and matching images; what is new to this machine takes a while")
        played = play(case)
        files = record(played, folder)
        wrong = list(faults(played))
        for sentence in wrong:
            say(sentence)
        untrue += bool(wrong)
        more = f"  (+{len(files) - 1})" if len(files) > 1 else ""
        line = f"{case.key:<{width}}  {case.cause:<22}  {outcome(played.trace):<22}  {files[0].name}{more}"
        print(line, flush=True)
    return untrue


def _refuse_other(path: Path) -> None:
    """Raise ``RecordingError`` for a file that the gallery has not written."""
    if not os.path.lexists(path):
        return
    try:
        own = examine(path).source == "gallery"
    except RecordingError:
        own = False
    if not own:
        raise RecordingError(f"{path}: exists and does not belong to the gallery; give another --output.")


def record(played: Played, folder: Path) -> list[Path]:
    """Write the recordings of a case, its own first; returns their paths. What a reviewer said of them stays."""
    case = played.case
    files = [folder / f"{case.key}.rrd"]
    _record(files[0], played.trace, case.origin, played.diagnosis)
    for item, trace in played.beside:
        if item.recorded:
            files.append(folder / f"{case.key}_{_file_part(item)}.rrd")
            _record(files[-1], trace, origin_of(item, f"{case.title}: {item.name}", case.story))
    return files


def _record(path: Path, trace: Trace, origin: Origin, diagnosis: Diagnosis | None = None) -> None:
    row = write_recording(trace, path, origin, diagnosis)
    if not has_review(path):
        return
    try:
        review = examine_review(path)
    except RecordingError:
        return  # of labels that cannot be read, lists speak
    # They name the recording by its id, which is another one now.
    write_review(path, review.labels, review.note, row.run_id)


def outcome(trace: Trace) -> str:
    """How far the pose of a run is from the truth."""
    metrics = evaluate(trace)
    if metrics.translation_error_m is None or metrics.rotation_error_deg is None:
        return "no pose"
    return f"{metrics.translation_error_m:.2f} m, {metrics.rotation_error_deg:.2f}° off"


def _file_part(item: Beside) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", item.name)
