"""The paper's baselines: RANSAC around solvers of a full pose, on the sphere or in a virtual pinhole camera."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chisquare

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.estimators import estimate, options_type
from spherloc.estimators.ransac_solver import RANSAC_EPNP, RANSAC_ODLT, draw_samples
from spherloc.geometry import DOWN, pose
from spherloc.metrics import evaluate, ransac_success_probability
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.trace import RansacStage, RefinementStage

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

SPHERE = ("ransac-svd", "ransac-mlpnp", "ransac-p3p")
PINHOLE = ("ransac-epnp", "ransac-odlt", "ransac-epropnp")
SIZE = {"ransac-svd": 6, "ransac-mlpnp": 6, "ransac-p3p": 3} | dict.fromkeys(PINHOLE, 3)

each = pytest.mark.parametrize("estimator", SPHERE + PINHOLE)


def run(problem, estimator, seed=0, **options):
    return estimate(problem, estimator, options_type(estimator)(**options), seed)


def front_problem(camera, rng, count=100, outlier_rate=0.0, noise_px=1.0, half_field=1.6):
    """Points in front of a camera that is tilted any way, as gravity says; outliers have each other's pixels."""
    rotation = Rotation.random(None, rng).as_matrix()
    truth = pose(rotation, rng.uniform(-5, 5, 3))
    plane = np.column_stack([rng.uniform(-half_field, half_field, (count, 2)), np.ones(count)])
    rays = plane * rng.uniform(1.0, 8.0, (count, 1))
    pixels, valid = camera.project(rays)
    assert valid.all()
    pixels += noise_px * rng.standard_normal((count, 2))
    inliers = np.arange(count) >= round(outlier_rate * count)
    pixels[~inliers] = np.roll(pixels[~inliers], 1, axis=0)
    return Problem(
        name="in front",
        camera=camera,
        pixels=pixels,
        points=(rays - truth[:, 3]) @ rotation,
        gravity_camera=rotation @ DOWN,
        gravity_map=DOWN,
        truth_cam_from_map=truth,
        truth_inliers=inliers,
    )


@each
@pytest.mark.parametrize("camera", ["mei", "fisheye", "panorama"])
def test_success_on_the_sphere(estimator, camera, scene_of):
    """30 % outliers, the paper's 100 samples, a wide camera that looks in all directions; none is lost."""
    wide = {"view_deg": 360.0} if estimator in PINHOLE else {}
    traces = [run(scene_of(camera, outlier_rate=0.3).problem(seed), estimator, seed, **wide) for seed in range(10)]
    assert not any("virtual" in trace.message for trace in traces)
    assert sum(bool(evaluate(trace).success) for trace in traces) >= 9


@pytest.mark.parametrize("estimator", PINHOLE)
def test_success_in_the_virtual_camera(estimator, scene_of, rng):
    """The same, with tilted cameras and all points in front of them."""
    camera = scene_of("mei").camera
    found = [evaluate(run(front_problem(camera, rng, outlier_rate=0.3), estimator, seed)) for seed in range(10)]
    assert sum(bool(metrics.success) for metrics in found) >= 9
    assert np.median([metrics.recall for metrics in found]) > 0.95
    assert np.median([metrics.precision for metrics in found]) > 0.95


@each
def test_gravity_changes_nothing(estimator, scene_of, rng):
    """Baselines know six degrees of freedom: whatever gravity is claimed, they return the same pose."""
    problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.2)
    wrong = rng.standard_normal(3)
    other = replace(problem, gravity_camera=wrong / np.linalg.norm(wrong), gravity_map=np.array([0.6, 0.0, -0.8]))
    first, second = run(problem, estimator), run(other, estimator)
    np.testing.assert_allclose(first.cam_from_map, second.cam_from_map, atol=1e-6)
    np.testing.assert_array_equal(first.inlier_mask, second.inlier_mask)
    if estimator in SPHERE:  # OpenCV's EPnP turns rounding errors of five points into other hypotheses
        hypotheses = [trace.stage(RansacStage).cam_from_map for trace in (first, second)]
        np.testing.assert_allclose(*hypotheses, atol=1e-6)


