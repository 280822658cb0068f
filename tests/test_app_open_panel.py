"""Opening scenes as a page does it: rows are pressed, files are uploaded, and each page keeps to itself."""

import html
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import viser

from spherloc.datasets.map_scene import MapScene
from spherloc.mapping.scenes.scene_files import UNITS_UNKNOWN, MapHead, own_queries, scene_text
from spherloc_viz.app.panels.open_panel import OpenedScene, OpenPanel, RecentScenes
from spherloc_viz.app.panels.uploads import MAX_BYTES
from spherloc_viz.app.web.drops import DropRoom
from spherloc_viz.app.web.touch import Touch, Touches
from tests.connected_page import KEY, ConnectedPage
from tests.datasets.colmap_samples import EQUIRECTANGULAR, binary_files, sample_model, write
from tests.waiting import until

ROOT = Path(__file__).resolve().parents[1]
CAMERA = '[camera]\nmodel = "equirectangular"\nwidth = 512\nheight = 256\n'
CSV = "u,v,X,Y,Z\n" + "".join(f"{20 * k + 5},{90 + 7 * k},{k - 5},{k % 3},{4 + k % 5}\n" for k in range(12))
SCENE = f"""
kind = "correspondences"
name = "NAME"
correspondences = "m.csv"
{CAMERA}
[gravity]
camera = [0, 1, 0]
map = [0, 0, -1]
"""
EVIL = "<img src=x onerror='alert(1)'>.toml"


class Visitor:
    """A connected page with the panel on it."""

    def __init__(self, server: viser.ViserServer, folder: Path, recent: Path, drops: DropRoom | None = None) -> None:
        self.page = ConnectedPage(server, KEY)
        self.opened: list[OpenedScene] = []
        self.touches = Touches(self._failed)
        client = self.page.handle
        self.panel = OpenPanel(
            client.gui,
            client,
            self.touches,
            (folder, ROOT / "scenes"),
            self.opened.append,
            lambda: self.opened[-1].path if self.opened else folder / "a.toml",
            RecentScenes(recent),
            drops=drops or DropRoom(),
        )
        buttons = [widget for widget in client.gui._gui_input_handle_from_uuid.values()]
        self.matches, self.calibration = (b for b in buttons if isinstance(b, viser.GuiUploadButtonHandle))
        self.go = next(b for b in buttons if getattr(b, "label", "") == "Open upload")
        self.settle()

    def _failed(self, error: Exception) -> None:
        raise error

    def settle(self) -> None:
        until(lambda: not self.panel._background._busy)

    def touch(self, words: str) -> None:
        action, _, argument = words.partition(":")
        self.touches.deliver(Touch(action, argument, 0.5, 0.5, 0.5, 0.5, False))
        self.settle()

    @property
    def rows(self) -> list[str]:
        """What can be pressed."""
        return [html.unescape(words) for words in re.findall(r'data-touch="([^"]+)"', self.panel._list.content)]

    @property
    def said(self) -> str:
        return self.panel._status.content if self.panel._status.visible else ""

    def close(self) -> None:
        self.panel.close()
        self.page.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "open"
    (folder / "sub").mkdir(parents=True)
    (folder / "m.csv").write_text(CSV)
    (folder / "a.toml").write_text(SCENE.replace("NAME", "mine"))
    (folder / EVIL).write_text(SCENE.replace("NAME", EVIL))
    (folder / "sub" / "bad.toml").write_text('kind = "nonsense"\n')
    (tmp_path / "secret.toml").write_text(SCENE)
    return folder


@pytest.fixture
def visitor(server: viser.ViserServer, folder: Path, tmp_path: Path) -> Iterator[Visitor]:
    visitor = Visitor(server, folder, tmp_path / "recent.json")
    yield visitor
    visitor.close()


def test_a_scene_is_found_by_its_folder_and_opened(visitor: Visitor, folder: Path) -> None:
    assert "open-folder:0:0:" in visitor.rows and "open-scene:1:mei_outliers_80.toml" in visitor.rows
    visitor.touch("open-folder:0:0:")
    assert {"open-folder:", "open-folder:0:0:sub", "open-scene:0:a.toml"} <= set(visitor.rows)
    visitor.touch("open-scene:0:a.toml")
    (opened,) = visitor.opened
    assert (opened.label, opened.path) == ("mine", folder / "a.toml") and len(opened.scene.problem()) == 12
    assert visitor.said == ""
    visitor.touch("open-scene:1:mei_outliers_80.toml")
    assert visitor.opened[1].label == "MEI fisheye, 80 % outliers"


