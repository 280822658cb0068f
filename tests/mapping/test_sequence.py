"""Sequences in the layouts of EuRoC and TUM-VI: which images are mapped, and what is known of them."""

import shutil
import tomllib

import cv2
import numpy as np
import pytest

from spherloc.datasets.asl import image_times
from spherloc.datasets.asl_layout import asl_sequence
from spherloc.datasets.query_gravity import read_gravity_file
from spherloc.errors import InputError
from spherloc.frontend.masks import Masks
from spherloc.mapping.alignment.sequence import sequence_data
from spherloc.mapping.images.frames import FRAMES, FrameChoice, ImageFolder, chosen
from spherloc.mapping.images.photographs import photographs, with_cameras
from spherloc.mapping.rig import shots_of
from spherloc.mapping.scenes.new_images import new_images_of
from spherloc.mapping.scenes.scene_files import MapHead, write_new_scene
from tests.datasets.asl_tree import START, STEP_NS, euroc, sensor_yaml, tum_vi


def off_deg(one, other):
    return np.degrees(np.arccos(min(1.0, one @ other / np.linalg.norm(one) / np.linalg.norm(other))))


def cam_and_time(name):
    return ("cam1" if "cam1" in name else "cam0"), int(name.rpartition("/")[2][:-4])


@pytest.mark.parametrize(
    ("write", "key"), [(euroc, ""), (tum_vi, "T_cam_imu"), (tum_vi, "T_imu_cam"), (tum_vi, "T_cn_cnm1")]
)
def test_calibrations_gravity_and_positions_are_found(tmp_path, rng, write, key):
    """Sensors are turned at random, so that any transform that is taken for its inverse is found out."""
    tree = write(tmp_path / "room", rng, **({"key": key} if key else {}))
    for folder, inside, cameras in (
        (tree.folder, "mav0/cam0/data/", 2),
        (tree.mav, "cam0/data/", 2),
        (tree.mav / "cam0", "data/", 1),
        (tree.mav / "cam0" / "data", "", 1),
    ):
        found = photographs(folder, {})
        assert len(found.views) == cameras * len(tree.times) and found.views[0].name == f"{inside}{START}.png"
        assert [found.views[0].camera.fx, found.views[-1].camera.fx] == [20.0, 19.0 + cameras]
        about = found.remarks[2 - cameras :]  # the first one is on the other camera
        assert about and all("calibration found beside them" in remark for remark in about), found.remarks
        data = sequence_data(folder, found.views)
        assert len(data.stated.found) == len(data.positions.by_name) == len(found.views)
        for view in found.views:
            camera, time = cam_and_time(view.path.as_posix().replace("/data/", "/"))
            assert off_deg(data.stated.found[view.name].down, tree.down_in(camera, time)) < 0.5
            np.testing.assert_allclose(data.positions.by_name[view.name], tree.centre_of(camera, time), atol=1e-4)
        gravity, scale = data.remarks
        assert "mav0/imu0/data.csv" in gravity and ("camchain.yaml" if key else "cam0/sensor.yaml") in gravity
        assert ("mocap0/data.csv" if key else "state_groundtruth_estimate0/data.csv") in scale
    assert found.views[0].read().dtype == np.uint8
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "cam1.png"), 255 * np.eye(48, 64, dtype=np.uint8))
    masked = photographs(tree.folder, {}, Masks(tmp_path / "masks")).views
    assert [view.mask is None for view in (masked[0], masked[-1])] == [True, False]
    shots = shots_of(photographs(tree.folder, {}).views)
    assert {camera for camera, _ in shots.values()} == {"cam0", "cam1"} and len(shots) == 2 * len(tree.times)


def test_more_images_than_a_map_can_have_are_refused(tmp_path, rng, monkeypatch):
    euroc(tmp_path, rng)
    monkeypatch.setattr("spherloc.mapping.images.photographs.MAX_IMAGES", 20)
    assert len(photographs(tmp_path, {}, choice=FrameChoice(10)).views) == 20
    with pytest.raises(
        InputError, match=r"24 photographs of all cameras are too many for a map, 20 at most; give fewer"
    ):
        photographs(tmp_path, {}, choice=FrameChoice(12))


