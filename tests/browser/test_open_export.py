"""Scenes from elsewhere and uploads come onto the page, and what is seen leaves it as files."""

import base64
import io
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playground import SCENE, Playground, blind_page, served
from playwright.sync_api import Browser, Locator, Page, expect

from spherloc.estimators import estimate
from spherloc.problem import Problem
from spherloc_viz.app.catalog import Catalog, SceneRequest
from spherloc_viz.layers.outcome import outcome_table
from spherloc_viz.recording.content.data import read_recording
from tests.waiting import LIMIT_S, until

CAMERA = '[camera]\nmodel = "equirectangular"\nwidth = 2048\nheight = 1024\n'


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one that pages may look into, ``maps``, one that they may not, and one for scratch files."""
    base = tmp_path_factory.mktemp("open")
    for name in ("start", "maps/north", "secret", "scratch"):
        (base / name).mkdir(parents=True)
    (base / "start" / "small.toml").write_text(SCENE)
    north = SCENE.replace("small street", "northern street").replace("= 40", "= 33").replace("seed = 3", "seed = 8")
    (base / "maps" / "north" / "street.toml").write_text(north)
    (base / "maps" / "broken.toml").write_text(SCENE.replace("0.5", "5.0"))
    (base / "secret" / "hidden.toml").write_text(SCENE)
    return base


@pytest.fixture(scope="module")
def own_address(folders: Path) -> Iterator[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folders / "scratch"))
        patch.setenv("SPHERLOC_CACHE", str(folders / "cache"))
        words = ("--allow", folders / "maps", "--recordings", folders / "recordings")
        with served(folders / "start" / "small.toml", *words) as (address, _):
            yield address


@pytest.fixture
def open_page(browser: Browser, own_address: str) -> Iterator[Callable[[], Playground]]:
    """Opens pages of this file's own server and closes them after the test."""
    pages: list[Playground] = []

    def opened() -> Playground:
        pages.append(Playground(browser, own_address))
        return pages[-1]

    yield opened
    for page in pages:
        page.close()


def row(tab: Playground, kind: str, name: str) -> Locator:
    """A row of the list of scenes."""
    pressed = tab.page.locator(f"tr[data-touch^='open-{kind}:']")
    return pressed.filter(has_text=re.compile(rf"^{re.escape(name)}")).last


DROPPED = """files => {
    const dataTransfer = new DataTransfer(), at = document.querySelector("canvas");
    for (const [name, content] of Object.entries(files))
        dataTransfer.items.add(new File([Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0))], name));
    return ["dragover", "drop"].map((kind) => {
        const event = new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer });
        at.dispatchEvent(event);
        return event.defaultPrevented;
    });
}"""
"""Drops files, by name their content in base64, onto the canvas; whether the page has kept each event from the
browser."""


def test_scenes_are_opened_from_allowed_folders(open_page: Callable[[], Playground], folders: Path) -> None:
    tab = open_page()
    tab.tab("Open")
    row(tab, "scene", "fisheye_outliers_80.toml").click()
    expect(tab.value("inliers")).to_have_text(re.compile(" of 100$"))
    tab.tab("Play")
    expect(tab.widget("Scene")).to_have_value("Kannala-Brandt fisheye, 80 % outliers")

    tab.tab("Open")
    row(tab, "folder", "maps/").click()
    row(tab, "scene", "broken.toml").click()
    wrong = tab.page.get_by_text(re.compile("outlier_rate"))
    expect(wrong).to_be_visible()
    assert "broken.toml" in wrong.inner_text() and str(folders) in wrong.inner_text()
    expect(tab.value("inliers")).to_have_text(re.compile(" of 100$"))
    row(tab, "folder", "north/").press("Enter")  # a mouse might meet another row, since the sentence moves the list
    row(tab, "scene", "street.toml").click()
    expect(tab.value("inliers")).to_have_text(re.compile(" of 33$"))
    expect(wrong).to_have_count(0)
    tab.tab("Play")
    expect(tab.widget("Scene")).to_have_value("northern street")
    expect(tab.entry("Seed")).to_have_value("8")
    tab.tab("Open")
    expect(tab.page.get_by_text("Recent", exact=True)).to_be_visible()
    expect(tab.page.get_by_text("hidden.toml")).to_have_count(0)
    assert tab.errors == []


