"""The boxes of the search over positions: they close in on the best pose's camera, and what is said of them is true."""

import numpy as np
import pytest

from spherloc.estimators import estimate
from spherloc.geometry import camera_centre
from spherloc.refine import residuals_px
from spherloc.trace import ConsensusStage, PositionStage
from spherloc_viz import style
from spherloc_viz.app.stage import views
from spherloc_viz.layers import paint, steps
from spherloc_viz.layers.primitives import Segments


@pytest.fixture(scope="module")
def trace(scene_of):
    scene = scene_of("mei", correspondences=260, outlier_rate=0.6, noise_px=1.0)
    return estimate(scene.problem(2), "mc-exact")


def test_boxes_hold_what_they_say(trace):
    stage, consensus = trace.stage(PositionStage), trace.stage(ConsensusStage)
    aligned, bound_px = trace.problem.aligned, trace.options.bound_px
    assert (np.diff(stage.level) >= 0).all() and (stage.bound > stage.support).all()
    assert stage.support == consensus.support[0] and stage.upper_bound == trace.certificate.upper_bound
    pose = aligned.align_pose(consensus.cam_from_map[0])
    rng = np.random.default_rng(0)
    inside = 0
    for (lower, upper), bound in zip(stage.boxes_m.astype(float), stage.bound, strict=True):
        # The best rotation, from all over the box, and from where the best pose is.
        for centre in (*rng.uniform(lower, upper, (20, 3)), np.clip(camera_centre(pose), lower, upper)):
            there = np.column_stack([pose[:, :3], -pose[:, :3] @ centre])
            assert np.count_nonzero(residuals_px(aligned, there) <= bound_px) <= bound
        inside += ((lower <= camera_centre(pose)) & (camera_centre(pose) <= upper)).all()
    assert inside >= 3
    volumes = np.prod(stage.boxes_m[:, 1] - stage.boxes_m[:, 0], axis=1)
    np.testing.assert_allclose(volumes * 2.0**stage.level, volumes[0] * 2.0 ** stage.level[0], rtol=1e-4)


def test_each_level_is_a_step(trace):
    stage = trace.stage(PositionStage)
    levels = np.unique(stage.level)
    mine = [index for index, heading in enumerate(steps(trace)) if heading.stage == "Positions"]
    assert 3 <= len(mine) == len(levels) <= 12
    for index, level in zip(mine, levels, strict=True):
        picture = paint(trace, index)
        boxes = next(item for item in picture.scene if item.name == "boxes/positions")
        assert isinstance(boxes, Segments) and boxes.layer in style.LAYERS
        bound = stage.bound[stage.level == level]
        assert len(boxes.points) == 12 * len(bound)
        corners = boxes.points.reshape(len(bound), -1, 3)
        np.testing.assert_allclose(corners.min(axis=1), stage.boxes_m[stage.level == level, 0], atol=1e-6)
        np.testing.assert_allclose(corners.max(axis=1), stage.boxes_m[stage.level == level, 1], atol=1e-6)
        sides = np.abs(boxes.points[:, 1] - boxes.points[:, 0])
        assert (np.count_nonzero(sides > 1e-9, axis=1) == 1).all(), "an edge is no edge"
        gold = (boxes.colors.reshape(len(bound), 12, 3)[:, 0] == style.CLIQUE).all(axis=1)
        np.testing.assert_array_equal(gold, bound == bound.max())
        assert f"up to {bound.max()} of 260" in picture.step.caption
        view = views.follow(picture, 0.83)
        seen = views.projected(view, boxes.points.reshape(-1, 3)) / np.tan(view.field_of_view_rad / 2)
        assert np.all(np.abs(seen) <= [0.83, 1.0]), "all boxes are on the canvas"
