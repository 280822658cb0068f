"""The image view of the matches: what it shows, what a press on it means, what it sends."""

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import viser
from pressed_page import Page

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets import load_scene
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.matches import match_drawing as drawing
from spherloc_viz.app.matches.image_panel import MAX_BYTES, ImagePanel, photo_uri
from spherloc_viz.app.matches.match_card import CROP_HEIGHT_PX, CROP_WIDTH_PX, SIDE_PX, MatchCard, crops_html
from spherloc_viz.app.matches.match_table import MatchTablePanel, chips_html
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.matches import match_view, valid_outlines
from spherloc_viz.layers.primitives import Picture, Points

SceneOf = Callable[..., SyntheticScene]
EVIL = "<img src=x onerror=alert(1)>"


@pytest.fixture
def page() -> Page:
    return Page()


@pytest.fixture(scope="module")
def trace(scene_of: SceneOf) -> Trace:
    return estimate(scene_of("fisheye", correspondences=60, outlier_rate=0.5).problem(), "mc")


def outcome(trace: Trace) -> Picture:
    return paint(trace, len(steps(trace)) - 1)


@pytest.fixture
def images(trace: Trace, tmp_path: Path) -> Trace:
    """The run, had its matches come from a photograph and two references."""
    camera = trace.problem.camera
    for name, size in (("query", (camera.height, camera.width)), ("r0", (300, 400)), ("r1", (300, 400))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((*size, 3), 90, np.uint8))
    rng = np.random.default_rng(5)
    problem = replace(
        trace.problem,
        image=tmp_path / "query.png",
        reference_images=(tmp_path / "r0.png", tmp_path / "r1.png"),
        reference_index=np.where(trace.inlier_mask, 1, np.arange(60) % 2),
        reference_pixels=rng.uniform([0, 0], [400, 300], (60, 2)),
    )
    return replace(trace, problem=problem)


def panel(server: viser.ViserServer, page: Page) -> ImagePanel:
    return ImagePanel(server.gui, page.touches, page.changed)


def test_images_stand_where_they_fit() -> None:
    (left, right), height = drawing.arrange([(512, 512), (400, 300)])
    assert left.height == right.height == height and left.y == right.y == 0.0
    assert right.x == pytest.approx(left.width + drawing.GAP) and right.x + right.width == pytest.approx(drawing.WIDTH)
    (above, below), height = drawing.arrange([(2048, 1024), (2048, 1024)])
    assert above.width == below.width == drawing.WIDTH and below.y == 500.0 + drawing.GAP
    assert height == below.y + below.height == 1000.0 + drawing.GAP
    assert np.array_equal(below.at(np.array([[1024.0, 512.0]])), [[500.0, below.y + 250.0]])


def test_photographs_are_sent_once_and_dots_anew(server: viser.ViserServer, page: Page, images: Trace) -> None:
    view, kept = panel(server, page), np.arange(60)
    view.draw(images, paint(images, 0), (), kept)
    photos, first = view._backgrounds.content, view._drawing.content
    assert photos.count("data:image/jpeg;base64,") == 2 and "data:" not in first
    view.draw(images, outcome(images), (), kept)
    assert view._backgrounds.content is photos and view._drawing.content != first
    assert len(view._drawing.content) < 30_000
    inliers = int(images.inlier_mask.sum())
    path = re.search(rf'<path d="([^"]*)" stroke="{style.css(style.INLIER)}"[^>]*round', view._drawing.content)
    assert path is not None and path[1].count("M") == inliers, "every inlier is a dot in its colour"


def test_nothing_is_sent_when_nothing_changed(server: viser.ViserServer, page: Page, images: Trace) -> None:
    view, kept = panel(server, page), np.arange(60)
    table, card = MatchTablePanel(server.gui, page.touches, page.changed), MatchCard(server.gui)
    for _ in range(2):
        view.draw(images, outcome(images), (3,), kept)
        table.draw(images, (3,), kept)
        card.draw(images, (3,), kept)
    htmls = [view._backgrounds, view._drawing, table._html, card._html]
    contents = [html.content for html in htmls]
    view.draw(images, outcome(images), (3,), kept.copy())
    table.draw(images, (3,), kept.copy())
    card.draw(images, (3,), kept.copy())
    assert all(html.content is content for html, content in zip(htmls, contents, strict=True))


