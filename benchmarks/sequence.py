"""A map of a rendered stereo sequence in the layout of EuRoC: how far positions, down and scale are off.

    .venv/bin/python -m benchmarks.sequence [--frames 40]     # some ten minutes on two cores

Two fisheyes that sway as a walker's are drawn along a part of the campus, four times a second. Between these images lie
blurred copies at 20 Hz, so that those that are drawn are the sharpest of their stretches. The IMU has 200 Hz and noise,
the body's frame is that of neither sensor, and the ground truth has another origin and other axes. Positions are
compared with the truth after the similarity that most images agree with, and so are the true poses that other images of
the sequence get by its ground truth. The scale is also measured by the distance of the two cameras. Needs the extra
``colmap``.
"""

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import InputError
from spherloc.geometry import camera_centre, rotation_angle
from spherloc.mapping.alignment.fixed_images import fixed_images
from spherloc.mapping.alignment.positions import SimilarityFit, overlaid
from spherloc.mapping.alignment.rig_scale import scale_by_rig
from spherloc.mapping.alignment.sequence import sequence_data
from spherloc.mapping.alignment.true_poses import truth_words
from spherloc.mapping.images.frames import FrameChoice
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc.mapping.scenes.new_images import new_images_of
from spherloc.types import FloatArray
from spherloc.worlds import Conditions, build_world, render

DRAWN, COPIES, START_NS, STEP_S, IMU_STEP_S = 60, 5, 1_520_530_308_199_447_626, 0.05, 0.005
FAR_M = 0.25
SIDE, FOCAL = 512, 190.98
DISTORTION = (0.00348, 0.000715, -0.00205, 0.000203)
LENS = KannalaBrandt(SIDE, SIDE, FOCAL, FOCAL, 255.9, 257.9, DISTORTION)
UP_FORCE = np.array([0.0, 0.0, 9.81])


