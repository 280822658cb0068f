"""``view`` as a user meets it: the viewer in a browser on this machine, or one sentence that says why not."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from recording_samples import scene_problem

from spherloc.errors import InputError, RecordingError
from spherloc.estimators import estimate
from spherloc_viz import style
from spherloc_viz.recording.view import view
from spherloc_viz.recording.writer import write_recording

# A shell's background job, and what it starts, ignores SIGINT.
PROGRAM = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from spherloc_viz.recording.view import view; view(sys.argv[1], web=True)"
)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    path = tmp_path_factory.mktemp("view") / "a run #1 ü.rrd"
    write_recording(trace, path)
    return path


@pytest.fixture(scope="module")
def server(path: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """The address that ``view --web`` prints, and its process."""
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    match = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
    assert match is not None
    yield match[0], process
    process.kill()
    process.wait()


def get(url: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(urllib.request.Request(url, headers=headers), timeout=60) as answer:
            return answer.status, answer.read(), {"url": answer.url, **answer.headers}
    except urllib.error.HTTPError as error:
        return error.code, error.read(), dict(error.headers)


def test_it_serves_the_viewer_with_the_recording(server: tuple[str, subprocess.Popen[str]], path: Path) -> None:
    address, _ = server
    status, page, headers = get(address)
    assert status == 200 and b"re_viewer.js" in page
    name = urllib.parse.parse_qs(urllib.parse.urlsplit(headers["url"]).query)["url"][0]
    assert name.startswith(address) and get(name)[1] == path.read_bytes()
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    status, program, headers = get(f"{address}re_viewer_bg.wasm")
    assert status == 200 and program.startswith(b"\0asm") and headers["Content-Type"] == "application/wasm"


def test_it_serves_nothing_else_and_nobody_else(server: tuple[str, subprocess.Popen[str]]) -> None:
    address, _ = server
    assert get(f"{address}../pyproject.toml")[0] == 404
    assert get(f"{address}etc/passwd")[0] == 404
    assert get(f"{address}re_viewer.js", Host="example.org")[0] == 403
    foreign = get(f"{address}?url=http://example.org/x.rrd")
    assert foreign[0] == 200 and "example.org" not in foreign[2]["url"]
    port = int(address.rsplit(":", 1)[1].strip("/"))
    # A server that listens on all addresses would also answer on this machine's other loopback ones.
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", port), timeout=5).close()


def test_ctrl_c_ends_it(path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and "http://" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == 0


def test_a_taken_port_is_one_sentence(path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(InputError, match="--port"):
        view(path, web=True, port=taken.getsockname()[1])


@pytest.mark.parametrize("web", [True, False])
def test_what_is_no_recording_is_one_sentence(tmp_path: Path, web: bool) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        view(tmp_path / "missing.rrd", web=web)


@pytest.mark.skipif(sys.platform != "linux", reason="only here a missing display can be told")
def test_without_a_display_it_says_how_else(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RecordingError, match="--web"):
        view(path, web=False)


@pytest.mark.browser
def test_a_browser_shows_the_scene_and_reaches_nobody_else(server: tuple[str, subprocess.Popen[str]]) -> None:
    import cv2
    import numpy as np
    from playwright.sync_api import sync_playwright

    address, _ = server
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_playwright() as playwright:
        program = os.environ.get("SPHERLOC_CHROMIUM") or shutil.which("chromium")
        if program is None:
            pytest.skip("no Chromium; SPHERLOC_CHROMIUM names one")
        browser = playwright.chromium.launch(executable_path=program, args=[*flags, "--disable-background-networking"])
        page = browser.new_page(viewport={"width": 900, "height": 600})
        answered: list[str] = []
        page.on("response", lambda response: answered.append(response.url))
        page.goto(address)
        truth = np.array(style.TRUTH[::-1])
        for _ in range(60):
            page.wait_for_timeout(1000)
            picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None
            drawn = np.abs(picture[:, :500].astype(int) - truth).max(axis=2) < 12
            if np.count_nonzero(drawn) > 30:
                break
        else:
            pytest.fail("the true camera never appears in the scene")
        assert page.locator("#the_canvas_id").count() == 1, "the viewer has crashed and taken its canvas away"
        assert all(url.startswith((address, "blob:", "data:")) for url in answered), answered
        browser.close()