def test_what_was_opened_is_recent_for_all(visitor: Visitor, server: viser.ViserServer, folder: Path) -> None:
    visitor.touch("open-scene:0:a.toml")
    recent = visitor.panel._recent._path
    assert json.loads(recent.read_text()) == [str(folder / "a.toml")]
    other = Visitor(server, folder, recent)
    assert other.rows.count("open-scene:0:a.toml") == 1
    # Elsewhere that folder is not allowed, so what is in it is not offered.
    stranger = Visitor(server, ROOT / "docs", recent)
    assert not any(row.endswith(":a.toml") for row in stranger.rows)
    (folder / "a.toml").unlink()
    other.touch("open-folder:")
    assert other.rows.count("open-scene:0:a.toml") == 0
    other.close()
    stranger.close()


@pytest.mark.parametrize(
    "words, sentence",
    [
        ("open-scene:0:../secret.toml", "not there or not in an allowed folder"),
        ("open-scene:0:/etc/passwd", "not there or not in an allowed folder"),
        ("open-scene:7:a.toml", "not allowed any more"),
        ("open-scene:", "not a place in an allowed folder"),
        ("open-folder:0:0:..", "not there or not in an allowed folder"),
        ("open-folder:0:0:a.toml", "cannot be read"),
        ("open-scene:0:sub/bad.toml", "unknown dataset"),
        ("open-scene:0:sub", "is a folder of 1 scene file"),
    ],
)
def test_what_cannot_be_opened_is_said_and_nothing_more(visitor: Visitor, words: str, sentence: str) -> None:
    visitor.touch(words)
    assert sentence in visitor.said and not visitor.opened
    assert "open-scene:1:mei_outliers_80.toml" in visitor.rows, "the list is still there"


def drop(visitor: Visitor, name: str, count: int) -> None:
    files = visitor.panel._dropped
    files.begin(name, count, count)
    for number in range(count):
        file = files.open(f"{number}.png")
        file.write(b"1")
        file.close()
    files.end()
    visitor.settle()


def test_photographs_that_are_dropped_are_shown_and_kept(
    server: viser.ViserServer, folder: Path, tmp_path: Path
) -> None:
    visitor = Visitor(server, folder, tmp_path / "recent.json", DropRoom(folder))
    drop(visitor, "rooms", 3)
    assert "map-folder:0:dropped_rooms" in visitor.rows and 'data-reveal="dropped-1"' in visitor.panel._list.content
    assert "Make a map of these 3 photographs<" in visitor.panel._list.content
    assert f"kept in {folder / 'dropped_rooms'}." in html.unescape(visitor.said)
    visitor.touch("open-folder:0:0:")
    assert "data-reveal" not in visitor.panel._list.content
    visitor.close()
    assert len(list((folder / "dropped_rooms").iterdir())) == 3


def test_photographs_without_a_folder_for_them_go_with_their_page(
    visitor: Visitor, server: viser.ViserServer, folder: Path, tmp_path: Path
) -> None:
    drop(visitor, "", 2)
    place = "2:dropped_photographs"
    assert f"map-folder:{place}" in visitor.rows and "go when this page is closed" in visitor.said
    kept = visitor.panel._roots.find(place)
    drop(visitor, "", 2)
    assert f"map-folder:{place}_2" in visitor.rows
    visitor.touch("open-folder:")
    assert "open-folder:0:2:" in visitor.rows and "dropped on this page/" in visitor.panel._list.content
    other = Visitor(server, folder, tmp_path / "recent.json")
    assert "dropped on this page" not in other.panel._list.content
    other.touch(f"open-folder:0:{place}")
    assert "not allowed any more" in other.said
    other.close()
    visitor.panel.close()
    assert not kept.parent.parent.exists()


