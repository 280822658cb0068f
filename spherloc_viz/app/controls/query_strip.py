"""The queries of a scene as a strip of thumbnails, coloured by their outcome; a press on one shows that query.

A page of the strip is shown at a time, so that thousands of queries cost no more than some dozens.
"""

import base64
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import takewhile
from pathlib import Path, PurePosixPath

import cv2

from spherloc.cameras.base import Camera
from spherloc.datasets.map_scene import MapScene
from spherloc.errors import InputError
from spherloc.experiments.results import DOUBTFUL, FAILED, LOCALIZED, UNREADABLE, QueryResult
from spherloc.files import is_file
from spherloc.frontend.view import View
from spherloc.metrics import said_length
from spherloc_viz import style
from spherloc_viz.app.paging import pages_html
from spherloc_viz.app.text import DIM, box
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.workers import BackgroundWorker

PAGE = 24
"""Queries that are shown at once."""
HEIGHT_PX, MAX_WIDTH_PX = 52, 104
"""Size of a thumbnail."""
KEPT = 400
"""Thumbnails that are remembered."""
LETTER_PX, LINES = 7, 2
"""Width of a letter of a name below a thumbnail, and how many lines the name may have."""
WAITING = "waiting"
MARKS = {
    LOCALIZED: ("✓", style.INLIER),
    DOUBTFUL: ("?", style.UNDECIDED),
    FAILED: ("✕", style.OUTLIER),
    UNREADABLE: ("✕", style.OUTLIER),
}
"""Sign and colour of each outcome of a query."""
WORST_FIRST = {FAILED: 0, UNREADABLE: 1, DOUBTFUL: 2, LOCALIZED: 3, WAITING: 4}
ORDERS = {"order": "in order", "outcome": "by outcome", "error": "by error", "inliers": "by inliers"}
"""Keys of the strip's order, and their words."""


class QueryStrip:
    """One page's. ``set`` and presses only note what is wanted; a thread of its own reads images."""

    def __init__(
        self,
        touches: Touches,
        show: Callable[[str], None],
        open_query: Callable[[str], None],
        failed: Callable[[str], None],
    ) -> None:
        """``show`` is given the HTML, on the strip's thread, ``open_query`` the name of a query that is pressed, and
        ``failed`` a sentence if the strip cannot be drawn."""
        self._show, self._open = show, open_query
        self._lock = threading.Lock()
        self._scene: MapScene | None = None
        self._rows: Mapping[str, QueryResult] = {}
        self._order, self._hidden, self._marked = "order", False, ""
        self._page: int | None = None
        """Page at hand; None for that of the marked query."""
        self._pictures: OrderedDict[Path, str] = OrderedDict()
        self._worker = BackgroundWorker("spherloc-strip", failed)
        touches.on("strip-order", self._sort)
        touches.on("strip-page", self._turn)
        touches.on("strip-open", self._press)

    def close(self) -> None:
        """End it after the image at hand; does not wait."""
        self._worker.close()

    def set(self, scene: MapScene | None, rows: Sequence[QueryResult], hidden: bool, marked: str) -> None:
        """Show the queries of a scene and what became of them by now; ``hidden`` tells no answers, ``marked`` is the
        name of the query that the page shows, to which the strip turns if it is another one."""
        with self._lock:
            if scene is not self._scene or marked != self._marked:
                self._page = None
            self._scene, self._hidden, self._marked = scene, hidden, marked
            self._rows = {row.query: row for row in rows}
        self._worker.ask(self._draw)

    def _sort(self, touch: Touch) -> None:
        if touch.argument in ORDERS:
            with self._lock:
                self._order, self._page = touch.argument, 0
            self._worker.ask(self._draw)

    def _turn(self, touch: Touch) -> None:
        if touch.argument.isascii() and touch.argument.isdigit() and len(touch.argument) < 6:
            with self._lock:
                self._page = int(touch.argument)
            self._worker.ask(self._draw)

    def _press(self, touch: Touch) -> None:
        with self._lock:
            scene = self._scene
        if scene is not None and any(view.name == touch.argument for view in scene.queries):
            self._open(touch.argument)

    def _draw(self) -> None:
        with self._lock:
            scene, rows, order = self._scene, self._rows, self._order
            hidden, page, marked = self._hidden, self._page, self._marked
        if scene is None:
            self._show("")
            return
        known = {} if hidden else rows
        views = ordered(scene.queries, known, order)
        if page is None:
            page = next((place for place, view in enumerate(views) if view.name == marked), 0) // PAGE
            with self._lock:
                if self._page is None and self._scene is scene and self._marked == marked:
                    self._page = page
        page = min(page, (len(views) - 1) // PAGE)
        shown = views[page * PAGE : (page + 1) * PAGE]
        pictures = {view.name: self._picture(view) for view in shown}
        told = differences([view.name for view in views])
        strip = Strip(shown, pictures, told, known, marked, scene)
        untold = () if any(view.cam_from_map is not None for view in scene.queries) else ("error",)
        orders = {key: words for key, words in ORDERS.items() if key not in untold}
        self._show(strip_html(strip, orders, order, page, len(views)))

    def _picture(self, view: View) -> str:
        """Address of the view's thumbnail; empty if there is none yet."""
        if view.path not in self._pictures:
            address = thumbnail(view)
            if not address:
                return ""
            self._pictures[view.path] = address
            if len(self._pictures) > KEPT:
                self._pictures.popitem(last=False)
        return self._pictures[view.path]


def thumbnail(view: View) -> str:
    """Address of a small JPEG; empty if the file is not there or cannot be read."""
    if not is_file(view.path):
        return ""
    try:
        pixels = view.read()
    except InputError:
        return ""
    scale = min(HEIGHT_PX / pixels.shape[0], MAX_WIDTH_PX / pixels.shape[1])
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    done, content = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 75])
    return f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode('ascii')}" if done else ""


