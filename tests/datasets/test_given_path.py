"""What is said of a path that is no scene file."""

import pytest

from spherloc.datasets import load_scene
from spherloc.datasets.given_path import images_below, what_it_is
from spherloc.datasets.scene_file import check_there
from spherloc.errors import InputError


def filled(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([f"{k}.JPG" for k in range(3)], "is a folder of 3 images; make a map of it with: spherloc map "),
        (
            ["left/1.png", "right/1.png", "scene.toml"],
            "is a folder without images, but with 2 in the folders in it; make a map of them with: spherloc ",
        ),
        (["1.png"], "is a folder of 1 image; a map takes two images or more: add some to it"),
        (["cameras.bin", "images.bin", "points3D.bin", "frames.bin"], "is a COLMAP model; a scene of kind colmap"),
        (["sensors/sensors.txt"], "is a dataset of kapture"),
        (
            ["mapping/daytime_360_0/camera_pose.json", *(f"mapping/daytime_360_0/image/{k}.jpg" for k in range(3))],
            "is a hall of 360Loc; a scene of kind 360loc localizes its images: see spherloc scenes 360loc",
        ),
        (["mapping/1.jpg", "mapping/2.jpg"], "is a folder without images, but with 2 in the folders in it; make a map"),
        (["results.jsonl", "trajectory.png"], "is a folder of results of spherloc localize; list its runs with"),
        (["a.rrd", "b.rrd"], "is a folder of 2 recordings; list them with: spherloc runs "),
        (["a.toml"], "is a folder of 1 scene file; give one of them, such as "),
        (
            ["day1/left/1.png", "day1/left/2.png", "notes/a.txt", ".thumbnails/small/1.png", ".thumbnails/small/2.png"],
            "is a folder without images, but with 2 deeper in it, in ",
        ),
        (
            ["mav0/cam0/data/1.png", "mav0/cam0/data/2.png", "mav0/cam1/data/1.png", "mav0/imu0/data.csv", "notes.txt"],
            "is a recorded sequence in the layout of EuRoC and TUM-VI, with 2 images of cam0 and 1 image of cam1; make "
            "a map of some of them with: spherloc map ",
        ),
        (
            ["sensor.yaml", "data/1.png"],
            "is a recorded sequence in the layout of EuRoC and TUM-VI, with 1 image of my photos; make a map of some",
        ),
        (["a.mp4"], "is a folder of 1 video; make a map of the frames of one with: spherloc map "),
        ([], "is an empty folder; give the path of a scene file"),
        (["notes.txt"], "is a folder without images or scene files; give the path of a scene file"),
    ],
)
def test_folders(tmp_path, names, said):
    folder = tmp_path / "my photos"
    folder.mkdir()
    told = what_it_is(filled(folder, *names))
    assert told.startswith(f"{folder}: {said}") and told.endswith(".") != (": spherloc " in told)
    for ask in (check_there, load_scene):
        with pytest.raises(InputError) as caught:
            ask(folder)
        assert str(caught.value) == told
    assert "'" in told or "spherloc map" not in told  # a path with a space is quoted for the shell


def test_images_deeper_in_a_folder_are_found(tmp_path):
    """The folder of the folders of several cameras where it has these, the least deep one first. One picture alone is
    that of a result."""
    filled(tmp_path, "a/b/c/1.png", "a/b/c/2.png", "recordings/one/trajectory.png", "recordings/other/trajectory.png")
    day = tmp_path / "trip" / "day1"
    filled(day, "left/1.png", "left/2.png", "right/1.png", "right/2.png", "../day2/1.png")
    assert images_below(tmp_path) == (day, 4)
    assert images_below(tmp_path / "a") == (tmp_path / "a" / "b" / "c", 2)
    assert images_below(tmp_path / "recordings") is None and images_below(tmp_path / "trip" / "day2") is None
    mav = tmp_path / "recorded" / "MH_01" / "mav0"
    filled(mav, "cam0/data/1.png", "cam0/data/2.png", "cam1/data/1.png", "imu0/data.csv")
    assert images_below(tmp_path / "recorded") == (mav.parent, 3)
    assert f"with 3 deeper in it, in {mav.parent}; make a map" in what_it_is(tmp_path / "recorded")
    (tmp_path / "a" / "b" / "around").symlink_to(tmp_path / "a")
    (tmp_path / "a" / "b" / "c" / "1.png").unlink()
    assert images_below(tmp_path / "a") is None, "a folder that is in itself ends, too"


def test_other_files_that_end_like_scene_files_are_none(tmp_path):
    (tmp_path / "pyproject.toml").write_text('[project]\nname = "photos"\n')
    assert "is a folder without images or scene files" in what_it_is(tmp_path)
    (tmp_path / "mine.toml").write_text('kind = "colmap"\n')
    told = what_it_is(tmp_path)
    assert "is a folder of 1 scene file; give one of them" in told and "mine.toml" in told


def test_the_scene_of_a_map_is_named_and_not_its_lens(tmp_path):
    """A map's folder has its lens and scenes of other photographs, too."""
    (tmp_path / "lens.toml").write_text('[camera]\nmodel = "equirectangular"\nwidth = 800\nheight = 400\n')
    for name in ("more.toml", "scene.toml"):
        (tmp_path / name).write_text('kind = "image-folder"\n')
    told = what_it_is(tmp_path)
    assert "is a folder of 2 scene files; give one of them" in told and told.endswith("scene.toml.")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("a.png", "is an image; make a map of all images of its folder with: spherloc map "),
        ("a.insv", "is a video; make a map of its frames with: spherloc map "),
        (
            "a.vrs",
            "is a recording of Project Aria's glasses; save its images with projectaria-tools, in an environment of "
            "its own because its version 2 needs another version of rerun, then make a map of their folder with: ",
        ),
        ("database.db", "is a COLMAP database"),
        ("matches.csv", "is a table; its matches are solved by a scene of kind correspondences"),
        ("camera.yaml", "is a YAML file; a calibration is named by the key 'calibration'"),
        ("photos.ZIP", "is an archive; unpack it, and give the folder or the file that comes out of it."),
        ("map.tar.gz", "is an archive; unpack it"),
        ("paper.pdf", "is a PDF document; save the photographs in it as JPEG or PNG files, then make a map of their"),
        ("trip.DOCX", "is a document; save the photographs in it as JPEG or PNG files, then make a map of their"),
        ("README.md", "is not a scene file; give the path of a scene file (TOML) or a bundled scene's name"),
    ],
)
def test_files(tmp_path, name, said):
    path = filled(tmp_path, name) / name
    assert what_it_is(path).startswith(f"{path}: {said}")
    with pytest.raises(InputError, match=r"spherloc|calibration|unpack"):
        check_there(path)


def test_what_may_be_a_scene_file_and_what_is_not_there_are_left_alone(tmp_path):
    filled(tmp_path, "a.toml")
    assert what_it_is(tmp_path / "a.toml") == "" == what_it_is(tmp_path / "none") == what_it_is(tmp_path / ("x" * 5000))
