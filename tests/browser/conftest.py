"""One server and one browser for all tests of the page."""

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playground import FLAGS, SCENE, Playground, find_chromium, served
from playwright.sync_api import Browser, sync_playwright


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test that uses a browser, so that ``-m "not browser"`` leaves all of them out."""
    for item in items:
        if isinstance(item, pytest.Function) and "browser" in item.fixturenames:
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the server records."""
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="session")
def address(tmp_path_factory: pytest.TempPathFactory, recordings: Path) -> Iterator[str]:
    """Address of a running playground with a small scene."""
    scene = tmp_path_factory.mktemp("scene") / "small.toml"
    scene.write_text(SCENE)
    with served(scene, "--recordings", recordings) as (found, _):
        yield found


_browsers: list[Browser] = []
_at_end = ExitStack()


@pytest.fixture(scope="module")
def browser() -> Browser:
    """A headless Chromium with WebGL in software, kept for the next file: a new one costs 5 s."""
    if not _browsers:
        path = find_chromium()
        playwright = _at_end.enter_context(sync_playwright())
        _browsers.append(playwright.chromium.launch(executable_path=path, headless=True, args=list(FLAGS)))
        _at_end.callback(_browsers[0].close)
    return _browsers[0]


def _close_browser() -> None:
    _browsers.clear()
    _at_end.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(nextitem: pytest.Item | None) -> Generator[None, object, object]:
    """The browser is not kept for tests without one: Playwright's event loop blocks others."""
    result = yield
    if not isinstance(nextitem, pytest.Function) or "browser" not in nextitem.fixturenames:
        _close_browser()
    return result


def pytest_sessionfinish() -> None:
    """Also where a run ends early."""
    _close_browser()


@pytest.fixture
def open_tab(browser: Browser, address: str) -> Iterator[Callable[[], Playground]]:
    """Opens tabs and closes them after the test."""
    tabs: list[Playground] = []

    def opened() -> Playground:
        tabs.append(Playground(browser, address))
        return tabs[-1]

    yield opened
    for tab in tabs:
        tab.close()


@pytest.fixture
def tab(open_tab: Callable[[], Playground]) -> Playground:
    """One open tab that shows its first run."""
    return open_tab()
