"""Queries that are judged by each other: those taken together by fixed cameras, and those of a sequence."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets.map_scene import MapScene
from spherloc.estimators import options_type
from spherloc.experiments.results import DOUBTFUL, FAILED, LOCALIZED, QueryResult
from spherloc.experiments.sequence import How, localize_queries
from spherloc.frontend.view import Gravity, Matches, View
from spherloc.geometry import DOWN, camera_centre, pose, transform, yaw_rotation
from spherloc.mapping.rig import rig_of
from spherloc.mapping.scenes.joint_outcome import judged_together, tried_anew
from spherloc.mapping.scenes.neighbours import jumps

CAMERA = KannalaBrandt(560, 560, 205.0, 205.0, 280.0, 280.0, (0.0, 0.0, 0.0, 0.0))
LOOKS = {"left": np.radians(-70.0), "front": 0.0, "right": np.radians(70.0)}
ASIDE_M = {"left": -0.2, "front": 0.0, "right": 0.2}
AWAY_M = np.array([40.0, 0.0, 0.0])
HOW = How("ransac-2p", options_type("ransac-2p")(), 0)
TIMES = 6


def pose_at(camera: str, time: float, away: np.ndarray | None = None) -> np.ndarray:
    """The pose (3, 4) of a camera of a car on a bent road, which may be put elsewhere."""
    heading = 0.1 * time
    here = np.array([0.3 * time**1.5, 0.0, 2.0 * time]) + (np.zeros(3) if away is None else away)
    here = here + ASIDE_M[camera] * np.array([np.cos(heading), 0.0, -np.sin(heading)])
    turn = yaw_rotation(heading + LOOKS[camera]).T
    return pose(turn, -turn @ here)


@dataclass(frozen=True)
class Drawn:
    """Draws matches: so many right ones, so many that agree with a place 40 m away, and thirty wrong ones."""

    reference: View
    counts: dict[str, tuple[int, int]]
    """By the name of a query; 80 right ones if absent."""
    tried: list[str] = field(default_factory=list)

    def __call__(self, query: View) -> Matches:
        self.tried.append(query.name)
        camera, time = query.name.split("/")[0], int(query.name[-7:-4])
        right, away = self.counts.get(query.name, (80, 0))
        rng = np.random.default_rng([time, len(camera)])
        poses = [pose_at(camera, time)] * right + [pose_at(camera, time, AWAY_M)] * away
        rays = CAMERA.unproject(rng.uniform(40.0, 520.0, (len(poses), 2)))[0]
        ranges = rng.uniform(3.0, 8.0, (len(poses), 1))
        points = np.array([one[:, :3].T @ (ray - one[:, 3]) for one, ray in zip(poses, rays * ranges, strict=True)])
        seen = np.array([transform(one, point[None])[0] for one, point in zip(poses, points, strict=True)])
        pixels = CAMERA.project(seen)[0] + 0.3 * rng.standard_normal((len(poses), 2))
        wrong = 30
        pixels = np.vstack([pixels, rng.uniform(40.0, 520.0, (wrong, 2))])
        points = np.vstack([points, rng.uniform(-10.0, 10.0, (wrong, 3))])
        nowhere = np.full_like(pixels, np.nan)
        return Matches(pixels, points, (self.reference,), np.zeros(len(pixels), np.int64), nowhere)


def scene_of(
    folder: Path, cameras: Sequence[str], counts: dict[str, tuple[int, int]], shifted: int = 0
) -> tuple[MapScene, list[QueryResult]]:
    """A map of two streets that look alike, with queries in the first one, and what becomes of each by itself; the
    numbers of the last camera's queries may be ``shifted``, so that they do not tell when they were taken."""
    image = folder / "image.png"
    cv2.imwrite(str(image), np.zeros((560, 560), np.uint8))
    down = Gravity(DOWN, "the IMU", float(np.radians(0.5)))
    references = [
        View(f"{camera}/{time + later:03d}.png", CAMERA, image, pose_at(camera, time, away))
        for camera in cameras
        for later, away in ((0, None), (100, AWAY_M))
        for time in range(TIMES)
    ]
    queries = [View(f"{camera}/{time:03d}.png", CAMERA, image, gravity=down) for camera in cameras for time in range(6)]
    matcher = Drawn(references[0], counts)
    scene = MapScene("drive", "drive.toml", tuple(queries), tuple(references), matcher, DOWN)
    rows = [row for row, _ in localize_queries(scene, scene.queries, *HOW[:3])]
    matcher.tried.clear()
    if shifted:
        late = [row for row in rows if row.query.startswith(cameras[-1])]
        moved = {late[k].query: replace(late[(k + shifted) % len(late)], query=late[k].query) for k in range(len(late))}
        rows = [moved.get(row.query, row) for row in rows]
    return scene, rows


