"""Ctrl-C ends a long search at once, with a sentence, and a long search says how far it is."""

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from recording_samples import scene_problem

from spherloc.datasets import load_scene
from spherloc.datasets.variation import Variation
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc_viz.commands.progress import solve
from spherloc_viz.recording.content.writer import write_recording
from tests.waiting import LIMIT_S

ROOT = Path(__file__).resolve().parents[1]
MAX_ITERATIONS = 10_000_000

PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # programs in the background begin without it
from spherloc_viz.commands import progress
from spherloc_viz.commands.cli import main
progress.LINE_EVERY_S = 0.05
main()
"""


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose options ask for as much work as can be, which takes many minutes."""
    problem = Variation(correspondences=5000).problem(load_scene(ROOT / "scenes" / "mei_outliers_90.toml"), 7)
    kind = options_type("ransac-2p")
    trace = estimate(problem, "ransac-2p", kind(iterations=10))
    path = tmp_path_factory.mktemp("endless") / "a.rrd"
    write_recording(replace(trace, options=kind(iterations=MAX_ITERATIONS)), path)
    return path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("repeat",), "0 of 1 recordings were repeated."),
        (
            ("run", "--no-record", "--estimator", "ransac-2p", "--option", f"iterations={MAX_ITERATIONS}"),
            "0 of 1 scenes were solved.",
        ),
    ],
)
def test_ctrl_c_ends_a_search_that_says_how_far_it_is(endless: Path, words: tuple[str, ...], said: str) -> None:
    command = [sys.executable, "-c", PROGRAM, words[0], str(endless), *words[1:]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        assert program.stderr is not None
        while "ransac-2p is at" not in (line := program.stderr.readline()):
            assert line, "it ended by itself"
        program.send_signal(signal.SIGINT)
        out, rest = program.communicate(timeout=LIMIT_S)
    assert program.returncode == 130 and out == ""
    assert rest.splitlines()[-1] == f"spherloc: stopped in {endless}; {said}"
    assert "Traceback" not in rest


def test_who_is_not_interrupted_gets_the_run_and_its_errors() -> None:
    problem = scene_problem("mei_outliers_80")
    options = options_type("mc")()
    assert solve(problem, "mc", options, 3).message == estimate(problem, "mc", options, 3).message
    with pytest.raises(InputError, match="unknown estimator"):
        solve(problem, "magic", options, 3)


def test_a_thread_inside_opencv_is_no_reason_to_abort() -> None:
    """Python stops such a thread at its end, and OpenCV cannot be stopped."""
    program = """
import sys, threading
import cv2, numpy as np
def blur():
    image = np.zeros((500, 500), np.uint8)
    while True:
        cv2.GaussianBlur(image, (0, 0), 5)
threading.Thread(target=blur, daemon=True).start()
threading.Thread(target=threading.Event().wait).start()  # one that would be waited for, for ever
from spherloc_viz.start import main
sys.argv = ["spherloc", "scenes"]
main()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT_S)
    assert (done.returncode, done.stderr) == (0, "")
    assert "street_fisheye" in done.stdout