def test_the_refinement_uses_gravity_if_asked(scene_of):
    """With exact gravity it keeps the tilt."""
    problem = scene_of("mei", outlier_rate=0.0).problem()
    free, level = run(problem, "ransac-svd"), run(problem, "ransac-svd", gravity_sd_deg=0.0)
    assert free.stage(RefinementStage).dof == 6 and level.stage(RefinementStage).dof == 4
    np.testing.assert_allclose(level.cam_from_map[:, :3] @ DOWN, DOWN, atol=1e-9)
    assert np.linalg.norm(free.cam_from_map[:, :3] @ DOWN - DOWN) > 1e-6


@pytest.mark.parametrize("estimator", PINHOLE)
def test_lost_correspondences_are_counted(estimator, scene_of):
    """Brute force: those that are more than 60 degrees off to a side, in the camera's own frame."""
    told = 0
    for seed in range(6):
        problem = scene_of("mei", outlier_rate=0.1).problem(seed)
        tilt = Rotation.from_rotvec([0.5, 0.0, -0.4]).as_matrix()
        problem = replace(problem, gravity_camera=tilt @ DOWN, truth_cam_from_map=None)
        seen = np.array(
            [
                z > 0 and abs(np.degrees(np.arctan2(x, z))) <= 60 and abs(np.degrees(np.arctan2(y, z))) <= 60
                for x, y, z in problem.bearings
            ]
        )
        trace = run(problem, estimator, view_deg=120.0)
        lost = np.count_nonzero(~seen)
        match = re.search(
            r"(\d+) of 100 usable correspondences lies? outside the virtual camera's 120 deg", trace.message
        )
        assert match and int(match[1]) == lost
        assert not trace.inlier_mask[~seen].any()
        if trace.cam_from_map is not None:
            stage = trace.stage(RansacStage)
            assert trace.message.startswith(f"Pose found: {trace.inlier_mask.sum()} of 100 ")
            assert seen[stage.samples].all() and not stage.inlier_masks[:, ~seen].any()
            told += 1
    assert told >= 3


@each
def test_nothing_lost_nothing_said(estimator, scene_of, rng):
    trace = run(front_problem(scene_of("mei").camera, rng), estimator)
    assert trace.message == f"Pose found: {trace.inlier_mask.sum()} of 100 correspondences agree with it."


@each
def test_improvements_are_recorded_as_they_happened(estimator, scene_of, rng):
    for seed in range(4):
        problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.4)
        stage = run(problem, estimator, seed).stage(RansacStage)
        sampled = ~stage.locally_optimized
        counts = stage.inlier_masks.sum(axis=1)
        assert (np.diff(counts[sampled]) > 0).all() and (np.diff(stage.improved_at) >= 0).all()
        assert stage.iterations == 100 and stage.samples.shape == (len(counts), SIZE[estimator])
        expected = ransac_success_probability(counts[-1] / 100, SIZE[estimator], 100)
        assert stage.confidence_reached == pytest.approx(expected)
        for cam_from_map, mask in zip(stage.cam_from_map, stage.inlier_masks, strict=True):
            error = residuals_px(problem.aligned, problem.aligned.align_pose(cam_from_map))
            np.testing.assert_array_equal(mask[problem.usable], error <= 8.0)


@pytest.mark.parametrize("solver", [RANSAC_EPNP, RANSAC_ODLT], ids=lambda solver: solver.name)
def test_the_named_solver_fits_the_inliers(solver, scene_of, rng):
    """The last hypothesis is its pose from the inliers of the one before, and the refinement starts there."""
    problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.3)
    trace = run(problem, solver.name)
    stage, refinement = trace.stage(RansacStage), trace.stage(RefinementStage)
    np.testing.assert_array_equal(stage.locally_optimized, np.arange(len(stage.samples)) == len(stage.samples) - 1)
    mask = stage.inlier_masks[-2]
    expected = solver.fitter.solve(problem.bearings[mask], problem.points[mask])[0]
    np.testing.assert_allclose(stage.cam_from_map[-1], expected, atol=1e-6)
    np.testing.assert_allclose(refinement.cam_from_map[0], stage.cam_from_map[-1], atol=1e-9)


