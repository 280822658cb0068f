"""Opens scenes from the page: bundled ones, recent ones, files in allowed folders, and uploaded matches."""

import json
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import viser

from spherloc.datasets import Scene, bundled_scenes, load_scene
from spherloc.disk_cache import cache_folder, store
from spherloc.errors import InputError
from spherloc.files import is_file
from spherloc.mapping.advice import for_a_page
from spherloc.mapping.images.photographs import MIN_IMAGES
from spherloc.mapping.scenes.new_queries import add_new_images, map_images, map_size
from spherloc.mapping.scenes.scene_files import MAP_FOLDER, SCENE
from spherloc_viz.app.panels.dropped import DroppedFiles, dropping_html
from spherloc_viz.app.panels.folders import Listing, Roots, Row, and_words, describe
from spherloc_viz.app.panels.map_panel import MapPanel
from spherloc_viz.app.panels.uploads import MAX_BYTES, MAX_CALIBRATION_BYTES, File, Scratch, UploadForm, open_upload
from spherloc_viz.app.text import DIM, begun, box, status_html
from spherloc_viz.app.web.drops import DropRoom
from spherloc_viz.app.web.touch import Touch, Touches
from spherloc_viz.app.web.viser_internals import limit_uploads, update_widget
from spherloc_viz.app.workers import BackgroundWorker

MAP_ABOUT = (
    "Panoramas twice as wide as high, or fisheyes, with a calibration beside them or without. It takes some minutes, "
    "and opens when it is done. For metres, give as Scale the height of the cameras above the ground (1.6), or two "
    "photographs and their distance (1.jpg 5.jpg 12.5)."
)
SEQUENCE_ABOUT = (
    "Some of its images are mapped, the sharpest of each stretch, with its calibrations; gravity is from its IMU and "
    "metres are from its ground truth where these are there. It takes some minutes, and opens when it is done."
)
MAX_NAMED = 3
"""Largest number of folders, besides the last, that are named."""
RULE = "border-top:1px solid rgba(128,140,160,.22)"


AGAIN_ABOUT = "What was done is kept: with another Scale it takes some seconds. It opens when it is done."
NEW_ABOUT = "The first is localized at once; the others are under Sequence in the tab Play."
ITS_MAP = "its map"
"""What the map at hand is called where the sequence is listed whose images it has."""
ONE_ABOUT = "It is localized at once."


def list_html(
    listing: Listing | None,
    roots: Sequence[Path],
    recent: Sequence[Row],
    bundled: Sequence[Row],
    remark: str,
    in_map: str = "",
    made: bool = False,
    reveal: str = "",
) -> str:
    """A folder's content, or the folders that may be looked into; then recent and bundled scenes. ``in_map`` is what
    the map is called in which the folder's photographs can be localized; empty for none. ``made`` says whether there is
    a map of them. To what can be done with them the page scrolls once for each ``reveal``, unless it is empty."""
    if listing is None:
        folders = [_row_html(f"open-folder:0:{k}:", f"{root.name}/", str(root)) for k, root in enumerate(roots)]
        parts = [_section("Folders", folders)]
    else:
        parts = [_folder_html(listing, in_map, made, reveal)]
    parts += [_section(title, [_scene_html(row) for row in rows]) for title, rows in _titled(recent, bundled)]
    return box("".join(parts), "font-size:12.5px") + (status_html(remark) if remark else "")


def _titled(recent: Sequence[Row], bundled: Sequence[Row]) -> list[tuple[str, Sequence[Row]]]:
    return [(title, rows) for title, rows in (("Recent", recent), ("Bundled", bundled)) if rows]


