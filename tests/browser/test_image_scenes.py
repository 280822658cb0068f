"""A scene made of images, as a user meets it: queries, matches on the photographs, the map's mesh, a whole sequence."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playground import SELECTED, Playground, served
from playwright.sync_api import Browser, expect

from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.map_scene import MapScene
from spherloc.experiments.results import ResultsLog, read_results
from spherloc_viz.commands.localize import Solving, localize_sequence
from spherloc_viz.recording.content.data import read_recording

PANORAMA = """
model = "equirectangular"
width = 512
height = 256
"""
FISHEYE = """
model = "kannala_brandt"
width = 384
height = 384
fx = 120.0
fy = 120.0
cx = 192.0
cy = 192.0
distortion = [0.0, 0.0, 0.0, 0.0]
"""
SCENE = """
kind = "rendered"
name = "small apartment"
provenance = "made by the test"
world = "apartment"
[camera]
model = "equirectangular"
width = 512
height = 256
[references]
count = 4
stop = 0.3
[queries]
count = 3
start = 0.05
stop = 0.25
"""


DOUBT = "Taken together with b.png, it should be 3.2 m from where it is found."


@pytest.fixture(scope="module")
def images_address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """Address of a playground with a small rendered scene, and where it records. A query of a scene beside it was
    localized before, and doubted."""
    folder = tmp_path_factory.mktemp("images")
    (folder / "small.toml").write_text(SCENE)
    (folder / "fisheye.toml").write_text(SCENE.replace(PANORAMA, FISHEYE).replace("small", "fisheye"))
    before = Solving("ransac-2p", (), folder / "recordings" / "kept", None)
    assert localize_sequence(folder / "fisheye.toml", [before], 0, ["query_001"], retry_failed=False) == 0
    found = read_results(before.output)
    with ResultsLog(before.output, found.configuration) as log:
        log.change([found.rows[0].doubted(DOUBT)])
    with served(folder / "small.toml", "--recordings", folder / "recordings") as (found, _):
        yield found, folder / "recordings"


@pytest.fixture(scope="module")
def images_tab(browser: Browser, images_address: tuple[str, Path]) -> Iterator[Playground]:
    """One page for all tests, which go on where the one before ended: a page and its first run cost 7 s. A link opens
    it, to a scene that is not there."""
    tab = Playground(browser, f"{images_address[0]}/#v=1&scene=nowhere")
    yield tab
    tab.page.context.close()


READ_PHOTO = """async place => {
    const image = new Image();
    image.src = getComputedStyle(place).backgroundImage.slice(5, -2);
    try {
        await image.decode();
    } catch {
        return null;
    }
    return [image.naturalWidth, image.naturalHeight];
}"""


def photo(tab: Playground, name: str) -> list[int]:
    """Width and height of the photograph behind the query's or the reference's matches.

    There is none for a moment while the page puts another one there.
    """
    place = tab.page.locator(f".match-{name}")
    size: list[int] = []

    def read() -> bool:
        size[:] = place.evaluate(READ_PHOTO) or []
        return bool(size)

    tab.until(read, f"a photograph of the {name}")
    return size


def ringed(tab: Playground) -> list[str]:
    """What stands beside the rings on both images."""
    return tab.page.locator(f"svg text[fill='{SELECTED}']").all_text_contents()


LIKENESS = """async lens => {
    const pixels = await Promise.all([...lens.querySelectorAll("img")].map(async one => {
        await one.decode();
        const canvas = Object.assign(document.createElement("canvas"), {width: 128, height: 64});
        const pen = canvas.getContext("2d");
        pen.drawImage(one, 0, 0, 128, 64);
        const {data} = pen.getImageData(0, 0, 128, 64);
        return Array.from({length: 128 * 64}, (_, k) => (data[4 * k] + data[4 * k + 1] + data[4 * k + 2]) / 3);
    }));
    return pixels;
}"""


def expect_through_the_lens(tab: Playground) -> None:
    """The map, seen from the estimated pose, looks like the photograph; buttons blend the two."""
    lens = tab.page.get_by_role("img", name="The query and the map from the estimated pose: half and half")
    expect(lens).to_be_visible()
    photograph, seen = np.array(lens.evaluate(LIKENESS))
    covered = np.abs(seen - 40.0) > 4.0
    assert np.corrcoef(photograph[covered], seen[covered])[0, 1] > 0.7 and covered.mean() > 0.2
    for blend, opacity in (("map", "1"), ("photograph", "0")):
        tab.touch(f"lens:{blend}").click()
        shown = tab.page.get_by_role("img", name=f"The query and the map from the estimated pose: {blend}")
        expect(shown.locator("img").last).to_have_css("opacity", opacity)


def recorded_queries(folder: Path) -> set[str]:
    return {read_recording(path).problem.name.split(", ")[1] for path in folder.glob("*.rrd")}


def test_a_link_to_a_scene_that_is_not_there_opens_the_page_s_own(images_tab: Playground) -> None:
    tab = images_tab
    expect(tab.page.get_by_text("The scene 'nowhere' is not open here").first).to_be_visible()
    expect(tab.page).to_have_url(re.compile("scene=small.apartment"))


def is_visible(tab: Playground, name: str) -> bool:
    """Whether a node is on the canvas and seen."""
    return bool((tab.node(name) or {}).get("visible"))


def test_the_query_on_the_sphere_and_the_mesh_around_it(images_tab: Playground) -> None:
    tab = images_tab
    for name in ("/sphere/image", "/backdrop"):
        tab.until(lambda name=name: is_visible(tab, name), f"{name} is there")
    tab.unfold("Layers")
    for label, name in (("Image", "/sphere/image"), ("Mesh", "/backdrop")):
        tab.tick(label, False)
        tab.until(lambda name=name: not is_visible(tab, name), f"{label} is hidden")
        tab.tick(label, True)
        tab.until(lambda name=name: is_visible(tab, name), f"{label} is back")
    tab.settle()
    tab.press("From the camera")
    centre = tab.centre("/cameras/estimate")
    tab.until(lambda: np.allclose(tab.viewer[:3], centre, atol=0.02), "the viewer stands in the camera")
    fov = "() => window.__viserMutable.camera.fov"
    tab.until(lambda: round(tab.page.evaluate(fov)) == 85, "the viewer sees wide")
    for name, seen in (("From the camera", False), ("Overview", True)):
        tab.press(name)
        seen_so = lambda seen=seen: is_visible(tab, "/cameras/estimate") == seen  # noqa: E731
        tab.until(seen_so, "one does not see the camera from inside")


def test_queries_their_photographs_and_the_whole_sequence(
    images_tab: Playground, images_address: tuple[str, Path]
) -> None:
    tab = images_tab
    expect(tab.value("outcome")).to_have_text("success")
    tab.tab("Images")
    expect(tab.page.get_by_text("one of 4 references")).to_contain_text("matches")
    assert photo(tab, "query") == photo(tab, "reference") == [512, 256]

    tab.tab("Matches")
    number = 5
    tab.row(number).click()
    tab.expect_card(number)
    tab.tab("Images")
    tab.until(lambda: ringed(tab) == [str(number)] * 2, "both of its ends have rings")
    circle = tab.page.locator(f"svg circle[stroke='{SELECTED}']").first
    ring = tab.still(circle.bounding_box, "the ring stands still")
    assert ring is not None
    tab.touch("deselect:").click()
    tab.expect_card()
    tab.page.mouse.click(ring["x"] + ring["width"] / 2, ring["y"] + ring["height"] / 2)
    tab.expect_card(number)
    tab.until(lambda: ringed(tab) == [str(number)] * 2, "both of its ends have rings")
    tab.until(lambda: tab.lit() == [number], "its point is lit")
    expect(tab.page.locator(".match-query")).to_be_visible()
    expect_through_the_lens(tab)

    position = tab.value("camera position").inner_text()
    tab.choose("Query", "query_002")
    expect(tab.value("camera position")).not_to_have_text(position)
    expect(tab.value("outcome")).to_have_text("success")
    tab.expect_card()

    tab.tab("Play")
    tab.press("Localize all queries")
    expect(tab.value("queries")).to_have_text("3 of 3")
    expect(tab.value("within 1° and 0.1 m")).to_have_text("3 of 3")
    tab.until(lambda: tab.instances("/trajectory/queries") == 3, "every query has its dot")
    tab.settle()
    ((x, y), *_) = tab.dots("/trajectory/queries")
    tab.page.mouse.click(x, y)
    expect(tab.widget("Query")).to_have_value("query_000")
    expect(tab.page.get_by_role("button", name="Localize all queries")).to_be_visible()
    recordings = images_address[1]
    names = {f"query_00{number}" for number in range(3)}
    tab.until(lambda: names <= recorded_queries(recordings), "each query is recorded")
    tab.expect_quiet(images_address[0])


def test_a_fisheye_is_opened_from_its_folder(images_tab: Playground, images_address: tuple[str, Path]) -> None:
    """Its image leaves a hole in the sphere; a query that was localized before is told, with the doubt about it."""
    tab = images_tab
    tab.press("Sphere")
    tab.until(lambda: is_visible(tab, "/sphere/image"), "the image of the panorama")
    panorama = tab.node("/sphere/image")
    tab.tab("Open")
    tab.touch("open-folder:0:0:").click()
    tab.page.get_by_text("fisheye apartment").click()
    tab.touch("open-folder:").click()
    expect(tab.touch("open-folder:0:0:")).to_be_visible()
    expect(tab.value("inliers")).to_be_visible()
    tab.tab("Images")
    tab.until(lambda: photo(tab, "query")[0] == photo(tab, "query")[1], "a square photograph")
    tab.tab("Play")
    expect(tab.page.get_by_text("Localized before by ransac-2p: kept.")).to_be_visible()
    expect(tab.value("queries")).to_have_text("1 of 3")
    tab.until(lambda: tab.instances("/trajectory/queries") == 1, "it has its dot")
    beside = tab.page.get_by_text("by itself, doubtful in the results of all queries")
    expect(beside).to_have_count(0)
    tab.touch("strip-open:query_001").click()
    expect(beside).to_be_visible()
    expect(tab.page.get_by_text(DOUBT, exact=True)).to_be_visible()
    expect(tab.touch("strip-open:query_001")).to_have_attribute("aria-current", "true")
    tab.touch("strip-open:query_000").click()
    expect(beside).to_have_count(0)
    expect(tab.touch("strip-open:query_000")).to_have_attribute("aria-current", "true")
    tab.press("Sphere")  # at the outcome, the view shows where the localized photograph was taken
    tab.until(lambda: is_visible(tab, "/sphere/image") and tab.node("/sphere/image") != panorama, "another image")
    tab.expect_quiet(images_address[0])


def write_photographs(folder: Path) -> None:
    """Three panoramas of a square, 5.9 m apart."""
    scene = load_scene(bundled_scenes()["campus_panorama"])
    assert isinstance(scene, MapScene)
    folder.mkdir()
    for view in scene.references[2:5]:
        view.make_file()
        cv2.imwrite(str(folder / f"{view.name}.png"), view.read())


def test_a_folder_of_photographs_becomes_a_map_and_opens(
    images_tab: Playground, images_address: tuple[str, Path]
) -> None:
    """Chosen in an allowed folder, with a known distance; it opens at the outcome, and its queries, which are images of
    the map, stand in the strip with their pictures."""
    tab, folder = images_tab, images_address[1].parent / "square"
    write_photographs(folder)
    inliers = tab.value("inliers").inner_text()
    tab.tab("Open")
    tab.touch("open-folder:0:0:").click()
    tab.touch("open-folder:0:0:square").click()
    names = sorted(path.name for path in folder.iterdir())
    tab.entry("Scale").fill(f"{names[0]} {names[2]} 11.8")
    stop = tab.page.get_by_role("button", name="Stop the map")
    tab.touch("map-folder:0:square").click()
    expect(tab.page.get_by_text(re.compile(r"^square: \d of \d (images|pairs of images) "))).to_be_visible()
    expect(stop).to_be_visible()
    expect(tab.page.get_by_role("cell", name=re.compile(r"^3 of 3 images, "))).to_be_visible()
    expect(stop).to_have_count(0)
    expect(tab.page.get_by_role("cell", name=re.compile("are 11.8 m apart$"), exact=True)).to_be_visible()
    with tab.page.expect_download() as download:
        tab.page.get_by_role("button", name="Save the report").click()
    assert download.value.suggested_filename == "square_map.html"
    assert download.value.path().read_bytes() == (folder.with_name("square_map") / "report.html").read_bytes()

    scene = load_scene(folder.with_name("square_map") / "scene.toml")
    assert isinstance(scene, MapScene) and scene.metric
    expect(tab.page.locator(".step-title")).to_have_text("Outcome")
    expect(tab.page.get_by_text(re.compile(r"^Taken .* m from reference_00\d.png and .* m from "))).to_be_visible()
    tab.tab("Play")
    expect(tab.widget("Scene")).to_have_value(scene.name)
    expect(tab.value("inliers")).not_to_have_text(inliers)
    expect(tab.value("outcome")).to_have_text("pose found, truth unknown")
    queries = tab.page.get_by_role("list", name="Queries").get_by_role("button")
    expect(queries).to_have_count(3)
    assert [query.get_attribute("aria-label") for query in queries.all()] == [view.name for view in scene.queries]
    sizes = queries.locator("img").evaluate_all("all => all.map(one => [one.naturalWidth, one.naturalHeight])")
    assert sizes == [[104, 52]] * 3

    tab.settle()
    opened = tab.viewer
    tab.press("Above")
    tab.until(lambda: tab.viewer != opened, "the viewer moves")
    tab.settle()
    above, inliers = tab.viewer, tab.value("inliers").inner_text()
    queries.nth(1).click()
    expect(tab.widget("Query")).to_have_value(scene.queries[1].name)
    expect(tab.value("inliers")).not_to_have_text(inliers)
    tab.settle()
    assert np.allclose(np.abs(tab.viewer[3:]), np.abs(above[3:]), atol=0.05), "from above too"
    tab.expect_quiet(images_address[0])