def test_what_is_asked_for_by_an_option_is_not_read(tmp_path, rng):
    tree = euroc(tmp_path, rng)
    views = photographs(tmp_path, {}).views
    data = sequence_data(tmp_path, views, gravity=False)
    assert data.stated is None and data.positions is not None and len(data.remarks) == 1
    assert sequence_data(tmp_path, views, gravity=False, positions=False).remarks == ()
    assert sequence_data(tree.mav / "imu0", views).remarks == ()


def test_a_camera_without_a_calibration_is_told(tmp_path, rng):
    tree = euroc(tmp_path, rng)
    (tree.mav / "cam1" / "sensor.yaml").unlink()
    found = with_cameras(tmp_path, {})
    assert {view.path.parent.parent.name for view in found.views} == {"cam0"}
    assert any(
        "cam1: It is left out: " in remark and "put their calibration beside" in remark for remark in found.remarks
    )
    place = tree.mav / "cam1" / "data" / "lens.yaml"
    place.write_text(sensor_yaml(np.eye(4), 23.0))
    assert {view.camera.fx for view in with_cameras(tmp_path, {}).views} == {20.0, 23.0}
    place.unlink()
    (tree.mav / "cam0" / "sensor.yaml").write_text("camera_model: unknown\nintrinsics: []\n")
    with pytest.raises(InputError, match=r"A file beside them is not used: .*cam0/sensor\.yaml"):
        photographs(tmp_path, {})


def test_an_imu_that_is_fixed_nowhere_is_not_used(tmp_path, rng):
    tree = euroc(tmp_path, rng)
    for camera in ("cam0", "cam1"):
        file = tree.mav / camera / "sensor.yaml"
        text = file.read_text()
        file.write_text(text[: text.index("T_BS")] + text[text.index("rate_hz") :])
    data = sequence_data(tmp_path, photographs(tmp_path, {}).views)
    assert data.stated is None and "no file says how cam0 and cam1 are fixed to the IMU" in data.remarks[0]
    assert data.positions is not None, "those of the body"


def test_logs_of_other_times_are_told(tmp_path, rng):
    tree = euroc(tmp_path, rng, count=12)
    log = tree.mav / "imu0" / "data.csv"
    lines = log.read_text().splitlines()
    log.write_text("\n".join(lines[: 1 + 200 + 65]))
    truth = tree.mav / "state_groundtruth_estimate0" / "data.csv"
    (tree.mav / "leica0").mkdir()
    rows = [f"{time}, {k}.5, 2.0, 3.0" for k, time in enumerate(tree.times)]
    (tree.mav / "leica0" / "data.csv").write_text("\n".join(rows))
    text = truth.read_text()
    truth.write_text(text.replace("15205303", "14005303"))
    views = photographs(tmp_path, {}).views
    data = sequence_data(tmp_path, views)
    assert len(data.stated.found) == 14 and any(
        "imu0/data.csv: 10 of 24 photographs have no gravity there" in remark for remark in data.remarks
    )
    assert data.positions.by_name[views[3].name].tolist() == [3.5, 2.0, 3.0], "of the laser tracker"
    assert "estimate0/data.csv: is not used for the scale, as it has a position at the time of 0 of 24" in str(
        data.remarks
    )
    assert "from 1520530308.199 to 1520530308.749 s, and it is from 1400530308.199" in str(data.remarks)
    log.write_text("\n".join(line.replace("15205303", "14005303") for line in lines))
    truth.write_text("1,2,3\n")
    (tree.mav / "leica0" / "data.csv").write_text("1,2,3,x\n")
    data = sequence_data(tmp_path, views)
    assert data.stated is None and data.positions is None
    none, columns, number = data.remarks
    assert "imu0/data.csv: is not used, as it has gravity of none of the 24 photographs" in none
    assert "estimate0/data.csv, line 1: has 3 columns" in columns and "leica0/data.csv, line 1: 'x' is not" in number


