"""What the selected correspondences light up, what dims, and by which rule pairs are thinned."""

from collections.abc import Callable
from itertools import combinations

import cv2
import numpy as np
import pytest
from recording_samples import exact_run

from spherloc.datasets.synthetic import SyntheticScene
from spherloc.estimators import estimate
from spherloc.trace import ConsensusStage, Trace, TranslationStage, YawStage
from spherloc_viz import style
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Balls, Picture, Points, SceneItem, Segments
from spherloc_viz.layers.selection import HALO, with_selection


@pytest.fixture(scope="module")
def mc(scene_of: Callable[..., SyntheticScene]) -> Trace:
    return estimate(scene_of("mei").problem(), "mc")


def at(trace: Trace, key: str) -> Picture:
    return paint(trace, [step.key for step in steps(trace)].index(key))


def items_of(picture: Picture) -> dict[str, SceneItem]:
    return {item.name: item for item in picture.scene}


def segments(picture: Picture, name: str) -> np.ndarray:
    item = items_of(picture)[name]
    assert isinstance(item, Segments) and item.layer == "selection"
    assert (item.colors == style.SELECTED).all() and len(item.colors) == len(item.points)
    return item.points


def test_nothing_selected_changes_nothing(mc: Trace) -> None:
    picture = at(mc, "outcome")
    assert with_selection(picture, mc, ()) is picture


def test_every_step_can_be_selected_in(mc: Trace) -> None:
    for trace, selected in ((mc, (3,)), (mc, (0, 7, 50)), (exact_run(), (5,)), (exact_run(), tuple(range(100)))):
        for index in range(len(steps(trace))):
            plain = paint(trace, index)
            picture = with_selection(plain, trace, selected)
            names = [item.name for item in picture.scene]
            assert len(set(names)) == len(names) and names[: len(plain.scene)] == [item.name for item in plain.scene]
            for item in picture.scene[len(plain.scene) :]:
                assert isinstance(item, Segments | Points)
                places = item.points if isinstance(item, Segments) else item.positions
                assert item.layer == "selection" and np.isfinite(places).all()
            assert picture.step.note.startswith(plain.step.note) and picture.charts == plain.charts


def test_rings_and_rays_are_around_the_selected(mc: Trace) -> None:
    plain = at(mc, "outcome")
    picture = with_selection(plain, mc, (4, 9))
    points, bearings = items_of(plain)["map/points"], items_of(plain)["sphere/bearings"]
    assert isinstance(points, Points) and isinstance(bearings, Points) and bearings.ids is not None
    for dots in (points, bearings):
        halo = items_of(picture)[f"selection/{dots.name}"]
        assert isinstance(halo, Points) and halo.rim and halo.radius_m > dots.radius_m and dots.ids is not None
        np.testing.assert_array_equal(halo.positions, dots.positions[np.isin(dots.ids, (4, 9))])
        assert halo.ids is None, "a ring is not picked instead of what it surrounds"
    circles = segments(picture, "selection/circles").reshape(2, 3, -1, 3)
    surface = items_of(plain)["sphere/surface"]
    centre = surface.vertices.mean(axis=0)  # pyright: ignore[reportAttributeAccessIssue]
    for k, (around_point, inner, outer) in zip((4, 9), circles, strict=True):
        (bearing,) = bearings.positions[bearings.ids == k]
        np.testing.assert_allclose(np.linalg.norm(around_point - points.positions[k], axis=1), HALO * points.radius_m)
        outward = (bearing - centre) / np.linalg.norm(bearing - centre)
        np.testing.assert_allclose((around_point - points.positions[k]) @ outward, 0.0, atol=1e-9)
        radius = np.linalg.norm(bearing - centre)
        assert np.linalg.norm(inner - centre, axis=1).max() < radius < np.linalg.norm(outer - centre, axis=1).min()
    many = with_selection(plain, mc, tuple(range(40)))
    assert "selection/circles" not in items_of(many), "many circles would cost much and show little"
    ends = segments(picture, "selection/rays")
    np.testing.assert_array_equal(ends[:, 1], points.positions[[4, 9]])
    np.testing.assert_array_equal(ends[:, 0], bearings.positions[np.isin(bearings.ids, (4, 9))])


def test_all_else_dims_towards_grey_and_the_selected_keep_their_colours(mc: Trace) -> None:
    for key in ("outcome", "yaw-clique", "clique"):
        plain = at(mc, key)
        picture = with_selection(plain, mc, (4,))
        for before, after in zip(plain.scene, picture.scene, strict=False):
            if not isinstance(before, Points | Segments | Balls):
                assert after is before
                continue
            assert isinstance(after, Points | Segments | Balls)
            if before.ids is None and before.layer != "rays":
                assert after is before
                continue
            own = np.zeros(len(before.colors), bool)
            if before.ids is not None:
                own = (before.ids.reshape(len(before.ids), -1) == 4).any(axis=1)
            np.testing.assert_array_equal(after.colors[own], before.colors[own])
            grey = np.array(style.UNDECIDED, float)
            away = [np.abs(item.colors[~own] - grey).sum() for item in (before, after)]
            assert away[1] <= 0.45 * away[0] + 3 * len(own)


def arcs_of(picture: Picture) -> set[tuple[float, float]]:
    """Both ends of every highlighted arc, degrees, by its track on the ring."""
    surface = items_of(picture)["sphere/surface"]
    centre = surface.vertices.mean(axis=0)  # pyright: ignore[reportAttributeAccessIssue]
    lines = segments(picture, "selection/arcs") - centre
    radius = np.round(np.linalg.norm(lines[:, 0], axis=1), 9)
    yaws = np.degrees(np.arctan2(-lines[..., 0], lines[..., 2]))
    return {
        (round(yaws[radius == track][0, 0], 6), round(yaws[radius == track][-1, 1], 6)) for track in np.unique(radius)
    }