def test_sphere_solvers_fit_nothing(scene_of):
    """Algorithm 1 refines the best sample's pose."""
    stage = run(scene_of("mei", outlier_rate=0.2).problem(), "ransac-svd").stage(RansacStage)
    assert not stage.locally_optimized.any()


def test_opencvs_sampling_is_a_choice(scene_of, rng):
    """Five matches by EPnP, as the paper's R+*; not on the whole sphere, and no view is 180 degrees wide."""
    problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.2)
    stage = run(problem, "ransac-odlt", sampler="epnp", view_deg=120.0).stage(RansacStage)
    assert stage.samples.shape[1] == 5
    for wrong in ({"view_deg": 180.0}, {"sampler": "dlt"}, {"sampler": "epnp", "view_deg": 360.0}):
        with pytest.raises(InputError, match=r"option (view_deg|sampler) is"):
            options_type("ransac-odlt")(**wrong)


@pytest.mark.parametrize("estimator", ["ransac-mlpnp", "ransac-p3p", "ransac-epropnp"])
def test_local_optimization_loses_nothing_and_needs_fewer_samples(estimator, scene_of):
    """Each kept fit explains more than the sample's pose before it; with a confidence, fewer samples are drawn."""
    wide = {"view_deg": 360.0} if estimator in PINHOLE else {}
    drawn, fits = np.zeros(2), 0
    for seed in range(6):
        problem = scene_of("mei", outlier_rate=0.4, noise_px=3.0).problem(seed)
        for k, local in enumerate((False, True)):
            options = {"iterations": 3000, "confidence": 0.999, "local_optimization": local} | wide
            stage = run(problem, estimator, seed, **options).stage(RansacStage)
            drawn[k] += stage.iterations
        counts = stage.inlier_masks.sum(axis=1)
        improved = np.flatnonzero(stage.locally_optimized[:-1] if estimator in PINHOLE else stage.locally_optimized)
        assert (counts[improved] > counts[improved - 1]).all()
        fits += len(improved)
    assert fits >= 3 and drawn[1] <= drawn[0]


@each
def test_seed_decides_everything(estimator, scene_of, rng):
    problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.3)
    first, same, other = (run(problem, estimator, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.cam_from_map, same.cam_from_map)
    np.testing.assert_array_equal(first.stage(RansacStage).samples, same.stage(RansacStage).samples)
    assert not np.array_equal(first.stage(RansacStage).samples, other.stage(RansacStage).samples)


@each
def test_samples_name_places_in_the_problem(estimator, scene_of, rng):
    """With unusable pixels in between, indices among the usable ones would be off."""
    problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.1)
    pixels = problem.pixels.copy()
    pixels[::3] = -5000.0
    problem = replace(problem, pixels=pixels)
    assert not problem.usable[::3].any()
    trace = run(problem, estimator)
    assert problem.usable[trace.stage(RansacStage).samples].all()
    assert not trace.inlier_mask[::3].any() and trace.inlier_mask.sum() > 40


@pytest.mark.parametrize("confidence", [0.5, 0.999])
@pytest.mark.parametrize("estimator", ["ransac-svd", "ransac-epnp"])
def test_confidence_stops_as_eq_28_says(estimator, confidence, scene_of, rng):
    """Not before the best hypothesis so far gives the probability, and not a sample later."""
    for seed in range(5):
        problem = front_problem(scene_of("mei").camera, rng, outlier_rate=0.3)
        stage = run(problem, estimator, seed, confidence=confidence, iterations=3000).stage(RansacStage)
        best = stage.inlier_masks[~stage.locally_optimized][-1].mean()
        assert stage.iterations < 3000
        assert ransac_success_probability(best, SIZE[estimator], stage.iterations) >= confidence
        if stage.iterations - 1 != stage.improved_at[-1]:
            assert ransac_success_probability(best, SIZE[estimator], stage.iterations - 1) < confidence


