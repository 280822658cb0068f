"""What all tests share: reproducible randomness, the bundled scenes with changes, and real data where it is present."""

import gc
import os
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from spherloc.datasets import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc_viz.recording.index.run_index import RunIndex
from spherloc_viz.recording.sandbox import examiner as examiners
from spherloc_viz.recording.sandbox.examiner import Examiner
from tests.needs import lacking, real_data

ROOT = Path(__file__).resolve().parents[1]
SUITE_SEED = int(os.environ.get("SPHERLOC_TEST_SEED", "0"))

# A busy machine is no reason to fail: neither a limit a case nor one on drawing the cases.
settings.register_profile(
    "spherloc", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("spherloc")


def pytest_report_header() -> list[str]:
    """A failing random test is repeated by the same seed; what will be skipped is said before it is."""
    skips = [f"tests will be skipped: {lack}" for lack in lacking().values()]
    return [f"SPHERLOC_TEST_SEED={SUITE_SEED}", *(skips or ["no test will be skipped"])]


def skip_reason(report: pytest.TestReport | pytest.CollectReport) -> str:
    """Why a test, or a file of tests, was skipped."""
    return report.longrepr[2].removeprefix("Skipped: ") if isinstance(report.longrepr, tuple) else str(report.longrepr)


def unannounced_fails(report: pytest.TestReport | pytest.CollectReport) -> None:
    """A test that skips for a reason that the start of the run did not tell has failed."""
    if report.skipped and not hasattr(report, "wasxfail") and (reason := skip_reason(report)) not in lacking().values():
        report.outcome = "failed"
        report.longrepr = f"skipped for a reason that tests/needs.py does not have, or that does not hold: {reason}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    unannounced_fails(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    unannounced_fails(report)
    return report


def pytest_terminal_summary(terminalreporter: "pytest.TerminalReporter") -> None:
    """How many tests were skipped, for each reason."""
    reasons = Counter(skip_reason(report) for report in terminalreporter.stats.get("skipped", ()))
    terminalreporter.section("skipped tests")
    for reason, count in reasons.most_common():
        terminalreporter.line(f"{count:5d}  {reason}")
    if not reasons:
        terminalreporter.line("none")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays: the garbage collector leaves it out, and this takes half the time."""
    gc.disable()
    result = yield
    gc.enable()
    gc.freeze()
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, object, object]:
    """What a file leaves open is found at its end and listed under its name, not raised in another file's test."""
    result = yield
    if nextitem is None or nextitem.path != item.path:
        # Until pytest puts its own filters back, which it does after this test.
        warnings.simplefilter("always", ResourceWarning)
        gc.collect()
        gc.freeze()
    return result


@pytest.fixture(scope="session", autouse=True)
def own_disk_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Renders and features of the tests stay out of the user's cache; processes that test side by side share one."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "spherloc-cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPHERLOC_CACHE", str(folder))
        yield folder


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Randomness of one test: the same in every run and whatever tests run beside it."""
    return np.random.default_rng([SUITE_SEED, zlib.crc32(request.node.nodeid.encode())])


@pytest.fixture(scope="module")
def own_examiner() -> Iterator[None]:
    """What the tests of a file have examined, a process of their own reads, which ends with them."""
    with pytest.MonkeyPatch.context() as patch, Examiner() as examiner:
        patch.setattr(examiners, "_shared", examiner)
        yield


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    """A viser server of one file's tests, on a free port."""
    from spherloc_viz.app.web.viser_internals import start_viser, stop_viser  # only tests of the page need them
    from tests.connected_page import KEY

    server = start_viser(KEY)
    yield server
    stop_viser(server)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of trajectories are empty files, where a test looks at other files: each takes the better part of a
    second to draw."""
    monkeypatch.setattr("spherloc_viz.plots.trajectories.trajectory_png", lambda results, backdrop: b"")


@pytest.fixture
def index(tmp_path: Path) -> Iterator[RunIndex]:
    """An empty list of runs, in a folder where there was none."""
    with RunIndex(tmp_path / "recordings") as index:
        yield index


@pytest.fixture(scope="session")
def scene_of() -> Callable[..., SyntheticScene]:
    """``scene_of("mei", outlier_rate=0.5)``: the simulation with the "mei", "fisheye" or "panorama" camera, changed."""

    def make(camera: str, **changes: Any) -> SyntheticScene:
        scene = load_scene(ROOT / "scenes" / f"{camera}_outliers_80.toml")
        assert isinstance(scene, SyntheticScene)
        return replace(scene, **changes)

    return make


@pytest.fixture(scope="session")
def aria() -> Path:
    """Folder of the real fisheye problems beside the project; the test is skipped where it is absent."""
    return real_data("aria_adt_fisheye")
