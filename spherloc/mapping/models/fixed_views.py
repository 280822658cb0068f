"""Images that were taken together by cameras whose calibration says how they are fixed to each other: what it tells of
pairs of them, of all images in COLMAP's mapper, and of a single moment, where it is all that places them.

Four fisheyes of a car at a single moment share thin parts of their views. Neighbours match there, but no point is seen
by three of them, so that nothing ties the lengths of their baselines to each other. The calibration does. The mapper
takes the images of a moment for one: where two moments match in the front camera alone, all others are placed, too.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from spherloc.frontend.view import View
from spherloc.geometry import inverse_pose
from spherloc.mapping.alignment.fixed_images import MIN_BASELINE_M, FixedImages
from spherloc.mapping.models.later import adjusted, register, with_images
from spherloc.mapping.models.misplaced import fits
from spherloc.mapping.models.model import Reconstruction, poses_of, registered
from spherloc.mapping.two_view.matched import Matched
from spherloc.mapping.two_view.pairs import MIN_MATCHES, relative
from spherloc.mapping.two_view.triangles import Pair, Relative

LOOSE = 0.8
"""Cameras are not fixed if the mean reprojection error is less than that share where each image moves by itself."""


def fixed_pairs(views: Sequence[View], fixed: FixedImages | None) -> dict[Pair, Relative]:
    """The relative poses of images that were taken at one moment, by the places of both among ``views``; none without a
    calibration, and none of cameras that it has in one place."""
    if fixed is None:
        return {}
    places = {view.name: place for place, view in enumerate(views)}
    found: dict[Pair, Relative] = {}
    for names in fixed.moments:
        for one, other in combinations(sorted(places[name] for name in names), 2):
            first, second = (fixed.body_from_camera[views[place].name] for place in (one, other))
            second_from_first = np.linalg.inv(second) @ first
            length_m = float(np.linalg.norm(second_from_first[:3, 3]))
            if length_m > MIN_BASELINE_M:
                found[one, other] = second_from_first[:3, :3], second_from_first[:3, 3] / length_m
    return found


def fix_cameras(pycolmap: Any, database: Any, ids: Mapping[str, int], fixed: FixedImages) -> None:
    """Write into an open database of images with these ``ids``, each with a rig of its own, that the cameras of those
    that were taken at one moment are fixed to each other."""
    inside = {name for names in fixed.moments for name in names}
    images = {name: database.read_image(number) for name, number in ids.items()}
    alone = {name: database.read_rig(database.read_frame(images[name].frame_id).rig_id) for name in ids.keys() - inside}
    database.clear_frames()
    database.clear_rigs()
    rig, first = pycolmap.Rig(), None
    of_body: dict[tuple[int, bytes], Any] = {}
    for name in sorted(inside):
        image, body_from_camera = images[name], fixed.body_from_camera[name]
        key = image.camera_id, body_from_camera.tobytes()
        if key not in of_body:
            camera = database.read_camera(image.camera_id)
            camera.camera_id = database.write_camera(camera)
            of_body[key] = camera
            if first is None:
                first = body_from_camera
                rig.add_ref_sensor(camera.sensor_id)
            else:
                sensor_from_rig = np.linalg.inv(body_from_camera) @ first
                rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(sensor_from_rig[:3]))
        image.camera_id = of_body[key].camera_id
    rig.rig_id = database.write_rig(rig)
    for names in fixed.moments:
        _write_frame(pycolmap, database, rig.rig_id, [images[name] for name in names])
    written: dict[int, int] = {}
    for name, own in sorted(alone.items()):
        if own.rig_id not in written:
            one = pycolmap.Rig()
            one.add_ref_sensor(own.ref_sensor_id)
            written[own.rig_id] = database.write_rig(one)
        _write_frame(pycolmap, database, written[own.rig_id], [images[name]])


def _write_frame(pycolmap: Any, database: Any, rig_id: int, images: Sequence[Any]) -> None:
    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    for image in images:
        frame.add_data_id(image.data_id)
    number = database.write_frame(frame)
    for image in images:
        image.frame_id = number
        database.update_image(image)


def placed_by_calibration(pycolmap: Any, matched: Matched, fixed: FixedImages) -> Reconstruction | None:
    """The map of images of one moment where the calibration has them, in the frame of the body, metres, without those
    that match no other one; None if no more of the matches agree with it than contradict it."""
    names = matched.names
    poses = {name: inverse_pose(matrix[:3]) for name, matrix in fixed.body_from_camera.items()}
    balance = 0
    for (one, other), geometry in matched.verified.items():
        agrees = fits(poses[names[one]], poses[names[other]], relative(geometry)[0])
        balance += len(geometry.inlier_matches) if agrees else -len(geometry.inlier_matches)
    if balance <= 0:
        return None
    made = _of_seen(with_images(_empty(pycolmap, matched), poses, adjust=False))
    return made if len(made.poses) > 1 else None


def with_single_images(pycolmap: Any, matched: Matched, rigs: Any) -> Reconstruction:
    """A model of COLMAP with ``fix_cameras``, with each image in a frame of its own instead, from which it can be
    taken."""
    made = _empty(pycolmap, matched)
    poses = poses_of(rigs)
    register(made, poses)
    for point in rigs.points3D.values():
        made.model.add_point3D(point.xyz, point.track, point.color)
    made.model.update_point_3d_errors()
    return _of_seen(replace(made, poses=poses))


def freed_if_loose(pycolmap: Any, made: Reconstruction) -> Reconstruction:
    """A model of fixed cameras, in which each image has moved by itself if that fits the matches far better: cameras
    that do not take their images at the same moment do not stand to each other as they are fixed."""
    free = copy.deepcopy(made.model)
    adjusted(pycolmap, free)
    if free.compute_mean_reprojection_error() > LOOSE * made.model.compute_mean_reprojection_error():
        return made
    return with_images(replace(made, model=free, poses=poses_of(free)), {})


def _empty(pycolmap: Any, matched: Matched) -> Reconstruction:
    """A model without images."""
    counts = matched.counts()
    every = counts + matched.same_place
    return Reconstruction(pycolmap.Reconstruction(), {}, counts, (), every, matched.database, matched.ids)


def _of_seen(made: Reconstruction) -> Reconstruction:
    """The model without images that see hardly a point: only the calibration would speak for their place."""
    seen = {image.name: image.num_points3D for image in registered(made.model)}
    return made.without({name for name, count in seen.items() if count < MIN_MATCHES})