def test_folders_of_cameras_are_offered_as_one_map_unless_a_link_leads_out(visitor: Visitor, folder: Path) -> None:
    for name in ("left/0.png", "left/1.png", "right/0.png", "right/1.png"):
        (folder / "rig" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "rig" / name).touch()
    visitor.touch("open-folder:0:0:rig")
    assert "map-folder:0:rig" in visitor.rows
    assert "Make a map of the 4 photographs in the folders left and right" in visitor.panel._list.content
    visitor.touch("open-folder:0:0:rig/left")
    assert "Make a map of these 2 photographs<" in visitor.panel._list.content
    (folder / "rig" / "left_map").mkdir()
    (folder / "rig" / "left_map" / "scene.toml").write_text("")
    visitor.touch("open-folder:0:0:rig/left")
    assert "Make a map of these 2 photographs again<" in visitor.panel._list.content

    (folder.parent / "private").mkdir()
    (folder.parent / "private" / "0.png").touch()
    (folder / "rig" / "third").symlink_to(folder.parent / "private")
    visitor.touch("open-folder:0:0:rig")
    assert "map-folder:0:rig" not in visitor.rows
    for place in ("0:rig", "0:sub"):
        visitor.touch(f"map-folder:{place}")
        assert "not a folder of photographs" in visitor.said and visitor.panel._map._process is None


def test_a_folder_of_which_no_map_can_be_made_says_so(visitor: Visitor, folder: Path) -> None:
    (folder / "few").mkdir()
    visitor.touch("open-folder:0:0:few")
    assert "no folders, no photographs and no scene files" in visitor.panel._list.content
    for name in ("0.png", "IMG_1.HEIC"):
        (folder / "few" / name).touch()
    visitor.touch("open-folder:0:0:few")
    assert "1 photograph; a map takes 2 or more" in visitor.panel._list.content
    assert "1 photograph was left out: IMG_1.HEIC; convert .heic to JPEG or PNG." in visitor.panel._list.content


def test_a_sequence_is_offered_as_one_map_unless_a_link_leads_out(visitor: Visitor, folder: Path) -> None:
    for camera in ("cam0", "cam1"):
        (folder / "room" / "mav0" / camera / "data").mkdir(parents=True)
        for number in range(3):
            (folder / "room" / "mav0" / camera / "data" / f"{number}.png").write_bytes(b"")
    for place in ("0:room", "0:room/mav0"):
        visitor.touch(f"open-folder:0:{place}")
        assert f"map-folder:{place}" in visitor.rows
        assert "Make a map of this sequence of cam0 and cam1, 6 images" in visitor.panel._list.content
        assert "metres are from its ground truth" in visitor.panel._list.content
    visitor.touch("open-folder:0:0:")
    assert "a recorded sequence of cam0 and cam1" in visitor.panel._list.content
    for place in ("cam1", "cam1/data"):
        visitor.touch(f"open-folder:0:0:room/mav0/{place}")
        assert "Make a map of this sequence of cam1, 3 images" in visitor.panel._list.content
        assert "For a map of all cameras of this sequence, cam0 and cam1, go up to mav0." in visitor.panel._list.content
        assert f"map-folder:0:room/mav0/{place}" in visitor.rows
    outside = folder.parent / "elsewhere"
    (folder / "room" / "mav0" / "cam1" / "data").rename(outside)
    (folder / "room" / "mav0" / "cam1" / "data").symlink_to(outside)
    visitor.touch("open-folder:0:0:room")
    assert "Make a map" not in visitor.panel._list.content
    visitor.touch("open-folder:0:0:")
    assert "a recorded sequence" not in visitor.panel._list.content