def drop_folder(tab: Playground, folder: Path) -> None:
    """Drop a folder onto the canvas as a person does, which no script in a page can."""
    chromium = tab.page.context.new_cdp_session(tab.page)
    at = tab.page.locator("canvas").first.bounding_box()
    assert at is not None
    place = {"x": at["x"] + at["width"] / 2, "y": at["y"] + at["height"] / 2}
    data = {"items": [], "files": [str(folder)], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        chromium.send("Input.dispatchDragEvent", {"type": kind, "data": data, **place})
    chromium.detach()


def base64_of(picture: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


def test_photographs_that_are_dropped_are_offered_as_a_map(
    open_page: Callable[..., Playground], folders: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    tab, text = open_page(), base64.b64encode(b"text").decode()
    card = tab.page.locator(".opening")
    assert tab.page.evaluate(DROPPED, {"notes": text}) == [True, True], (
        "the browser does not show it in the page's place"
    )
    expect(card).to_contain_text("notes was not opened")
    expect(card).to_contain_text("Left out: 1 file of another format (notes). Drop photographs (.bmp")
    tab.tab("Compare")
    expect(card).to_have_count(0)  # the card goes with the next press elsewhere

    pictures = {f"{name}.png": rng.integers(0, 256, (32, 64, 3), dtype=np.uint8) for name in ("a", "b", "c ü")}
    photographs = {name: base64_of(picture) for name, picture in pictures.items()}
    files = photographs | {"camera.toml": base64.b64encode(CAMERA.encode()).decode(), "IMG.HEIC": text}
    tab.page.evaluate(DROPPED, files)
    expect(tab.page.get_by_text("Make a map of these 3 photographs")).to_be_in_viewport()  # the tab Open is to be seen
    expect(card).to_contain_text("3 photographs")
    expect(card).to_contain_text("Left out: 1 file to be converted to JPEG or PNG (IMG.HEIC).")
    kept = folders / "maps" / "dropped_photographs"
    expect(tab.page.get_by_text(f"The photographs are kept in {kept}.")).to_be_visible()
    assert sorted(path.name for path in kept.iterdir()) == sorted([*photographs, "camera.toml"])
    for name, picture in pictures.items():
        np.testing.assert_array_equal(np.asarray(Image.open(kept / name)), picture)

    for name in ("left/0.png", "left/1.png", "left/.hidden.png", "right/0.png", "left/deeper/calibration.yaml"):
        (tmp_path / "my rig" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "my rig" / name).write_bytes(name.encode())
    drop_folder(tab, tmp_path / "my rig")
    expect(tab.page.get_by_text("Make a map of the 3 photographs in the folders left and right")).to_be_in_viewport()
    expect(card).to_contain_text("my rig: 3 photographs")
    kept = folders / "maps" / "dropped_my_rig"
    found = {path.relative_to(kept).as_posix(): path.read_text() for path in kept.rglob("*.*")}
    assert found == {name: name for name in ("left/0.png", "left/1.png", "left/deeper/calibration.yaml", "right/0.png")}

    # While the first file is kept waiting, another drop is not taken, and all of it can be taken back.
    tab.page.route("**/drop/*/file*", lambda route: None)
    tab.page.evaluate(DROPPED, photographs)
    expect(card).to_contain_text("0 of 3 photographs")
    tab.page.evaluate(DROPPED, {"other.png": photographs["a.png"]})
    expect(card).to_contain_text("other.png was not opened: drop it when these are there.")
    assert list((folders / "maps").glob(".dropped*"))
    card.get_by_role("button", name="Cancel").click()
    expect(card).to_have_count(0)
    until(lambda: not list((folders / "maps").glob(".dropped*")))
    assert not (folders / "maps" / "dropped_photographs_2").exists()
    assert tab.errors == []


def matches_csv(problem: Problem) -> str:
    rows = np.hstack([problem.pixels, problem.points])
    return "u,v,X,Y,Z\n" + "".join(",".join(map(repr, map(float, values))) + "\n" for values in rows)


def upload(tab: Playground, button: str, name: str, content: str) -> None:
    """Give a file to a button, and wait until the page says that it has it."""
    with tab.page.expect_file_chooser() as chooser:
        tab.press(button)
    data = content.encode()
    chooser.value.set_files({"name": name, "mimeType": "text/plain", "buffer": data})
    expect(tab.page.get_by_text(re.compile(rf"{re.escape(name)}, {len(data):,} bytes"))).to_be_visible()


def words(values: np.ndarray) -> str:
    return " ".join(map(repr, map(float, np.ravel(values))))


def scratch_files(folders: Path) -> list[Path]:
    return [path for path in (folders / "scratch").rglob("*") if path.name == "matches.csv"]


def test_an_upload_is_solved_and_stays_with_its_page(
    open_page: Callable[[], Playground], own_address: str, folders: Path
) -> None:
    catalog = Catalog(folders / "start" / "small.toml")
    problem = catalog.problem(SceneRequest("small street", 77))
    assert problem.truth_cam_from_map is not None
    tab, text = open_page(), matches_csv(problem)
    tab.tab("Open")
    tab.unfold("Upload matches")
    tab.press("Open upload")
    expect(tab.page.get_by_text("A CSV of matches is missing; upload one.")).to_be_visible()

    lines = text.splitlines(keepends=True)
    upload(tab, "Matches (CSV)", "bad.csv", "".join([*lines[:4], "12,left,1,2,3\n", *lines[4:]]))
    upload(tab, "Calibration", "camera.toml", CAMERA)
    tab.press("Open upload")
    wrong = tab.page.get_by_text(re.compile(r"^bad\.csv"))
    expect(wrong).to_be_visible()
    assert re.search(r"line 5\b", wrong.inner_text()) and wrong.inner_text().count("\n") == 0
    assert str(folders) not in wrong.inner_text()
    expect(tab.value("inliers")).to_have_text(re.compile(" of 40$"))

    upload(tab, "Matches (CSV)", "mine.csv", text)
    tab.type("Gravity, camera", words(problem.gravity_camera))
    tab.type("Gravity, map", words(problem.gravity_map))
    tab.type("True pose", words(problem.truth_cam_from_map))
    tab.press("Open upload")
    tab.tab("Play")
    expect(tab.widget("Scene")).to_have_value("uploaded: mine.csv")
    expected = dict(outcome_table(estimate(problem, "mc", seed=0)).rows)
    assert expected["outcome"] == "success"
    for name in ("outcome", "inliers", "rotation error", "position error"):
        expect(tab.value(name)).to_have_text(expected[name])
    expect(wrong).to_have_count(0)
    assert scratch_files(folders)
    assert tab.errors == []

    other = open_page()
    other.widget("Scene").click()
    expect(other.page.get_by_role("option", name="small street", exact=True)).to_be_visible()
    expect(other.page.get_by_role("option", name=re.compile("uploaded"))).to_have_count(0)
    expect(other.page.get_by_role("option", name="northern street")).to_have_count(0)
    other.tab("Open")
    expect(row(other, "scene", "fisheye_outliers_80.toml")).to_be_visible()
    expect(other.page.get_by_text(re.compile(r"mine\.csv"))).to_have_count(0)

    tab.page.close()
    until(lambda: not any(folders.joinpath("scratch").glob("spherloc-*")))


def downloaded(tab: Playground, button: str, folder: Path) -> Path:
    """Press a button; the file that comes of it."""
    with tab.page.expect_download() as found:
        tab.press(button)
    path = folder / found.value.suggested_filename
    found.value.save_as(path)
    return path


def test_what_is_seen_leaves_as_files(
    browser: Browser, open_page: Callable[[], Playground], folders: Path, tmp_path: Path
) -> None:
    tab = open_page()
    expect(tab.page.get_by_text(re.compile(r"^Recorded as "))).to_be_visible()
    inliers = tab.value("inliers").inner_text()
    tab.tab("Share")

    tab.draw_canvas(True)
    picture = downloaded(tab, "Picture (PNG)", tmp_path)
    assert picture.name == "spherloc-small-street-mc.png"
    pixels = np.asarray(Image.open(picture).convert("RGB"))
    box = tab.page.locator("canvas").first.bounding_box()
    assert box is not None
    height = round(pixels.shape[1] * box["height"] / box["width"])
    words = pixels[height + 2 :]
    assert 20 < len(words) < 0.2 * height and words.std() > 5.0, "scene and step stand below the canvas"
    pixels = pixels[: height - 2]
    seen = np.asarray(Image.open(io.BytesIO(tab.page.screenshot(clip=box))).convert("RGB"))  # pyright: ignore
    tab.draw_canvas(False)
    assert np.abs(pixels[-4, 4].astype(int) - seen[-4, 4]).max() <= 2, "the background is the page's"
    colors, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    assert len(colors) > 50 and counts.max() < 0.995 * counts.sum()
    assert (np.abs(pixels.astype(int) - pixels[0, 0]).max(axis=2) > 30).mean() > 0.002
    red, green, blue = np.moveaxis(pixels.astype(float), 2, 0)
    inlier_colored = (green > 90) & (green > 1.5 * red) & (green > 1.2 * blue)
    assert np.count_nonzero(inlier_colored) > 50, "rays of inliers are seen"

    recording = downloaded(tab, "Recording (.rrd)", tmp_path)
    run = read_recording(recording)
    assert f"{int(run.inlier_mask.sum())} of {len(run.problem)}" == inliers
    expected = estimate(
        Catalog(folders / "start" / "small.toml").problem(SceneRequest("small street", 3)), "mc", seed=3
    )
    np.testing.assert_array_equal(run.cam_from_map, expected.cam_from_map)

    page = downloaded(tab, "Scene (HTML)", tmp_path)
    shown = visible_nodes(tab.page)
    assert "/map/points" in shown and "/cameras/estimate" in shown
    assert tab.errors == []
    tab.close()
    check_page(browser, page, shown)


def visible_nodes(page: Page) -> dict[str, int]:
    """What is visible on a canvas: by node the bytes of its arrays."""
    script = """() => Object.entries(window.__viserSceneTree?.getState() ?? {})
        .filter(([name, node]) => node.effectiveVisibility && node.message?.props)
        .map(([name, {message}]) => [name, Object.values(message.props).reduce((n, x) => n + (x?.byteLength ?? 0), 0)])
        .filter(([name, bytes]) => bytes > 0)"""
    return dict(page.evaluate(script))


def check_page(browser: Browser, path: Path, shown: dict[str, int]) -> None:
    """The file opens from the disk, asks for nothing, and has what the canvas had."""
    page = blind_page(browser)
    asked: list[str] = []
    errors: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("websocket", lambda socket: asked.append(socket.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.goto(path.as_uri())
    expect(page).to_have_title("small street")
    expect(page.get_by_text("maximum clique", exact=True)).to_be_visible()
    end = time.monotonic() + LIMIT_S
    while (found := visible_nodes(page)) != shown:
        assert time.monotonic() < end, f"the file shows {found}, not {shown}"
        page.wait_for_timeout(100)
    own = path.as_uri()
    assert [url for url in asked if url != own and not url.startswith(("data:", "blob:"))] == []
    assert errors == []
    page.context.close()
