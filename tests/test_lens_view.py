"""The map through a query's lens: what is seen where, what hides what, and the strip of queries."""

import re
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from waiting import until

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.experiments.results import QueryResult
from spherloc.frontend.view import View
from spherloc.geometry import pose
from spherloc_viz.app.controls.query_strip import (
    ORDERS,
    QueryStrip,
    Strip,
    differences,
    ordered,
    short_name,
    strip_html,
    thumbnail,
)
from spherloc_viz.app.paging import pages_html
from spherloc_viz.layers.lens_view import through_lens

LENS = KannalaBrandt(320, 320, 110.0, 110.0, 160.0, 160.0, (0.0, 0.0, 0.0, 0.0))
AT_ORIGIN = pose(np.eye(3), np.zeros(3))


def reference(path, color, depth_m, centre=(0.0, 0.0, 0.0)):
    """A one-coloured panorama whose pixels are all that far away."""
    camera = Equirectangular(256, 128)
    assert cv2.imwrite(str(path), np.full((128, 256, 3), color[::-1], np.uint8))

    def lift(pixels):
        bearings, seen = camera.unproject(pixels)
        return depth_m * bearings + np.array(centre), seen

    return View(path.name, camera, path, AT_ORIGIN, lift=lift)


def test_near_things_hide_far_ones(tmp_path):
    near, far = (200, 30, 30), (30, 30, 200)
    views = [reference(tmp_path / "far.png", far, 9.0), reference(tmp_path / "near.png", near, 2.0)]
    for order in (views, views[::-1]):
        picture, covered = through_lens(LENS, AT_ORIGIN, order)
        assert picture.shape == (320, 320, 4) and covered > 0.95
        assert np.abs(picture[40:280, 40:280, :3].astype(int) - near).max() < 12


def test_a_thing_is_seen_where_the_lens_puts_it(tmp_path):
    """A red spot ahead and to the right, from a camera that moved and turned."""
    camera = Equirectangular(512, 256)
    image = np.zeros((256, 512, 3), np.uint8)
    cv2.circle(image, (300, 110), 4, (0, 0, 255), -1)
    cv2.imwrite(str(tmp_path / "spot.png"), image)

    def lift(pixels):
        bearings, seen = camera.unproject(pixels)
        return 5.0 * bearings, seen

    view = View("spot.png", camera, tmp_path / "spot.png", AT_ORIGIN, lift=lift)
    turn = np.array([[np.cos(0.3), 0.0, np.sin(0.3)], [0.0, 1.0, 0.0], [-np.sin(0.3), 0.0, np.cos(0.3)]])
    moved = pose(turn, np.array([0.2, -0.1, 0.4]))
    picture, _ = through_lens(LENS, moved, [view])
    spot = 5.0 * camera.unproject(np.array([[300.5, 110.5]]))[0][0]
    (expected,), _ = LENS.project((turn @ spot + moved[:, 3])[None])
    rows, columns = np.nonzero(picture[..., 0] > 150)
    assert np.linalg.norm([columns.mean() + 0.5 - expected[0], rows.mean() + 0.5 - expected[1]]) < 2.0


def test_without_points_there_is_no_picture(tmp_path):
    view = reference(tmp_path / "a.png", (9, 9, 9), 1.0)
    assert through_lens(LENS, AT_ORIGIN, []) is None
    assert through_lens(LENS, AT_ORIGIN, [View("a.png", view.camera, view.path, AT_ORIGIN)]) is None
    (tmp_path / "a.png").unlink()
    assert through_lens(LENS, AT_ORIGIN, [view]) is None


def test_names_below_thumbnails_tell_images_apart():
    """In full if they fit into two lines, else what differs, else the end of that."""

    def shown(width_px: int, *names: str) -> list[str]:
        told = differences(names)
        return [short_name(name, told[name], width_px) for name in names]

    assert shown(104, "hall_1.png", "hall_2.png") == ["hall_1", "hall_2"]
    moments = [f"cam{k}/data/17000000{t:02d}500000000.png" for k in (0, 3) for t in (1, 2)]
    assert shown(52, *moments) == ["cam0/…1…", "cam0/…2…", "cam3/…1…", "cam3/…2…"]
    assert shown(52, *moments[:2]) == ["…1…", "…2…"]
    heads = ("slam-side-right_7385324932864.png", "slam-side-left_7385324932864.png")
    assert shown(52, *heads) == ["…right…", "…left…"]
    assert shown(52, "slam-side-right_7385324932864.png") == ["…7385324932864"]
    assert shown(104, "slam-side-right_7385324932864.png") == ["…am-side-right_7385324932864"]
    assert shown(52, "a/hall_in_the_evening.png", "hall_in_the_morning.png") == ["a/…evening", "…morning"]