def judged(scene: MapScene, rows: list[QueryResult]) -> dict[str, QueryResult]:
    """All rows after they were judged by each other, by name; judged again, none changes and nothing is tried again."""
    after = {row.query: row for row in rows}
    after.update({row.query: row for row, _ in judged_together(scene, rows, HOW)})
    assert isinstance(scene.matcher, Drawn)
    scene.matcher.tried.clear()
    assert not list(judged_together(scene, list(after.values()), HOW)) and not scene.matcher.tried
    return after


def off_m(row: QueryResult) -> float:
    assert row.cam_from_map is not None
    camera, time = row.query.split("/")[0], int(row.query[-7:-4])
    return float(np.linalg.norm(camera_centre(row.cam_from_map) - camera_centre(pose_at(camera, time))))


def test_right_poses_stay_as_they_are(tmp_path: Path) -> None:
    scene, rows = scene_of(tmp_path, ("left", "right"), {})
    assert {row.status for row in rows} == {LOCALIZED} and max(map(off_m, rows)) < 0.1
    assert not list(judged_together(scene, rows, HOW))
    assert isinstance(scene.matcher, Drawn) and not scene.matcher.tried


def test_a_doubtful_query_is_localized_around_the_pose_of_its_partner(tmp_path: Path) -> None:
    """More of its matches agree elsewhere, but not many more."""
    name = "right/002.png"
    scene, rows = scene_of(tmp_path, ("left", "right"), {name: (30, 34), "left/004.png": (0, 0)})
    before = {row.query: row for row in rows}
    assert before[name].status == DOUBTFUL and off_m(before[name]) > 30.0
    after = judged(scene, rows)
    assert after[name].status == LOCALIZED and off_m(after[name]) < 0.1 and tried_anew(after[name])
    assert "left/002.png" in after[name].remarks[-1] and (after[name].inliers or 0) >= 25
    lost = after["left/004.png"]  # without right matches it is none
    assert lost.status != LOCALIZED and "in vain" in lost.remarks[-1]
    assert sum(row is not before[row.query] for row in after.values()) == 2


def test_of_two_that_disagree_neither_is_believed(tmp_path: Path) -> None:
    name = "right/002.png"
    scene, rows = scene_of(tmp_path, ("left", "right"), {name: (0, 60)})
    assert {row.status for row in rows} == {LOCALIZED}
    after = judged(scene, rows)
    doubted = {row.query for row in after.values() if row.status == DOUBTFUL}
    assert doubted == {"left/002.png", name}
    assert "left/002.png, it should be 40 m from" in after[name].message and "not known which" in after[name].message
    assert after[name].doubts and "right/002.png" in after["left/002.png"].doubts[0]


def test_of_two_that_disagree_that_is_believed_around_which_both_are_localized(tmp_path: Path) -> None:
    """Many matches of one agree elsewhere, a fifth of them where the other one says."""
    name = "right/002.png"
    scene, rows = scene_of(tmp_path, ("left", "right"), {name: (16, 70)})
    assert {row.status for row in rows} == {LOCALIZED}
    after = judged(scene, rows)
    assert {row.status for row in after.values()} == {LOCALIZED}
    assert off_m(after[name]) < 0.2 and off_m(after["left/002.png"]) < 0.1


def test_of_three_the_majority_decides(tmp_path: Path) -> None:
    scene, rows = scene_of(tmp_path, tuple(LOOKS), {"front/003.png": (0, 60)})
    assert {row.status for row in rows} == {LOCALIZED}
    after = judged(scene, rows)
    assert [row.query for row in after.values() if row.status != LOCALIZED] == ["front/003.png"]
    assert "not known" not in after["front/003.png"].message


