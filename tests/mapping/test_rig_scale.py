"""Scale and poses of a map by cameras that are fixed to each other, as their calibration says."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spherloc.errors import InputError
from spherloc.geometry import camera_centre, pose
from spherloc.mapping.alignment.fixed_images import FixedImages, fixed_images
from spherloc.mapping.alignment.positions import Positions
from spherloc.mapping.alignment.rig_poses import expected_by_calibration, turned_otherwise
from spherloc.mapping.alignment.rig_scale import doubt_of_scale, scale_by_rig
from spherloc.mapping.alignment.upright import Level, MapScale
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import scale_of
from spherloc.mapping.request import ScaleMeasurement
from tests.datasets.asl_tree import euroc, transform, tum_vi

METRES_PER_UNIT = 3.7
"""Of the maps."""


def in_map(world_from_camera, rng, noise_m=0.0, turned_deg=0.0):
    """The pose (3, 4) of a camera in a map with another origin, other axes and units."""
    turn = Rotation.from_rotvec(np.radians(turned_deg) * rng.normal(size=3)).as_matrix()
    map_from_world = Rotation.random(random_state=5).as_matrix()
    centre = map_from_world @ (world_from_camera[:3, 3] + rng.normal(0.0, noise_m, 3) + [4.0, -2.0, 9.0])
    rotation = turn @ world_from_camera[:3, :3].T @ map_from_world.T
    return pose(rotation, -rotation @ centre / METRES_PER_UNIT)


class Rig:
    """Three cameras on a body that goes about, and a map of their images."""

    def __init__(self, rng, times=12, noise_m=0.0, turned_deg=0.0):
        self.bodies = {name: transform(Rotation.random(random_state=k).as_matrix(), rng.normal(0.0, 0.1, 3))
                       for k, name in enumerate("abc")}  # fmt: skip
        self.poses, together = {}, {}
        for time in range(times):
            world_from_body = transform(Rotation.random(random_state=100 + time).as_matrix(), rng.normal(0, 5, 3))
            together[time] = [f"{name}{time}" for name in self.bodies]
            for name, body in self.bodies.items():
                self.poses[f"{name}{time}"] = in_map(world_from_body @ body, rng, noise_m, turned_deg)
        bodies = {name: self.bodies[name[0]] for name in self.poses}
        self.fixed = FixedImages("rig.json", bodies, together)

    @property
    def scale(self):
        return scale_by_rig(self.poses, self.fixed)


def test_the_scale_is_that_of_the_baselines(rng):
    scale = Rig(rng).scale
    assert scale.metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=1e-9)
    assert "rig.json: images that cameras" in scale.source and "at 12 times; the scale is good to" in scale.source


def test_images_that_are_turned_otherwise_are_told(rng):
    rig = Rig(rng, noise_m=0.01, turned_deg=0.5)
    assert turned_otherwise(rig.poses, rig.fixed) == set()
    around = Rotation.from_rotvec([0.0, 0.0, np.pi]).as_matrix()
    for name in ("a3", "b7"):
        rig.poses[name] = pose(around @ rig.poses[name][:, :3], rig.poses[name][:, 3])
    assert turned_otherwise(rig.poses, rig.fixed) == {"a3", "b7"}


def test_the_calibration_of_another_rig_is_not_believed(rng):
    rig = Rig(rng)
    others = {name: rig.bodies["bca"["abc".index(name[0])]] for name in rig.poses}
    fixed = replace(rig.fixed, body_from_camera=others)
    assert turned_otherwise(rig.poses, fixed) == set()
    del rig.poses["a2"]
    assert expected_by_calibration(rig.poses, fixed) == {} and "a2" in expected_by_calibration(rig.poses, rig.fixed)


def test_where_an_image_must_be_is_told_by_one_of_its_time(rng):
    """Its centre only if the scale is known."""
    rig = Rig(rng)
    left = {name: rig.poses.pop(name) for name in ("a2", "c2", "b5")}
    found = expected_by_calibration(rig.poses, rig.fixed)
    assert found.keys() == left.keys()
    for name, known in left.items():
        np.testing.assert_allclose(found[name], known, atol=1e-9)
    few = {name: rig.poses[name] for name in ("b2", "a5", "c5")}
    found = expected_by_calibration(few, rig.fixed)["a2"]
    np.testing.assert_allclose(found[:, :3], left["a2"][:, :3], atol=1e-9)
    np.testing.assert_allclose(camera_centre(found), camera_centre(few["b2"]), atol=1e-9)


def test_its_uncertainty_is_that_of_the_errors(rng):
    """Noise of positions, which would make distances longer, and images that are misplaced."""
    errors, told = [], []
    for _ in range(60):
        rig = Rig(rng, noise_m=0.01, turned_deg=0.2)
        for name in ("a3", "b7"):
            rig.poses[name] = pose(rig.poses[name][:, :3], rig.poses[name][:, 3] + rng.normal(0.0, 1.0, 3))
        scale = rig.scale
        errors.append(scale.metres_per_unit / METRES_PER_UNIT - 1.0)
        told.append(float(scale.source.rpartition("good to ")[2].rstrip("%")) / 100.0)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert 0.3 * rms < np.mean(told) < 3.0 * rms and abs(np.mean(errors)) < rms, (rms, np.mean(told), np.mean(errors))


def test_cameras_that_the_map_has_turned_are_shifted_too(rng):
    """By a tenth of a degree, at all times and at each one, about points two metres and a half away: per cents."""
    errors, told = [], []
    for _ in range(30):
        rig = Rig(rng)
        always = {name: np.radians(rng.normal(0.0, 0.1, 3)) for name in rig.bodies}
        for name, one in rig.poses.items():
            turn = always[name[0]] + np.radians(rng.normal(0.0, 0.1, 3))
            body_from_map = rig.bodies[name[0]][:3, :3] @ one[:, :3]
            shift_m = body_from_map.T @ np.cross(turn, [1.0, 0.5, 2.5]) + rng.normal(0.0, 0.001, 3)
            centre = camera_centre(one) + shift_m / METRES_PER_UNIT
            rotation = rig.bodies[name[0]][:3, :3].T @ Rotation.from_rotvec(turn).as_matrix() @ body_from_map
            rig.poses[name] = pose(rotation, -rotation @ centre)
        scale = rig.scale
        errors.append(scale.metres_per_unit / METRES_PER_UNIT - 1.0)
        told.append(float(scale.source.rpartition("good to ")[2].rstrip("%")) / 100.0)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert rms < 0.005 and 0.3 * rms < np.mean(told) < 3.0 * rms, (rms, np.mean(told))


def test_two_cameras_that_the_mapper_had_fixed_are_one_measurement(rng):
    """Turned and shifted by the same at all times: a lever fits that, whatever the scale is along the turn's axis."""
    errors, told = [], []
    for _ in range(60):
        rig = Rig(rng)
        apart_m = np.linalg.norm(rig.bodies["b"][:3, 3] - rig.bodies["a"][:3, 3])
        if apart_m < 0.05:
            continue
        turn = 0.004 * apart_m * rng.normal(size=3)
        shift_m = np.cross(turn, [1.0, 0.5, 2.5]) + 0.003 * apart_m * rng.normal(size=3)
        for time in range(12):
            del rig.poses[f"c{time}"]
            one = rig.poses[f"b{time}"]
            body_from_map = rig.bodies["b"][:3, :3] @ one[:, :3]
            rotation = rig.bodies["b"][:3, :3].T @ Rotation.from_rotvec(turn).as_matrix() @ body_from_map
            centre = camera_centre(one) + body_from_map.T @ shift_m / METRES_PER_UNIT
            rig.poses[f"b{time}"] = pose(rotation, -rotation @ centre)
        scale = rig.scale
        errors.append(scale.metres_per_unit / METRES_PER_UNIT - 1.0)
        told.append(float(scale.source.rpartition("good to ")[2].rstrip("%")) / 100.0)
    rms = float(np.sqrt(np.mean(np.square(errors))))
    assert rms < 0.05 and 0.3 * rms < np.mean(told) < 3.0 * rms, (rms, np.mean(told))


