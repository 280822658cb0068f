"""A calibration for images that were scaled."""

from dataclasses import replace

from spherloc.cameras._checks import FocalCamera
from spherloc.cameras.base import Camera


def scaled(camera: Camera, width: int, height: int) -> Camera | None:
    """The camera of the same images, scaled to another size, px; None if that has another shape, up to the rounding of
    a pixel, or if the model is not one of a focal length and a principal point in pixels, which scale with the image.
    """
    same_shape = abs(width * camera.height - height * camera.width) <= max(camera.width, camera.height)
    if not isinstance(camera, FocalCamera) or not same_shape:
        return None
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=across * camera.fx,
        fy=down * camera.fy,
        cx=across * camera.cx,  # counted from the corner of the image, not from the centre of its first pixel
        cy=down * camera.cy,
    )
