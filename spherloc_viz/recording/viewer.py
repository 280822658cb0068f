"""Opens a recording in a window of the Rerun viewer, paused at a step."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

from spherloc.errors import InputError, RecordingError
from spherloc_viz.recording.content.names import TIMELINE
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.reviews import Review, review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.sandbox.examiner import examine_review

HOST = "127.0.0.1"
TRIES = 300
PAUSE_S = 0.2
"""Seconds between two tries to set the step of a viewer that is starting: a minute in all."""


def step_of(row: RunRow, request: int | None) -> int:
    """The number of the step to open a run at, from 1: the one that is asked for, else the key step.

    Recordings of the first version do not say how many steps they have. Raises ``InputError`` if there is no such step.
    """
    if request is None:
        return row.key_step + 1
    if request < 1 or (row.steps and request > row.steps):
        steps = "only step 1" if row.steps == 1 else f"steps 1 to {row.steps}"
        raise InputError(f"{row.file}: there is no step {request}; the run has {steps}.")
    return request


def labels_of(recording: Path, run_id: str) -> Path | None:
    """The file with the labels and the note of a run, which a viewer shows as a part of its recording; None without.

    Raises ``RecordingError`` if the file is damaged, or belongs to another run, which would cover this one.
    """
    path = review_path(recording)
    if examine_review(recording) == Review():
        return None
    # Here, since rerun takes a quarter of a second to import: a page should not wait for it.
    from rerun.chunk import RrdReader

    if {entry.recording_id for entry in RrdReader(path).recordings()} != {run_id}:
        raise RecordingError(f"{path}: labels and note of another run; delete the file and label this one.")
    return path


def view_in_window(path: Path, row: RunRow, step: int) -> None:
    """Open a recording, with its labels and note, paused at a step (from 1), and return when the window is closed.

    Raises ``RecordingError`` if the viewer cannot open, or cannot show the labels.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RecordingError(f"{path.name}: there is no display to open a window on; add --web to use a browser.")
    files = [str(file.resolve()) for file in (path, labels_of(path, row.run_id)) if file is not None]
    with socket.create_server((HOST, 0)) as free:
        port = free.getsockname()[1]
    # The port is for programs that control the viewer, as this one does: no other machine should reach it.
    command = [*rerun_command(), "--bind", HOST, "--port", str(port), *files]
    with subprocess.Popen(command, env=rerun_environment()) as viewer:
        stand_at(viewer, f"rerun+http://{HOST}:{port}/proxy", row.on_timeline(step))
        if viewer.wait():
            raise RecordingError(f"{path.name}: the Rerun viewer has failed; add --web to use a browser instead.")


def stand_at(viewer: subprocess.Popen[bytes], address: str, place: int) -> bool:
    """Tell a viewer that is starting to pause at a place of the timeline as soon as it has its recording; False if it
    never takes it."""
    from rerun.experimental import ViewerClient  # here for the same reason

    for _ in range(TRIES):
        if viewer.poll() is not None:
            return False
        with contextlib.suppress(Exception):  # errors of many kinds, all of which mean that the viewer is not ready
            ViewerClient.connect(address).set_time(TIMELINE, sequence=place, play_state="paused")
            return True
        time.sleep(PAUSE_S)
    return False
