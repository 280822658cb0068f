"""``spherloc_viz.show``: a real server beside this program, seen by a real browser."""

import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect, sync_playwright

import spherloc
import spherloc_viz
from spherloc.errors import InputError
from spherloc_viz.showing import Playground
from tests.browser.playground import FLAGS, PATIENCE_MS, blind_page, find_chromium
from tests.browser.playground import Playground as Tab
from tests.waiting import until

SEED = 5


@pytest.fixture(scope="module")
def found() -> spherloc.Localization:
    problem = spherloc.load_scene(spherloc.bundled_scenes()["mei_outliers_80"]).problem(3)
    return spherloc.localize(
        problem.pixels,
        problem.points,
        problem.camera,
        problem.gravity_camera,
        gravity_map=problem.gravity_map,
        estimator="ransac-2p",
        options={"iterations": 77},
        seed=SEED,
        name="query 17",
    )


@pytest.fixture(scope="module")
def playground(found: spherloc.Localization) -> Iterator[Playground]:
    with spherloc_viz.show(found, browser=False) as playground:
        yield playground
    playground.close()  # once more does nothing
    assert not is_served(playground.url) and "closed" in repr(playground)
    assert "iframe" not in playground._repr_html_()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = find_chromium()
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, headless=True, args=list(FLAGS))
        yield chromium
        chromium.close()


def is_served(url: str) -> bool:
    try:
        with urllib.request.urlopen(url) as answer:
            return answer.status == 200
    except OSError:
        return False


def test_the_page_opens_on_the_run(found: spherloc.Localization, playground: Playground, browser: Browser) -> None:
    tab = Tab(browser, playground.url)
    expect(tab.value("inliers")).to_contain_text(f"{np.count_nonzero(found.inliers)} of {len(found.inliers)}")
    for said in ("scene=query\\+17", f"seed={SEED}", "estimator=ransac-2p", "option=iterations%3D77"):
        expect(tab.page).to_have_url(re.compile(f"[#&]{said}(&|$)"), timeout=PATIENCE_MS)
    tab.expect_quiet(playground.url)
    tab.close()


@contextmanager
def notebook(playground: Playground) -> Iterator[int]:
    """The port of a server whose page holds what a notebook would show."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(playground._repr_html_().encode())

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("", 0), Page) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            yield server.server_port
        finally:
            server.shutdown()


def test_a_notebook_shows_it_inline_and_no_other_site_can(
    found: spherloc.Localization, playground: Playground, browser: Browser
) -> None:
    page = blind_page(browser)
    with notebook(playground) as port:
        page.goto(f"http://localhost:{port}/lab")
        inliers = page.frame_locator("iframe").locator("//tr[td[1][normalize-space()='inliers']]/td[2]")
        expect(inliers).to_contain_text(str(np.count_nonzero(found.inliers)), timeout=PATIENCE_MS)
        assert page.get_by_role("link").get_attribute("href") == playground.url
        with page.expect_console_message(lambda message: "frame-ancestors" in message.text):
            page.goto(f"http://127.0.0.2:{port}/")  # no address that notebooks of this machine have
    page.context.close()


SCRIPT = """
import time, spherloc, spherloc_viz
trace = spherloc.estimate(spherloc.load_scene(spherloc.bundled_scenes()["mei_outliers_80"]).problem(3), "ransac-2p")
print(spherloc_viz.show(trace, browser=False).url, flush=True)
time.sleep(600)
"""


def test_it_ends_with_its_program_and_others_go_on(playground: Playground, tmp_path: Path) -> None:
    """Also if that is killed, and nothing is left."""
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True, env=environment
    ) as program:
        assert program.stdout is not None
        url = program.stdout.readline().strip()
        assert url != playground.url and is_served(url) and list(tmp_path.glob("spherloc-*"))
        program.send_signal(signal.SIGKILL)
    until(lambda: not is_served(url) and not list(tmp_path.glob("spherloc-*")))
    assert is_served(playground.url)


def test_what_cannot_be_shown_is_said_in_a_sentence(found: spherloc.Localization) -> None:
    with pytest.raises(InputError, match="'ndarray'; give what spherloc"):
        spherloc_viz.show(found.inliers)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="nobodys-estimator"):
        spherloc_viz.show(replace(found.trace, estimator="nobodys-estimator"), browser=False)
