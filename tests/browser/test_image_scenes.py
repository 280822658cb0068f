"""A scene made of images, as a user meets it: queries, matches on the photographs, the map's mesh, a whole sequence."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playground import Playground, served
from playwright.sync_api import Browser, expect

from spherloc_viz.recording.reader import read_recording

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


@pytest.fixture(scope="module")
def images_address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """Address of a playground with a small rendered scene, and where it records."""
    folder = tmp_path_factory.mktemp("images")
    (folder / "small.toml").write_text(SCENE)
    with served(folder / "small.toml", "--recordings", folder / "recordings") as (found, _):
        yield found, folder / "recordings"


@pytest.fixture
def images_tab(browser: Browser, images_address: tuple[str, Path]) -> Iterator[Playground]:
    tab = Playground(browser, images_address[0])
    yield tab
    tab.close()


def test_queries_their_photographs_and_the_mesh(images_tab: Playground) -> None:
    tab = images_tab
    expect(tab.value("outcome")).to_have_text("success")
    caption = tab.page.get_by_text("one of 4 references")
    expect(caption).to_contain_text("above")
    picture = tab.page.locator("img[src^='blob:'], img[src^='data:image']").first
    expect(picture).to_be_visible()
    tab.until(lambda: picture.evaluate("image => image.naturalWidth") == 900, "the photographs are there")

    shown = tab.node("/backdrop")
    assert shown is not None and shown["visible"]
    tab.page.get_by_text("Layers", exact=True).click()
    tab.widget("Mesh").uncheck()
    tab.until(lambda: not (tab.node("/backdrop") or {"visible": True})["visible"], "the mesh is hidden")

    position = tab.value("camera position").inner_text()
    tab.choose("Query", "query_002")
    expect(tab.value("camera position")).not_to_have_text(position)
    expect(tab.value("outcome")).to_have_text("success")
    assert tab.errors == []


def recorded_queries(folder: Path) -> set[str]:
    return {read_recording(path).problem.name.split(", ")[1] for path in folder.glob("*.rrd")}


def test_a_sequence_is_localized_and_drawn(images_tab: Playground, images_address: tuple[str, Path]) -> None:
    tab = images_tab
    expect(tab.value("outcome")).to_have_text("success")
    tab.press("Localize all queries")
    expect(tab.value("queries")).to_have_text("3 of 3")
    expect(tab.value("within 1° and 0.1 m")).to_have_text("3 of 3")
    tab.until(lambda: tab.instances("/trajectory/queries") == 3, "every query has its dot")
    expect(tab.page.get_by_role("button", name="Localize all queries")).to_be_visible()
    recordings = images_address[1]
    names = {f"query_00{number}" for number in range(3)}
    tab.until(lambda: names <= recorded_queries(recordings), "each query is recorded")
    assert tab.errors == []
