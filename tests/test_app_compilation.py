"""Solvers are compiled while the page is open; who needs one that is not ready waits for it, or ends the waiting."""

import threading
from collections.abc import Callable, Iterator

import pytest

from spherloc.watch import Cancelled, Watch
from spherloc_viz.app import compilation
from spherloc_viz.app.compilation import Compilation, first_and_later
from spherloc_viz.app.controls.estimator_controls import START
from tests.waiting import LIMIT_S, until


class Compiler:
    """Compiles nothing: it says in which order it is asked, and goes on when it is told to."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.go_on = threading.Semaphore(0)

    def compile(self, estimator: str, stopped: Callable[[], bool]) -> None:
        self.asked.append(estimator)
        while not stopped() and not self.go_on.acquire(timeout=0.01):
            pass


@pytest.fixture
def compiler(monkeypatch: pytest.MonkeyPatch) -> Compiler:
    made = Compiler()
    monkeypatch.setattr(compilation, "compile_apart", made.compile)
    monkeypatch.setattr(compilation, "warm_up", lambda estimators: None)
    monkeypatch.setattr(compilation, "FIRST_PAGE_S", 0.0)
    return made


@pytest.fixture
def running(compiler: Compiler) -> Iterator[Compilation]:
    made = Compilation(["mc-exact", "ransac-2p", "auto"])
    made.start()
    until(lambda: compiler.asked == ["mc-exact"])
    yield made
    made.close()
    assert not made._thread.is_alive()


def test_nothing_is_compiled_before_the_first_page_unless_somebody_waits(
    compiler: Compiler, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "FIRST_PAGE_S", 1e6)
    made = Compilation(["mc-exact", "auto"])
    made.start()
    assert not compiler.asked
    said: list[str] = []
    waiting = threading.Thread(target=made.wait_for, args=("auto", Watch(), said.append), daemon=True)
    waiting.start()
    until(lambda: compiler.asked == ["auto"])
    compiler.go_on.release()
    waiting.join(LIMIT_S)
    assert not waiting.is_alive()
    made.close()
    assert not made._thread.is_alive()


def test_an_end_does_not_wait_for_the_first_page(compiler: Compiler, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "FIRST_PAGE_S", 1e6)
    made = Compilation(["mc-exact"])
    made.start()
    made.close()
    assert not made._thread.is_alive()
    assert not compiler.asked


def test_who_waits_is_next_and_goes_on_when_it_is_ready(running: Compilation, compiler: Compiler) -> None:
    said: list[str] = []
    waiting = threading.Thread(target=running.wait_for, args=("auto", Watch(), said.append), daemon=True)
    waiting.start()
    until(lambda: said == ["Compiling auto, once after an installation …"])
    compiler.go_on.release()
    until(lambda: compiler.asked == ["mc-exact", "auto"])
    assert waiting.is_alive()
    compiler.go_on.release()
    waiting.join(LIMIT_S)
    assert not waiting.is_alive()
    running.wait_for("mc-exact", Watch(), said.append)
    assert len(said) == 1, "nobody waits for what is ready"


def test_waiting_is_cancelled(running: Compilation) -> None:
    watch = Watch()
    with pytest.raises(Cancelled):
        running.wait_for("ransac-2p", watch, lambda sentence: watch.cancel())


def test_every_estimator_is_compiled_once_and_the_first_run_s_before_the_page_opens() -> None:
    first, later = first_and_later()
    assert START in first
    assert len({*first, *later}) == len(first) + len(later)
    assert {"mc", "mc-exact", "ransac-2p", "auto", "ransac-epnp"} <= {*first, *later}