def expected_arcs(stage: YawStage, which: np.ndarray) -> set[tuple[float, float]]:
    ends = (np.degrees(np.column_stack([stage.lo_rad, stage.hi_rad])[which]) + 180) % 360 - 180
    return {(round(low, 6), round(high, 6)) for low, high in ends.tolist()}


def test_an_inlier_shows_its_arcs_in_the_clique(mc: Trace) -> None:
    stage = mc.stage(YawStage)
    assert stage is not None
    inlier = int(np.flatnonzero(mc.inlier_mask)[2])
    members = stage.clique[(stage.pairs[stage.clique] == inlier).any(axis=1)]
    assert 0 < len(members) <= style.MAX_SELECTED_ARCS
    picture = with_selection(at(mc, "yaw-clique"), mc, (inlier,))
    assert arcs_of(picture) == expected_arcs(stage, members)
    assert "of the selection" not in picture.step.note, "none was left out"


def test_one_outside_the_clique_shows_its_other_arcs_thinned(mc: Trace) -> None:
    stage = mc.stage(YawStage)
    assert stage is not None
    inside = np.unique(stage.pairs[stage.clique])
    (outside,) = np.setdiff1d(np.arange(len(mc.problem)), inside)[:1]
    own = np.flatnonzero((stage.pairs == outside).any(axis=1))
    picture = with_selection(at(mc, "yaw-clique"), mc, (int(outside),))
    assert len(own) > style.MAX_SELECTED_ARCS == len(arcs_of(picture))
    assert arcs_of(picture) < expected_arcs(stage, own)
    assert f"{style.MAX_SELECTED_ARCS} of {len(own)} arcs of the selection are highlighted." in picture.step.note


def test_of_several_only_the_pairs_among_them(mc: Trace) -> None:
    stage = mc.stage(YawStage)
    assert stage is not None
    pair = tuple(sorted(stage.pairs[stage.clique[0]].tolist()))
    both = np.flatnonzero((np.sort(stage.pairs, axis=1) == pair).all(axis=1))
    picture = with_selection(at(mc, "yaw-arcs"), mc, pair)
    assert arcs_of(picture) == expected_arcs(stage, np.intersect1d(both, stage.clique))
    assert "selection/arcs" not in items_of(with_selection(at(mc, "outcome"), mc, pair)), "only where arcs are shown"


def test_balls_are_their_level_circles(mc: Trace) -> None:
    stage = mc.stage(TranslationStage)
    assert stage is not None
    ball = int(stage.clique[0])
    pair = tuple(sorted(stage.pairs[ball].tolist()))
    same = [k for k in stage.clique.tolist() if tuple(sorted(stage.pairs[k].tolist())) == pair]
    picture = with_selection(at(mc, "clique"), mc, pair)
    circles = segments(picture, "selection/balls").reshape(len(same), -1, 3)
    for k, circle in zip(sorted(same, key=lambda k: stage.radii_m[k]), circles, strict=True):
        np.testing.assert_allclose(np.linalg.norm(circle - stage.centres_m[k], axis=1), stage.radii_m[k])
        np.testing.assert_allclose(circle[:, 1], stage.centres_m[k, 1])
    many = with_selection(at(mc, "clique"), mc, tuple(np.flatnonzero(mc.inlier_mask).tolist()))
    assert (
        f"{style.MAX_SELECTED_BALLS} of " in many.step.note and "balls of the selection in the clique" in many.step.note
    )


def test_agreeing_pairs_are_lines_on_the_map() -> None:
    exact = exact_run()
    stage = exact.stage(ConsensusStage)
    assert stage is not None
    plain = at(exact, "consensus-clique")
    points = items_of(plain)["map/points"]
    assert isinstance(points, Points)
    first, second, third = (int(k) for k in stage.clique[:3])
    one = segments(with_selection(plain, exact, (first,)), "selection/pairs")
    others = [int(k) for k in stage.clique if k != first]
    np.testing.assert_array_equal(one, points.positions[[[first, k] for k in others]])
    selected = tuple(sorted((first, second, third)))
    three = segments(with_selection(plain, exact, selected), "selection/pairs")
    np.testing.assert_array_equal(three, points.positions[list(combinations(selected, 2))])
    stranger = int(np.setdiff1d(np.arange(len(exact.problem)), stage.clique)[0])
    assert not len(segments(with_selection(plain, exact, (stranger,)), "selection/pairs"))


def test_the_colour_of_the_selection_differs_from_all_others_and_from_both_pages() -> None:
    def lab(color: tuple[int, int, int]) -> np.ndarray:
        return cv2.cvtColor(np.float32([[color]]) / 255, cv2.COLOR_RGB2LAB)[0, 0]  # pyright: ignore

    def light(color: tuple[int, int, int]) -> float:
        value = np.array(color) / 255
        linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    others = [color for color, name in style.LEGEND if name != "selected"] + [style.SPHERE, style.SCALE]
    assert min(np.linalg.norm(lab(style.SELECTED) - lab(other)) for other in others) > 35
    dark, bright = light((20, 20, 20)), light((255, 255, 255))
    own = light(style.SELECTED)
    assert (own + 0.05) / (dark + 0.05) > 3 and (bright + 0.05) / (own + 0.05) > 3
    assert (style.SELECTED, "selected") in style.LEGEND
