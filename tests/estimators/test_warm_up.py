"""Nobody waits for a compiler once the kernels are warm."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from spherloc.warm_up import SHARED, _compile_in_order, warm_up
from tests.waiting import LIMIT_S

SCRIPT = """
import importlib, pkgutil, numba
import spherloc
from spherloc import registry
from spherloc.diagnosis import diagnose
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.estimators import estimate
from spherloc.warm_up import warm_up

def compiled():
    found = {}
    for module in pkgutil.walk_packages(spherloc.__path__, "spherloc."):
        for name, item in vars(importlib.import_module(module.name)).items():
            if isinstance(item, numba.core.registry.CPUDispatcher):
                found[item.__module__ + "." + item.__name__] = len(item.signatures)
    return found

warm_up()
before = compiled()
paths = [path for path in bundled_scenes().values() if 'kind = "synthetic"' in path.read_text()]
assert len(paths) >= 6
for path in paths:
    for estimator in registry.names("estimators"):
        diagnose(estimate(load_scene(path).problem(), estimator))
after = compiled()
print(len(after), sorted(name for name in after if after[name] != before[name]))
"""


def test_warm_up_leaves_nothing_to_compile() -> None:
    """A kernel that warm-up does not reach would make the first user wait for it."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=LIMIT_S)
    count, late = done.stdout.split(" ", 1)
    assert int(count) >= 10
    assert late.strip() == "[]"


def test_a_cold_start_is_announced_and_a_warm_one_is_not(tmp_path: Path) -> None:
    """Seconds of silence look like a hang; a sentence at every start would be noise."""
    # Ctrl-C ends it, even if whoever started these tests ignores it.
    script = """
import signal
from spherloc.warm_up import warm_up
signal.signal(signal.SIGINT, signal.default_int_handler)
warm_up(lambda sentence: print(sentence, flush=True))"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    cold = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, env=environment)
    assert cold.stdout is not None
    try:
        assert "compiling the solvers, once after an installation" in cold.stdout.readline()
    finally:
        cold.send_signal(signal.SIGINT)  # what it announces takes a minute; its own processes end with it
        cold.communicate()
    warm_up(estimators=["ransac-2p"])
    said: list[str] = []
    warm_up(said.append, ["ransac-2p"])
    assert said == []


@pytest.mark.parametrize("part", ["search", "mc-exact, uncertain gravity"])
def test_a_part_that_is_compiled_in_a_process_of_its_own(part: str) -> None:
    """It failed in silence, and everything was compiled by one process."""
    done = subprocess.run([sys.executable, "-m", "spherloc.warm_up", part, "0"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("part", SHARED)
def test_parts_that_all_estimators_need_can_be_compiled(part: str) -> None:
    """In this process, where they are warm; what a process of its own adds is above."""
    SHARED[part]()


def test_who_waits_is_told_how_many_parts_are_done() -> None:
    """Also of one that fails, which is compiled later where it is needed."""
    told: list[int] = []
    _compile_in_order(["search", "no such part"], told=told.append)
    assert told in ([1, 2], [2])