@pytest.mark.parametrize("place", ["walk", "walk/mav0/cam0/data"])
def test_other_images_of_a_sequence_are_localized_in_its_own_map(
    visitor: Visitor, folder: Path, rng: np.random.Generator, place: str
) -> None:
    """If most of its images are not in the map."""
    data = folder / "walk" / "mav0" / "cam0" / "data"
    data.mkdir(parents=True)
    inside = "" if place.endswith("data") else "mav0/cam0/data/"
    names = [f"{inside}{1_520_530_308_000_000_000 + 50_000_000 * k}.png" for k in range(120)]
    for name in names:
        cv2.imwrite(str(folder / place / name), np.zeros((320, 640), np.uint8))
    model = sample_model(rng, models=(EQUIRECTANGULAR,))
    images = [(*one[:3], name, one[4]) for one, name in zip(model.images, names[::30], strict=True)]
    written = write(folder / "walk_map" / "model", binary_files(replace(model, images=images)))
    head = MapHead("walk (units unknown)", "One.", f"../{place}", UNITS_UNKNOWN, ("", "[gravity]", "map = [0, 0, -1]"))
    (written.parent / "scene.toml").write_text(scene_text(head, own_queries(names[::30])))
    visitor.touch("open-scene:0:walk_map/scene.toml")
    visitor.touch(f"open-folder:0:0:{place}")
    assert "Localize other images of this sequence in its map" in visitor.panel._list.content
    visitor.touch("open-folder:0:0:")
    assert not [row for row in visitor.rows if row.startswith("localize-folder")], "the folder above"
    visitor.touch(f"localize-folder:0:{place}")
    queries = {view.name for view in visitor.opened[-1].scene.queries}
    assert len(queries) == 40 and not queries & set(names[::30])
    for name in names[7:]:
        (folder / place / name).unlink()
    visitor.touch(f"open-folder:0:0:{place}")
    assert "Localize other images" not in visitor.panel._list.content, "four of seven may be in the map"


def test_photographs_are_localized_in_the_map_at_hand(visitor: Visitor, folder: Path, rng: np.random.Generator) -> None:
    """They become queries of a scene beside the map's own, which is opened."""
    own, later = [f"seq/{k:03}.jpg" for k in range(4)], ["image_0.png", "image_1.png"]
    for path in (*(folder / "home" / name for name in own), *(folder / "later" / name for name in later)):
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.zeros((320, 640), np.uint8))
    written = write(folder / "home_map" / "model", binary_files(sample_model(rng, models=(EQUIRECTANGULAR,))))
    head = MapHead("home (units unknown)", "A map.", "../home", UNITS_UNKNOWN, ("", "[gravity]", "map = [0, 0, -1]"))
    (written.parent / "scene.toml").write_text(scene_text(head, own_queries(own)))

    visitor.touch("open-folder:0:0:later")
    assert "localize-folder:0:later" not in visitor.rows, "no map is shown"
    visitor.touch("open-scene:0:home_map/scene.toml")
    assert visitor.said == ""
    visitor.touch("open-folder:0:0:home")
    assert "localize-folder:0:home" not in visitor.rows, "these are the map's own"
    visitor.touch("open-folder:0:0:")
    assert not [row for row in visitor.rows if row.startswith("localize-folder")], "the map's own are below it"
    visitor.touch("open-folder:0:0:later")
    assert "no folders, no photographs" not in visitor.panel._list.content
    assert "Localize these 2 photographs in the map of home" in visitor.panel._list.content
    visitor.touch("localize-folder:0:later")
    opened = visitor.opened[-1]
    assert opened.path == folder / "home_map" / "later.toml" and opened.label == "later in home (units unknown)"
    assert isinstance(opened.scene, MapScene)
    assert [view.name for view in opened.scene.queries] == later
    assert len(opened.scene.references) == 4 and not opened.scene.metric
    visitor.touch("localize-folder:0:sub")
    assert "has no images; give a folder with images" in visitor.said


def test_names_of_files_are_escaped(visitor: Visitor) -> None:
    visitor.touch("open-folder:0:0:")
    assert "<img" not in visitor.panel._list.content and f"open-scene:0:{EVIL}" in visitor.rows
    visitor.touch(f"open-scene:0:{EVIL}")
    assert [opened.label for opened in visitor.opened] == [EVIL]


def upload(visitor: Visitor, matches: bytes, calibration: bytes | None) -> None:
    visitor.page.upload(visitor.matches, "my <b>matches</b>.csv", matches, part=200)
    until(lambda: "matches" in visitor.panel._files)
    if calibration is not None:
        visitor.page.upload(visitor.calibration, "camera.toml", calibration)
        until(lambda: "calibration" in visitor.panel._files)
    visitor.page.press(visitor.go)
    until(lambda: visitor.opened or visitor.panel._status.visible)
    visitor.settle()


