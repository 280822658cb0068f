"""Makes a map of a folder's photographs in the background, with its progress and a button that stops it."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import viser

from spherloc_viz.app.text import begun, box, status_html

MODULE = "spherloc_viz.commands.map"
MAX_LETTERS = 20_000
"""Longest line that is read from the process."""
OUTPUT = "_map"
"""What the folder of a map is called, after that of its photographs; as the command calls it."""


class MapPanel:
    """One page's; one map at a time. The work is a process of its own, so that the page stays quick."""

    def __init__(self, gui: viser.GuiApi, finished: Callable[[Path], None]) -> None:
        """``finished`` is called with the scene file of a map that is done, on a thread of this panel."""
        self._finished = finished
        self._text = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._stop = gui.add_button("Stop the map", visible=False)
        self._stop.on_click(lambda event: self.close())
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False

    def start(self, folder: Path, output: Path) -> None:
        """Make the map of ``folder`` in ``output``; nothing happens while another one is made."""
        with self._lock:
            if self._process is not None:
                return
            self._stopped = False
            command = [sys.executable, "-m", MODULE, str(folder), str(output)]
            self._process = process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
        self._say(f"Making a map of {folder.name} …")
        self._bar.value, self._bar.visible, self._stop.visible = 0.0, True, True
        threading.Thread(target=self._follow, args=(process, folder), name="spherloc-map", daemon=True).start()

    def close(self) -> None:
        """Stop what runs; does not wait. What was done is kept."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.terminate()

    def _follow(self, process: "subprocess.Popen[str]", folder: Path) -> None:
        said: dict[str, Any] = {}
        assert process.stdout is not None
        for line in process.stdout:
            said = _parsed(line) or said
            if "kind" in said:
                self._bar.value = 100.0 * said["done"] / max(1, said["count"])
                self._say(f"{folder.name}: {said['done']:,} of {said['count']:,} {said['kind']} …")
        process.wait()
        with self._lock:
            self._process, stopped = None, self._stopped
        self._bar.visible = self._stop.visible = False
        if "scene" in said:
            self._text.content = box(_table(said["summary"]), "font-size:12px;overflow-wrap:anywhere")
            self._finished(Path(said["scene"]))
        elif stopped:
            self._say("Stopped; what was done is kept for the next time.")
        else:
            sentence = str(said.get("error", "the map could not be made; try the command spherloc map."))
            self._text.content = status_html(begun(sentence), wrong=True)

    def _say(self, words: str) -> None:
        self._text.content = status_html(words)


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
