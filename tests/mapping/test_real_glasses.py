"""A map of real images of glasses with three fisheyes, two of each, 33 ms apart."""

import numpy as np

from spherloc.geometry import camera_centre, rotation_angle
from spherloc.mapping.alignment.fixed_images import fixed_images
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.models.model import MIN_DISTANCE, registered
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from tests.needs import real_data

CAMERAS = "camera-rgb", "camera-slam-left", "camera-slam-right"


def test_all_cameras_of_glasses_see_points(tmp_path):
    """COLMAP takes a lens with a distortion above 1, such as that of the rgb camera, for a wrong calibration."""
    data = real_data("aria_adt_fisheye")
    folder = tmp_path / "glasses"
    folder.mkdir()
    for camera in CAMERAS:
        for path in sorted((data / "images").glob(f"{camera}*.png"))[:2]:
            (folder / path.name).symlink_to(path)
    given = data / "calibration_fisheye624.json"
    cameras, _ = given_cameras(given, None, folder)
    views = photographs(folder, cameras).views
    fixed, _ = fixed_images(folder, views, given)
    assert max(np.abs(cameras["camera-rgb"].distortion)) > 1.0
    assert [len(names) for names in fixed.moments] == [3, 3]
    made = make_map(MapRequest(views, folder, ScaleMeasurement(fixed=fixed)), tmp_path / "map")
    poses = made.written.poses
    assert len(poses) == 6 and "at 2 times" in made.scale.source
    assert all(image.num_points3D > 300 for image in registered(made.made.model))
    for names in fixed.moments:
        rgb, _, right = names
        stated = np.linalg.inv(fixed.body_from_camera[right]) @ fixed.body_from_camera[rgb]
        turn = poses[right][:, :3] @ poses[rgb][:, :3].T
        assert rotation_angle(turn @ stated[:3, :3].T) < np.radians(1.5)
        apart_m = np.linalg.norm(camera_centre(poses[right]) - camera_centre(poses[rgb]))
        assert abs(apart_m / np.linalg.norm(stated[:3, 3]) - 1.0) < 0.1
    centres = {image.image_id: image.projection_center() for image in registered(made.made.model)}
    usual = np.median(made.made.depths())
    for point in made.made.model.points3D.values():
        seen_from = [centres[one.image_id] for one in point.track.elements]
        distances = np.linalg.norm(point.xyz - seen_from, axis=1)
        assert len(distances) > 2 or min(distances) > 0.5 * MIN_DISTANCE * usual
