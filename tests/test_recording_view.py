"""``view`` as a user meets it: the viewer in a browser or in a window, or one sentence that says why not."""

import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_process import one_sentence, spherloc_here
from recording_samples import scene_problem
from rerun.experimental import ViewerClient

from spherloc.errors import InputError, RecordingError
from spherloc.estimators import estimate
from spherloc_viz.app.web.viewer import serve_recording
from spherloc_viz.recording.content.writer import write_recording
from spherloc_viz.recording.rerun_program import rerun_command, rerun_environment
from spherloc_viz.recording.review_file import write_review
from spherloc_viz.recording.reviews import review_path
from spherloc_viz.recording.run_row import RunRow
from spherloc_viz.recording.viewer import labels_of, stand_at, view_in_window
from tests.needs import needs, vulkan
from tests.waiting import LIMIT_S

# A shell's background job, and what it starts, ignores SIGINT.
PROGRAM = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from spherloc_viz.commands.cli import main\n"
    "sys.argv = ['spherloc', 'view', *sys.argv[1:], '--web', '--port', '0']; main()"
)
Run = tuple[Path, RunRow]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A recording with labels and an odd name, and its row."""
    path = tmp_path_factory.mktemp("view") / "a run #1 ü.rrd"
    row = write_recording(estimate(scene_problem("mei_outliers_80"), "mc"), path)
    write_review(path, ["odd"], "")
    return path, row


@pytest.fixture(scope="module")
def server(run: Run) -> Iterator[str]:
    """The address that ``view --web`` prints."""
    process = start(run[0], "--step", "2")
    assert process.stdout is not None
    match = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
    assert match is not None
    yield match[0]
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 0, "Ctrl-C ends it well"
    process.stdout.close()


def start(path: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", PROGRAM, str(path), *words], stdout=subprocess.PIPE, text=True)


def get(url: str, **headers: str) -> tuple[int, bytes, str]:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(urllib.request.Request(url, headers=headers), timeout=LIMIT_S) as answer:
            return answer.status, answer.read(), answer.url
    except urllib.error.HTTPError as error:
        return error.code, error.read(), error.url


def test_it_serves_the_viewer_at_the_step(server: str, run: Run) -> None:
    status, page, url = get(server)
    assert status == 200 and url.startswith(f"{server}viewer/?") and b'data-step="2"' in page
    files = re.search(rb'data-files="(\S+) (\S+)"', page)
    assert files is not None
    for url, path in zip(files.groups(), (run[0], review_path(run[0])), strict=True):
        assert get(server + url.decode().lstrip("/"))[1] == path.read_bytes()


def test_it_serves_nothing_else_and_nobody_else(server: str, run: Run) -> None:
    assert get(f"{server}etc/passwd")[0] == 404
    assert get(f"{server}viewer/?run=other.rrd")[0] == 404
    assert get(f"{server}viewer/data/other.rrd")[0] == 404
    assert get(f"{server}viewer/data/run.rrd", Host="example.org")[0] == 403
    port = int(server.rsplit(":", 1)[1].strip("/"))
    # A server that listens on all addresses would also answer on this machine's other loopback ones.
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", port), timeout=5).close()


def test_a_taken_port_is_one_sentence(run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(InputError, match="--port"):
        serve_recording(*run, 0, taken.getsockname()[1])


@pytest.mark.usefixtures("own_examiner")
@pytest.mark.parametrize(
    "words, sentence", [(["missing.rrd"], "missing.rrd"), (["RUN", "--step", "99"], "there is no step 99")]
)
def test_what_cannot_be_viewed_is_one_sentence(run: Run, tmp_path: Path, words: list[str], sentence: str) -> None:
    words = [str(run[0]) if word == "RUN" else word for word in words]
    assert sentence in one_sentence(spherloc_here("view", *words, "--web", "--port", "0", cwd=tmp_path))


def test_labels_of_another_run_are_not_shown(run: Run, tmp_path: Path) -> None:
    copy = tmp_path / "copy.rrd"
    copy.write_bytes(run[0].read_bytes())
    assert labels_of(copy, run[1].run_id) is None
    write_review(copy, ["mine"], "")
    assert labels_of(copy, run[1].run_id) == review_path(copy)
    with pytest.raises(RecordingError, match="of another run"):
        labels_of(copy, "another")


@needs("linux")
def test_without_a_display_it_says_how_else(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RecordingError, match="--web"):
        view_in_window(*run, 0)


@needs("vulkan")
@pytest.mark.browser
def test_a_window_stands_at_the_step(run: Run) -> None:
    """rerun's own program, as for a window, but without one: it shows run and labels as one recording."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address = f"rerun+http://127.0.0.1:{port}/proxy"
    files = [str(run[0]), str(review_path(run[0]))]
    viewer = subprocess.Popen(
        [*rerun_command(), "--headless", "--bind", "127.0.0.1", "--port", str(port), *files],
        env=rerun_environment() | (vulkan() or {}),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert stand_at(viewer, address, 3)
        (recording,) = ViewerClient.connect(address).get_state().recordings
        assert recording.store_id.endswith(run[1].run_id)
        assert (recording.current_timeline, recording.current_time) == ("step", 3)
    finally:
        viewer.kill()
        viewer.wait()
