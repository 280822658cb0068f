"""The interface of camera models: from pixels to unit bearings and back, with validity and a Jacobian.

Camera frame: OpenCV axes (+x right, +y down, +z forward) for every model. Pixels: the centre of the
top-left pixel is (0.5, 0.5).
"""

from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np

from spherloc.types import BoolArray, FloatArray

MODEL_NAMES = {
    "double_sphere": "double sphere",
    "eucm": "EUCM",
    "fisheye624": "FISHEYE624",
    "kannala_brandt": "Kannala-Brandt",
    "mei": "MEI",
    "ocam": "OCamCalib",
    "radial_poly": "radial polynomial",
}
"""Names of models for users; other models are called as in files, with spaces for underscores."""


def model_name(camera: "Camera") -> str:
    """Name of the camera's model for users."""
    return MODEL_NAMES.get(camera.model, camera.model.replace("_", " "))


@runtime_checkable
class Camera(Protocol):
    """A central camera: a frozen dataclass with ``width`` and ``height`` in pixels, registered by entry point."""

    model: ClassVar[str]
    """Name used in TOML files and in the registry."""

    @property
    def width(self) -> int:
        """Width of the image, pixels."""
        ...

    @property
    def height(self) -> int:
        """Height of the image, pixels."""
        ...

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Project camera-frame points (N, 3), metres, to pixels (N, 2).

        The mask (N,) is true where the model is invertible for that direction; other pixels are NaN. It
        does not say whether the pixel lies in the image: see ``in_image``.
        """
        ...

    def unproject(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Unit bearings (N, 3) of pixels (N, 2), and a mask (N,) of pixels that the model can see."""
        ...

    def unprojection_jacobian(self, pixels: FloatArray) -> FloatArray:
        """d bearing / d pixel, (N, 3, 2), per pixel; NaN where ``unproject`` is invalid."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """The camera as the ``[camera]`` table of a scene file."""
        ...

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str) -> Self:
        """Build from a ``[camera]`` table; ``where`` names its file in error messages.

        Raises ``CalibrationError`` for unknown, missing or non-finite values.
        """
        ...


def in_image(camera: Camera, pixels: FloatArray) -> BoolArray:
    """Which pixels (N, 2) lie inside the image rectangle."""
    u, v = pixels[:, 0], pixels[:, 1]
    with np.errstate(invalid="ignore"):
        return (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