def test_times_are_those_of_the_table(tmp_path):
    images = tmp_path / "cam0" / "data"
    images.mkdir(parents=True)
    for name in ("00001520530308199447626.png", "frame_a.png", "b.png"):
        (images / name).write_bytes(b"")
    assert image_times(images).times_ns == {"00001520530308199447626.png": START}
    table = tmp_path / "cam0" / "data.csv"
    table.write_text("#timestamp [ns],filename\n5,frame_a.png\n000007, b.png\n9,c.png\n")
    told = image_times(images)
    assert told.times_ns == {"00001520530308199447626.png": START, "frame_a.png": 5, "b.png": 7}
    assert told.remarks == (f"{table}: 1 of its 3 rows name no image there, the first is c.png.",)
    table.write_text("5,x.png\n6,y.png\n")
    (remark,) = image_times(images).remarks
    assert "2 of its 2 rows name no image there" in remark and "times are those in the names of the images" in remark
    table.write_text("5;x.png\n")
    (remark,) = image_times(images).remarks
    assert "data.csv, line 1: is not a row of timestamp [ns], filename. Times are those in the names" in remark


def test_the_sharpest_of_each_stretch_is_mapped_and_others_are_localized(tmp_path, rng):
    """Those that both cameras took; the second one lost every second image. The same are chosen again."""
    tree = euroc(tmp_path, rng, count=120)
    sharp = {tree.times[10 * k + 4] for k in range(12)}
    for place, time in enumerate(tree.times):
        for camera in ("cam0", "cam1"):
            path = tree.mav / camera / "data" / f"{time}.png"
            if camera == "cam1" and place % 2:
                path.unlink()
            elif time not in sharp:
                cv2.imwrite(str(path), cv2.blur(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), (5, 5)))
    found = photographs(tmp_path, {}, choice=FrameChoice(12))
    assert {cam_and_time(view.name) for view in found.views} == {
        (cam, time) for cam in ("cam0", "cam1") for time in sharp
    }
    lost, choice, *_ = found.remarks
    assert "mav0/cam1/data.csv: 60 of its 120 rows name no image there" in lost
    assert "24 of 180 images are mapped, of 2 cameras at the same times," in choice
    assert len({step for _, step in shots_of(found.views).values()}) == 12
    assert found.others == 156
    again = photographs(tmp_path, {}, choice=FrameChoice(12))
    assert [view.name for view in again.views] == [view.name for view in found.views]
    assert len(photographs(tmp_path, {}).views) == 2 * FRAMES, "120 images at 20 Hz are a recording"
    new, remarks = new_images_of(tree.mav, found, choice=FrameChoice(12))
    assert len(new.views) == 24 and not {view.path for view in new.views} & {view.path for view in found.views}
    assert "24 of 180 images are localized" in remarks[1] and "not in the map" in remarks[1]
    assert sorted(new.gravity) == sorted(view.name for view in new.views)
    assert not new_images_of(tree.mav, found, choice=FrameChoice(12), measured_gravity=False)[0].gravity
    sections = ("", "[gravity]", "map = [0.0, 0.0, -1.0]", 'file = "mine.txt"')
    head = MapHead("m", "a", "..", 'units = "metres"', sections)
    scene = write_new_scene(head, tmp_path, new, found.views[0].camera)
    rows = read_gravity_file(tmp_path / "mav0_gravity.txt")
    assert tomllib.loads(scene.read_text())["gravity"] == {"file": "mav0_gravity.txt", "map": [0.0, 0.0, -1.0]}
    assert rows.keys() == new.gravity.keys()
    first = new.views[0].name
    assert off_deg(rows[first].down, tree.down_in(*cam_and_time(first))) < 0.5
    assert rows[first].bound_rad == pytest.approx(np.radians(2.0), rel=1e-3)


def folder_of(*names, inside="", times=None):
    return ImageFolder(inside, inside, names, times or {})


