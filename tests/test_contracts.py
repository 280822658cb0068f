"""``spherloc.testing`` lets spherloc's own kinds pass, and says in a sentence what is wrong with others."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spherloc import registry
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import CalibrationError
from spherloc.estimators.base import Estimate
from spherloc.estimators.ransac import TwoPointRansac
from spherloc.refine import RefinementOptions
from spherloc.solvers.svd import Svd
from spherloc.testing import check_calibration_reader, check_camera, check_dataset, check_estimator, check_solver
from spherloc.watch import Cancelled
from tests.tiny_scene import write_tiny_scene


def refusal(check: Callable[..., object], *arguments: Any) -> str:
    """The sentence of a check that fails."""
    with pytest.raises(AssertionError) as caught:
        check(*arguments)
    sentence = str(caught.value)
    assert sentence.endswith(".") and "\n" not in sentence
    return sentence


@pytest.mark.parametrize("name", registry.names("estimators"))
def test_own_estimators_keep_the_contract(name: str) -> None:
    check_estimator(name)


def test_own_datasets_keep_the_contract(tmp_path: Path) -> None:
    check_dataset(write_tiny_scene(tmp_path))


class Shifted(Equirectangular):
    def project(self, points):
        pixels, valid = super().project(points)
        return pixels + np.array([1e-4, 0.0]), valid


class Everywhere(Equirectangular):
    def unproject(self, pixels):
        bearings, valid = super().unproject(pixels)
        return bearings, np.ones_like(valid)


class Steep(Equirectangular):
    def unprojection_jacobian(self, pixels):
        return 1.001 * super().unprojection_jacobian(pixels)


class Long(Equirectangular):
    def unproject(self, pixels):
        bearings, valid = super().unproject(pixels)
        return 1.001 * bearings, valid


class Warning_(Equirectangular):  # noqa: N801
    def project(self, points):
        np.asarray(points)[:, :2] / np.asarray(points)[:, 2:]
        return super().project(points)


class Untrue(Equirectangular):
    def to_dict(self):
        return super().to_dict() | {"width": self.width + 1}


class Lenient(Equirectangular):
    @classmethod
    def from_dict(cls, table, where):
        return cls(table["width"], table["height"]) if "height" in table else super().from_dict(table, where)


class Narrow(Equirectangular):
    def unproject(self, pixels):
        bearings, valid = super().unproject(pixels)
        return np.full_like(bearings, np.nan), np.zeros_like(valid)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Shifted, "does not project the bearing of the pixel"),
        (Everywhere, "has no finite Jacobian at the valid pixel (nan, 1)"),
        (Steep, "has another Jacobian than central differences at the pixel ("),
        (Long, "gives a bearing that is not a unit vector at the pixel ("),
        (Warning_, "makes a warning of NaN, infinity or the origin in project()"),
        (Untrue, "is not equal to from_dict() of its to_dict()"),
        (Lenient, "does not raise CalibrationError in from_dict() without model"),
        (Narrow, "sees less than 1 % of its own image"),
    ],
)
def test_broken_cameras_are_refused(kind: type[Equirectangular], words: str) -> None:
    assert words in refusal(check_camera, kind(400, 200))


def test_what_is_no_camera_is_refused() -> None:
    assert "lacks a method or attribute of Camera" in refusal(check_camera, 3)


class Turned(Svd):
    def solve(self, bearings, points):
        return super().solve(bearings, points) * np.array([1.0, 1.0, 1.0, 1.001])


class Scaled(Svd):
    def solve(self, bearings, points):
        return super().solve(bearings, points) * 1.001


class Careless(Svd):
    def solve(self, bearings, points):
        return super().solve(bearings[:6], points[:6]) if len(points) > 5 else np.zeros((0, 3, 4))


class Random(Svd):
    def solve(self, bearings, points):
        return np.vstack([super().solve(bearings, points), np.random.default_rng().normal(size=(1, 3, 4))])


class Greedy(Svd):
    def solve(self, bearings, points):
        found = super().solve(bearings, points)
        points *= 2.0
        return found


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Turned, "does not find the true pose of 7 correspondences (round 0) without noise"),
        (Scaled, "gives a pose whose left block is not a rotation of 6 correspondences"),
        (Careless, "does not raise ProblemError of a point too few"),
        (Random, "is not deterministic"),
        (Greedy, "changes its input"),
    ],
)
def test_broken_solvers_are_refused(kind: type[Svd], words: str) -> None:
    assert words in refusal(check_solver, kind())


@dataclass(frozen=True)
class Unchecked(RefinementOptions):
    bound_px: float = 8.0


class NoOptions:
    run = TwoPointRansac.run


class AnyOptions(TwoPointRansac):
    Options = Unchecked


class Seedless(TwoPointRansac):
    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        return TwoPointRansac.run(aligned, options, bounds, int(np.random.default_rng().integers(2**40)), clock)


class Eager(TwoPointRansac):
    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        if len(aligned.index) < 5:
            raise IndexError("five")
        return TwoPointRansac.run(aligned, options, bounds, seed, clock)


class Deaf(TwoPointRansac):
    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        for name in ("one", "two"):
            try:
                with clock.stage(name):
                    pass
            except Cancelled:
                clock.watch.board[0] = 0
        return TwoPointRansac.run(aligned, options, bounds, seed, type(clock)())


class Silent(TwoPointRansac):
    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        return Estimate((), None, np.zeros(len(aligned.index), dtype=bool))


class Integral(TwoPointRansac):
    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        return Estimate((), np.eye(3, 4), np.zeros(len(aligned.index)))


class Lost(TwoPointRansac):
    @staticmethod
    def run(aligned, options, bounds, seed, clock):
        return Estimate((), np.eye(3, 4), np.zeros(len(aligned.index), dtype=bool))


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (NoOptions, "has no Options, a dataclass that derives from RefinementOptions"),
        (AnyOptions, "does not raise InputError for bound_px = 0.0"),
        (Seedless, "is not deterministic: the trace.stages[0]."),
        (Eager, "raises IndexError('five') of two matches"),
        (Deaf, "after it was cancelled"),
        (Silent, "gives no pose and no reason"),
        (Integral, "returns an inlier mask of a wrong form"),
        (Lost, "does not find the pose of an easy problem (seed 0)"),
    ],
)
def test_broken_estimators_are_refused(kind: type, words: str) -> None:
    sentence = refusal(check_estimator, kind)
    assert words in sentence and kind.__name__ in sentence


def test_readers_are_tried_with_other_files(tmp_path: Path) -> None:
    path = tmp_path / "camera.zebra"
    path.write_text("zebra 400 200")

    def good(path: Path, name: str | None) -> Equirectangular | None:
        words = path.read_bytes().split()
        if words[:1] != [b"zebra"]:
            return None
        if len(words) < 3:
            raise CalibrationError("has no size.")
        return Equirectangular(int(words[1]), int(words[2]))

    assert check_calibration_reader(good, path) == Equirectangular(400, 200)
    blind = lambda path, name: Equirectangular(400, 200)  # noqa: E731
    assert "gives Equirectangular(" in refusal(check_calibration_reader, blind, path)
    crashing = lambda path, name: good(path, name) if path.read_bytes()[:1] == b"z" else 1 / 0  # noqa: E731
    assert "raises ZeroDivisionError('division by zero') for a file with b''" in refusal(
        check_calibration_reader, crashing, path
    )
    assert "which is not a camera" in refusal(check_calibration_reader, lambda path, name: None, path)


def test_broken_datasets_are_refused(tmp_path: Path) -> None:
    path = write_tiny_scene(tmp_path)
    own = registry.lookup("datasets", "synthetic")
    check_dataset(path, own)
    number = iter(range(100))

    def lenient(table, path):
        return own({key: value for key, value in table.items() if key != "no_such_key"}, path)

    def crashing(table, path):
        return own(table, path) if isinstance(table["name"], str) else table["name"].strip()

    def restless(table, path):
        scene = own(table, path)
        draw = type("Restless", (), {"name": scene.name, "problem": lambda self: scene.problem(next(number))})
        return draw()

    def failing(table, path):
        return type("Failing", (), {"name": "failing", "problem": lambda self: {}["depth"]})()

    assert "takes an unknown key with no_such_key = 1" in refusal(check_dataset, path, lenient)
    assert f"the dataset 'synthetic' raises KeyError('depth') for {path}." == refusal(check_dataset, path, failing)
    assert "raises AttributeError(" in refusal(check_dataset, path, crashing)
    assert "gives another problem when it is asked again: the problem.pixels" in refusal(check_dataset, path, restless)
    assert "is not a Problem" in refusal(
        check_dataset, path, lambda table, path: type("No", (), {"name": "no", "problem": lambda self: None})()
    )