def test_a_press_selects_the_nearest_match_by_its_original_number(
    server: viser.ViserServer, page: Page, images: Trace
) -> None:
    view, kept, problem = panel(server, page), np.arange(60) + 100, images.problem
    view.draw(images, outcome(images), (), kept)
    index, pixels = problem.reference_index, problem.reference_pixels
    assert index is not None and pixels is not None
    number = int(np.flatnonzero(index == 1)[3])
    size = np.array([problem.camera.width, problem.camera.height])
    page.press("image-pick:query", *((problem.pixels[number] + 0.7) / size).tolist())
    page.press("image-pick:reference", *((pixels[number] + 0.5) / [400, 300]).tolist(), extend=True)
    assert page.selected == [(str(number + 100), False), (str(number + 100), True)]
    page.press("image-pick:elsewhere")
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30)), axis=-1).reshape(-1, 2)
    clearance = np.linalg.norm((grid * size)[:, None] - problem.pixels[index == 1], axis=2).min(axis=1)
    page.press("image-pick:query", *grid[np.argmax(clearance)].tolist())
    assert len(page.selected) == 2, "nothing is near"


def test_the_selected_match_brings_its_reference_and_a_chip_another(
    server: viser.ViserServer, page: Page, images: Trace
) -> None:
    view, kept = panel(server, page), np.arange(60)
    index = images.problem.reference_index
    assert index is not None
    view.draw(images, outcome(images), (), kept)
    assert "r1.png, one of 2 references" in view._drawing.content, "most inliers"
    page.press("image-reference:0")
    assert page.redraws == 1
    view.draw(images, outcome(images), (), kept)
    assert "r0.png, one of 2 references" in view._drawing.content
    view.draw(images, outcome(images), (int(np.flatnonzero(index == 1)[0]),), kept)
    assert "r1.png, one of 2 references" in view._drawing.content
    for argument in ("9", "-1", "x", "9" * 400):
        page.press(f"image-reference:{argument}")
        view.draw(images, outcome(images), (), kept)
        assert "r1.png, one of 2 references" in view._drawing.content


@pytest.mark.parametrize(
    "names",
    [
        ("rig/cam0/0001.png", "rig/cam1/0001.png"),
        ("camera-slam-left_0017.png", "camera-slam-right_0017.png"),
        ("in_the_morning_0001_of_a_walk.png", "in_the_morning_0002_of_a_walk.png"),
    ],
)
def test_chips_of_references_differ(images: Trace, names: tuple[str, str]) -> None:
    problem = replace(images.problem, reference_images=tuple(map(Path, names)))
    html = chips_html(problem, images.inlier_mask, 0)
    shown = re.findall(r">([^<>]*): \d+/\d+</span>", html)
    assert len(set(shown)) == 2, shown
    hints = re.findall(r'title="([^"]*): \d+ inliers', html)
    assert len(set(hints)) == 2, hints


def test_selected_matches_have_rings_and_a_line(server: viser.ViserServer, page: Page, images: Trace) -> None:
    view, index = panel(server, page), images.problem.reference_index
    assert index is not None
    own, other = (int(np.flatnonzero(~images.inlier_mask & (index == k))[0]) for k in (1, 0))
    view.draw(images, outcome(images), (own, other), np.arange(60) + 7)
    content, first = view._drawing.content, min(own, other)
    assert content.count(f">{first + 7}</text>") == 2, "in both images, for the match whose reference is shown"
    assert content.count("</text>") == 2 and content.count("<circle") == 4, "a white and a coloured ring each"
    color = style.css(style.SELECTED)
    assert re.search(rf'd="M\d+ \d+L\d+ \d+" stroke="{color}"', content)


def test_without_images_the_camera_shows_where_the_pose_puts_points(
    server: viser.ViserServer, page: Page, scene_of: SceneOf
) -> None:
    run = estimate(scene_of("mei", correspondences=40, outlier_rate=0.5).problem(), "mc")
    view = panel(server, page)
    view.draw(run, outcome(run), (), np.arange(40))
    content = view._drawing.content
    assert view._backgrounds.content == "<style></style>" and "crosses mark that for inliers" in content
    crosses = re.search(rf'd="([^"]*)" fill="none" stroke="{style.css(style.ESTIMATE)}"', content)
    assert crosses is not None
    first = re.match(r"M(\d+) (\d+)l(\d+)", crosses[1])
    assert first is not None and crosses[1].count("M") >= 2 * run.inlier_mask.sum() - 4, "but for some past the border"
    at = (np.array([float(first[1]), float(first[2])]) + float(first[3]) / 2) * run.problem.camera.width / drawing.WIDTH
    assert np.linalg.norm(run.problem.pixels[run.inlier_mask] - at, axis=1).min() < 5.0
    view.draw(run, paint(run, 0), (), np.arange(40))
    assert "crosses" not in view._drawing.content, "before anything is decided there is no pose to show"


