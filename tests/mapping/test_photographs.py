"""Which files of a folder are photographs, of which camera, and what is said of the others."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from image_samples import camera_file, picture
from PIL import Image

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.errors import CalibrationError, InputError
from spherloc.frontend.view import View
from spherloc.mapping.images.folder_cameras import is_called
from spherloc.mapping.images.frames import frames_of
from spherloc.mapping.images.full_panorama import two_circles
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.lens import for_colmap
from spherloc.mapping.images.photographs import Photographs, photographs
from spherloc.mapping.scenes.new_images import new_images_of
from spherloc.mapping.scenes.scene_files import (
    SCENE,
    check_images_of,
)
from spherloc_viz.commands.map import (
    _take_frames,
)
from tests.waiting import LIMIT_S


def test_the_calibration_beside_the_photographs_is_taken(tmp_path, rng):
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 300, rng)
    lens = {"model": "kannala_brandt", "width": 640, "height": 480, "fx": 90.0, "fy": 90.0, "cx": 200.0, "cy": 150.0}
    for name, size in (("a.toml", (640, 480)), ("b.toml", (400, 300))):
        rows = {**lens, "width": size[0], "height": size[1], "distortion": [0.0, 0.0, 0.0, 0.0]}
        words = (f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in rows.items())
        (tmp_path / name).write_text("[camera]\n" + "\n".join(words))
    (tmp_path / "notes.json").write_text("{}")
    found = photographs(tmp_path, {})
    assert [view.camera.width for view in found.views] == [400, 400]
    assert found.remarks == ("The calibration found beside them: b.",)
    (tmp_path / "b.toml").unlink()
    (tmp_path / "calibration.yaml").write_text("nothing: 1")
    with pytest.raises(InputError, match="have no") as error:
        photographs(tmp_path, {}, find_lens=_no_lens)
    told = str(error.value)
    assert "have no calibration that can be used, and they show nothing." in told and "notes" not in told
    assert "is not used (a is of 640 x 480 pixels), as no photograph there has its size: give it with --camera" in told
    assert "A file beside them is not used: " in told and "calibration.yaml" in told


def test_a_calibration_that_is_turned_is_told(tmp_path, rng):
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 300, rng)
    for centre, exchanged in (("200 150", False), ("150 200", True), ("260 150", False)):
        (tmp_path / "cameras.txt").write_text(f"1 PINHOLE 400 300 250 250 {centre}\n")
        told = " ".join(photographs(tmp_path, {}).remarks)
        assert ("is at 150, 200, far from the middle of 400 x 300 pixels; if x and y are exch" in told) == exchanged
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 300 400 250 250 150 200\n")
    with pytest.raises(InputError, match="has its size: turn the photographs by 90°, or calibrate anew"):
        photographs(tmp_path, {}, find_lens=_no_lens)


def _no_lens(paths, size):
    raise InputError("they show nothing")


def test_a_folder_with_other_photographs_or_their_map_is_not_taken(tmp_path):
    """Two folders of one name would have one folder for their maps; one that is gone is not missed."""
    for name in ("monday", "tuesday", "map"):
        (tmp_path / name).mkdir()
    check_images_of(tmp_path / "map", tmp_path / "monday")
    (tmp_path / "map" / SCENE).write_text('images = "../monday"')
    check_images_of(tmp_path / "map", tmp_path / "map" / ".." / "monday")
    with pytest.raises(InputError, match=r"holds the map of other photographs, those in .*monday; give another folder"):
        check_images_of(tmp_path / "map", tmp_path / "tuesday")
    with pytest.raises(InputError, match="is the folder of the photographs, and a map needs its own; give another"):
        check_images_of(tmp_path / "tuesday" / ".." / "monday", tmp_path / "monday")
    (tmp_path / "monday").rmdir()
    check_images_of(tmp_path / "map", tmp_path / "tuesday")


def test_each_image_of_a_rig_has_its_camera(tmp_path, rng):
    """In folders by a calibration in it, by one beside it, or by the name of a camera of a file; else by its name."""
    lens = KannalaBrandt(400, 300, 90.0, 90.0, 200.0, 150.0, (0.0, 0.0, 0.0, 0.0))
    other = replace(lens, fx=95.0)
    for name in ("left", "right", "up"):
        (tmp_path / name).mkdir()
        for image in ("1.png", "2.png"):
            picture(tmp_path / name / image, 400, 300, rng)
    with pytest.raises(InputError, match=r"0 photographs with .* left: It is left out: .*--camera FILE\."):
        photographs(tmp_path, {})
    (tmp_path / "left" / "lens.toml").write_text(camera_file(lens))
    (tmp_path / "right.toml").write_text(camera_file(other))
    found = photographs(tmp_path, {})
    assert [(view.name, view.camera) for view in found.views] == [
        ("left/1.png", lens), ("left/2.png", lens), ("right/1.png", other), ("right/2.png", other)
    ]  # fmt: skip
    assert found.remarks[:2] == (
        "left: The calibration found beside them: lens.",
        "right: The calibration found beside them: right.",
    )
    assert found.remarks[2].startswith("up: It is left out: ")
    by_name = photographs(tmp_path, {"left": other, "up": lens})
    assert [view.camera for view in by_name.views if "right" not in view.name] == [other, other, lens, lens]
    assert "right: Camera left is taken for all images of 400 x 300 pixels, but up would fit" in " ".join(
        by_name.remarks
    )
    assert {view.camera.fx for view in photographs(tmp_path, {"": other}).views} == {95.0}
    with pytest.raises(
        InputError, match=r"first is 1\.png with 400 x 300 pixels, but the calibration is for 200 x 150"
    ):
        photographs(tmp_path / "up", {"": replace(other, width=200, height=150)})

    flat = tmp_path / "flat"
    flat.mkdir()
    for name in ("camera-slam-left_1.png", "camera-slam-right_1.png", "else.png"):
        picture(flat / name, 400, 300, rng)
    # A number may be that of a picture, and cam1 is not cam10.
    numbers = photographs(flat, {"1": lens, "2": other})
    assert {view.camera.fx for view in numbers.views} == {90.0} and "Camera 1 is taken" in numbers.remarks[0]
    assert (
        not is_called("cam1", "cam10_1.png")
        and is_called("left", "left0001.png")
        and not is_called("left", "leftover.png")
    )
    picture(flat / "panorama.png", 400, 200, rng)
    (flat / "slam_left.toml").write_text(camera_file(lens))
    (flat / "slam_right.toml").write_text(camera_file(other))
    found = photographs(flat, {})
    assert [view.camera.model for view in found.views] == ["kannala_brandt", "kannala_brandt", "equirectangular"]
    assert [view.camera for view in found.views][:2] == [lens, other]
    assert found.remarks == (
        "The calibration found beside them: slam_left, slam_right.",
        "1 of 4 images were left out, as their camera is not known; the first is else.png with 400 x 300 pixels.",
    )
    picture(flat / "at_hand.png", 300, 400, rng)
    assert photographs(flat, {}).remarks[1] == (
        "2 of 5 images were left out, as their camera is not known; the first is at_hand.png with 300 x 400 pixels, on "
        "its side: orientation tags are not used, so store it as the others are."
    )


SENSORS = """# kapture format: 1.1
# sensor_id, name, sensor_type, [sensor_params]+
007, , camera, OPENCV_FISHEYE, 400, 300, 90, 90, 200, 150, 0, 0, 0, 0
010, , camera, OPENCV_FISHEYE, 400, 300, 95, 90, 200, 150, 0, 0, 0, 0
GPS, gps, gnss, EPSG:4326
"""


def test_folders_have_the_cameras_of_their_numbers(tmp_path, rng):
    """Of a file with several cameras beside the folders, or of one that is given: only if each folder has one."""
    for name in ("cam07", "cam10"):
        (tmp_path / name).mkdir()
        picture(tmp_path / name / "1.png", 400, 300, rng)
    (tmp_path / "sensors.txt").write_text(SENSORS)
    found = photographs(tmp_path, {})
    assert [(view.name, view.camera.fx) for view in found.views] == [("cam07/1.png", 90.0), ("cam10/1.png", 95.0)]
    assert found.remarks == (
        "cam07: The calibration found beside them: 007.",
        "cam10: The calibration found beside them: 010.",
    )
    given, _ = given_cameras(tmp_path / "sensors.txt", None, tmp_path)
    assert [view.camera.fx for view in photographs(tmp_path, given).views] == [90.0, 95.0]
    (tmp_path / "cam07").rename(tmp_path / "cam09")
    found = photographs(tmp_path, {})
    assert {view.camera.fx for view in found.views} == {90.0}
    assert "cam09: Camera 007 is taken for all images of 400 x 300 pixels, but 010 would fit" in found.remarks[0]


def test_photographs_that_are_refused_or_left_out(tmp_path, rng):
    with pytest.raises(InputError, match="is not a folder"):
        photographs(tmp_path / "none", {})
    (tmp_path / "walk.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"is a video; .* spherloc map frames --video .*walk\.mp4$"):
        photographs(tmp_path / "walk.mp4", {})
    with pytest.raises(InputError, match=r"is a folder of 1 video; .* spherloc map frames --video .*walk\.mp4$"):
        photographs(tmp_path, {})
    (tmp_path / "walk.mp4").unlink()
    with pytest.raises(InputError, match="has no photographs"):
        photographs(tmp_path, {})
    picture(tmp_path / "a.png", 400, 300, rng)
    with pytest.raises(InputError, match=r"400 x 300 pixels.*--camera FILE"):
        photographs(tmp_path, {})
    (tmp_path / "a.png").unlink()
    picture(tmp_path / "b.png", 400, 200, rng)
    with pytest.raises(InputError, match="has 1 photograph with a known camera"):
        photographs(tmp_path, {})
    picture(tmp_path / "c.png", 400, 200, rng)
    picture(tmp_path / "d.png", 300, 200, rng)
    (tmp_path / "e.jpg").write_bytes(b"no image")
    found = photographs(tmp_path, {})
    assert [view.name for view in found.views] == ["b.png", "c.png"]
    assert len(found.remarks) == 2 and "d.png" in found.remarks[1] and "e.jpg" in found.remarks[0]
    for name in ("f.png", "g.png", "h.png"):  # more of them, but nothing says what camera they have
        picture(tmp_path / name, 300, 200, rng)
    assert [view.name for view in photographs(tmp_path, {}).views] == ["b.png", "c.png"]
    (tmp_path / "c.png").rename(tmp_path / "c.heic")
    with pytest.raises(InputError, match=r"has 1 photograph with .* convert \.heic to JPEG or PNG\. 4 of 5 images"):
        photographs(tmp_path, {})


def test_panoramas_that_programs_show_turned_are_told(tmp_path, rng):
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        picture(tmp_path / name, 400, 200, rng)
    for name, orientation in (("a.jpg", 1), ("b.jpg", 3)):
        tags = Image.Exif()
        tags[0x0112] = orientation
        with Image.open(tmp_path / name) as image:
            image.save(tmp_path / name, exif=tags)
    (remark,) = photographs(tmp_path, {}, panorama=True).remarks
    assert remark.startswith("1 panorama has an orientation tag, which is not used: b.jpg; where pixels are upside")


@pytest.mark.parametrize("panorama", [False, True])
def test_panoramas_that_are_stored_on_their_side_are_told(panorama, tmp_path, rng):
    def save(orientation):
        tags = Image.Exif()
        tags[0x0112] = orientation
        for name in ("a.jpg", "b.jpg", "c.jpg"):
            picture(tmp_path / name, 200, 400, rng)
            with Image.open(tmp_path / name) as image:
                image.save(tmp_path / name, exif=tags)

    for orientation in (6, 8):
        save(orientation)
        with pytest.raises(InputError, match=r"3 of 200 x 400 pixels, are panoramas that are stored on their side"):
            photographs(tmp_path, {}, panorama=panorama)
    save(3)
    with pytest.raises(InputError, match="no full panoramas" if panorama else "are not full panoramas"):
        photographs(tmp_path, {}, panorama=panorama)


def test_nothing_in_a_folder_of_a_stranger_is_left_out_in_silence(tmp_path, rng):
    """One whose end is missing has a sound header, and would otherwise end the work at the features."""
    for name in ("Büro am Fenster.JPG", "b.png", "cut.jpg"):
        picture(tmp_path / name, 400, 200, rng)
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "cut.jpg").read_bytes()[:-5000])
    (tmp_path / "inside").mkdir()
    picture(tmp_path / "inside" / "f.png", 400, 200, rng)
    for name in ("IMG_1.HEIC", "._b.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"Mac OS X")
    found = photographs(tmp_path, {})
    assert [view.name for view in found.views] == ["Büro am Fenster.JPG", "b.png"]
    assert [remark.partition(":")[0] for remark in found.remarks] == [
        "1 image was left out, damaged or empty",
        "1 photograph was left out",
        "1 image was left out, in subfolders",
    ]
    assert "cut.jpg" in found.remarks[0] and "convert .heic" in found.remarks[1] and "inside" in found.remarks[2]


def test_a_sound_image_is_not_said_to_be_damaged(tmp_path, rng, monkeypatch):
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 200, rng)
    monkeypatch.setattr("spherloc.images.MAX_PIXELS", 100_000)
    picture(tmp_path / "large.png", 800, 400, rng)
    assert cv2.imwrite(str(tmp_path / "depth.tif"), rng.random((200, 400)).astype(np.float32))
    found = photographs(tmp_path, {})
    assert [view.name for view in found.views] == ["a.png", "b.png"]
    (said,) = found.remarks
    assert said.startswith("2 images were left out that cannot be read. The first: ")
    assert "depth.tif: has float32 pixels; give an image with 8 or 16 bits" in said
    (tmp_path / "depth.tif").unlink()
    (said,) = photographs(tmp_path, {}).remarks
    assert "large.png: claims" in said and "100,000; give a smaller image" in said


def test_raw_images_of_a_360_degree_camera_are_no_panoramas(tmp_path, rng):
    """Nor are panoramas raw whose zenith and nadir are black, or that were taken at night."""
    v, u = np.mgrid[:200, :400]
    circle = np.hypot(u % 200 - 99.5, v - 99.5) < 99
    room = rng.integers(60, 255, (200, 400), np.uint8)
    bands = np.abs(v - 100) < 80
    assert two_circles(np.where(circle, room, 5).astype(np.uint8))
    for panorama in (room, np.where(bands, room, 0).astype(np.uint8), room // 40):
        assert not two_circles(panorama)
    for name, pixels in (("a.png", room), ("b.png", room), ("raw.png", np.where(circle, room, 5))):
        cv2.imwrite(str(tmp_path / name), pixels)
    found = photographs(tmp_path, {})
    assert [view.name for view in found.views] == ["a.png", "b.png"]
    assert "two fisheye circles side by side and no panorama: raw.png" in found.remarks[0]
    assert len(photographs(tmp_path, {}, panorama=True).views) == 3


def test_a_folder_without_photographs_says_what_there_is(tmp_path):
    (tmp_path / "left").mkdir()
    with pytest.raises(InputError, match="has no photographs"):
        photographs(tmp_path, {})
    (tmp_path / "a.heic").write_bytes(b"")
    with pytest.raises(InputError, match=r"no photographs that can be read\. .*convert \.heic to JPEG"):
        photographs(tmp_path, {})


def test_frames_of_a_video_are_its_sharpest(tmp_path, rng, capsys):
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, (160, 80))
    if not writer.isOpened():
        pytest.fail("this OpenCV writes no MJPG")
    sharp = rng.integers(0, 255, (80, 160, 3), np.uint8)
    for number in range(12):
        writer.write(sharp if number % 4 == 2 else np.asarray(cv2.GaussianBlur(sharp, (0, 0), 3.0), np.uint8))
    writer.release()
    names = []
    assert frames_of(video, tmp_path, 3, names.append) == []
    assert names == ["frame_000002.jpg", "frame_000006.jpg", "frame_000010.jpg"]
    for count, taken in ((7, 7), (11, 11), (40, 12)):
        again: list[str] = []
        assert frames_of(video, tmp_path / f"{count}", count, again.append) == [] and len(again) == taken
    _take_frames(video, 1, tmp_path, lambda *_: None)
    said = "has 2 more images, such as frame_000006.jpg, which are mapped with the frames."
    assert said in capsys.readouterr().err, "one of the three is taken again"
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    (remark,) = frames_of(video, tmp_path, 3, names.append)
    assert re.search(r"only the first [5-8] of its 12 frames can be read, of which 2 were taken; copy", remark)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="cannot read it as a video"):
        frames_of(tmp_path / "text.mp4", tmp_path / "frames", 3, names.append)
    cv2.imwrite(str(tmp_path / "a.png"), sharp)
    (tmp_path / "glasses.vrs").write_bytes(b"vrs")
    for given, what in (("a.png", "is an image; "), ("glasses.vrs", "is a recording of Project Aria's glasses; ")):
        with pytest.raises(InputError, match=what):
            frames_of(tmp_path / given, tmp_path / "frames", 3, names.append)
    with pytest.raises(InputError, match=r"is a folder of \d+ images; "):
        frames_of(tmp_path, tmp_path / "frames", 3, names.append)
    assert not (tmp_path / "frames").exists()


def test_a_video_without_an_end_is_one_sentence(tmp_path):
    """FFmpeg prints no line of its own before it; in a process of its own, as OpenCV sets that once."""
    (tmp_path / "cut.mp4").write_bytes(b"\0\0\0\x14ftypisom\0\0\2\0isom" + b"\0\0\0\x10mdat" + bytes(8))
    script = (
        "import os\nfrom pathlib import Path\nfrom spherloc.errors import InputError\n"
        "from spherloc.mapping.images.frames import frames_of\nbefore = dict(os.environ)\n"
        "try:\n    frames_of(Path('cut.mp4'), Path('frames'), 3, print)\n"
        "except InputError as error:\n    print(error, os.environ == before)"
    )
    environment = {key: value for key, value in os.environ.items() if key != "OPENCV_FFMPEG_LOGLEVEL"}
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=LIMIT_S)
    assert done.stdout.startswith("cut.mp4: OpenCV cannot read it as a video") and done.stdout.endswith("True\n")
    assert done.stderr == ""


def test_a_lens_that_colmap_lacks_is_fitted():
    lens = Mei(716, 705, 668.16, 667.89, 358.47, 352.88, 2.2134, (0.0168, 1.6548, 0.00042, 0.00046))
    fitted, remark = for_colmap(lens)
    assert isinstance(fitted, KannalaBrandt) and "px off at most" in remark
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (716, 705), (500, 2))
    bearings, seen = lens.unproject(pixels)
    seen &= bearings[:, 2] > np.cos(np.radians(84))
    back, _ = fitted.project(bearings[seen])
    assert np.linalg.norm(back - pixels[seen], axis=1).max() < 0.2
    assert for_colmap(fitted) == (fitted, "")
    bent = Mei(640, 480, 300.0, 300.0, 320.0, 240.0, 0.5, (0.0, 0.0, 0.05, 0.05))
    with pytest.raises(CalibrationError, match="no camera model mei"):
        for_colmap(bent)


def test_photographs_of_an_unknown_camera_are_told_by_size(tmp_path, rng):
    for name, size in (("a.png", (64, 48)), ("b.png", (60, 60)), ("c.png", (64, 48))):
        picture(tmp_path / name, *size, rng)
    told = "2 of 64 x 48 pixels, 1 of 60 x 60 pixels, are not full panoramas .* calibrations of all"
    with pytest.raises(InputError, match=told):
        photographs(tmp_path, {})


def test_all_folders_of_a_folder_count(tmp_path, rng):
    camera = KannalaBrandt(40, 30, 9.0, 9.0, 20.0, 15.0, (0.0,) * 4)
    for number in range(60):
        (tmp_path / f"{number:02}").mkdir()
        picture(tmp_path / f"{number:02}" / "a.png", 40, 30, rng)
    assert len(photographs(tmp_path, {"lens": camera}).views) == 60


def test_photographs_deeper_in_a_folder_are_named(tmp_path, rng):
    """The folder that has them, for a map and to be localized."""
    day = tmp_path / "trip" / "day 1" / "left"
    day.mkdir(parents=True)
    for name in ("1.png", "2.png"):
        picture(day / name, 400, 200, rng)
    with pytest.raises(InputError) as caught:
        photographs(tmp_path, {})
    said = f"{tmp_path}: is a folder without images, but with 2 deeper in it, in {day}; make a map of these with: "
    assert str(caught.value) == f"{said}spherloc map '{day}'"
    mapped = Photographs((View("m.png", Equirectangular(400, 200), tmp_path / "m.png"),), (), {})
    with pytest.raises(InputError, match=r"has no images, but 2 deeper in it, in .*left; give that folder\.$"):
        new_images_of(tmp_path, mapped)
    (tmp_path / "around").mkdir()
    for name in ("1.png", "2.png"):
        picture(tmp_path / "around" / name, 400, 200, rng)
    found = photographs(tmp_path, {})
    assert [view.name for view in found.views] == ["around/1.png", "around/2.png"]
    left_out = f"2 images were left out, deeper in the folder, in {day}; give that folder to have them."
    assert found.remarks == (left_out,) and new_images_of(tmp_path, mapped)[1] == (left_out,)
    (tmp_path / "new.zip").write_bytes(b"PK")
    for ask in (lambda path: photographs(path, {}), lambda path: new_images_of(path, mapped)):
        with pytest.raises(InputError, match=r"new\.zip: is an archive; unpack it"):
            ask(tmp_path / "new.zip")