def _folder_html(listing: Listing, in_map: str, made: bool, reveal: str) -> str:
    """Folder by folder; first the way up, last the other pages."""
    above = "open-folder:" if listing.parent is None else f"open-folder:0:{listing.parent}"
    rows = [_row_html(above, "↑ up" if listing.parent else "↑ all folders", "")]
    if in_map and (count := listing.photographs or sum(listing.in_folders.values())):
        these, about = ("this photograph", ONE_ABOUT) if count == 1 else (f"these {count:,} photographs", NEW_ABOUT)
        if listing.sequence:
            these = "other images of this sequence" if in_map == ITS_MAP else "images of this sequence"
        rows.append(_row_html(f"localize-folder:{listing.place}", f"Localize {these} in {in_map}", about, reveal))
    if title := _map_title(listing):
        new_about = SEQUENCE_ABOUT if listing.sequence else MAP_ABOUT
        title, about = (f"{title} again", AGAIN_ABOUT) if made else (title, new_about)
        rows.append(_row_html(f"map-folder:{listing.place}", title, about, reveal))
    for row in listing.rows:
        if row.kind == "folder":
            rows.append(_row_html(f"open-folder:0:{row.place}", f"{row.name}/", row.about))
        else:
            rows.append(_scene_html(row))
    if listing.photographs and listing.photographs < MIN_IMAGES:
        rows.append(_row_html(None, f"{listing.photographs} photograph; a map takes {MIN_IMAGES} or more", ""))
    if not listing.rows and not listing.photographs:
        rows.append(_row_html(None, "no folders, no photographs and no scene files (*.toml)", ""))
    pages = ""
    if listing.pages > 1:
        ways = (("‹ before", listing.page - 1), ("after ›", listing.page + 1))
        links = [
            _link(f"open-folder:{page}:{listing.place}", words) for words, page in ways if 0 <= page < listing.pages
        ]
        pages = f'<div style="padding:.3em 0">page {listing.page + 1} of {listing.pages} {" ".join(links)}</div>'
    remarks = "".join(f'<div style="font-size:12px;{DIM}">{escape(words)}</div>' for words in listing.remarks)
    return _section(f"{listing.folder.name}/", rows) + pages + remarks


def _map_title(listing: Listing) -> str:
    """What map could be made here; empty for none."""
    if listing.photographs >= MIN_IMAGES and not listing.sequence:
        return f"Make a map of these {listing.photographs:,} photographs"
    inside = sum(listing.in_folders.values())
    if inside < MIN_IMAGES:
        return ""
    names = sorted(listing.in_folders)
    if listing.sequence:
        return f"Make a map of this sequence of {and_words(names)}, {inside:,} images"
    folders = f"the folder{'s' if len(names) > 1 else ''} {and_words(names)}"
    if len(names) > MAX_NAMED + 1:
        folders = f"{len(names)} folders"
    return f"Make a map of the {inside:,} photographs in {folders}"


def _link(action: str, words: str) -> str:
    look = "text-decoration:underline;margin-left:.6em"
    return f'<span role="button" tabindex="0" data-touch="{escape(action)}" style="{look}">{escape(words)}</span>'


def _section(title: str, rows: Sequence[str]) -> str:
    head = f'<div style="font-weight:600;padding:.5em 0 .2em;overflow-wrap:anywhere">{escape(title)}</div>'
    return f'{head}<table style="border-collapse:collapse;width:100%">{"".join(rows)}</table>'


def _scene_html(row: Row) -> str:
    return _row_html(f"open-scene:{row.place}" if row.kind == "scene" else None, row.name, row.about)


def _row_html(action: str | None, name: str, about: str, reveal: str = "") -> str:
    """A row that is pressed; paler if there is nothing to press. The page scrolls to one with a new ``reveal``."""
    touch = "" if action is None else f' role="button" tabindex="0" data-touch="{escape(action)}"'
    words = f'<div style="font-size:12px;{DIM};overflow-wrap:anywhere">{escape(about)}</div>' if about else ""
    pale = f"{DIM};" if action is None else ""
    cell = f'<td style="{RULE};{pale}padding:.25em .4em;overflow-wrap:anywhere">{escape(name)}{words}</td>'
    shown = f' data-reveal="{reveal}"' if reveal else ""
    return f"<tr{touch}{shown}>{cell}</tr>"


MAX_RECENT = 8
"""Scenes that are remembered."""
MAX_RECENT_BYTES = 100_000

_writing = threading.Lock()