def test_its_uncertainty_is_also_that_of_what_is_off_at_all_times(rng):
    """A calibration that has the cameras some millimetres beside where they are, or a map that does."""
    errors, told = [], []
    for _ in range(60):
        rig = Rig(rng, noise_m=0.0005)
        shifts = {name: rng.normal(0.0, 0.002, 3) for name in rig.bodies}
        bodies = {
            name: transform(body[:3, :3], body[:3, 3] + shifts[name[0]])
            for name, body in rig.fixed.body_from_camera.items()
        }
        scale = scale_by_rig(rig.poses, FixedImages("rig.json", bodies, rig.fixed.times))
        errors.append(scale.metres_per_unit / METRES_PER_UNIT - 1.0)
        told.append(float(scale.source.rpartition("good to ")[2].rstrip("%")) / 100.0)
    deviations = float(np.median(np.abs(errors) / told)) / 0.674  # that of a normal number
    assert 0.4 < deviations < 2.0, deviations


def test_where_the_mapper_fixed_the_cameras_all_times_are_off_alike(rng):
    """And tell less together than as many that differ."""
    shifts = {name: rng.normal(0.0, 0.002, 3) for name in "abc"}
    told = []
    for scatter_m in (0.0, 0.0001):
        rig = Rig(np.random.default_rng(7), noise_m=0.0)
        for name, one in rig.poses.items():
            off = rig.bodies[name[0]][:3, :3].T @ shifts[name[0]] + rng.normal(0.0, scatter_m, 3)
            rig.poses[name] = pose(one[:, :3], one[:, 3] - off / METRES_PER_UNIT)
        told.append(float(rig.scale.source.rpartition("good to ")[2].rstrip("%")))
    assert told[0] > 1.5 * told[1] > 0.0, told


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"times": 1}, "two cameras took images together at fewer than 2 times"),
        (
            {"noise_m": 0.5},
            r"by images that cameras .* m apart took together, at 12 times, the scale is (uncertain|not)",
        ),
        ({"turned_deg": 20.0}, "turned against each other .*° otherwise than it says"),
    ],
)
def test_what_gives_no_scale_is_told(rng, given, sentence):
    with pytest.raises(InputError, match=f"rig.json, which says how .* gave no scale: .*{sentence}"):
        _ = Rig(rng, **given).scale


