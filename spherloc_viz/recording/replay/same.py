"""Whether two problems are the same in every bit that an estimator can see."""

from dataclasses import fields
from typing import Any

import numpy as np

from spherloc.problem import Problem

WORDS = {"name", "scene", "image", "reference_images", "remarks"}
"""Fields that only people read."""


def same_bits(a: Any, b: Any) -> bool:
    """Whether two arrays or numbers, or None, are equal in type, shape and every bit; NaN equals itself."""
    if a is None or b is None:
        return a is b
    left, right = np.asarray(a), np.asarray(b)
    return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()


def different_fields(a: Problem, b: Problem) -> tuple[str, ...]:
    """Names of the fields in which two problems differ, but for the words about them."""
    names = [item.name for item in fields(Problem) if item.name not in WORDS | {"camera"}]
    changed = [name for name in names if not same_bits(getattr(a, name), getattr(b, name))]
    same_camera = type(a.camera) is type(b.camera) and a.camera.to_dict() == b.camera.to_dict()
    return (*([] if same_camera else ["camera"]), *changed)
