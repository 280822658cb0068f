"""Every step shows what its caption speaks of: on the screen, and at a size that can be read."""

import re

import numpy as np
import pytest
from recording_samples import scene_problem

from spherloc.estimators import estimate
from spherloc.geometry import camera_centre, yaw_rotation
from spherloc.registry import names
from spherloc.trace import Trace
from spherloc.types import FloatArray
from spherloc_viz.app.catalog import Catalog
from spherloc_viz.app.controls.presets import presets
from spherloc_viz.app.stage import views
from spherloc_viz.app.stage.painter import LABEL_SCALE
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Balls, Label, Picture, Points, Segments

ASPECTS = (0.83, 1.2)
"""Width over height of the canvas of a page of 1366 x 768 and 1920 x 1080."""

ABOUT: tuple[tuple[str, tuple[str, ...], float], ...] = (
    # (steps, what their captions speak of, the least share of the screen's width or height that it covers)
    (r"problem|sample-\d+|samples-drawn|consensus-poses?.*|refinement-(\d+|inliers|outliers)|refinement|outcome",
     ("map/points",), 0.5),
    (r"bearings|gravity|decision|samples-needed|consensus-guess", ("sphere/bearings",), 0.5),
    (r"positions-\d+", ("boxes/positions",), 0.4),
    (r"match", ("pairs/ray", "sphere/bearings"), 0.5),
    (r"unknowns", ("ring/circle",), 0.5),
    (r"yaw-pair|yaw-roots", ("ring/candidate", "ring/overlap", "pairs/sample"), 0.5),
    (r"yaw-arcs.*|yaw-candidate-.*|yaw-clique", ("ring/arcs", "ring/overlap"), 0.5),
    (r"consensus-bound|consensus-yaw-.*", ("ring/bound", "ring/bars"), 0.5),
    (r"consensus-clique.*", ("pairs/clique",), 0.4),
    (r"balls-pair", ("pairs/rays", "balls/one"), 0.5),
    (r"balls.*", ("balls/others",), 0.5),
    (r"clique.*", ("balls/clique",), 0.5),
    (r"sample-\d+-pose", ("cameras/estimate",), 0.05),
    (r"refinement-error", ("uncertainty/ellipsoid", "uncertainty/angle"), 0.4),
)  # fmt: skip
LETTER = 2.0 * views.LETTER_PX * LABEL_SCALE / 768
"""Width of a letter on a page of 1366 x 768, by half its height."""
BALL_SHARE = 0.04
"""A ball that can be read covers this share of the canvas' height."""


@pytest.fixture(scope="module", params=names("estimators"))
def trace(request: pytest.FixtureRequest) -> Trace:
    return estimate(scene_problem("mei_outliers_80"), request.param)


def about(key: str) -> tuple[tuple[str, ...], float]:
    return next((items, share) for keys, items, share in ABOUT if re.fullmatch(keys, key))


def ends(picture: Picture, name: str) -> FloatArray:
    """Places (K, 3) of a picture's item; of balls, those of their denser half, which are framed, and their reach."""
    item = next(item for item in picture.scene if item.name == name)
    match item:
        case Points():
            return item.positions
        case Segments():
            return item.points.reshape(-1, 3)
        case Balls():
            return item.centers
    raise AssertionError(name)


def on_screen(view: views.Viewpoint, places: FloatArray, aspect: float) -> FloatArray:
    """Where places are seen: (K, 2), -1 to 1 within the canvas."""
    return views.projected(view, places) / (np.tan(view.field_of_view_rad / 2) * np.array([aspect, 1.0]))


def is_on(seen: FloatArray) -> np.ndarray:
    return np.all(np.abs(seen) <= 1.0, axis=1)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_every_step_shows_what_it_is_about(trace: Trace, aspect: float) -> None:
    for index, heading in enumerate(steps(trace)):
        picture = paint(trace, index)
        view = views.follow(picture, aspect)
        framed = on_screen(view, picture.focus.points, aspect)
        assert is_on(framed).all(), f"{heading.key}: its focus is on the screen"
        assert np.ptp(framed, axis=0).max() >= 1.0, f"{heading.key}: its focus covers half of the screen"
        assert views.shows(view, picture.focus.points, aspect)
        items, share = about(heading.key)
        drawn = {item.name for item in picture.scene} & set(items)
        assert drawn, heading.key
        seen = np.vstack([on_screen(view, ends(picture, name), aspect) for name in sorted(drawn)])
        on = is_on(seen)
        assert np.mean(on) >= (0.5 if "balls" in items[0] else 0.85), f"{heading.key}: {items} are on the screen"
        assert np.ptp(seen[on], axis=0).max() / 2 >= share or "balls" in items[0], f"{heading.key}: {items} can be seen"