class RecentScenes:
    """Paths of scene files, the newest first, in a small JSON file that all pages share."""

    def __init__(self, path: Path | None = None) -> None:
        self._path = path or cache_folder("recent") / "scenes.json"

    def read(self) -> tuple[tuple[Path, ...], str]:
        """The paths, and a remark if the file is damaged; whether the scenes are still there is not known."""
        try:
            if not self._path.exists():
                return (), ""
            if self._path.stat().st_size > MAX_RECENT_BYTES:
                raise ValueError("too large")
            values = json.loads(self._path.read_text(encoding="utf-8"))
            if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
                raise ValueError("no list of paths")
        except (OSError, ValueError, RecursionError):
            return (), f"The list of recent scenes ({self._path.name}) is damaged and is begun anew."
        return tuple(Path(value) for value in values[:MAX_RECENT] if value and "\0" not in value), ""

    def note(self, path: Path) -> None:
        """Put a scene file in front."""
        with _writing:
            before, _ = self.read()
            paths = [str(path), *(str(other) for other in before if other != path)]
            store(self._path, json.dumps(paths[:MAX_RECENT], indent=1).encode())


UPLOADED = "uploaded: "
DROPPED_HERE = "dropped on this page"
GOES = (
    "The photographs, and a map of them, go when this page is closed. spherloc play --allow FOLDER keeps in FOLDER "
    "what is dropped."
)
PASTED = "the pasted calibration"


@dataclass(frozen=True, eq=False)
class OpenedScene:
    """A scene to go to."""

    label: str
    """What to call it; untrusted text if it was uploaded."""
    path: Path
    """Its scene file."""
    scene: Scene


