"""A process of its own in which pycolmap reads a model: whatever its C++ does to a bad file ends here.

Called as ``python -P colmap_child.py FOLDER bin|txt``; prints cameras and absolute poses as JSON. It must not import
this package, which would take longer than the reading.
"""

import json
import sys


def main(folder: str, form: str) -> dict:
    """Cameras and images as lists; the pose of an image (12 numbers, row by row) is None if its rig leaves it open."""
    import pycolmap

    model = pycolmap.Reconstruction()
    try:
        (model.read_binary if form == "bin" else model.read_text)(folder)
    except (ValueError, LookupError, RuntimeError, TypeError, MemoryError) as error:
        return {"error": str(error)}
    cameras = [
        [number, camera.model.name, camera.width, camera.height, list(camera.params)]
        for number, camera in model.cameras.items()
    ]
    return {"cameras": cameras, "images": [_image(number, image) for number, image in model.images.items()]}


def _image(number: int, image) -> list:
    frame = image.frame
    sensor = image.camera.sensor_id
    rig = frame.rig
    known = image.has_pose and (rig.is_ref_sensor(sensor) or rig.sensor_from_rig(sensor) is not None)
    pose = image.cam_from_world().matrix().ravel().tolist() if known else None
    return [number, image.name, image.camera_id, pose]


if __name__ == "__main__":
    json.dump(main(sys.argv[1], sys.argv[2]), sys.stdout)
