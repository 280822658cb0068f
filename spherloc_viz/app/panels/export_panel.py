"""Takes what is on the page elsewhere: a picture, a page with the 3-D scene, the recording, and code to repeat it."""

import io
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import viser
from PIL import Image, ImageDraw, ImageFont

from spherloc.errors import InputError
from spherloc.trace import Trace
from spherloc_viz.app.glossary import heading_html
from spherloc_viz.app.stage.still_page import Still, still_html, viewpoint
from spherloc_viz.app.text import DIM, WITHHELD, begun, box, status_html
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.layers.primitives import SceneItem

VIEW = "Share"
"""Name by which the page reports whether the panel can be seen."""
PATIENCE_S = 60.0
"""A page that draws in software takes some ten seconds for a picture of its canvas."""
WHERE = "Paths without a slash in front begin at the folder in which the playground was started; run the code there."
LINK = box(
    '<button class="copy-link" data-copy="" title="The page\'s address, to be pasted into a message">'
    f'Copy the link to what you see</button><div style="{DIM}">'
    "It leads to this scene, these settings, this step and this view, on this machine. Somebody else starts spherloc "
    "and puts what follows the # behind the address of their own page; without spherloc, send the picture or the "
    "scene below, which opens in any browser.</div>",
    "font-size:12px",
)
"""The page's script knows the address, see ``touch.js``."""
CANVAS = {True: (20, 20, 20), False: (255, 255, 255)}
"""What the canvas has behind everything, by whether the page is dark."""
INK = {True: ((235, 238, 242), (170, 178, 190)), False: ((25, 28, 32), (95, 102, 112))}
"""Colours of the title and of the note below a picture."""
MIN_TEXT_PX, TEXT_SHARE = 11.0, 0.96
"""Least height of that text, and the share of the picture's width that it may take."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What is on the page."""

    trace: Trace
    items: Sequence[SceneItem]
    """What the canvas shows, without the layers that are switched off."""
    backdrop: bytes | None
    """The map's mesh, if it is shown."""
    title: str
    """The scene's label; untrusted if it was uploaded."""
    note: str
    """A line about the run."""
    recorded: Path | None
    """The run's recording, if there is one already."""
    dark: bool


class ExportPanel:
    """The link, three buttons and two pieces of code."""

    def __init__(self, gui: viser.GuiApi, client: viser.ClientHandle, shown: Callable[[], Shown | None]) -> None:
        """``shown`` tells what is on the page, on a thread of this panel; None before the first picture."""
        self._client, self._shown = client, shown
        self._background = BackgroundWorker(f"spherloc-export-{client.client_id}", self._complain)
        self._code: tuple[str, str] | None = None
        self._hidden = False
        gui.add_html(heading_html("Send what you see, or repeat it elsewhere", "recording"))
        gui.add_html(LINK)
        buttons = (
            ("Picture (PNG)", "The canvas as it is seen now, and below it what it shows.", self._picture),
            ("Scene (HTML)", "The canvas as a file that opens in any browser, with no network.", self._page),
            ("Recording (.rrd)", "The run with all of its steps, for a Rerun viewer.", self._recording),
        )
        for label, hint, job in buttons:
            gui.add_button(label, hint=hint).on_click(lambda event, job=job: self._background.ask(job))
        self._status = gui.add_html("", visible=False)
        self._text = gui.add_html("")

    def draw(self, python: str, command: str) -> None:
        """Show the code that repeats the run at hand."""
        if self._code != (python, command):
            self._code = (python, command)
            self._show()

    def hide_answers(self, hidden: bool) -> None:
        """Hide the code, whose scene and settings tell how many matches are wrong, or show it again."""
        if self._hidden != hidden:
            self._hidden = hidden
            self._show()

    def _show(self) -> None:
        if self._hidden:
            self._text.content = status_html(WITHHELD)
        elif self._code is not None:
            python, command = self._code
            self._text.content = (
                code_html("Python", python)
                + code_html("Command", command)
                + box(f'<div style="{DIM}">{WHERE}</div>', "font-size:12px")
            )

    def close(self) -> None:
        """Export nothing more; does not wait."""
        self._background.close()

    def _now(self) -> Shown:
        shown = self._shown()
        if shown is None:
            raise InputError("there is nothing to export yet; wait for the first picture.")
        return shown

    def _picture(self) -> None:
        shown, camera = self._now(), self._client.camera
        self._say("Taking the picture … a browser without a graphics card needs some ten seconds.")
        try:
            pixels = self._client.get_render(
                camera.image_height, camera.image_width, transport_format="png", timeout=PATIENCE_S
            )
        except (TimeoutError, RuntimeError):
            raise InputError(
                "the browser gave no picture of the canvas; keep its tab in front and try again."
            ) from None
        self._send(f"{file_stem(shown)}.png", picture_png(pixels, shown.title, shown.note, shown.dark))

    def _page(self) -> None:
        shown = self._now()
        self._say("Making the page …")
        still = Still(
            title=shown.title,
            note=shown.note,
            items=shown.items,
            backdrop=shown.backdrop,
            aligned_from_map=shown.trace.problem.aligned.map_turn,
            dark=shown.dark,
            **viewpoint(self._client.camera),
        )
        self._send(f"{file_stem(shown)}.html", still_html(still).encode())

    def _recording(self) -> None:
        shown = self._now()
        name = f"{file_stem(shown)}.rrd"
        if shown.recorded is not None and shown.recorded.is_file():
            self._send(name, shown.recorded.read_bytes())
            return
        self._say("Writing the recording …")
        # Here, since it imports rerun, which takes a quarter of a second: a page should not wait for it.
        from spherloc_viz.recording.content.writer import write_recording

        with tempfile.TemporaryDirectory(prefix="spherloc-") as folder:
            path = Path(folder) / "run.rrd"
            write_recording(shown.trace, path)
            self._send(name, path.read_bytes())

    def _send(self, name: str, content: bytes) -> None:
        self._client.send_file_download(name, content, save_immediately=True)
        self._say(f"{name}, {len(content) / 1e6:.2g} MB")

    def _say(self, words: str) -> None:
        self._status.content, self._status.visible = status_html(words), True

    def _complain(self, sentence: str) -> None:
        self._status.content = status_html(begun(sentence), wrong=True)
        self._status.visible = True


