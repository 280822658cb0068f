"""The frames that a problem happens to be given in must not matter: gravity alignment in and out."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spherloc.cameras.base import Camera
from spherloc.estimators import estimate
from spherloc.geometry import rotation_angle
from spherloc.problem import Problem

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@dataclass(frozen=True, eq=False)
class TurnedCamera:
    """Another camera bolted on at an angle: the same pixels, bearings turned by ``turn`` (3, 3)."""

    inner: Camera
    turn: np.ndarray
    model = "turned"

    @property
    def width(self):
        return self.inner.width

    @property
    def height(self):
        return self.inner.height

    def project(self, points):
        return self.inner.project(points @ self.turn)

    def unproject(self, pixels):
        bearings, valid = self.inner.unproject(pixels)
        return bearings @ self.turn.T, valid

    def unprojection_jacobian(self, pixels):
        return self.turn @ self.inner.unprojection_jacobian(pixels)


def turned(problem, camera_turn, map_turn):
    """The same problem in other frames: p_map' = map_turn p_map, p_cam' = camera_turn p_cam."""
    return Problem(
        name=problem.name,
        camera=TurnedCamera(problem.camera, camera_turn),
        pixels=problem.pixels,
        points=problem.points @ map_turn.T,
        gravity_camera=camera_turn @ problem.gravity_camera,
        gravity_map=map_turn @ problem.gravity_map,
    )


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_turned_frames_give_the_same_pose_and_inliers(rng, scene_of, camera, estimator):
    for seed in range(4):
        problem = scene_of(camera, outlier_rate=0.6).problem(seed)
        here = estimate(problem, estimator, seed=seed)
        camera_turn, map_turn = Rotation.random(2, rng).as_matrix()
        there = estimate(turned(problem, camera_turn, map_turn), estimator, seed=seed)
        assert here.cam_from_map is not None and there.cam_from_map is not None
        rotation = camera_turn.T @ there.cam_from_map[:, :3] @ map_turn
        translation = camera_turn.T @ there.cam_from_map[:, 3]
        # Turned by a yaw too, MC starts its refinement elsewhere within the same arcs.
        assert rotation_angle(here.cam_from_map[:, :3].T @ rotation) < 1e-6
        np.testing.assert_allclose(translation, here.cam_from_map[:, 3], atol=1e-6)
        np.testing.assert_array_equal(here.inlier_mask, there.inlier_mask)


@pytest.mark.parametrize("estimator", ["mc", "ransac-2p"])
def test_upside_down(scene_of, estimator):
    """Gravity at -y, where the aligning half turn has no axis of its own."""
    flip = np.diag([1.0, -1.0, -1.0])
    problem = scene_of("mei", outlier_rate=0.5).problem()
    here, there = estimate(problem, estimator), estimate(turned(problem, flip, flip), estimator)
    np.testing.assert_allclose(flip @ there.cam_from_map[:, :3] @ flip, here.cam_from_map[:, :3], atol=1e-9)
    np.testing.assert_allclose(flip @ there.cam_from_map[:, 3], here.cam_from_map[:, 3], atol=1e-9)


def test_every_pose_of_the_trace_is_in_the_problems_frames(rng, scene_of):
    """Stages hold poses too; one that was not turned back would draw the camera in the wrong place."""
    problem = scene_of("mei", outlier_rate=0.5, noise_px=0.2).problem()
    camera_turn, map_turn = Rotation.random(2, rng).as_matrix()
    other = turned(problem, camera_turn, map_turn)
    truth_rotation = camera_turn @ problem.truth_cam_from_map[:, :3] @ map_turn.T
    truth_shift = camera_turn @ problem.truth_cam_from_map[:, 3]
    for estimator in ("mc", "ransac-2p"):
        for stage in estimate(other, estimator).stages:
            poses = getattr(stage, "cam_from_map", None)
            if poses is not None:
                last = poses.reshape(-1, 3, 4)[-1]
                assert rotation_angle(truth_rotation.T @ last[:, :3]) < 0.02, stage.kind
                np.testing.assert_allclose(last[:, 3], truth_shift, atol=0.15, err_msg=stage.kind)


def test_gravity_off_by_its_bound_is_corrected(rng, scene_of):
    """Half a degree of error in the prior, and stated as such: 6-DoF refinement takes it out again."""
    tilt = Rotation.from_rotvec(np.radians([0.3, 0.0, 0.4])).as_matrix()
    for seed in range(5):
        problem = scene_of("mei", outlier_rate=0.5).problem(seed)
        tilted = replace(problem, gravity_camera=tilt @ problem.gravity_camera, gravity_bound_rad=np.radians(0.6))
        for estimator in ("mc", "ransac-2p"):
            found = estimate(tilted, estimator, seed=seed).cam_from_map
            assert np.degrees(rotation_angle(problem.truth_cam_from_map[:, :3].T @ found[:, :3])) < 0.5
