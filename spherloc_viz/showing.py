"""``show``: the playground on a run, from a script or a notebook.

The page's server wants signals, settings of the interpreter and threads for itself, so that it is a process of its own
(``spherloc_viz.app.shown``). It gets the run as a recording in a temporary folder, from which the problem comes back
bit for bit, and ends with the process that asked for it.
"""

import atexit
import re
import subprocess
import sys
import tempfile
import threading
import webbrowser
from html import escape
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from spherloc.errors import InputError
from spherloc.errors import show as quoted
from spherloc.localization import Localization
from spherloc.trace import Trace
from spherloc_viz.recording.content.writer import write_recording

HEIGHT_PX = 720
"""Height of the frame in a notebook."""
PATIENCE_S = 5.0
"""How long a server may take to end before it is killed."""
_open: "set[Playground]" = set()
"""Keeps playgrounds alive whose caller does not keep what ``show`` returned."""


class Playground:
    """A playground beside this program, until it is closed or the program ends. A notebook shows it inline."""

    def __init__(self, trace: Trace) -> None:
        """Start the server of a run's playground and wait until its address is known, a few seconds.

        Raises:
            InputError: If the server cannot open the run, such as one of an estimator that is not installed.
            RecordingError: If the temporary folder cannot take the run.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="spherloc-", ignore_cleanup_errors=True)
        self._lock = threading.Lock()
        file = Path(self._folder.name) / "run.rrd"
        try:
            write_recording(trace, file)
            self._server = _started(file)
        except BaseException:
            self._folder.cleanup()
            raise
        _open.add(self)
        try:
            self.url = _address(self._server)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the server; its pages stay as they are, and nothing more happens there. Calling it again does nothing."""
        with self._lock:
            _end(self._server)
            self._folder.cleanup()
        _open.discard(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Playground {self.url}{'' if self in _open else ', closed'}>"

    def _repr_html_(self) -> str:
        if self not in _open:
            return f"<p>{escape(repr(self))}</p>"
        frame = (
            f'<iframe src="{self.url}" width="100%" height="{HEIGHT_PX}" style="border:0" allow="fullscreen"></iframe>'
        )
        return f'{frame}<p><a href="{self.url}" target="_blank">{self.url}</a></p>'


def show(result: Localization | Trace, *, browser: bool | None = None) -> Playground:
    """Open the playground on a run: its problem, estimator, options and seed.

    It is served on 127.0.0.1 at a free port, for as long as this program runs, and any number may be open. This returns
    when the address is known; where the solvers are not compiled yet, the page waits for them.

    Args:
        result: What ``spherloc.localize`` or ``spherloc.estimate`` returned.
        browser: Whether to open a browser; None opens one unless this is a notebook, which shows the page inline if
            the returned object is the last value of a cell.

    Returns:
        The playground, with its address ``url`` and ``close()``; as a context manager it is closed at the end.

    Raises:
        InputError: For any other ``result``, and if the server cannot open the run.
        RecordingError: If the temporary folder cannot take the run.
    """
    if not isinstance(result, Localization | Trace):
        raise InputError(
            f"show got {quoted(type(result).__name__)}; give what spherloc.localize or spherloc.estimate returned."
        )
    playground = Playground(result.trace if isinstance(result, Localization) else result)
    if browser or (browser is None and not _in_notebook()):
        webbrowser.open(playground.url)
    return playground


def _started(file: Path) -> "subprocess.Popen[str]":
    """The process of the server. It ends when its input does, so also if this process is killed; and it is in a session
    of its own, so that Ctrl-C interrupts this program only."""
    return subprocess.Popen(
        [sys.executable, "-m", "spherloc_viz.app.shown", str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        start_new_session=True,
    )


def _address(server: "subprocess.Popen[str]") -> str:
    """What the server says first."""
    line = _stream(server.stdout).readline().strip()
    if not re.fullmatch(r"http://\S+", line):
        raise InputError(line or "the playground's server ended before it said where it is; its messages say why.")
    return line


def _end(server: "subprocess.Popen[str]") -> None:
    _stream(server.stdin).close()
    try:
        server.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()
    _stream(server.stdout).close()


def _stream(pipe: "IO[str] | None") -> "IO[str]":
    assert pipe is not None
    return pipe


def _in_notebook() -> bool:
    """Whether this program is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return hasattr(shell, "kernel")


@atexit.register
def _close_all() -> None:
    for playground in tuple(_open):
        playground.close()
