"""The gallery of failures on the page: a press opens a case in the playground and tells its story."""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape

import viser

from spherloc_viz import style
from spherloc_viz.app.review.filters import pill
from spherloc_viz.app.review.rows import OPENED, RULE, picture_html
from spherloc_viz.app.review.run_library import RunLibrary
from spherloc_viz.app.text import DIM, begun, box, status_html
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.app.workers import BackgroundWorker
from spherloc_viz.gallery import GalleryCase, Play, gallery_cases, staged_path
from spherloc_viz.recording.replay import Reopened
from spherloc_viz.recording.run_row import RunRow

FOLDER = "gallery"
"""Name of the folder, inside the folder of recordings, of the cases' recordings."""


class GalleryList:
    """The cases as rows; the one that is open shows its story, and the runs that it is compared with."""

    def __init__(
        self,
        gui: viser.GuiApi,
        touches: Touches,
        library: RunLibrary | None,
        name: str,
        open_file: Callable[[str], None],
        open_scene: Callable[[Reopened, bool], None],
    ) -> None:
        """``open_file`` opens a recording, ``open_scene`` what has none, beside the open recording or instead of it;
        both are called on a thread of this part."""
        self._library, self._open_file, self._open_scene = library, open_file, open_scene
        self._background = BackgroundWorker(f"spherloc-gallery-{name}", self._fail)
        self._html = gui.add_html("", visible=False)
        self._opened: str | None = None
        touches.on("gallery-open", self._press)
        touches.on("gallery-beside", self._press_beside)

    def show(self, shown: bool) -> None:
        """Show the list, or make room."""
        self._html.visible = shown
        if shown:
            self._background.ask(self._draw)

    def close(self) -> None:
        """Open nothing more; does not wait."""
        self._background.close()

    def _press(self, touch: Touch) -> None:
        self._background.ask(partial(self._open, touch.argument))

    def _press_beside(self, touch: Touch) -> None:
        key, _, number = touch.argument.rpartition(":")
        if number.isascii() and number.isdigit() and len(number) < 4:
            self._background.ask(partial(self._open_beside, key, int(number)))

    def _open(self, key: str) -> None:
        case = next((case for case in gallery_cases() if case.key == key), None)
        if case is None:
            return
        self._opened = key
        self._draw()
        if file_of(case) in self._rows():
            self._open_file(file_of(case))
        else:
            self._open_scene(reopened(case, case, case.key), False)

    def _open_beside(self, key: str, number: int) -> None:
        case = next((case for case in gallery_cases() if case.key == key), None)
        if case is not None and number < len(case.beside):
            play = case.beside[number]
            stem = case.key if play.staged == case.staged else f"{case.key}_{number}"
            self._open_scene(reopened(case, play, stem), True)

    def _rows(self) -> dict[str, RunRow]:
        """The recordings of the cases that have one."""
        files = [file_of(case) for case in gallery_cases()]
        return {} if self._library is None else {row.file: row for row in self._library.rows(files)}

    def _draw(self) -> None:
        html = gallery_html(gallery_cases(), self._rows(), self._opened)
        update_widget(self._html, content=html)

    def _fail(self, sentence: str) -> None:
        self._html.content = status_html(begun(sentence), wrong=True)


def file_of(case: GalleryCase) -> str:
    """The name of its recording in the folder of recordings."""
    return f"{FOLDER}/{case.key}.rrd"


def reopened(case: GalleryCase, play: Play, stem: str) -> Reopened:
    """A case, or a run beside it, as a scene to open; ``stem`` names those that have no scene file."""
    path = play.scene_path or staged_path(stem)
    label = case.title if play.scene_path is None else play.scene.name
    return Reopened(play.scene, path, label, play.seed, play.query, play.variation, play.estimator, play.options)


def gallery_html(cases: Sequence[GalleryCase], rows: dict[str, RunRow], opened: str | None) -> str:
    """All cases, and the story of the one that is open."""
    about = "Failures worth seeing, and why they happen. A press opens one in the playground."
    pictures = [_thumbnail(rows.get(file_of(case))) for case in cases]
    # Before "spherloc gallery" has recorded them, no case has one, and a column of empty frames says nothing.
    shown = [picture_html(png) if any(pictures) else "" for png in pictures]
    body = "".join(_case_html(case, picture, case.key == opened) for case, picture in zip(cases, shown, strict=True))
    return box(f'<div style="{DIM};padding-bottom:.4em">{about}</div>{body}', "font-size:12px;line-height:1.4")


def _thumbnail(row: RunRow | None) -> bytes:
    return b"" if row is None else row.thumbnail


def _case_html(case: GalleryCase, picture: str, opened: bool) -> str:
    """A case; ``picture`` is HTML."""
    color = style.css_text(style.OUTLIER)
    head = (
        f'<div style="font-weight:600;overflow-wrap:anywhere">{escape(case.title)}</div>'
        f'<div><span style="color:{color}">{escape(case.cause)}</span>'
        f'<span style="{DIM}"> · {escape(case.estimator)}</span></div>'
    )
    ground = f"background:{OPENED};box-shadow:inset 2px 0 0 {style.css(style.ESTIMATE)};" if opened else ""
    line = (
        f'<div role="button" tabindex="0" class="touch-row" data-touch="gallery-open:{escape(case.key)}" '
        f'style="{RULE};{ground}display:flex;gap:.6em;align-items:center;padding:.2em .25em">{picture}'
        f'<div style="flex:1;min-width:0">{head}</div></div>'
    )
    if not opened:
        return line
    beside = "".join(
        pill(
            f"{escape(play.name)}: {'succeeds' if play.succeeds else 'fails'}",
            f"gallery-beside:{case.key}:{number}",
            False,
            "Run this instead",
        )
        for number, play in enumerate(case.beside)
    )
    ways = f'<div style="display:flex;flex-wrap:wrap;gap:.3em;padding-top:.4em">{beside}</div>' if beside else ""
    story = f'<div style="padding:.4em .25em .7em">{escape(case.story)}{ways}</div>'
    return f'<div data-reveal="{escape(case.key)}">{line}{story}</div>'
