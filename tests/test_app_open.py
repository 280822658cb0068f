"""What a page may open: nothing outside the allowed folders, and no upload that is not what it should be."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.datasets import bundled_scenes
from spherloc.datasets.correspondences import CorrespondencesScene
from spherloc.errors import InputError
from spherloc_viz.app.panels.folders import MAX_ENTRIES, PAGE, Roots
from spherloc_viz.app.panels.open_panel import MAX_RECENT, RecentScenes
from spherloc_viz.app.panels.uploads import MAX_BYTES, MAX_ROWS, File, Scratch, UploadForm, numbers, open_upload
from tests.needs import real_data

ROOT = Path(__file__).resolve().parents[1]
CAMERA = '[camera]\nmodel = "equirectangular"\nwidth = 512\nheight = 256\n'
CSV = "u,v,X,Y,Z\n" + "".join(f"{20 * k + 5},{90 + 7 * k},{k - 5},{k % 3},{4 + k % 5}\n" for k in range(12))
EVIL = '../../<img src=x onerror="alert(1)">.csv'
SCENE = f'kind = "correspondences"\nname = "mine"\ncorrespondences = "m.csv"\n{CAMERA}[gravity]\ncamera = [0,1,0]\n'


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """An allowed folder ``open`` beside a forbidden one, with links of every kind."""
    for name in ("open/sub/deep", "secret", "also", "open/.hidden"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("open/a.toml", "open/sub/b.toml", "secret/c.toml", "also/d.toml", "open/.e.toml"):
        (tmp_path / name).write_text(SCENE)
    (tmp_path / "open" / "plain.toml").write_text("x = 1\n")
    (tmp_path / "open" / "broken.toml").write_text("= 1\n")
    (tmp_path / "open" / "notes.txt").write_text("no scene")
    links = {
        "out": "secret",
        "out.toml": "secret/c.toml",
        "near.toml": "open/sub/b.toml",
        "also": "also",
        "loop": "open",
    }
    for name, target in links.items():
        (tmp_path / "open" / name).symlink_to(tmp_path / target)
    (tmp_path / "open" / "gone.toml").symlink_to(tmp_path / "nowhere")
    (tmp_path / "open" / "circle").symlink_to(tmp_path / "open" / "circle")
    os.mkfifo(tmp_path / "open" / "pipe.toml")
    return tmp_path


@pytest.mark.parametrize(
    "place",
    [
        "0:../secret/c.toml",
        "0:sub/../../secret/c.toml",
        "0:/etc/passwd",
        "0:out",
        "0:out/c.toml",
        "0:out.toml",
        "0:..",
        "0:sub/../..",
        "0:gone.toml",
        "0:circle",
        "0:nothing.toml",
        "0:a.toml/../../secret/c.toml",
        "0:a\0.toml",
        "0:" + "x" * 5000,
        "1:c.toml",
        "-1:a.toml",
        "٠:a.toml",
        "99999999999999999999:a.toml",
        ":a.toml",
        "a.toml",
        "",
        "0",
        "0:~/x",
        "0:\ud800",
    ],
)
def test_a_place_outside_is_refused(house: Path, place: str) -> None:
    with pytest.raises(InputError, match=r"choose one from the list\.$"):
        Roots([house / "open"]).find(place)


def test_places_inside_are_found(house: Path) -> None:
    roots = Roots([house / "open", house / "nowhere", house / "also", house / "open" / "."])
    assert roots.folders == (house / "open", house / "also"), "what is missing or the same is no root"
    assert roots.find("0:a.toml") == house / "open" / "a.toml"
    assert roots.find("0:") == house / "open"
    assert roots.find("0:near.toml") == roots.find("0:loop/loop/sub/b.toml") == house / "open/sub/b.toml"
    assert roots.find("0:also/d.toml") == house / "also" / "d.toml", "a link into another root is allowed"
    assert roots.place(house / "open/sub/b.toml") == "0:sub/b.toml" and roots.place(house / "secret") is None
    assert roots.place(house / "open-not") is None, "a folder whose name begins alike is another"


PARTS = st.sampled_from(
    ["..", ".", "sub", "deep", "out", "loop", "also", "secret", "a.toml", "c.toml", "", "/", "~", "\0"]
)


@settings(max_examples=150)
@given(parts=st.lists(PARTS | st.text(max_size=4), max_size=7), number=st.integers(-2, 3))
def test_no_path_leads_out(tmp_path_factory: pytest.TempPathFactory, parts: list[str], number: int) -> None:
    base = tmp_path_factory.getbasetemp() / "walk"
    if not base.exists():
        (base / "open" / "sub" / "deep").mkdir(parents=True)
        (base / "secret").mkdir()
        (base / "secret" / "c.toml").write_text(SCENE)
        (base / "open" / "a.toml").write_text(SCENE)
        (base / "open" / "out").symlink_to(base / "secret")
        (base / "open" / "sub" / "up").symlink_to("..")
    roots = Roots([base / "open"])
    try:
        found = roots.find(f"{number}:" + "/".join(parts))
    except InputError:
        return
    real = Path(os.path.realpath(found))
    assert real == found and real.is_relative_to(base / "open") and real.exists()


def test_a_listing_shows_what_can_be_opened_and_says_what_not(house: Path) -> None:
    listing = Roots([house / "open"]).look_into("0:")
    kinds = {row.name: row.kind for row in listing.rows}
    assert kinds == {
        "loop": "folder",
        "sub": "folder",
        "a.toml": "scene",
        "broken.toml": "other",
        "near.toml": "scene",
        "pipe.toml": "other",
        "plain.toml": "other",
    }
    assert listing.parent is None and listing.pages == 1
    # Two hidden ones; and links to two folders, to a file outside and to nowhere.
    assert [remark.split()[0] for remark in listing.remarks] == ["2", "4"]
    deeper = Roots([house / "open"]).look_into("0:sub")
    assert deeper.parent == "0:." and [row.place for row in deeper.rows] == ["0:sub/deep", "0:sub/b.toml"]


def test_long_folders_have_pages(tmp_path: Path) -> None:
    for number in range(2 * PAGE + 3):
        (tmp_path / f"s{number:03}.toml").write_text(SCENE)
    roots = Roots([tmp_path])
    pages = [roots.look_into("0:", page) for page in range(3)]
    assert [len(page.rows) for page in pages] == [PAGE, PAGE, 3] and {page.pages for page in pages} == {3}
    names = [row.name for page in pages for row in page.rows]
    assert names == sorted(path.name for path in tmp_path.iterdir())
    assert roots.look_into("0:", 99).page == 2 and roots.look_into("0:", -5).page == 0


def test_a_folder_that_cannot_be_read_says_so(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> Iterator[os.DirEntry]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "scandir", refuse)  # root may read what is forbidden
    with pytest.raises(InputError, match=r"the folder sub cannot be read \(Permission denied\)"):
        Roots([house / "open"]).look_into("0:sub")
    with pytest.raises(InputError, match="cannot be read"):
        Roots([house / "open"]).look_into("0:a.toml")


def test_an_endless_folder_is_looked_at_in_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spherloc_viz.app.panels.folders.MAX_ENTRIES", 5)
    for number in range(8):
        (tmp_path / f"{number}.toml").write_text(SCENE)
    listing = Roots([tmp_path]).look_into("0:")
    assert len(listing.rows) == 5 and "first 5 entries" in listing.remarks[0] and MAX_ENTRIES > 1000


def test_recent_scenes_are_remembered_newest_first(tmp_path: Path) -> None:
    recent = RecentScenes(tmp_path / "deep" / "scenes.json")
    assert recent.read() == ((), "")
    paths = [tmp_path / f"{number}.toml" for number in range(MAX_RECENT + 3)]
    for path in [*paths, paths[-2]]:
        recent.note(path)
    kept, remark = RecentScenes(tmp_path / "deep" / "scenes.json").read()
    assert kept[:3] == (paths[-2], paths[-1], paths[-3]) and len(kept) == MAX_RECENT and not remark
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["scenes.json"], "no half-written file is left"


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[1]", b"[", b"\xff\xfe", b"[" * 50_000, b'["' + b"x" * 200_000 + b'"]', b"null"]
)
def test_a_damaged_list_is_ignored_with_a_remark(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scenes.json"
    path.write_bytes(content)
    recent = RecentScenes(path)
    kept, remark = recent.read()
    assert kept == () and "damaged" in remark
    recent.note(tmp_path / "a.toml")
    assert recent.read() == ((tmp_path / "a.toml",), "")


def form(**changes: object) -> UploadForm:
    values = {
        "matches": File("my matches.csv", CSV.encode()),
        "calibration": File("camera.toml", CAMERA.encode()),
        "gravity_camera": "0 1 0",
        "gravity_map": "[0, 0, -1]",
        "gravity_bound_deg": "",
        "truth": "",
    }
    return UploadForm(**values | changes)  # type: ignore[arg-type]


def test_an_upload_becomes_a_scene(tmp_path: Path) -> None:
    truth = "1 0 0 0; 0 0 -1 0; 0 1 0 2.5"
    path, scene = open_upload(form(gravity_bound_deg="1.5", truth=truth), tmp_path)
    problem = scene.problem()
    assert isinstance(scene, CorrespondencesScene) and scene.name == "my matches.csv" and len(problem) == 12
    assert np.array_equal(problem.points[3], [-2, 0, 7]) and np.array_equal(problem.pixels[3], [65, 111])
    assert np.isclose(problem.gravity_bound_rad, np.radians(1.5)) and np.array_equal(problem.gravity_map, [0, 0, -1])
    assert problem.truth_cam_from_map is not None and problem.truth_cam_from_map[2, 3] == 2.5
    assert path.parent == tmp_path and {item.name for item in tmp_path.iterdir()} == {
        "calibration",
        "matches.csv",
        "scene.toml",
    }


@pytest.mark.parametrize(
    "name", ["basalt_tumvi_512_ds_calib.json", "tumvi_kalibr_imucam_chain.yaml", "adapter_euroc_KB.yml"]
)
def test_calibrations_of_other_tools_are_taken(tmp_path: Path, name: str) -> None:
    content = (real_data("formats_real") / name).read_bytes()
    _, scene = open_upload(form(calibration=File(name, content)), tmp_path)
    assert scene.problem().camera.width >= 512


def test_real_matches_are_taken(tmp_path: Path, aria: Path) -> None:
    matches = next((aria / "correspondences").glob("camera-rgb*.csv"))
    text = (aria / "rgb.toml").read_text()
    camera = text[text.index("[camera]") : text.index("[gravity]")]
    gravity = "0.878193611531, -0.0180378573705, 0.477965078607"
    changes = {"calibration": File("x", camera.encode()), "gravity_camera": gravity, "gravity_map": "0 -1 0"}
    _, scene = open_upload(form(matches=File(matches.name, matches.read_bytes()), **changes), tmp_path)
    assert len(scene.problem()) == len(matches.read_text().splitlines()) - 1


NUL = CSV.replace("90", "9\0").encode()
ROWS = b"u,v,X,Y,Z\n" + b"1,2,3,4,5\n" * MAX_ROWS
BAD = [
    ({"matches": File("big.csv", b"1" * (MAX_BYTES + 1))}, r"^big\.csv: larger than 10 MB"),
    ({"matches": File("long.csv", ROWS)}, r"^long\.csv: has more than 200,000 lines"),
    ({"matches": File("old.csv", ROWS.replace(b"\n", b"\r"))}, r"^old\.csv: has more than 200,000 lines"),
    ({"matches": File("empty.csv", b"")}, r"^empty\.csv: is empty"),
    ({"matches": File("nul.csv", NUL)}, r"^nul\.csv: byte \d+ is not text"),
    ({"matches": File("b.csv", b"\x89PNG\r\n\x1a\n\xff")}, r"^b\.csv: not a CSV text file"),
    ({"matches": File("c.csv", b"u,v,X,Y\n1,2,3,4\n")}, r"^c\.csv: column 'Z' is missing"),
    ({"matches": File("f.csv", (CSV + "=1+1,2,3,4,5\n").encode())}, r"^f\.csv, line 14: u is '=1\+1', not a number"),
    ({"matches": File("s.csv", (CSV + "1,2,3\n").encode())}, r"^s\.csv, line 14: 3 values under 5 columns"),
    ({"matches": File("n.csv", (CSV + "nan,2,3,4,5\n").encode())}, r"^n\.csv, line 14: u is nan"),
    ({"matches": File("h.csv", (CSV + "1,2,1e300,4,5\n").encode())}, r"^h\.csv, line 14: X is 1e\+300, beyond 1e\+09"),
    ({"matches": File("one.csv", b"u,v,X,Y,Z\n9,9,3,4,5\n")}, r"one\.csv: 1 usable of 1 correspondences"),
    ({"matches": File(EVIL, b"u,v\n")}, r"^<img src=x onerror=\"alert\(1\)\">\.csv: column 'X'"),
    ({"calibration": File("k.yaml", b"cam0:\n  camera_model: nope\n")}, r"^k\.yaml: "),
    ({"calibration": File("k.bin", b"\xff" * 300)}, r"^k\.bin: byte 0 is not UTF-8"),
    ({"calibration": File("k.toml", b"#" * 300_000)}, r"^k\.toml: larger than 256 KiB"),
    ({"calibration": File("a.toml", f'image = "/etc/passwd"\n{CAMERA}'.encode())}, r"^a\.toml: has 'image' beside"),
    ({"calibration": File("a.toml", SCENE.encode())}, r"^a\.toml: has 'correspondences' beside .*name other files\.$"),
    ({"calibration": File("a.toml", f'{CAMERA}image = "/etc/passwd"'.encode())}, r"^a\.toml: .*'image' is unknown"),
    ({"gravity_camera": "0 1"}, r"^gravity in the camera is '0 1'; give 3 numbers\.$"),
    ({"gravity_map": "0 0 -9.81"}, r"gravity_map has length 9\.81; give a unit vector"),
    ({"gravity_bound_deg": "much"}, r"^gravity's error is 'much'; give a number\.$"),
    ({"gravity_bound_deg": "200"}, r"bound_deg is 200\.0; give a number from 0 to 90"),
    ({"truth": "1 2 3"}, r"^the true pose is '1 2 3'; give 12 numbers\.$"),
    ({"truth": "1 " * 12}, r"the true cam_from_map is not a rotation matrix"),
    ({"truth": "inf " * 12}, r"^the true pose is 'inf"),
]


@pytest.mark.parametrize("changes, sentence", BAD, ids=[sentence[1:24] for _, sentence in BAD])
def test_a_bad_upload_gets_one_sentence(tmp_path: Path, changes: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        open_upload(form(**changes), tmp_path)
    assert str(tmp_path) not in str(caught.value), "folders of this machine are nobody's business"
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)
    assert {item.name for item in tmp_path.iterdir()} <= {"calibration", "matches.csv", "scene.toml"}


@settings(max_examples=120)
@given(content=st.binary(max_size=120) | st.text(st.sampled_from("uvXYZ,\n\r\"=-0123456789.e'\ufeff\0"), max_size=120))
def test_whatever_is_uploaded_is_a_scene_or_a_sentence(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str
) -> None:
    data = content if isinstance(content, bytes) else ("u,v,X,Y,Z\n" + content).encode()
    for changes in ({"matches": File("x.csv", data)}, {"calibration": File("x", data)}):
        folder = tmp_path_factory.mktemp("fuzz")
        try:
            _, scene = open_upload(form(**changes), folder)
        except InputError as error:
            assert str(folder) not in str(error)
        else:
            assert len(scene.problem()) >= 2


@settings(max_examples=80)
@given(name=st.text(max_size=90))
def test_an_uploaded_name_is_shown_and_never_used(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    folder = tmp_path_factory.mktemp("names") / "in"
    folder.mkdir()
    _, scene = open_upload(form(matches=File(name, CSV.encode())), folder)
    assert scene.name.isprintable() and 1 <= len(scene.name) <= 60 and "/" not in scene.name
    assert len(list(folder.parent.iterdir())) == 1 and len(list(folder.iterdir())) == 3


def test_numbers_are_read_however_they_are_apart() -> None:
    assert numbers(" [1, -2.5e3;\t3] ", 3, "x") == [1.0, -2500.0, 3.0]
    for text in ("", "1 2", "1 2 3 4", "1 2 x", "nan 1 2", "1e999 1 2", "[]"):
        with pytest.raises(InputError, match="x is"):
            numbers(text, 3, "x")


def test_the_scratch_folder_is_private_and_goes() -> None:
    scratch, unused = Scratch(), Scratch()
    one, other = scratch.new(), scratch.new()
    assert one != other and one.parent == other.parent
    assert stat.S_IMODE(one.parent.stat().st_mode) == stat.S_IMODE(one.stat().st_mode) == 0o700
    (one / "file").write_text("secret")
    scratch.close()
    unused.close()
    assert not one.parent.exists()
    with pytest.raises(InputError, match="page has been closed"):
        scratch.new()


def test_bundled_scenes_can_be_placed() -> None:
    roots = Roots([ROOT / "scenes"])
    assert {roots.place(path.resolve()) for path in bundled_scenes().values()} == {
        f"0:{path.name}" for path in (ROOT / "scenes").glob("*.toml")
    }