def test_uploaded_matches_are_opened_on_this_page_only(
    visitor: Visitor, server: viser.ViserServer, folder: Path
) -> None:
    other = Visitor(server, folder, visitor.panel._recent._path)
    upload(visitor, CSV.encode(), CAMERA.encode())
    (opened,) = visitor.opened
    # What stands before a slash is a folder to us.
    assert opened.label == "uploaded: b>.csv" and len(opened.scene.problem()) == 12 and not other.opened
    assert "<b>" not in visitor.panel._files_text.content and "12 matches" not in other.panel._list.content
    assert not opened.path.is_relative_to(folder) and opened.path.is_file()
    assert RecentScenes(visitor.panel._recent._path).read()[0] == (), "it will be gone, so it is not remembered"
    visitor.panel.close()
    assert not opened.path.parent.parent.exists(), "the session's folder goes with it"
    other.close()


def test_a_pasted_calibration_goes_before_an_uploaded_one(visitor: Visitor) -> None:
    visitor.panel._pasted.value = CAMERA.replace("512", "1024").replace("256", "512")
    upload(visitor, CSV.encode(), CAMERA.encode())
    assert visitor.opened[0].scene.problem().camera.width == 1024


@pytest.mark.parametrize(
    "matches, calibration, sentence",
    [
        (CSV.encode(), None, "A calibration is missing; upload one."),
        (b"u,v\n", CAMERA.encode(), "column &#x27;X&#x27; is missing"),
        (CSV.encode(), b'image = "/etc/passwd"\n' + CAMERA.encode(), "cannot name other files"),
        (
            CSV.encode() + b"<script>,1,2,3,4\n",
            CAMERA.encode(),
            "line 14: u is &#x27;&lt;script&gt;&#x27;, not a number",
        ),
    ],
)
def test_a_bad_upload_is_said_in_one_sentence(
    visitor: Visitor, matches: bytes, calibration: bytes | None, sentence: str
) -> None:
    upload(visitor, matches, calibration)
    assert sentence in visitor.said and not visitor.opened and "<b>" not in visitor.said


def test_a_file_too_large_is_turned_away_while_it_arrives(visitor: Visitor) -> None:
    under_way = visitor.page.handle.gui._current_file_upload_states
    ended: list[str] = []

    def note(message: dict[str, Any]) -> None:
        if message["type"] == "FileTransferPartAck" and message["transferred_bytes"] == message["total_bytes"]:
            ended.append(message["transfer_uuid"])

    visitor.page.answer = note
    visitor.page.upload(visitor.matches, "big.csv", b"x" * 300_000, said=MAX_BYTES + 1)
    until(lambda: "larger than 10 MB" in visitor.said)
    until(lambda: ended == ["big.csv"])  # else the page keeps its button disabled
    assert not under_way, "nothing of it is kept"
    visitor.panel._status.visible = False
    visitor.page.upload(visitor.matches, "liar.csv", b"x" * 300_000, said=1000)
    until(lambda: "larger than it said" in visitor.said)
    until(lambda: not under_way)
    assert "matches" not in visitor.panel._files
    visitor.page.upload(visitor.calibration, "big.yaml", b"#" * 300_000)
    until(lambda: "big.yaml: larger than 0.26 MB" in visitor.said)
    assert "calibration" not in visitor.panel._files


def test_files_that_never_end_do_not_pile_up(visitor: Visitor) -> None:
    gui = visitor.page.handle.gui
    start: dict[str, Any] = {
        "type": "FileTransferStartUpload",
        "source_component_uuid": visitor.matches._impl.uuid,
        "filename": "x",
        "mime_type": "",
        "part_count": 5,
        "size_bytes": 5000,
    }
    for number in range(6):
        visitor.page.send(start | {"transfer_uuid": f"slow-{number}"})
    until(lambda: "two files are on their way already" in visitor.said.lower())
    assert len(gui._current_file_upload_states) <= 2


def test_real_matches_can_be_uploaded(visitor: Visitor, aria: Path) -> None:
    table = (aria / "rgb.toml").read_text()
    visitor.panel._gravity[0].value = "0.878193611531, -0.0180378573705, 0.477965078607"
    visitor.panel._gravity[1].value = "0 -1 0"
    visitor.panel._truth.value = " ".join(re.findall(r"-?\d+\.\d+", table[table.index("[truth]") :]))
    matches = next((aria / "correspondences").glob("camera-rgb*.csv"))
    upload(visitor, matches.read_bytes(), table[table.index("[camera]") : table.index("[gravity]")].encode())
    problem = visitor.opened[0].scene.problem()
    assert problem.truth_cam_from_map is not None and np.isclose(problem.truth_cam_from_map[0, 3], 1.3800606943)
