"""Checks of the contracts of what packages may register; spherloc's own kinds pass them (docs/extending.md).

Each check raises ``AssertionError`` with one sentence that says what is wrong and where; none needs a test framework.
"""

import json
import math
import tempfile
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spherloc.bounds import Bounds
from spherloc.cameras._files import MAX_FILE_BYTES
from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.extensions import Reader, reader_of
from spherloc.datasets.scene_file import SceneKind, load_scene, loader_of, read_table, scene_kind
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.errors import CalibrationError, InputError, ProblemError, show
from spherloc.estimators.base import Clock, Estimate, estimate_faults, estimator_of, run_estimator
from spherloc.files import read_file
from spherloc.geometry import pose, so3_exp
from spherloc.metrics import evaluate, rotation_error_deg, translation_error_m
from spherloc.problem import AlignedProblem, Problem
from spherloc.refine import RefinementOptions
from spherloc.solvers.base import Solver, solver_of
from spherloc.trace import Trace
from spherloc.types import BoolArray, FloatArray
from spherloc.watch import Cancelled, Watch


class Subject:
    """The object that is being checked; its name is the subject of the sentences about what is wrong."""

    def __init__(self, what: str) -> None:
        self._what = what

    def need(self, true: Any, otherwise: str) -> None:
        """Raise ``AssertionError`` with ``otherwise`` unless it is true."""
        if not true:
            self.fail(otherwise)

    def fail(self, otherwise: str) -> None:
        """Raise ``AssertionError`` with a sentence that ends with ``otherwise``."""
        raise AssertionError(f"{self._what} {otherwise}.")

    def raises(self, kind: type[Exception], call: Callable[[], Any], of: str) -> None:
        """Raise ``AssertionError`` unless ``call`` raises this kind of error; ``of`` says in which case it should."""
        try:
            call()
        except kind:
            return
        except Exception as error:
            self.fail(f"raises {error!r} {of}, not {kind.__name__}")
        self.fail(f"does not raise {kind.__name__} {of}")


def name_of(thing: Any) -> str:
    """Its name in messages: its own, or that of its type."""
    return str(getattr(thing, "name", getattr(thing, "__name__", type(thing).__name__)))


def difference(one: Any, other: Any, path: str) -> str:
    """The path of the first difference, other than of times, of two traces, stages or problems; empty if equal."""
    if isinstance(one, np.ndarray):
        alike = isinstance(other, np.ndarray) and one.dtype == other.dtype and one.tobytes() == other.tobytes()
        return "" if alike and one.shape == other.shape else path
    if is_dataclass(one) and not isinstance(one, type):
        names = [item.name for item in fields(one) if item.name != "timings_ms"] if type(one) is type(other) else [""]
        parts = (difference(getattr(one, name), getattr(other, name), f"{path}.{name}") for name in names if name)
        return path if names == [""] else next(filter(None, parts), "")
    if isinstance(one, tuple) and isinstance(other, tuple):
        if len(one) != len(other):
            return path
        pairs = enumerate(zip(one, other, strict=True))
        return next(filter(None, (difference(*pair, f"{path}[{number}]") for number, pair in pairs)), "")
    return "" if one == other or (one != one and other != other) else path


GRID = 400
"""Number of pixels along the longer side of the image, in even steps, at which a camera is checked."""
STEP_PX = 1e-2
"""Step of central differences."""


def check_camera(camera: Camera) -> None:
    """Raise ``AssertionError`` unless a camera keeps the contract of ``spherloc.cameras.base.Camera``.

    ``project`` and ``unproject`` are each other's inverse over the whole image and in all directions, within 1e-6 px
    and 1e-6 rad; masks and NaN agree; bearings are unit vectors; the Jacobian is that of central differences within
    1e-6 of its size; NaN, infinity, the origin and empty arrays make no warnings; the camera is frozen, hashable and
    rebuilt from its table, which JSON can hold; and unknown and missing keys are a ``CalibrationError``.
    """
    subject = Subject(f"the camera {show(getattr(camera, 'model', camera))}")
    subject.need(isinstance(camera, Camera), "lacks a method or attribute of Camera (spherloc.cameras.base)")
    whole = all(isinstance(side, int) and side > 0 for side in (camera.width, camera.height))
    subject.need(whole, f"has the size {camera.width} x {camera.height}; give whole pixels")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _check_image(camera, subject)
        _check_directions(camera, subject)
        _check_jacobian(camera, subject)
        _check_odd_input(camera, subject)
    _check_table(camera, subject)