def test_the_strip_is_sorted_turned_and_told(tmp_path):
    """Fifty queries, of which three are done; names are text and not HTML."""
    queries = [View(f"<q{number:02d}>", LENS, tmp_path / f"{number}.png") for number in range(50)]
    rows = {
        "<q07>": QueryResult(7, "<q07>", "localized", matches=90, inliers=60, translation_error_m=0.1),
        "<q30>": QueryResult(30, "<q30>", "failed"),
        "<q11>": QueryResult(11, "<q11>", "doubtful", matches=80, inliers=9, translation_error_m=2.0),
    }
    names = [view.name for view in ordered(queries, rows, "outcome")[:4]]
    assert names == ["<q30>", "<q11>", "<q07>", "<q00>"]
    assert [view.name for view in ordered(queries, rows, "error")[:2]] == ["<q11>", "<q07>"]
    assert [view.name for view in ordered(queries, rows, "inliers")[:2]] == ["<q11>", "<q07>"]
    assert ordered(queries, rows, "order") == queries
    shown = ordered(queries, rows, "outcome")[:24]
    names = [view.name for view in shown]
    strip = Strip(shown, dict.fromkeys(names, ""), differences(names), rows, "<q11>", "m")
    html = strip_html(strip, ORDERS, "outcome", 0, 50)
    assert "1–24 of 50" in html and "strip-page:1" in html and "<q30>" not in html and "&lt;q30&gt;: failed" in html
    assert html.count("strip-open:") == 24 and "9 of 80 matches" in html
    pressed = html.partition("strip-open:&lt;q00&gt;")[2].partition('role="listitem"')[0]
    assert pressed.endswith("&lt;q00&gt;</div></div></div><div "), "the name below a picture is part of its button"
    assert html.count("aria-current") == 1 and 'aria-current="true" data-touch="strip-open:&lt;q11&gt;"' in html
    assert thumbnail(queries[0]) == ""
    cv2.imwrite(str(queries[0].path), np.full((320, 320, 3), 90, np.uint8))
    assert thumbnail(queries[0]).startswith("data:image/jpeg;base64,")


def test_a_page_in_the_midst_of_many_is_a_few_presses_away():
    """The pages beside, ten before and after, the first and the last; of two pages the other one only."""

    def targets(page: int, count: int) -> list[int]:
        return [
            int(place) for place in re.findall(r'data-touch="rows:(\d+)"', pages_html(page, count, "rows", size=24))
        ]

    assert targets(60, 3000) == [59, 0, 50, 60, 70, 124, 61]
    assert targets(0, 3000) == [0, 10, 124, 1] and targets(124, 3000) == [123, 0, 114, 124]
    assert targets(0, 25) == [1] and targets(1, 25) == [0] and targets(0, 24) == targets(0, 0) == []
    assert "1,441–1,464 of 3,000" in pages_html(60, 3000, "rows", size=24)


def test_the_strip_turns_to_the_query_that_the_page_shows(tmp_path):
    """At first, and if another one is shown; else it stays where it was turned to, also while results come in."""
    presses: dict[str, Any] = {}
    shown: list[str] = []
    strip = QueryStrip(SimpleNamespace(on=presses.__setitem__), shown.append, print, print)  # pyright: ignore[reportArgumentType]
    queries = [View(f"q{number:02d}", LENS, tmp_path / f"{number}.png") for number in range(60)]
    scene: Any = SimpleNamespace(queries=queries, metric=True)

    def expect(page: int, marks: int) -> None:
        until(lambda: shown and f"{24 * page - 23}–" in shown[-1] and shown[-1].count("3px solid") == marks)
        assert len(re.findall("strip-open:", shown[-1])) == (12 if page == 3 else 24)

    strip.set(scene, (), False, "q40")
    expect(2, 0)
    presses["strip-page"](SimpleNamespace(argument="0"))
    expect(1, 0)
    strip.set(scene, (QueryResult(0, "q00", "failed"),), False, "q40")
    expect(1, 1)
    strip.set(scene, (QueryResult(0, "q00", "failed"),), False, "q59")
    expect(3, 0)
    presses["strip-order"](SimpleNamespace(argument="outcome"))
    expect(1, 1)
    strip.close()
