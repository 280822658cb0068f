"""Makes a map of a folder's photographs in the background: progress, a button that stops it, and the report."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import viser

from spherloc.errors import InputError, reason
from spherloc.files import read_file
from spherloc_viz.app.text import begun, box, status_html

MODULE = "spherloc_viz.commands.map"
MAX_LETTERS = 20_000
"""Longest line that is read from the process."""
SCALE_HINT = (
    "For a map in metres: the height of the cameras above the ground, such as 1.6, or two photographs and their "
    "distance, such as 1.jpg 5.jpg 12.5. A map that is there already is only scaled."
)
MAX_ENDING_S = 5.0
MAX_REPORT_BYTES = 500_000_000


class MapPanel:
    """One page's; one map at a time. The work is a process of its own, so that the page stays quick."""

    def __init__(self, client: viser.ClientHandle, finished: Callable[[Path], None]) -> None:
        """``finished`` is called with the scene file of a map that is done, on a thread of this panel."""
        gui = client.gui
        self._client, self._finished = client, finished
        self._scale = gui.add_text("Scale", "", hint=SCALE_HINT, visible=False)
        self._text = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._stop = gui.add_button("Stop the map", visible=False)
        self._save = gui.add_button("Save the report", hint="What became of each photograph, and why.", visible=False)
        self._stop.on_click(lambda event: self.close())
        self._save.on_click(lambda event: self._save_report())
        self._report: Path | None = None
        self._told = ""
        """What is said of the map that was made last, as HTML."""
        self._lock = threading.Lock()
        self._number = 0
        """Number of the maps that were begun."""
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False

    def offer(self, photographs: bool) -> None:
        """Ask for the scale where a folder of ``photographs`` is looked at."""
        self._scale.visible = photographs

    def start(self, folder: Path, output: Path) -> None:
        """Make the map of ``folder`` in ``output``; nothing happens while another one is made."""
        with self._lock:
            if self._process is not None:
                return
            self._stopped = False
            self._number += 1
            command = [sys.executable, "-m", MODULE, str(folder), str(output), self._scale.value]
            # A process that is stopped leaves its temporary files there.
            scratch = TemporaryDirectory(prefix="spherloc-map-", ignore_cleanup_errors=True)
            self._process = process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={**os.environ, "TMPDIR": scratch.name},
            )
        self._say(f"Making a map of {folder.name} …")
        self._bar.value, self._bar.visible, self._stop.visible = 0.0, True, True
        threading.Thread(target=self._follow, args=(process, folder, scratch), name="spherloc-map", daemon=True).start()

    def close(self) -> None:
        """Stop what runs; does not wait. What was done is kept."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.terminate()

    def wait(self) -> None:
        """Wait until the process has ended that was stopped, some seconds at most."""
        with self._lock:
            process = self._process
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(MAX_ENDING_S)

    def _follow(self, process: "subprocess.Popen[str]", folder: Path, scratch: "TemporaryDirectory[str]") -> None:
        said: dict[str, Any] = {}
        assert process.stdout is not None
        for line in process.stdout:
            said = _parsed(line) or said
            if "kind" in said:
                self._bar.value = 100.0 * said["done"] / max(1, said["count"])
                self._say(f"{folder.name}: {said['done']:,} of {said['count']:,} {said['kind']} …")
        process.wait()
        scratch.cleanup()
        with self._lock:
            self._process, stopped = None, self._stopped
        self._bar.visible = self._stop.visible = False
        if "scene" in said:
            title = f"<div style='font-weight:600'>The map of {escape(folder.name)}</div>"
            self._told = box(title + _table(said["summary"]), "font-size:12px;overflow-wrap:anywhere")
            self._text.content, self._report, self._save.visible = self._told, Path(said["report"]), True
            self._finished(Path(said["scene"]))
        elif stopped:
            self._say("Stopped; what was done is kept for the next time.")
        else:
            sentence = str(said.get("error", "the map could not be made; try the command spherloc map."))
            self._text.content = self._in_sight(status_html(begun(sentence), wrong=True), "-wrong") + self._told

    def _save_report(self) -> None:
        """Send the report to the browser, which saves it."""
        assert self._report is not None
        try:
            content = read_file(self._report, MAX_REPORT_BYTES)
        except OSError as error:
            raise InputError(f"{self._report}: cannot be read ({reason(error)}); make the map again.") from None
        self._client.send_file_download(f"{self._report.parent.name}.html", content, save_immediately=True)

    def _say(self, words: str) -> None:
        self._text.content = self._in_sight(status_html(words))

    def _in_sight(self, html: str, kind: str = "") -> str:
        """The same, to which the page scrolls when it comes: the list, in which a map is begun, may be far below."""
        return f'<div data-reveal="map-{self._number}{kind}">{html}</div>'


def _table(lines: Sequence[str]) -> str:
    """Lines of a map's summary, each a name and, after two spaces or more, what there is to say."""
    rows = []
    for line in lines:
        name, told, rest = line.partition("  ")
        cells = f"<td style='padding-right:8px;white-space:nowrap'>{escape(name)}</td><td>{escape(rest.strip())}</td>"
        rows.append(f"<tr style='vertical-align:top'>{cells if told else f'<td colspan=2>{escape(line)}</td>'}</tr>")
    return f"<table>{''.join(rows)}</table>"


def _parsed(line: str) -> dict[str, Any] | None:
    """The progress in a line of the process's output; None for other output."""
    try:
        said = json.loads(line[:MAX_LETTERS])
    except ValueError:
        return None
    return said if isinstance(said, dict) else None