def check_calibration_reader(reader: Reader | str, path: str | Path, name: str | None = None) -> Camera:
    """Raise ``AssertionError`` unless a calibration reader, or the one registered under a name, keeps its contract.

    ``path`` is a file of its kind, ``name`` that of one of its cameras. It gives a camera that passes ``check_camera``,
    None or a ``CalibrationError`` for files of other kinds, and for parts of its own one of these or a camera. Returns
    the camera.
    """
    subject = Subject(f"the calibration reader {show(reader if isinstance(reader, str) else name_of(reader))}")
    read = reader_of(reader) if isinstance(reader, str) else reader
    camera = read(Path(path), name)
    subject.need(isinstance(camera, Camera), f"gives {show(camera)} for {path}, which is not a camera")
    assert isinstance(camera, Camera)
    check_camera(camera)
    content = read_file(Path(path), MAX_FILE_BYTES)
    others = (
        b"",
        b"\n",
        b"\x00\xff\xfe",
        b"{}",
        b"[1, 2]",
        b"model: 3\n",
        b"a = 1\n",
        b"<a/>",
        "\u00e9 \u4e2d".encode(),
    )
    parts = [content[: len(content) * part // 8] for part in range(1, 8)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / Path(path).name
        for is_part, text in [(False, text) for text in others] + [(True, text) for text in parts]:
            file.write_bytes(text)
            try:
                found = read(file, name)
            except CalibrationError:
                continue
            except Exception as error:
                subject.fail(f"raises {error!r} for a file with {show(text)}; raise CalibrationError or give None")
            allowed = found is None or (is_part and isinstance(found, Camera))
            subject.need(allowed, f"gives {show(found)} for a file with {show(text)}")
    return camera


def _pixels(camera: Camera) -> FloatArray:
    """Pixels (N, 2) all over the image, its borders and corners included."""
    step = max(camera.width, camera.height) / GRID
    u = np.append(np.arange(0.0, camera.width, step), camera.width)
    v = np.append(np.arange(0.0, camera.height, step), camera.height)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles (N,) between rows of two arrays (N, 3), rad."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def _at(where: FloatArray, wrong: BoolArray) -> str:
    """The first of the wrong places, in words."""
    return "(" + ", ".join(f"{value:.6g}" for value in where[int(np.argmax(wrong))]) + ")"


def _check_image(camera: Camera, subject: Subject) -> None:
    pixels = _pixels(camera)
    bearings, valid = camera.unproject(pixels)
    forms = np.shape(bearings) == (len(pixels), 3) and np.shape(valid) == (len(pixels),) and valid.dtype == bool
    subject.need(forms, "gives unproject() of N pixels other than bearings (N, 3) and a mask (N,) of bool")
    subject.need(valid.mean() > 0.01, "sees less than 1 % of its own image")
    subject.need(np.isnan(bearings[~valid]).all(), "gives bearings other than NaN where unproject() is invalid")
    wrong = valid & ~(np.abs(np.linalg.norm(bearings, axis=1) - 1.0) < 1e-12)
    subject.need(not wrong.any(), f"gives a bearing that is not a unit vector at the pixel {_at(pixels, wrong)}")
    again, seen = camera.project(bearings)
    forms = np.shape(again) == (len(pixels), 2) and np.shape(seen) == (len(pixels),) and seen.dtype == bool
    subject.need(forms, "gives project() of N points other than pixels (N, 2) and a mask (N,) of bool")
    wrong = seen != valid
    subject.need(not wrong.any(), f"has other masks in project() than in unproject() at the pixel {_at(pixels, wrong)}")
    wrong = valid & ~(np.abs(again - pixels).max(axis=1) < 1e-6)
    # A seam or a pole of a panorama has several pixels of one bearing.
    wrong[wrong] = ~(_angles(camera.unproject(again[wrong])[0], bearings[wrong]) < 1e-12)
    subject.need(not wrong.any(), f"does not project the bearing of the pixel {_at(pixels, wrong)} to it again")


def _check_directions(camera: Camera, subject: Subject) -> None:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(20_000, 3))
    points *= 10.0 ** rng.uniform(-1, 2, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    pixels, valid = camera.project(points)
    subject.need(valid.any(), "projects no direction")
    subject.need(np.isnan(pixels[~valid]).all(), "gives pixels other than NaN where project() is invalid")
    bearings, seen = camera.unproject(pixels)
    wrong = seen != valid
    subject.need(not wrong.any(), f"cannot unproject what it projects of the point {_at(points, wrong)}")
    # Close to a fold the angle has half the digits of the pixel, since the pixel hardly moves there.
    error = np.where(valid, _angles(bearings, points), 0.0)
    subject.need(error.max() < 1e-6, f"has another bearing than that of the point {_at(points, error >= 1e-6)}")
    subject.need(np.median(error[valid]) < 1e-12, "has bearings that are off by more than 1e-12 rad in the median")


def _check_jacobian(camera: Camera, subject: Subject) -> None:
    pixels = np.vstack([_pixels(camera)[::17], [[math.nan, 1.0], [-1e7, 3.0]]])
    valid, analytic = camera.unproject(pixels)[1], camera.unprojection_jacobian(pixels)
    subject.need(np.shape(analytic) == (len(pixels), 3, 2), "gives a Jacobian other than (N, 3, 2)")
    finite = np.isfinite(analytic).all(axis=(1, 2))
    wrong = valid & ~finite
    subject.need(not wrong.any(), f"has no finite Jacobian at the valid pixel {_at(pixels, wrong)}")
    subject.need(np.isnan(analytic[~valid]).all(), "gives a Jacobian other than NaN where unproject() is invalid")
    ends = [[camera.unproject(pixels + sign * axis)[0] for sign in (1, -1)] for axis in np.eye(2) * STEP_PX]
    numeric = np.stack([(ahead - behind) / (2 * STEP_PX) for ahead, behind in ends], axis=-1)
    # Differences fail near the rim, where the second derivatives of the model are unbounded.
    outward = pixels + 0.02 * (pixels - [camera.width / 2, camera.height / 2])
    inside = camera.unproject(outward)[1] & np.isfinite(numeric).all(axis=(1, 2))
    inside[-2:] = False
    size = np.linalg.norm(analytic, axis=(1, 2))
    wrong = inside & ~(np.linalg.norm(analytic - numeric, axis=(1, 2)) < 1e-6 * size)
    subject.need(inside.any(), "has no pixel at which its Jacobian can be compared with differences")
    subject.need(not wrong.any(), f"has another Jacobian than central differences at the pixel {_at(pixels, wrong)}")


def _check_odd_input(camera: Camera, subject: Subject) -> None:
    nan, inf = math.nan, math.inf
    points = [
        [0, 0, 0],
        [nan, 0, 1],
        [0, nan, 1],
        [0, 0, nan],
        [inf, 0, 1],
        [0, -inf, 1],
        [0, 0, inf],
        [inf, inf, -inf],
    ]
    for what, method, given in (
        ("project()", camera.project, np.array(points)),
        ("unproject()", camera.unproject, np.array([[nan, 1.0], [1.0, nan], [inf, 1.0], [1.0, -inf], [1e300, 1e300]])),
    ):
        try:
            found, valid = method(given)
            subject.need(not valid.any() and np.isnan(found).all(), f"takes NaN, infinity or the origin in {what}")
            nothing = [np.shape(part) for part in method(np.empty((0, given.shape[1])))]
            subject.need(nothing == [(0, np.shape(found)[1]), (0,)], f"gives {nothing} for no rows in {what}")
        except Warning as warning:
            subject.fail(f"makes a warning of NaN, infinity or the origin in {what} ({warning}); use np.errstate")


def _check_table(camera: Camera, subject: Subject) -> None:
    table, kind = camera.to_dict(), type(camera)
    try:
        plain = json.loads(json.dumps(table, allow_nan=False)) == table
    except (TypeError, ValueError):
        plain = False
    subject.need(plain, f"gives to_dict() with more than plain numbers, texts and lists: {show(table)}")
    subject.need(
        table.get("model") == camera.model == kind.model, f"calls its model {show(table.get('model'))} in to_dict()"
    )
    again = kind.from_dict(table, "here")
    subject.need(again == camera and hash(again) == hash(camera), "is not equal to from_dict() of its to_dict()")
    try:
        camera.width = camera.width + 1  # pyright: ignore[reportAttributeAccessIssue]
    except (FrozenInstanceError, AttributeError):
        pass
    else:
        subject.fail("can be changed; make it a frozen dataclass")
    for key in table:
        rest = {name: value for name, value in table.items() if name != key}
        subject.raises(
            CalibrationError, lambda rest=rest: kind.from_dict(rest, "here"), f"in from_dict() without {key}"
        )
    wrong = {**table, "no_such_key": 1}
    subject.raises(CalibrationError, lambda: kind.from_dict(wrong, "here"), "in from_dict() of an unknown key")
    wrong = {**table, "width": math.nan}
    subject.raises(CalibrationError, lambda: kind.from_dict(wrong, "here"), "in from_dict() of a width that is NaN")


def check_dataset(scene: str | Path, loader: Callable[[dict[str, Any], Path], Any] | None = None) -> None:
    """Raise ``AssertionError`` unless the scene of a file, and its loader, keep the contract of scene files.

    Without ``loader``, the one that is registered for the file's kind is checked. The scene has a name and always gives
    the same ``Problem``; the loader refuses unknown keys, and values of other types, with an ``InputError`` that names
    the file; and its module has a docstring and an ``EXAMPLE`` of its own kind.
    """
    path = Path(scene)
    table = read_table(path)
    subject = Subject(f"the dataset {show(table.get('kind'))}")
    load = loader or loader_of(str(table.get("kind")))
    try:
        found = load(dict(table), path) if loader else load_scene(path)
        problem = found.problem()
    except Exception as error:
        cause = error.__cause__ or error
        raise AssertionError(f"the dataset {show(table.get('kind'))} raises {cause!r} for {path}.") from cause
    subject.need(isinstance(found.name, str) and found.name.isprintable() and bool(found.name), f"names {path} badly")
    subject.need(isinstance(problem, Problem), f"gives {show(problem)} for {path}, which is not a Problem")
    changed = difference(problem, found.problem(), "the problem")
    subject.need(not changed, f"gives another problem when it is asked again: {changed} of {path} differs")
    changes = [{**table, "no_such_key": 1}]
    changes += [{**table, key: value} for key in table if key != "kind" for value in (-1.5, [], {"no": "key"})]
    for number, values in enumerate(changes):
        key = next(key for key in values if values[key] is not table.get(key))
        what = f"with {key} = {show(values[key])} in {path.name}"
        try:
            load(values, path)
        except InputError as error:
            subject.need(path.name in str(error), f"does not name the file {what}: {error}")
        except Exception as error:
            subject.fail(f"raises {error!r} {what}; raise InputError")
        else:
            subject.need(number > 0, f"takes an unknown key {what}; raise InputError")
    if loader is None:
        _check_kind(scene_kind(str(table["kind"])), subject)


def _check_kind(kind: SceneKind, subject: Subject) -> None:
    subject.need(not kind.problem, f"cannot be described: {kind.problem}")
    subject.need(
        kind.documentation.partition("\n")[0].endswith("."), "has no module docstring whose first line is a sentence"
    )
    if kind.example:
        subject.need(tomllib.loads(kind.example).get("kind") == kind.name, "has an EXAMPLE of another kind")


def check_solver(solver: Solver | str) -> None:
    """Raise ``AssertionError`` unless a solver, or the one registered under a name, keeps the contract of
    ``spherloc.solvers.base.Solver``.

    For noise-free correspondences one of its poses is the true one, within 1e-6 rad and m: always for ``sample_size`` +
    1 of them, and for a minimal sample in 9 of 10 cases. Solutions are finite and have rotation matrices, also for
    degenerate input; the same input gives the same bits; the input arrays are not changed; and wrong input raises
    ``ProblemError``.
    """
    subject = Subject(f"the solver {show(solver if isinstance(solver, str) else getattr(solver, 'name', solver))}")
    solver = solver_of(solver) if isinstance(solver, str) else solver
    rng, size = np.random.default_rng(0), solver.sample_size
    minimal = 0
    for round_ in range(40):
        for count in (size, size + 1, size + 10):
            bearings, points, truth = _correspondences(rng, count, solver.pinhole)
            before = bearings.copy(), points.copy()
            found = solver.solve(bearings, points)
            where = f"of {count} correspondences (round {round_})"
            subject.need(np.ndim(found) == 3 and np.shape(found)[1:] == (3, 4), f"gives no (S, 3, 4) array {where}")
            subject.need(np.array_equal(before, (bearings, points)), f"changes its input {where}")
            subject.need(np.array_equal(found, solver.solve(bearings, points)), f"is not deterministic {where}")
            _check_rotations(found, subject, where)
            exact = any(math.radians(rotation_error_deg(truth, one)) < 1e-6 and translation_error_m(truth, one) < 1e-6
                        for one in found)  # fmt: skip
            minimal += exact and count == size
            subject.need(exact or count == size, f"does not find the true pose {where} without noise")
    subject.need(minimal >= 36, f"finds the true pose of {size} correspondences without noise {minimal} times in 40")
    bearings, points, _ = _correspondences(rng, size + 6, solver.pinhole)
    line = points[0] + np.arange(len(points))[:, None] * (points[1] - points[0])
    for what, one, other in (
        ("one point", bearings, np.repeat(points[:1], len(points), axis=0)),
        ("one bearing", np.repeat(bearings[:1], len(points), axis=0), points),
        ("points on a line", bearings, line),
    ):
        found = solver.solve(one, other)
        subject.need(
            np.ndim(found) == 3 and bool(np.isfinite(found).all()), f"gives numbers that are not finite of {what}"
        )
    wrong = [("bearings of shape (N, 2)", bearings[:, :2], points), ("a point too few", bearings, points[:-1])]
    wrong.append((f"{size - 1} correspondences", bearings[: size - 1], points[: size - 1]))
    if solver.pinhole:
        wrong.append(("a bearing behind the camera", -bearings, points))
    for what, one, other in wrong:
        subject.raises(ProblemError, lambda one=one, other=other: solver.solve(one, other), f"of {what}")


def check_estimator(estimator: str | Any) -> None:
    """Raise ``AssertionError`` unless an estimator, by its registered name or the object itself, keeps the contract of
    ``spherloc.estimators.base.Estimator``.

    It finds the pose of easy problems (60 matches, 20 % wrong, 100 degrees wide); the same seed gives the same bits;
    the results have the right types and shapes; too few, wrong and equal matches give a finite pose or a sentence
    without a pose; options are frozen and refuse invalid values with ``InputError``; and a cancelled run begins no
    further stage.
    """
    name = estimator if isinstance(estimator, str) else name_of(estimator)
    subject = Subject(f"the estimator {show(name)}")
    kept = _CheckedEstimator(estimator_of(estimator) if isinstance(estimator, str) else estimator, subject)
    kept.check_options()
    camera = Equirectangular(2048, 1024)
    easy = SyntheticScene("easy", camera, 60, 0.2, 0.5, 0, field_of_view_deg=100.0)
    for seed in range(3):
        problem = easy.problem(seed)
        trace = kept.solve(problem, seed)
        subject.need(bool(evaluate(trace).success), f"does not find the pose of an easy problem (seed {seed})")
        changed = difference(trace, kept.solve(problem, seed), "the trace")
        subject.need(not changed, f"is not deterministic: {changed} changes from run to run with seed {seed}")
    alike = replace(easy, correspondences=6).problem()
    alike = replace(alike, points=np.repeat(alike.points[:1], len(alike), axis=0), truth_cam_from_map=None)
    for what, hard in (
        ("two matches", replace(easy, correspondences=2, outlier_rate=0.0).problem()),
        ("three matches", replace(easy, correspondences=3).problem()),
        ("outliers only", replace(easy, correspondences=20, outlier_rate=1.0).problem()),
        ("matches with one point", alike),
    ):
        try:
            kept.solve(hard, 0)
        except AssertionError:
            raise
        except Exception as error:
            subject.fail(f"raises {error!r} of {what}; return an Estimate without a pose and the reason")
    watch = _Impatient()
    try:
        kept.solve(problem, 0, watch)
    except Cancelled:
        subject.need(len(watch.begun) <= 1, f"goes on to the stage {show(watch.begun[-1])} after it was cancelled")
    else:
        subject.fail("is not ended by its watch: do not catch Cancelled")


def _correspondences(rng: np.random.Generator, count: int, ahead: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit bearings (N, 3) all around or within 120 degrees, points (N, 3), and their pose (3, 4)."""
    plane = np.column_stack([rng.uniform(-1.7, 1.7, (count, 2)), np.ones(count)])
    rays = plane * rng.uniform(1.0, 8.0, (count, 1)) if ahead else 4.0 * rng.standard_normal((count, 3))
    truth = pose(so3_exp(rng.normal(size=3)), rng.uniform(-20.0, 20.0, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), (rays - truth[:, 3]) @ truth[:, :3], truth


def _check_rotations(found: FloatArray, subject: Subject, where: str) -> None:
    rotations = found[:, :, :3]
    good = np.isfinite(found).all() and np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    subject.need(
        good and (np.linalg.det(rotations) > 0.0).all(), f"gives a pose whose left block is not a rotation {where}"
    )


class _Impatient(Watch):
    """Cancels the run as soon as a stage begins."""

    def __init__(self) -> None:
        super().__init__()
        self.begun: list[str] = []

    def begin(self, stage: str, until: float | None = None) -> None:
        super().begin(stage, until)
        self.begun.append(stage)
        self.cancel()


class _CheckedEstimator:
    """An estimator whose results are checked."""

    def __init__(self, estimator: Any, subject: Subject) -> None:
        self._estimator, self._say = estimator, subject
        self.Options: Any = getattr(estimator, "Options", None)

    def check_options(self) -> None:
        subject, options = self._say, self.Options
        derived = isinstance(options, type) and issubclass(options, RefinementOptions) and is_dataclass(options)
        subject.need(derived, "has no Options, a dataclass that derives from RefinementOptions")
        default = options()
        subject.need(hasattr(default, "bound_px"), "has no option bound_px")
        try:
            default.noise_px = 1.0  # pyright: ignore[reportAttributeAccessIssue]
        except FrozenInstanceError:
            pass
        else:
            subject.fail("has Options that can be changed; make it a frozen dataclass")
        for value in (0.0, -1.0, math.nan, "x", None):
            subject.raises(
                InputError, lambda value=value: self.Options(bound_px=value), f"for bound_px = {show(value)}"
            )

    def solve(self, problem: Problem, seed: int, watch: Watch | None = None) -> Trace:
        return run_estimator(self, "checked", problem, None, seed, watch)

    def run(self, aligned: AlignedProblem, options: Any, bounds: Bounds, seed: int, clock: Clock) -> Estimate:
        result, subject = self._estimator.run(aligned, options, bounds, seed, clock), self._say
        faults = estimate_faults(result, len(aligned.index))
        subject.need(not faults, f"returns {' and '.join(faults)} of a wrong form")
        if result.cam_from_map is None:
            subject.need(result.reason.endswith("."), "gives no pose and no reason, which is a sentence")
            subject.need(not result.inlier_mask.any(), "has inliers without a pose")
        else:
            subject.need(not result.reason, f"has a pose and the reason {show(result.reason)} why there is none")
            _check_rotations(np.asarray(result.cam_from_map)[None], subject, "of its result")
        return result