def test_which_folders_are_mapped_whole(tmp_path):
    """Files are missing here, as unreadable ones are in a folder: one of each stretch is chosen all the same."""
    ordinary = folder_of(*(f"IMG_{20200101 + k // 9}_{k:06d}.jpg" for k in range(500)), "notes.txt")
    assert chosen(tmp_path, [ordinary], FrameChoice()) == ((ordinary,), ())
    more = folder_of(*ordinary.names, "IMG_z.jpg")
    (left,), (remark,) = chosen(tmp_path, [more], FrameChoice())
    assert (
        len(left.names) == FRAMES + 1
        and "notes.txt" in left.names
        and remark.startswith("40 of 501 images are mapped,")
    )
    (left,), _ = chosen(tmp_path, [ordinary], FrameChoice(7))
    assert len(left.names) == 8, "as many as are asked for"
    assert chosen(tmp_path, [ordinary], FrameChoice(500)) == ((ordinary,), ())
    slow = folder_of(*(f"{START + k * 10**9}.png" for k in range(300)))
    assert chosen(tmp_path, [slow], FrameChoice()) == ((slow,), ()), "one a second"
    fast = folder_of(*(f"{START + k * STEP_NS}.png" for k in range(300)))
    (left,), _ = chosen(tmp_path, [fast], FrameChoice())
    assert len(left.names) == FRAMES
    numbers = np.array([(int(name[:-4]) - START) // STEP_NS for name in left.names])
    assert np.abs(numbers / 7.5 - 0.5 - np.arange(FRAMES)).max() < 0.7, "spread evenly"


def test_new_images_of_another_folder_are_all_taken_unless_they_are_many(tmp_path):
    few = folder_of(*(f"{k}.jpg" for k in range(60)))
    mapped = frozenset([tmp_path / "other" / "1.jpg"])
    assert chosen(tmp_path, [few], FrameChoice(12, mapped)) == ((few,), ())
    own = frozenset((tmp_path / f"{k}.jpg").resolve() for k in range(12))
    (left,), (remark,) = chosen(tmp_path, [few], FrameChoice(12, own))
    assert len(left.names) == 12 and not {tmp_path / name for name in left.names} & own and "localized" in remark
    assert chosen(tmp_path, [few], FrameChoice(None, own)) == ((few,), ()), "a small map's own images may be localized"


def test_cameras_that_took_nothing_together_are_chosen_from_one_by_one(tmp_path):
    folders = [folder_of(*(f"{name}{k}.jpg" for k in range(300)), inside=name) for name in ("front", "back")]
    left, _ = chosen(tmp_path, [folders[0], ImageFolder("back", "back", folders[1].names[:280])], FrameChoice())
    both = {name[4:] for name in left[1].names}
    assert len(left[0].names) == FRAMES and both < {name[5:] for name in left[0].names} and len(both) >= FRAMES - 3
    half = ImageFolder("back", "back", folders[1].names[::2])
    left, _ = chosen(tmp_path, [folders[0], half], FrameChoice(FRAMES))
    assert [len(one.names) for one in left] == [FRAMES, FRAMES], "each stretch has one that both took"
    others = ImageFolder("back", "back", tuple(f"b{k}.jpg" for k in range(1000, 1280)))
    left, (remark,) = chosen(tmp_path, [folders[0], others], FrameChoice())
    assert [len(one.names) for one in left] == [FRAMES, FRAMES] and "together" not in remark
    many = [folder_of(*(f"{k}.jpg" for k in range(60)), inside=f"c{n}") for n in range(25)]
    left, _ = chosen(tmp_path, many, FrameChoice())
    assert sum(len(one.names) for one in left) == 500


def test_folders_that_are_no_sequence(tmp_path, rng):
    tree = euroc(tmp_path / "room", rng, count=2)
    assert asl_sequence(tmp_path) is None and asl_sequence(tree.mav / "imu0") is None
    assert list(asl_sequence(tree.folder).cameras) == ["cam0", "cam1"]
    one = photographs(tree.mav / "cam0" / "data", {})
    assert len(one.views) == 2 and one.remarks[0] == (
        "These are the images of cam0 of a recorded sequence; for a map of all of its cameras, cam0, cam1, give "
        f"{tree.mav}."
    )
    assert "all of its cameras" not in "".join(photographs(tree.folder, {}).remarks)
    (tree.mav / "cam2").mkdir()
    assert "Without images in a folder data, and left out: cam2." in with_cameras(tree.folder, {}).remarks
    photos = tmp_path / "photos"
    (photos / "data").mkdir(parents=True)
    (photos / "data" / "1.png").write_bytes(b"")
    (photos / "data.csv").write_text("name,price\n")
    assert asl_sequence(photos) is None and asl_sequence(photos / "data") is None
    shutil.copytree(tree.mav, tmp_path / "left", dirs_exist_ok=True)
    (tmp_path / "left" / "1.png").write_bytes(b"")
    assert asl_sequence(tmp_path / "left") is None, "it has images itself"