def test_what_a_camera_sees_has_a_border(scene_of: SceneOf, aria: Path) -> None:
    assert valid_outlines(scene_of("panorama").camera) == ()
    camera = load_scene(aria / "rgb.toml").problem().camera
    (border,) = valid_outlines(camera)
    inside, outside = border.mean(axis=0) + 0.97 * (border - border.mean(axis=0)), border.mean(axis=0) * 0.01
    assert camera.unproject(inside)[1].mean() > 0.95 and not camera.unproject(outside[None])[1].any()


def test_thousands_of_matches_are_thinned_and_counted(server: viser.ViserServer, page: Page, scene_of: SceneOf) -> None:
    run = estimate(scene_of("fisheye", correspondences=3000, outlier_rate=0.3).problem(), "ransac-2p")
    view = panel(server, page)
    view.draw(run, outcome(run), (17,), np.arange(3000))
    content = view._drawing.content
    drawn = re.search(r"(\d+) of 3,000 dots are drawn", content)
    assert drawn is not None and drawing.MAX_DOTS <= int(drawn[1]) <= drawing.MAX_DOTS + 1
    assert len(content) < 32_000 and ">17</text>" in content
    for color in (style.INLIER, style.OUTLIER):
        path = re.search(rf'<path d="([^"]*)" stroke="{style.css(color)}"[^>]*round', content)
        assert path is not None and path[1].count("M") >= drawing.MAX_DOTS // 2 - 1, "both kinds are seen"
    view.draw(run, outcome(run), tuple(range(1000)), np.arange(3000))
    assert "100 of 1,000 selected matches have rings" in view._drawing.content and len(view._drawing.content) < 80_000


def test_images_that_have_gone_are_said(server: viser.ViserServer, page: Page, images: Trace) -> None:
    gone = replace(images, problem=replace(images.problem, image=Path(f"/nowhere/{EVIL}.png")))
    view = panel(server, page)
    view.draw(gone, outcome(gone), (), np.arange(60))
    assert "it is still being drawn, or it is gone" in view._drawing.content and "<img" not in view._drawing.content
    lost = replace(images, problem=replace(images.problem, reference_images=(Path("a.png"), Path("b.png"))))
    view.draw(lost, outcome(lost), (), np.arange(60))
    assert "b.png cannot be read" in view._drawing.content


def test_real_photographs_fit_their_budget(aria: Path, scene_of: SceneOf) -> None:
    image = load_scene(aria / "rgb.toml").problem().image
    for width in (450, 900):
        uri = photo_uri(image, width)
        assert uri is not None and len(uri) < 1.4 * MAX_BYTES
    assert photo_uri(image, 900) is photo_uri(image, 900) and photo_uri(None, 900) is None


def test_lines_are_for_inliers_and_the_selected(images: Trace) -> None:
    item = next(item for item in outcome(images).scene if isinstance(item, Points) and item.name == "map/points")
    view = match_view(images.problem, item.colors, images.inlier_mask, selected=(2,), reference=1)
    index = images.problem.reference_index
    assert index is not None and view.reference == 1
    expected = np.flatnonzero(images.inlier_mask & (index == 1))
    assert set(view.lines) == set(expected) | ({2} if index[2] == 1 else set())


def test_a_crop_is_centred_on_its_pixel(tmp_path: Path) -> None:
    """Decoded, the middle of the picture has the colour of the marked pixel, also beside the border."""
    for at in ((100, 60), (1, 2)):
        image = np.full((150, 300, 3), 30, np.uint8)
        image[at[1], at[0]] = (0, 255, 0)
        cv2.imwrite(str(tmp_path / "q.png"), image)
        problem = Problem(
            "p", Equirectangular(300, 150), np.array([[at[0] + 0.5, at[1] + 0.5], [200.0, 100.0]]), np.eye(3)[:2],
            np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0]), image=tmp_path / "q.png",
        )  # fmt: skip
        html = crops_html(problem, 0)
        assert html.count("<img") == 1
        data = re.search(r"base64,([^\"]*)", html)
        assert data is not None
        crop = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_COLOR)
        assert crop is not None and crop.shape[:2] == (CROP_HEIGHT_PX, CROP_WIDTH_PX)
        rows, columns = np.nonzero(crop[..., 1].astype(int) - crop[..., 0] > 60)
        middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        assert np.abs(middle - [CROP_WIDTH_PX / 2, CROP_HEIGHT_PX / 2]).max() < 0.3 * CROP_WIDTH_PX / SIDE_PX
    assert crops_html(replace(problem, image=None), 0) == ""


def test_cards_of_images_show_both_pixels(server: viser.ViserServer, images: Trace) -> None:
    card = MatchCard(server.gui)
    card.draw(images, (4,), np.arange(60))
    assert card._html.content.count("<img") == 2 and len(card._html.content) < 30_000