def test_a_scale_that_was_given_is_doubted_if_the_rig_says_otherwise(rng):
    """Such as one in centimetres; a tenth is no reason."""
    rig = Rig(rng)
    for times, said in ((1.0, ""), (1.1, ""), (100.0, "0.01")):
        given = MapScale(times * METRES_PER_UNIT, "cameras 160 m above the ground")
        doubt = doubt_of_scale(rig.poses, given, rig.fixed)
        assert bool(doubt) == bool(said) and (not said or f"the map is {said} times as large" in doubt)
    assert not doubt_of_scale({}, MapScale(1.0, "somehow"), rig.fixed)


def test_images_that_are_not_in_the_map_do_not_count(rng):
    rig = Rig(rng)
    rig.poses = {name: one for name, one in rig.poses.items() if name[0] == "a" or name in ("b1", "c4", "b9")}
    assert "at 3 times" in rig.scale.source
    del rig.poses["b9"], rig.poses["b1"]
    with pytest.raises(InputError, match="at 1 times"):
        _ = rig.scale


@pytest.mark.parametrize(("write", "key"), [(euroc, ""), (tum_vi, "T_imu_cam"), (tum_vi, "T_cn_cnm1")])
def test_a_sequence_tells_how_its_cameras_are_fixed(tmp_path, rng, write, key):
    tree = write(tmp_path / "room", rng, **({"key": key} if key else {}))
    views = photographs(tree.folder, {}).views
    fixed, _ = fixed_images(tree.folder, views, None)
    assert len(fixed.times) == len(tree.times) and all(len(names) == 2 for names in fixed.times.values())
    assert ("camchain.yaml" if key else "mav0/cam0/sensor.yaml and mav0/cam1/sensor.yaml") in fixed.source
    poses = {}
    for view in views:
        camera, time = view.path.parent.parent.name, int(view.path.stem)
        poses[view.name] = in_map(tree.world_from_body[time] @ tree.body_from_camera[camera], rng)
    assert scale_by_rig(poses, fixed).metres_per_unit == pytest.approx(METRES_PER_UNIT, rel=1e-4)