def ordered(queries: Sequence[View], rows: Mapping[str, QueryResult], order: str) -> list[View]:
    """The queries as a key of ``ORDERS`` says: what went wrong first, and last what is not done yet."""

    def key(view: View) -> float:
        row = rows.get(view.name)
        if order == "outcome":
            return WORST_FIRST[WAITING if row is None else row.status]
        value = None if row is None else row.translation_error_m if order == "error" else row.inliers
        if value is None:
            return float("inf")
        return -value if order == "error" else value

    return list(queries) if order == "order" else sorted(queries, key=key)


@dataclass(frozen=True, eq=False)
class Strip:
    """What a page of the strip shows."""

    shown: Sequence[View]
    pictures: Mapping[str, str]
    """Addresses of the thumbnails by the names of the queries."""
    differences: Mapping[str, str]
    """What tells their names apart, see ``differences``."""
    rows: Mapping[str, QueryResult]
    """What became of the queries, by their names."""
    marked: str
    """The query that the page shows."""
    scene: MapScene
    """Its map has the unit and the extent of errors."""


def strip_html(strip: Strip, orders: Mapping[str, str], order: str, page: int, count: int) -> str:
    """A page of the strip, and what sorts and turns it: ``orders`` are words by their keys."""
    sorting = " · ".join(
        f"<b>{words}</b>" if key == order else _pressed(f"strip-order:{key}", words) for key, words in orders.items()
    )
    turning = pages_html(page, count, "strip-page", size=PAGE) if count > PAGE else ""
    cells = "".join(_cell(view, strip) for view in strip.shown)
    return box(
        f'<div style="{DIM};padding-bottom:.25em">Queries {sorting}</div>'
        f'<div style="display:flex;flex-wrap:wrap;gap:4px" role="list" aria-label="Queries">{cells}</div>{turning}',
        "font-size:12px",
    )


def _pressed(action: str, words: str) -> str:
    return f'<u role="button" tabindex="0" data-touch="{action}" style="cursor:pointer">{words}</u>'