@each
@pytest.mark.parametrize("count", range(2, 9))
def test_too_few_correspondences_are_a_sentence(estimator, count, scene_of, rng):
    """From too few for a sample to enough for one: a pose, or a reason that names the numbers."""
    trace = run(front_problem(scene_of("mei").camera, rng, count, noise_px=0.1), estimator)
    if count < SIZE[estimator]:
        assert trace.cam_from_map is None and not trace.inlier_mask.any()
        where = "usable" if estimator in SPHERE else "inside its virtual camera"
        assert trace.message == f"No pose: {estimator} needs {SIZE[estimator]} correspondences, {count} are {where}."
        stage = trace.stage(RansacStage)
        assert stage.iterations == 0 and stage.confidence_reached == 0.0
        assert stage.samples.shape == (0, SIZE[estimator]) and stage.inlier_masks.shape == (0, count)
        assert trace.stage(RefinementStage) is None
    else:
        assert trace.message.startswith(("Pose found: ", "No pose: ")) and trace.message.endswith(".")
        assert (trace.cam_from_map is None) == trace.message.startswith("No pose: ")


def test_too_few_inliers_for_the_named_solver_are_a_sentence(scene_of, rng):
    """Five correspondences give EPnP a pose, but oDLT needs six."""
    messages = {
        run(front_problem(scene_of("mei").camera, rng, 5, noise_px=0.0), "ransac-odlt").message for _ in range(5)
    }
    assert "No pose: oDLT needs 6 inliers, the best sample's pose has 5." in messages


@each
def test_no_pose_is_a_sentence(estimator):
    """All points in one place: no sample has a solution."""
    pixels = np.column_stack([np.linspace(400, 600, 9), np.linspace(200, 300, 9)])
    problem = Problem("one point", Equirectangular(1000, 500), pixels, np.ones((9, 3)), DOWN, DOWN)
    trace = run(problem, estimator, iterations=70)
    assert trace.cam_from_map is None and not trace.inlier_mask.any()
    assert trace.message == "No pose: none of 70 samples has a solution that explains a correspondence."


@pytest.mark.parametrize("count, size", [(6, 6), (7, 6), (12, 5), (4, 1)])
def test_samples_are_uniform_sets(count, size):
    """Every number and every pair of numbers equally often, none twice in a sample."""
    samples = draw_samples(np.random.default_rng(1), count, size, 40_000)
    assert samples.shape == (40_000, size) and samples.min() >= 0 and samples.max() < count
    ordered = np.sort(samples, axis=1)
    assert (np.diff(ordered, axis=1) > 0).all()
    if count == size:
        return
    assert chisquare(np.bincount(samples.ravel(), minlength=count)).pvalue > 1e-3
    if size > 1:
        present = np.zeros((40_000, count))
        np.put_along_axis(present, samples, 1.0, axis=1)
        together = (present.T @ present)[np.triu_indices(count, 1)]
        expected = 40_000 * size * (size - 1) / (count * (count - 1))
        assert np.abs(together - expected).max() < 5 * np.sqrt(expected)


@pytest.mark.parametrize(
    "options",
    [
        {"bound_px": 0.0},
        {"bound_px": np.inf},
        {"bound_px": None},
        {"iterations": 0},
        {"iterations": 2.5},
        {"iterations": 10**7},
        {"confidence": 1.0},
        {"confidence": np.nan},
        {"gravity_sd_deg": -1.0},
    ],
)
def test_bad_options_are_input_errors(options):
    name = next(iter(options))
    with pytest.raises(InputError, match=f"option {name} is"):
        options_type("ransac-svd")(**options)


def test_defaults_are_the_papers():
    options = options_type("ransac-mlpnp")()
    assert (options.bound_px, options.iterations, options.confidence) == (8.0, 100, None)
    assert options.gravity_sd_deg == np.inf