LENS = {"model": "OPENCV_FISHEYE", "width": 64, "height": 48, "params": [20, 20, 32, 24, 0, 0, 0, 0]}


def written(folder, focal, size=(64, 48)):
    """Images of two cameras, ``left_1.png`` and so on, with a calibration of both beside them."""
    folder.mkdir()
    for name in ("left", "right"):
        for number in range(4):
            cv2.imwrite(str(folder / f"{name}_{number}.png"), np.zeros((size[1], size[0]), np.uint8))
    table = {
        name: LENS | {"params": [f, f, *LENS["params"][2:]], "T_device_camera": transform(np.eye(3), at).tolist()}
        for name, f, at in (("left", 20, (0, 0, 0)), ("right", focal, (0.2, 0, 0)))
    }
    (folder / "rig.json").write_text(json.dumps(table))
    return folder


def test_a_calibration_beside_images_or_given_tells_it(tmp_path):
    folder = written(tmp_path / "beside", 21)
    views = photographs(folder, {}).views
    for file in (None, folder / "rig.json"):
        fixed, _ = fixed_images(folder, views, file)
        assert fixed.source == "rig.json" and len(fixed.times) == 4
        assert {name: body[0, 3] for name, body in fixed.body_from_camera.items()} == {
            f"{name}_{number}.png": at for name, at in (("left", 0.0), ("right", 0.2)) for number in range(4)
        }
    (folder / "rig.json").write_text(json.dumps({"left": LENS, "right": LENS}))
    assert fixed_images(folder, views, None) == (None, [])


def test_a_calibration_that_states_no_transform_is_told(tmp_path):
    folder = written(tmp_path / "beside", 21)
    views = photographs(folder, {}).views
    (folder / "rig.json").write_text((folder / "rig.json").read_text().replace("0.2", "1e999"))
    (folder / "calibration.json").write_text((folder / "rig.json").read_text())
    fixed, remarks = fixed_images(folder, views, None)
    assert fixed is None and len(remarks) == 1, "what is not called as calibrations are may be anything"
    assert "calibration.json: right: " in remarks[0] and remarks[0].endswith("It is not used for the scale.")
    assert len(fixed_images(folder, views, folder / "rig.json")[1]) == 1


def test_images_that_were_scaled_are_known_too(tmp_path):
    folder = written(tmp_path / "half", 21, (32, 24))
    cameras, _ = given_cameras(folder / "rig.json", None, folder)
    fixed, _ = fixed_images(folder, photographs(folder, cameras).views, folder / "rig.json")
    assert len(fixed.times) == 4


def in_folders(folder, names):
    """The images of ``left_1.png`` and so on, in a folder for each camera, of these names."""
    for name, called in names.items():
        (folder / called).mkdir()
        for path in folder.glob(f"{name}_*.png"):
            path.rename(folder / called / path.name.removeprefix(f"{name}_"))
    return photographs(folder, {})


