"""Matches that agree on one thing in the view alone: an object that looks alike elsewhere fixes a wrong pose well."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.consensus.spread import MAX_RADIUS_DEG, MIN_REST, spread_of
from spherloc.diagnosis.causes import Cause
from spherloc.diagnosis.decide import diagnose
from spherloc.estimators.base import estimate
from spherloc.outcome import Outcome, judge

PANORAMA = Equirectangular(400, 200)


def around(rng, middle, degrees, count):
    """Unit vectors (count, 3) evenly in a cap."""
    axis = np.asarray(middle, float) / np.linalg.norm(middle)
    heights = rng.uniform(np.cos(np.radians(degrees)), 1.0, count)
    side = rng.normal(size=(count, 3))
    side -= (side @ axis)[:, None] * axis
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return heights[:, None] * axis + np.sqrt(1.0 - heights**2)[:, None] * side


def test_the_smallest_part_is_found_and_counted(rng):
    middle = [0.2, -0.4, 0.9]
    shelf, far = around(rng, middle, 20.0, 90), around(rng, [-v for v in middle], 90.0, 210)
    bearings = np.concatenate([shelf, far])
    agreeing = np.zeros(300, bool)
    agreeing[:90], agreeing[90:95] = True, True
    spread = spread_of(PANORAMA, bearings, agreeing)
    assert spread is not None and 15.0 < spread.radius_deg < 25.0
    assert spread.inside + spread.rest == 300 and spread.agreeing_inside + spread.agreeing_rest == 95
    assert spread.agreeing_inside >= 0.9 * 95 and spread.rest > 200
    assert spread.margin < 0.0 and f"{spread.agreeing_rest} of {spread.rest} do" in spread.sentence
    assert spread_of(KannalaBrandt(400, 400, 90, 90, 200, 200, (0.0,) * 4), bearings, agreeing) is None
    order = rng.permutation(300)
    assert spread_of(PANORAMA, bearings[order], agreeing[order]).margin == pytest.approx(spread.margin, abs=0.3)


@pytest.mark.parametrize(
    "reason", ["the rest agrees, too", "a large part", "few matches elsewhere", "all agree", "few"]
)
def test_what_is_believed(rng, reason):
    degrees = MAX_RADIUS_DEG + 20.0 if reason == "a large part" else 20.0
    shelf = around(rng, [0, 0, 1], degrees, 100)
    rest = around(rng, [0, 0, -1], 60.0, {"few matches elsewhere": MIN_REST - 20, "all agree": 0}.get(reason, 200))
    agreeing = np.concatenate([np.ones(100, bool), np.zeros(len(rest), bool)])
    if reason == "the rest agrees, too":
        agreeing[:90], agreeing[100:110] = False, True
    if reason == "few":
        agreeing[3:] = False
    spread = spread_of(PANORAMA, np.concatenate([shelf, rest]), agreeing)
    assert spread is None if reason == "few" else spread is not None and spread.margin > 0.0


def test_a_pose_on_one_thing_in_the_view_is_doubtful(scene_of):
    """Three hundred wrong matches all around, and right ones in a corner of the view only; with right ones everywhere
    the same pose is believed."""
    problem = scene_of("panorama", correspondences=500, outlier_rate=0.6).problem(3)
    problem = replace(problem, truth_cam_from_map=None, truth_inliers=None)
    everywhere = estimate(problem, "mc", seed=0)
    assert judge(everywhere).outcome is Outcome.LOCALIZED
    bearings, _ = problem.camera.unproject(problem.pixels)
    right = everywhere.inlier_mask
    corner = bearings @ bearings[np.flatnonzero(right)[0]] > np.cos(np.radians(45.0))
    kept = np.flatnonzero(~right | corner)
    part = replace(problem, pixels=problem.pixels[kept], points=problem.points[kept])
    assert judge(estimate(part, "mc", seed=0)).outcome is Outcome.LOCALIZED, "wrong matches of a simulation say nothing"
    matched = replace(part, reference_images=(Path("a.png"),), reference_index=np.zeros(len(kept), np.int64))
    trace = estimate(matched, "mc", seed=0)
    judgement = judge(trace)
    assert np.count_nonzero(trace.inlier_mask) > 15 and judgement.outcome is Outcome.DOUBTFUL
    assert any("within" in reason and "of one direction" in reason for reason in judgement.reasons)
    found = diagnose(trace)
    assert found.cause is Cause.FALSE_CONSENSUS and found.alternative_cam_from_map is None
    assert "something that looks alike may stand there" in found.summary and "add images of the place" in found.advice