class OpenPanel:
    """A list whose rows are pressed, and a form for uploads."""

    def __init__(
        self,
        gui: viser.GuiApi,
        client: viser.ClientHandle,
        touches: Touches,
        roots: Sequence[Path],
        open_scene: Callable[[OpenedScene], None],
        at_hand: Callable[[], Path],
        recent: RecentScenes | None = None,
        *,
        drops: DropRoom,
    ) -> None:
        """``roots`` are the folders that may be looked into; ``open_scene`` is called on a thread of this panel, and
        ``at_hand`` gives the file of the scene that the page shows. What is dropped onto the page comes through
        ``drops``."""
        self._open_scene, self._at_hand = open_scene, at_hand
        self._roots, self._recent = Roots(roots), recent or RecentScenes()
        self._scratch = Scratch()
        self._drops, self._dropped = drops, DroppedFiles(self._homes, self._show_dropped)
        self._drop_address = drops.take_for(self._dropped)
        self._background = BackgroundWorker(f"spherloc-open-{client.client_id}", self._complain)
        self._lock = threading.Lock()
        self._at: tuple[str, int] | None = None
        self._drop_number = 0
        self._new: Path | None = None
        """The folder that was dropped last, to which the page scrolls."""
        self._scratch_folder: Path | None = None
        self._files: dict[str, File] = {}
        self._bundled: list[Row] = []
        self._status = gui.add_html("", visible=False)
        with gui.add_folder("Upload matches", expand_by_default=False):
            self._build_form(gui)
        self._map = MapPanel(client, lambda path: self._background.ask(lambda: self._open_file(path)))
        self._list = gui.add_html("")
        # Larger files are turned away before they fill this process's memory.
        limit_uploads(client, MAX_BYTES, self._complain)
        touches.on("open-scene", lambda touch: self._background.ask(lambda: self._open(touch.argument)))
        touches.on("open-folder", self._walk)
        touches.on("map-folder", lambda touch: self._background.ask(lambda: self._make_map(touch.argument)))
        touches.on("localize-folder", lambda touch: self._background.ask(lambda: self._localize(touch.argument)))
        self._background.ask(self._refresh)

    @property
    def dropping(self) -> str:
        """HTML that lets photographs be dropped onto the page. It is none of the tab's, which may be hidden."""
        return dropping_html(self._drop_address)

    def close(self) -> None:
        """Forget what was uploaded, and what was dropped if it is not kept; does not wait for what is being opened."""
        self._drops.leave(self._drop_address)
        self._map.close()
        self._background.close()
        self._dropped.close()
        self._map.wait()  # it may write into the folder of this page
        self._scratch.close()

    def _homes(self) -> tuple[Callable[[], Path], ...]:
        """What find the folders for photographs that are dropped, the best first."""
        kept = self._drops.kept_in
        return (self._scratch_home,) if kept is None else (lambda: kept, self._scratch_home)

    def _scratch_home(self) -> Path:
        """The folder of this page for what is dropped, into which it may look."""
        with self._lock:
            if self._scratch_folder is None:
                self._scratch_folder = self._scratch.new() / DROPPED_HERE
                self._scratch_folder.mkdir()
                self._roots.add(self._scratch_folder)
            return self._scratch_folder

    def _show_dropped(self, folder: Path) -> None:
        """Show a folder that was dropped."""
        real = folder.resolve()
        place = self._roots.place(real)
        assert place is not None, "the folders for them are allowed"
        with self._lock:
            self._at, self._new = (place, 0), real
            self._drop_number += 1
        self._background.ask(self._refresh)
        gone = self._scratch.has(real)
        self._say(GOES if gone else f"The photographs are kept in {folder}.")

    def _build_form(self, gui: viser.GuiApi) -> None:
        about = (
            "A CSV whose first line names u, v (px), X, Y, Z (m) and maybe inlier (0 or 1). Only this page has it, and "
            "it is removed when the page is closed. Gravity is a vector that points down; in the camera +x is right, "
            "+y down, +z forward. The true pose, which may be left empty, is twelve numbers: the rows of [R | t], "
            "camera from map."
        )
        gui.add_html(box(f'<div style="{DIM}">{escape(about)}</div>', "font-size:12px"))
        matches = gui.add_upload_button("Matches (CSV)", mime_type=".csv,text/csv,text/plain")
        calibration = gui.add_upload_button(
            "Calibration", hint="KITTI-360, Kalibr, stella or 360Loc YAML, Basalt JSON, or TOML with [camera]."
        )
        self._pasted = gui.add_text("or paste [camera]", "", multiline=True, hint="TOML; goes before an uploaded one.")
        self._gravity = (
            gui.add_text("Gravity, camera", "0 1 0", hint="Points down, in the camera frame."),
            gui.add_text("Gravity, map", "0 0 -1", hint="Points down, in the map frame."),
            gui.add_text("Gravity bound (deg)", "", hint="How far the camera's may be off; empty for 0."),
        )
        self._truth = gui.add_text("True pose", "", hint="Shows how far the estimate is off.")
        self._fields = (self._pasted, *self._gravity, self._truth)
        self._files_text = gui.add_html("", visible=False)
        go = gui.add_button("Open upload")
        matches.on_upload(lambda event: self._take("matches", event.target.value))
        calibration.on_upload(lambda event: self._take("calibration", event.target.value))
        go.on_click(lambda event: self._background.ask(self._open_upload))

    def _take(self, what: str, given: viser.UploadedFile) -> None:
        """Keep an uploaded file until the form is sent."""
        file = File(given.name, given.content)
        most = MAX_BYTES if what == "matches" else MAX_CALIBRATION_BYTES
        if len(file.content) > most:
            self._complain(f"{file.title}: larger than {most / 1e6:.2g} MB; upload a smaller file.")
            return
        with self._lock:
            self._files[what] = file
            lines = [f"{kind}: {kept.title}, {len(kept.content):,} bytes" for kind, kept in self._files.items()]
            self._files_text.content = box("<br>".join(map(escape, lines)), "font-size:12px;overflow-wrap:anywhere")
            self._files_text.visible = True

    def _open_upload(self) -> None:
        with self._lock:
            files = dict(self._files)
        if self._pasted.value.strip():
            files["calibration"] = File(PASTED, self._pasted.value.encode("utf-8", "replace"))
        for what, kind in (("matches", "a CSV of matches"), ("calibration", "a calibration")):
            if what not in files:
                raise InputError(f"{kind} is missing; upload one.")
        in_camera, in_map, bound = (field.value for field in self._gravity)
        form = UploadForm(files["matches"], files["calibration"], in_camera, in_map, bound, self._truth.value)
        self._say("Reading the upload …")
        path, scene = open_upload(form, self._scratch.new())
        self._open_scene(OpenedScene(UPLOADED + form.matches.title, path, scene))
        self._say("")

    def _make_map(self, place: str) -> None:
        """Make a map of a folder's photographs."""
        folder = self._roots.find(place)
        if not folder.is_dir() or not _map_title(self._roots.look_into(place)):
            raise InputError("this is not a folder of photographs; choose one from the list.")
        self._map.start(folder, self._map_of(folder))

    def _map_of(self, folder: Path) -> Path:
        """Where the map of a folder is put: beside it, or inside it if pages may not write beside it. The command puts
        it where it is given."""
        above = folder if self._roots.place(folder.parent) is None else folder.parent
        return above / MAP_FOLDER.format(folder.name)

    def _localize(self, place: str) -> None:
        """Open a scene of a folder's photographs in the map that the page shows; it is written beside the map's own."""
        folder, scene = self._roots.find(place), self._at_hand()
        if self._place(scene) is None:
            raise InputError("the map that is shown is not in an allowed folder; open a map from the list first.")
        self._say("Looking at the photographs …")
        with for_a_page():
            path, remarks = add_new_images(scene, folder)
        self._open_file(path)
        self._say(" ".join(remarks))

    def _map_for(self, listing: Listing) -> str:
        """What the map at hand is called, if other photographs than its own are listed, or a sequence most of whose
        images are not in it; else empty."""
        scene = self._at_hand()
        try:
            images = None if self._place(scene) is None else map_images(scene)
            # Of the folder above it, the map's own photographs would be localized too.
            own = images is not None and images.resolve().is_relative_to(listing.folder.resolve())
            if images is not None and listing.sequence and images.resolve() == listing.folder.resolve():
                return ITS_MAP if sum(listing.in_folders.values()) >= 2 * map_size(scene) else ""
        except (InputError, OSError, RuntimeError):
            return ""
        return "" if images is None or own else f"the map of {images.name}"

    def _open(self, place: str) -> None:
        self._open_file(self._roots.find(place))

    def _open_file(self, path: Path) -> None:
        self._say(f"Opening {path.name} …")
        scene = load_scene(path)
        self._open_scene(OpenedScene(scene.name, path, scene))
        if not self._scratch.has(path):
            self._recent.note(path)
        self._say("")
        self._refresh()

    def _walk(self, touch: Touch) -> None:
        """Note which folder to show: "PAGE:PLACE", or nothing for none."""
        page, _, place = touch.argument.partition(":")
        with self._lock:
            self._at = (place, int(page)) if page.isascii() and page.isdigit() and len(page) < 6 else None
        self._background.ask(self._refresh)

    def _refresh(self) -> None:
        """Show the list anew."""
        with self._lock:
            at = self._at
        try:
            listing = None if at is None else self._roots.look_into(*at)
        except InputError:
            with self._lock:
                self._at = None
            self._list.content = self._list_html(None)
            self._map.offer(False)
            raise
        html = self._list_html(listing)
        self._map.offer(listing is not None and bool(_map_title(listing)))
        update_widget(self._list, content=html)

    def _list_html(self, listing: Listing | None) -> str:
        recent, remark = self._recent.read()
        if not self._bundled:
            self._bundled = [row for _, row in self._described(bundled_scenes().values())]
        in_map = "" if listing is None else self._map_for(listing)
        made = listing is not None and is_file(self._map_of(listing.folder) / SCENE)
        new = listing is not None and listing.folder == self._new
        last = [replace(row, name=f"{path.parent.name}/{row.name}") for path, row in self._described(recent)]
        reveal = f"dropped-{self._drop_number}" if new else ""
        return list_html(listing, self._roots.folders, last, self._bundled, remark, in_map, made, reveal)

    def _described(self, paths: Iterable[Path]) -> list[tuple[Path, Row]]:
        """Those of the files that are there and allowed."""
        return [(path, describe(path, place)) for path in paths if (place := self._place(path)) is not None]

    def _place(self, path: Path) -> str | None:
        """What names a scene file to ``Roots.find``; None if it is gone or not allowed."""
        try:
            real = path.resolve()
            return self._roots.place(real) if real.is_file() else None
        except (OSError, ValueError, RuntimeError):
            return None

    def _say(self, words: str) -> None:
        self._status.content, self._status.visible = status_html(words), bool(words)

    def _complain(self, sentence: str) -> None:
        if sentence.partition(" ")[0].isalpha():  # file names stay as they are
            sentence = begun(sentence)
        self._status.content, self._status.visible = status_html(sentence, wrong=True), True