def test_cameras_with_one_lens_are_told_apart_by_names(tmp_path):
    """Else it is not known which took an image, which is told."""
    folder = written(tmp_path / "same", 20)
    fixed, _ = fixed_images(folder, photographs(folder, {}).views, None)
    assert [sorted(names) for names in fixed.times.values()] == [[f"left_{k}.png", f"right_{k}.png"] for k in range(4)]
    fixed, _ = fixed_images(folder, in_folders(folder, {"left": "left", "right": "right"}).views, None)
    assert sorted(fixed.times[0]) == ["left/0.png", "right/0.png"]
    folder = written(tmp_path / "others", 20)
    fixed, _ = fixed_images(folder, in_folders(folder, {"left": "a", "right": "b"}).views, None)
    with pytest.raises(InputError, match=r"fewer than 2 times, as far as names .* tell its cameras"):
        scale_by_rig({}, fixed)


def test_a_camera_without_a_calibration_is_not_taken_for_another(tmp_path):
    """Its images have the lens of a camera of their size, which is told, but do not stand where that one is."""
    folder = written(tmp_path / "lacks", 21)
    table = json.loads((folder / "rig.json").read_text())
    table["rear"] = table.pop("right") | {"width": 32, "height": 24}
    (folder / "rig.json").write_text(json.dumps(table))
    for number in range(4):
        cv2.imwrite(str(folder / f"rear_{number}.png"), np.zeros((24, 32), np.uint8))
    found = in_folders(folder, {"left": "left", "right": "right", "rear": "rear"})
    assert [remark for remark in found.remarks if "another folder is called so" in remark] == [
        "right: Camera left is taken for its images, which have that size, but another folder is called so; put the "
        "calibration of this one's camera beside them if it differs."
    ]
    fixed, _ = fixed_images(folder, found.views, None)
    assert [sorted(names) for names in fixed.times.values()] == [[f"left/{k}.png", f"rear/{k}.png"] for k in range(4)]


def test_images_of_other_times_are_told_to_give_no_scale(tmp_path):
    folder = written(tmp_path / "apart", 21)
    for number in range(4):
        (folder / f"right_{number}.png").rename(folder / f"right_{10 + number}.png")
    with pytest.raises(InputError, match=r"fewer than 2 times, .* numbers or times in them"):
        scale_by_rig({}, fixed_images(folder, photographs(folder, {}).views, None)[0])
    for path in folder.glob("right_*.png"):
        path.unlink()
    assert fixed_images(folder, photographs(folder, {}).views, None) == (None, [])  # of one camera


def test_millimetres_are_not_taken_for_metres(rng):
    rig = Rig(rng)
    bodies = {name: transform(body[:3, :3], 1000.0 * body[:3, 3]) for name, body in rig.fixed.body_from_camera.items()}
    with pytest.raises(InputError, match=r"rig.json, .* cameras are \d{2,3} m apart; give .* not in millimetres"):
        scale_by_rig(rig.poses, FixedImages("rig.json", bodies, rig.fixed.times))


def test_it_is_used_where_positions_give_no_scale(rng):
    rig = Rig(rng)

    class Made:
        poses = rig.poses

        def depths(self):
            return np.array([2.0])

    level = Level(np.array([0.0, 1.0, 0.0]), "", 0.0, {})
    centres = {name: -one[:, :3].T @ one[:, 3] for name, one in rig.poses.items()}
    gps = Positions({name: 5.0 * centre for name, centre in centres.items()}, "GPS")
    far = Positions({name: rng.normal(size=3) for name in centres}, "GPS")
    for positions, scale in ((gps, 5.0), (far, METRES_PER_UNIT), (None, METRES_PER_UNIT)):
        found = scale_of(Made(), level, ScaleMeasurement(positions=positions, fixed=rig.fixed))
        assert found.metres_per_unit == pytest.approx(scale, rel=1e-6) and found.source
    found = scale_of(Made(), level, ScaleMeasurement(positions=far))
    assert not found.source and "GPS gave no scale" in found.why_unknown