def _cell(view: View, strip: Strip) -> str:
    picture, row = strip.pictures[view.name], strip.rows.get(view.name)
    mark, border = "", "1px dashed rgba(128,140,160,.6)"
    if row is not None:
        sign, color = MARKS[row.status]
        border = f"3px solid {style.css(color)}"
        mark = (
            f'<span aria-hidden="true" style="position:absolute;right:0;bottom:0;padding:0 .3em;color:#fff;'
            f'background:rgba(20,24,32,.75);font-weight:700">{sign}</span>'
        )
    said, width_px = said_of(view.name, row, strip.scene), width_of(view.camera)
    current, weight = (' aria-current="true"', "font-weight:700") if view.name == strip.marked else ("", DIM)
    image = (
        f'<img alt="" src="{picture}" style="display:block;height:{HEIGHT_PX}px">'
        if picture
        else f'<div style="width:{width_px}px;height:{HEIGHT_PX}px;background:rgba(128,140,160,.2)"></div>'
    )
    # As wide as the picture, to which it must not give a width of its own.
    wrapped = "width:0;min-width:100%;overflow-wrap:anywhere;line-height:1.15"
    words = escape(short_name(view.name, strip.differences[view.name], width_px))
    name = f'<div aria-hidden="true" style="{wrapped};text-align:center;{weight}">{words}</div>'
    framed = f"position:relative;border:{border};border-radius:4px;overflow:hidden"
    return (
        f'<div role="listitem"><div role="button" tabindex="0"{current} data-touch="strip-open:{escape(view.name)}" '
        f'title="{escape(said)}" aria-label="{escape(said)}" style="cursor:pointer">'
        f'<div style="{framed}">{image}{mark}</div>{name}</div></div>'
    )


def width_of(camera: Camera) -> int:
    """Width of a thumbnail, px."""
    return round(min(MAX_WIDTH_PX, HEIGHT_PX * camera.width / camera.height))


def differences(names: Sequence[str]) -> dict[str, str]:
    """What tells each of the names from the others, by the name: not its suffix, folders that all share, and what the
    files' names begin and end with alike, such as digits of a time."""
    paths = {name: _stem(name).split("/") for name in names}
    if len(paths) < 2:
        return {name: _stem(name) for name in names}
    depths = {len(path) for path in paths.values()}
    shared = {place for place in range(min(depths) - 1) if len({path[place] for path in paths.values()}) == 1}
    files = {path[-1] for path in paths.values()}
    begin = _alike(files)
    end = _alike({file[begin:][::-1] for file in files})
    told: dict[str, str] = {}
    for name, (*folders, file) in paths.items():
        differs = f"{'…' if begin else ''}{file[begin : len(file) - end]}{'…' if end else ''}"
        own = [folder for place, folder in enumerate(folders) if len(depths) > 1 or place not in shared]
        told[name] = "/".join((*own, differs))
    return told


def _alike(texts: Collection[str]) -> int:
    """How many letters different texts begin with alike, without those of a word that goes on."""
    alike = sum(1 for _ in takewhile(lambda letters: len(set(letters)) == 1, zip(*texts, strict=False)))
    if len(texts) < 2:
        return 0
    while alike and any(text[alike - 1 : alike + 1].isalpha() and len(text) > alike for text in texts):
        alike -= 1
    return alike


def short_name(name: str, differs: str, width_px: int) -> str:
    """A query's name without its suffix if that fits below a thumbnail of that width, else what ``differs`` from those
    of others, or as much of its end as fits."""
    stem, room = _stem(name), LINES * (width_px // LETTER_PX)
    if len(stem) <= room:
        return stem
    return differs if len(differs) <= room else f"…{differs[1 - room :]}"


def _stem(name: str) -> str:
    return name.removesuffix(PurePosixPath(name).suffix)


def said_of(name: str, row: QueryResult | None, scene: MapScene) -> str:
    """A query's name and what became of it, in a line, and what other queries or maps say against its pose."""
    if row is None:
        return name
    parts = [f"{name}: {row.status}"]
    if row.inliers is not None and row.matches:
        parts.append(f"{row.inliers} of {row.matches} matches")
    if row.translation_error_m is not None and row.rotation_error_deg is not None:
        error = f"{row.translation_error_m:.2g} {'m' if scene.metric else 'units'}"
        parts.append(
            f"{said_length(row.translation_error_m, scene.extent_m, error)}, {row.rotation_error_deg:.2g}° off"
        )
    return ". ".join((", ".join(parts), *row.doubts))