def test_names_that_do_not_tell_the_time_are_not_believed(tmp_path: Path) -> None:
    scene, rows = scene_of(tmp_path, ("left", "right"), {}, shifted=2)
    said: list[str] = []
    assert not list(judged_together(scene, rows, HOW, say=said.append))
    assert len(said) == 1 and "6 of 6 pairs" in said[0]


def test_which_queries_were_taken_together(tmp_path: Path) -> None:
    scene, _ = scene_of(tmp_path, ("left", "right"), {})
    rig = rig_of(scene.references)
    assert rig is not None and rig_of(scene.references[:16]) is None and rig.off == pytest.approx(1.0, rel=0.3)
    np.testing.assert_allclose(rig.relative["left", "right"][:, 3], pose_right_from_left()[:, 3], atol=1e-9)

    def times(*names: str) -> list[int]:
        views = [View(name, CAMERA, tmp_path / "image.png") for name in names]
        return [step for _, step in rig.times_of(views).values()]

    assert times("left/007.png", "right/007.png") == [0, 0]
    assert times("left/001.png", "left/002.png", "right/002.png") == [0, 1, 1]
    assert times("left/001.png", "up/001.png") == []


def pose_right_from_left() -> np.ndarray:
    left, right = (np.vstack([pose_at(camera, 0.0), [0.0, 0.0, 0.0, 1.0]]) for camera in ("left", "right"))
    return (right @ np.linalg.inv(left))[:3]


def row_at(name: str, place: np.ndarray, status: str = LOCALIZED) -> QueryResult:
    known = None if status == FAILED else pose(np.eye(3), -place)
    return QueryResult(0, name, status, cam_from_map=known)


def walk(rng: np.random.Generator, numbers: Sequence[int]) -> dict[str, np.ndarray]:
    """Places on a walk with turns, by the names of frames."""
    turns = rng.choice([0.0, 0.3, np.pi / 2, np.pi], numbers[-1] + 1, p=[0.5, 0.3, 0.15, 0.05])
    headings = np.cumsum(turns * rng.choice([-1.0, 1.0], len(turns)))
    ways = rng.uniform(0.5, 1.5, len(turns))[:, None]
    places = np.cumsum(ways * np.column_stack([np.cos(headings), 0.0 * headings, np.sin(headings)]), axis=0)
    return {f"frame_{number:04d}.png": places[number] for number in numbers}


def test_a_frame_far_from_those_before_and_after_it_stands_out(rng: np.random.Generator) -> None:
    for _ in range(20):
        places = walk(rng, range(20))
        places["frame_0007.png"] = places["frame_0007.png"] + [14.0, 0.0, 0.0]
        rows = [row_at(name, place) for name, place in places.items()]
        rows[12] = row_at(rows[12].query, np.zeros(3), FAILED)
        found = jumps(rows[::-1], 0.5)
        assert set(found) == {"frame_0007.png"}
        jump = found["frame_0007.png"]
        assert (jump.before, jump.after) == ("frame_0006.png", "frame_0008.png") and jump.away > 10.0 > jump.apart
        assert not jumps(rows, 20.0) and not jumps(rows[:7], 0.5)


def test_turns_gaps_and_photographs_in_no_order_do_not_stand_out(rng: np.random.Generator) -> None:
    for _ in range(50):
        gaps = np.cumsum(rng.choice([1, 1, 1, 1, 20], 24)).tolist()
        scattered = {f"IMG_{k:04d}.jpg": place for k, place in enumerate(rng.uniform(0.0, 20.0, (30, 3)))}
        unnamed = {f"{chr(97 + k)}.png": place for k, place in enumerate(rng.uniform(0.0, 20.0, (20, 3)))}
        for places in (walk(rng, range(24)), walk(rng, gaps), scattered, unnamed):
            assert not jumps([row_at(name, place) for name, place in places.items()], 0.5)
    there_and_back = [row_at(f"{k}.png", np.array([0.01 * k, 0.0, 0.0])) for k in range(10)]
    there_and_back += [row_at("60.png", np.array([14.0, 0.0, 0.0]))]  # long after, and long before the next one
    there_and_back += [row_at(f"{k}.png", np.array([0.01 * (k - 100), 0.0, 0.0])) for k in range(110, 120)]
    assert set(jumps(there_and_back, 0.5)) <= {"60.png"}