@pytest.mark.parametrize("aspect", ASPECTS)
def test_balls_are_large_enough_to_be_seen(aspect: float) -> None:
    """Also the first few, and whatever was looked at before."""
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    for index, heading in enumerate(steps(trace)):
        picture = paint(trace, index)
        balls = [item for item in picture.scene if isinstance(item, Balls)]
        if not balls:
            continue
        view = views.follow(picture, aspect)
        shown = balls[-1]
        depth = np.linalg.norm(shown.centers - view.position, axis=1)
        heights = shown.radii_m / depth / np.tan(view.field_of_view_rad / 2)
        seen = is_on(on_screen(view, shown.centers, aspect))
        assert seen.any() and np.median(heights[seen]) >= BALL_SHARE, f"{heading.key}: {np.median(heights[seen]):.3f}"
        if (size := re.fullmatch(r"balls-(\d+)", heading.key)) and int(size[1]) <= 3:
            assert seen.all() and len(seen) == int(size[1])
            for turn in (0.0, 1.0, 2.0, 3.0):  # whole balls, from whichever side
                toward = yaw_rotation(turn) @ np.array([0.5, -0.6, 0.5])
                place, target = views._fits(picture.focus.points, toward[None], aspect)
                depth = (place[0] - shown.centers) @ (place[0] - target[0]) / np.linalg.norm(place[0] - target[0])
                over = on_screen(views.Viewpoint(place[0], target[0]), shown.centers, aspect)[:, 1]
                reach = shown.radii_m / depth / np.tan(views.FIELD_OF_VIEW_RAD / 2)
                assert np.all(np.abs(over) + reach < 1.15), heading.key


@pytest.mark.parametrize("title", ["Horizontal bearings", "Repeated facades", "RANSAC bad luck"])
def test_the_balls_of_a_clique_fill_the_canvas_and_are_whole(title: str) -> None:
    """Also if the radii of the clique go from 14 cm to 32 m, as with points that are all as high as the camera."""
    catalog = Catalog(None)
    preset = next(preset for preset in presets(catalog) if preset.title == title)
    trace = estimate(catalog.problem(preset.scene), "mc")
    cliques = [index for index, heading in enumerate(steps(trace)) if re.fullmatch(r"clique(-\d+)?", heading.key)]
    assert len(cliques) >= 2
    for index in cliques:
        picture = paint(trace, index)
        [balls] = [item for item in picture.scene if item.name == "balls/clique"]
        assert isinstance(balls, Balls)
        size = re.fullmatch(r"clique-(\d+)", picture.step.key)
        assert len(balls.radii_m) == min(int(size[1]), 10) if size else len(balls.radii_m) == 10
        view = views.follow(picture, ASPECTS[1])
        depth = np.linalg.norm(balls.centers - view.position, axis=1)
        heights = balls.radii_m / depth / np.tan(view.field_of_view_rad / 2)
        assert np.all(np.abs(on_screen(view, balls.centers, ASPECTS[1])[:, 1]) + heights < 1.25), picture.step.key
        assert heights.max() > 0.5, picture.step.key


def test_steps_about_one_thing_are_seen_from_one_side(trace: Trace) -> None:
    """So that what grows from step to step does not turn as well."""
    sides: dict[str, list[FloatArray]] = {}
    for index, heading in enumerate(steps(trace)):
        view = views.follow(paint(trace, index), ASPECTS[0])
        kind = next(
            (kind for kind in ("yaw-arcs", "yaw-candidate", "balls-", "clique") if heading.key.startswith(kind)), None
        )
        if kind is not None and heading.key != "balls-pair":
            away = view.position - view.target
            sides.setdefault(kind, []).append(away / np.linalg.norm(away))
    for kind, found in sides.items():
        assert all(np.allclose(side, found[0], atol=1e-6) for side in found), kind


def test_new_things_are_named_in_the_canvas_where_they_first_appear() -> None:
    trace = estimate(scene_problem("mei_outliers_80"), "mc")
    words = ("unit sphere", "yaw ring", "arc:", "ball:", "edge", "clique")
    named: dict[str, str] = {}
    for index, heading in enumerate(steps(trace)):
        picture = paint(trace, index)
        for label in (item for item in picture.scene if isinstance(item, Label)):
            for word in words:
                if word in label.text:
                    named.setdefault(word, heading.key)
            if label.name.endswith("/name"):
                view = views.follow(picture, ASPECTS[0], letter=LETTER)
                assert label.name not in views.cut(picture, view, ASPECTS[0], LETTER), f"{heading.key}: {label.text}"
                assert is_on(on_screen(view, picture.focus.points, ASPECTS[0])).all()
    assert named == {
        "unit sphere": "bearings", "yaw ring": "unknowns", "arc:": "yaw-pair", "ball:": "balls-pair",
        "edge": "balls-3", "clique": "yaw-clique",
    }  # fmt: skip


def test_an_estimate_far_away_is_on_the_screen_too(trace: Trace) -> None:
    if trace.cam_from_map is None:
        return
    picture = paint(trace, len(steps(trace)) - 1)
    centre = camera_centre(trace.problem.aligned.align_pose(trace.cam_from_map))
    assert is_on(on_screen(views.follow(picture, 1.0), centre[None], 1.0)).all()