def picture_png(pixels: np.ndarray, title: str, note: str, dark: bool) -> bytes:
    """A canvas, RGBA pixels (H, W, 4), with two lines of text below it, as a PNG."""
    picture = Image.fromarray(pixels, "RGBA")
    width, height = picture.size
    lines = [_line(title, width, height / 32), _line(note, width, height / 42)]
    pad = height // 60
    ground = Image.new("RGBA", (width, height + sum(line.size_px for line in lines) + 3 * pad), (*CANVAS[dark], 255))
    ground.alpha_composite(picture)
    draw, top = ImageDraw.Draw(ground), height + pad
    for line, color in zip(lines, INK[dark], strict=True):
        draw.text((pad, top), line.text, color, line.font)
        top += line.size_px + pad
    out = io.BytesIO()
    ground.convert("RGB").save(out, "PNG")
    return out.getvalue()


@dataclass(frozen=True)
class _TextLine:
    text: str
    font: Any
    size_px: int


def _font(size_px: float) -> Any:
    """A font that knows Greek letters and signs of mathematics too."""
    import matplotlib  # a tenth of a second, so only where it is needed

    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"), size_px)


def _line(text: str, width: int, size_px: float) -> _TextLine:
    """Text on one line within a ``width``, px; smaller than ``size_px`` if it is long, and cut if that is too small."""
    size = max(MIN_TEXT_PX, size_px)
    font: Any = _font(size)
    long = font.getlength(text) / (TEXT_SHARE * width)
    if long > 1.0:
        size = max(MIN_TEXT_PX, size / long)
        font = _font(size)
        while len(text) > 1 and font.getlength(text) > TEXT_SHARE * width:
            text = text[: int(0.9 * len(text))].rstrip(" …") + "…"
    return _TextLine(text, font, round(1.2 * size))


def file_stem(shown: Shown) -> str:
    """A file name of letters, digits and dashes, whatever the scene is called."""
    words = re.findall(r"[a-z0-9]+", f"spherloc {shown.title} {shown.trace.estimator}".lower())
    return "-".join(words)[:80].strip("-")


def code_html(title: str, code: str) -> str:
    """Code with a button that copies it."""
    link = "text-decoration:underline;font-size:12px;margin-left:.8em"
    face = "font-family:ui-monospace,Menlo,Consolas,monospace;font-size:12px;line-height:1.45"
    look = "white-space:pre-wrap;overflow-wrap:anywhere;max-height:24em;overflow-y:auto;padding:.5em .7em"
    ground = "background:rgba(128,140,160,.12);border-radius:.4em;margin:.25em 0 0"
    copy = (
        f'<span role="button" tabindex="0" aria-label="Copy as {escape(title)}" data-copy="{escape(code)}" '
        f'style="{link};{DIM}">copy</span>'
    )
    named = f'tabindex="0" role="region" aria-label="{escape(title)}"'  # keys scroll what is longer
    return box(
        f'<span style="font-weight:600">{escape(title)}</span>{copy}<pre {named} style="{face};{look};{ground}">'
        f"{escape(code)}</pre>"
    )