def rigid(degrees: tuple[float, float, float], place: tuple[float, float, float]) -> FloatArray:
    """A transform (4, 4) by angles about x, y and z."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), place
    return matrix


BODY_FROM = {"cam0": rigid((-91.0, 2.0, -88.0), (-0.022, -0.065, 0.01))}
BODY_FROM["cam1"] = BODY_FROM["cam0"] @ rigid((0.6, -2.0, 1.1), (0.11, 0.001, 0.0))
BODY_FROM["imu0"] = rigid((20.0, -35.0, 110.0), (0.03, 0.02, -0.05))
TRUTH_FROM_WORLD = rigid((65.0, 20.0, -30.0), (-12.0, 30.0, 5.0))


def poses() -> FloatArray:
    """``world_from_body`` (K, 4, 4) at 20 Hz."""
    count = DRAWN * COPIES
    at = np.arange(count) * STEP_S
    swings = (-8.0 + 4.0 * np.sin(1.3 * at), 6.0 * np.sin(0.9 * at + 1.0), 5.0 * np.sin(2.1 * at))
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3] = build_world("campus", 7).route(count, stop=0.45)
    found = np.linalg.inv(found)
    found[:, :3, :3] = found[:, :3, :3] @ Rotation.from_euler("xyz", np.column_stack(swings), degrees=True).as_matrix()
    return found @ np.linalg.inv(BODY_FROM["cam0"])


def written(folder: Path) -> dict[str, FloatArray]:
    """Write the sequence; returns the true ``cam_from_world`` (3, 4) by the names of the images."""
    world, truth, world_from_body = build_world("campus", 7), {}, poses()
    times = [START_NS + round(1e9 * STEP_S * k) for k in range(len(world_from_body))]
    for sensor in BODY_FROM:
        (folder / "mav0" / sensor).mkdir(parents=True)
        (folder / "mav0" / sensor / "sensor.yaml").write_text(sensor_yaml(sensor))
    for camera in ("cam0", "cam1"):
        images = folder / "mav0" / camera / "data"
        images.mkdir()
        names = [f"{one}.png" for one in times]
        rows = [f"{one},{name}" for one, name in zip(times, names, strict=True)]
        (images.parent / "data.csv").write_text("\n".join(["#timestamp [ns],filename", *rows, ""]))
        for k, name in enumerate(names):
            cam_from_world = np.linalg.inv(world_from_body @ BODY_FROM[camera])[:, :3]
            truth[f"mav0/{camera}/data/{name}"] = cam_from_world[k]
            drawn = k // COPIES * COPIES + COPIES // 2
            image = render(world, LENS, cam_from_world[drawn], Conditions(noise=2.0), drawn, f"{camera}_{drawn}").image
            cv2.imwrite(str(images / name), image if k == drawn else cv2.blur(image, (9, 3)))
    write_measurements(folder / "mav0", times, world_from_body)
    return truth


def sensor_yaml(sensor: str) -> str:
    """A ``sensor.yaml`` with ``T_BS``, of a camera with its lens too."""
    text = f"T_BS:\n  cols: 4\n  rows: 4\n  data: {BODY_FROM[sensor].ravel().tolist()}\n"
    if sensor == "imu0":
        return text
    return text + (
        f"resolution: [{SIDE}, {SIDE}]\ncamera_model: pinhole\ndistortion_model: equidistant\n"
        f"intrinsics: {[FOCAL, FOCAL, LENS.cx - 0.5, LENS.cy - 0.5]}\ndistortion_coefficients: {list(DISTORTION)}\n"
    )


def write_measurements(mav: Path, times: list[int], world_from_body: FloatArray) -> None:
    """Write the log of the IMU and the ground truth."""
    rng = np.random.default_rng(3)
    at = np.arange(times[0], times[-1] + 1, round(1e9 * IMU_STEP_S)) - START_NS
    turned = Slerp(np.array(times) - START_NS, Rotation.from_matrix(world_from_body[:, :3, :3]))(at)
    turned = turned * Rotation.from_matrix(BODY_FROM["imu0"][:3, :3])
    rates = (turned[:-1].inv() * turned[1:]).as_rotvec() / IMU_STEP_S
    forces = turned.inv().apply(UP_FORCE) + rng.normal(0.0, 0.15, (len(at), 3))
    measured = np.hstack([np.vstack([rates, rates[-1:]]) + rng.normal(0.0, 0.01, forces.shape), forces])
    rows = [f"{START_NS + t},{str(row)[1:-1]}" for t, row in zip(at, measured.tolist(), strict=True)]
    (mav / "imu0" / "data.csv").write_text("\n".join(rows))
    truth = mav / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = []
    for one, pose in zip(times, TRUTH_FROM_WORLD @ world_from_body, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        rows.append(f"{one},{','.join(map(repr, (*pose[:3, 3].tolist(), w, x, y, z)))}")
    (truth / "data.csv").write_text("\n".join(rows))


def main() -> None:
    """Print what is known of the sequence, and how far the map is off."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--frames", type=int)
    frames = words.parse_args().frames
    with TemporaryDirectory() as place:
        folder = Path(place) / "campus"
        truth = written(folder)
        start = time.perf_counter()
        found = photographs(folder, {}, choice=FrameChoice(frames))
        data, (fixed, _) = sequence_data(folder, found.views), fixed_images(folder, found.views, None)
        assert fixed is not None
        print("\n".join([*found.remarks, *data.remarks]))
        measured = ScaleMeasurement(positions=data.positions)
        others, _ = new_images_of(folder, found, choice=FrameChoice(frames))
        request = MapRequest(found.views, folder, measured, others, stated=data.stated)
        made = make_map(request, Path(place) / "map")
        seconds = time.perf_counter() - start
    mapped = made.written.poses
    fit = overlaid(*(np.array([camera_centre(one[name]) for name in mapped]) for one in (mapped, truth)))
    leans = [np.degrees(np.arccos(min(1.0, mapped[name][:, 2] @ truth[name][:, 2]))) for name in mapped]
    far = np.count_nonzero(fit.off_m > FAR_M)
    print(
        f"{len(mapped)} of {len(found.views)} images, {far} of them over {FAR_M} m off; "
        f"positions {100 * np.median(fit.off_m):.1f} cm (median), down {np.median(leans):.2f}°, "
        f"scale {100 * (1.0 / fit.scale - 1.0):+.2f} %, {seconds:.0f} s"
    )
    try:
        rig = scale_by_rig(mapped, fixed)
        print(
            f"without ground truth: {rig.source}; it is off by {100 * (rig.metres_per_unit / fit.scale - 1.0):+.2f} %"
        )
    except InputError as error:
        print(f"without ground truth: {error}")
    if made.written.truth is not None:
        print(truth_words(made.written.truth))
        print(true_poses_off(made.written.truth.poses, truth, fit))


def true_poses_off(found: Mapping[str, FloatArray], truth: Mapping[str, FloatArray], fit: SimilarityFit) -> str:
    """How far true poses in the map's frame are from those of the renderer, after the similarity from the map to its
    world."""
    if not found:
        return "no other image has a true pose"
    centres = np.array([camera_centre(pose) for pose in found.values()])
    off_m = np.linalg.norm(
        fit.scale * centres @ fit.rotation.T + fit.translation - [camera_centre(truth[name]) for name in found], axis=1
    )
    off_deg = [
        np.degrees(rotation_angle(pose[:, :3] @ fit.rotation.T @ truth[name][:, :3].T)) for name, pose in found.items()
    ]
    return (
        f"true poses of {len(found)} other images: {100 * np.median(off_m):.2f} cm and {np.median(off_deg):.2f}° off "
        f"(median), {100 * off_m.max():.2f} cm and {max(off_deg):.2f}° at most"
    )


if __name__ == "__main__":
    main()
