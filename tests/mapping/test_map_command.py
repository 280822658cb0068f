"""The command that makes a map: how it ends, what it leaves, and what it says meanwhile."""

import json
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from image_samples import picture

from spherloc import registry
from spherloc.errors import InputError
from spherloc.files import lock
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc_viz.commands.image_commands import map as map_command
from spherloc_viz.commands.map import (
    _stages,
    distance_of,
    main,
    scale_of_words,
)


def test_a_job_tells_what_went_wrong_in_a_line(tmp_path, rng, capsys):
    picture(tmp_path / "a.png", 400, 300, rng)
    assert main(tmp_path, tmp_path / "map") == 1
    (said,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert "put their calibration beside them, into that folder, and make the map again" in said["error"]
    with pytest.raises(InputError, match="give it with --camera FILE"):
        photographs(tmp_path, {})


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no termination signal")
def test_a_terminated_map_prints_no_stack_trace():
    code = "import os, signal; from spherloc_viz.commands.map import end_without_a_trace; end_without_a_trace(); "
    done = subprocess.run([sys.executable, "-c", f"{code}os.kill(os.getpid(), signal.SIGTERM)"], capture_output=True)
    assert done.returncode == -15 and done.stderr == b""


def test_images_that_show_nothing_together(tmp_path, rng):
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 200, rng)
    found = photographs(tmp_path, {})
    with pytest.raises(InputError, match=r"'z\.png' is not one of the 2 photographs"):
        make_map(
            MapRequest(found.views, tmp_path, ScaleMeasurement(distance=("a.png", "z.png", 1.0))), tmp_path / "map"
        )
    with pytest.raises(InputError, match=r"no two of the 2 photographs surely show the same place .*the best pair has"):
        make_map(MapRequest(found.views, tmp_path), tmp_path / "map")
    assert not (tmp_path / "map").exists(), "a map that cannot be made leaves nothing"


def test_black_images_are_told_as_such(tmp_path, rng):
    picture(tmp_path / "a.png", 400, 200, rng)
    for name in ("b.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((200, 400), np.uint8))
    views = photographs(tmp_path, {}, panorama=True).views
    with pytest.raises(InputError, match=r"^2 of the 3 photographs, such as b\.png, show hardly anything"):
        make_map(MapRequest(views, tmp_path), tmp_path / "map")


def test_a_map_that_cannot_be_made_leaves_what_was_there(tmp_path, rng):
    """A finished map and a file of the user's; but not the matches of an attempt that was stopped."""
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 200, rng)
    views = photographs(tmp_path, {}).views
    finished, stopped, own = (tmp_path / name for name in ("finished", "stopped", "own"))
    for folder, name in ((finished, "scene.toml"), (own, "notes.txt")):
        folder.mkdir()
        (folder / name).write_text("kept")
    (finished / "matches_0.db").write_text("of the finished map")
    stopped.mkdir()
    (stopped / "matches_0.db").write_text("half")
    for folder in (finished, stopped, own):
        with pytest.raises(InputError, match="no two of the 2 photographs"):
            make_map(MapRequest(views, tmp_path), folder)
    assert sorted(path.name for path in finished.iterdir()) == ["matches_0.db", "scene.toml"]
    assert [path.name for path in own.iterdir()] == ["notes.txt"]
    assert not stopped.exists()


def test_a_folder_in_which_a_map_is_being_made_is_left_alone(tmp_path, rng):
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 200, rng)
    views, busy = photographs(tmp_path, {}).views, tmp_path / "map"
    busy.mkdir()
    (busy / "matches_0.db").write_text("of the other process")
    handle = os.open(busy, os.O_RDONLY)
    try:
        lock(handle)  # as another process does
        with pytest.raises(InputError, match=r"map: another process is making a map there; wait .* --output"):
            make_map(MapRequest(views, tmp_path), busy)
        assert (busy / "matches_0.db").exists()
    finally:
        os.close(handle)
    with pytest.raises(InputError, match="no two of the 2 photographs"):
        make_map(MapRequest(views, tmp_path), busy)


def test_a_stopped_map_goes_on(tmp_path, rng):
    """Stopped while features are sought, nothing is there yet; afterwards a half written database is no obstacle."""
    for name in ("a.png", "b.png"):
        picture(tmp_path / name, 400, 200, rng)
    views = photographs(tmp_path, {}).views

    def stopped_at(stage):
        def tell(kind, *_):
            if kind == stage:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            make_map(MapRequest(views, tmp_path), tmp_path / "map", tell)

    stopped_at("images searched for features")
    assert not (tmp_path / "map").exists()
    stopped_at("pairs of images matched")
    (path,) = (tmp_path / "map").glob("matches_*.db")  # the other one is made when all pairs are done
    pycolmap = registry.require("pycolmap", "colmap", "making a map")
    with pycolmap.Database.open(str(path)) as database:
        database.clear_keypoints()
    with pytest.raises(InputError, match="no two of the 2 photographs"):
        make_map(MapRequest(views, tmp_path), tmp_path / "map")


def test_a_page_asks_for_the_scale_in_a_line():
    assert scale_of_words(" ") == ScaleMeasurement()
    assert scale_of_words("1.6") == ScaleMeasurement(camera_height_m=1.6)
    assert scale_of_words("'first floor/1.jpg' 5.jpg 12.5") == ScaleMeasurement(
        distance=("first floor/1.jpg", "5.jpg", 12.5)
    )
    for words in ("0", "-1", "nan", "1e7", "1.jpg 2", "1.jpg 2.jpg", "1.jpg 2.jpg 3.jpg 4", "'1.jpg 2"):
        with pytest.raises(InputError, match="give the height of the cameras in metres"):
            scale_of_words(words)


def test_progress_follows_a_number_of_pieces_that_grows(monkeypatch, capsys):
    """As that of joins of maps, whose number is not known before."""
    monkeypatch.setattr("spherloc_viz.commands.progress.LINE_EVERY_S", -1.0)
    with _stages() as tell:
        for number in range(1, 4):
            tell("joins of maps tried", number, number)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"spherloc: {number} of {number} joins of maps tried." for number in range(1, 4)]


def test_a_distance_is_two_images_and_metres():
    assert distance_of(()) is None and distance_of(("a.jpg", "b.jpg", "12.5")) == ("a.jpg", "b.jpg", 12.5)
    for words in (("a.jpg", "b.jpg"), ("a.jpg", "b.jpg", "far"), ("a.jpg", "b.jpg", "3", "folder")):
        with pytest.raises(InputError, match=r"--distance is '.*'; give two images and the metres between them"):
            distance_of(words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"nadir": 95.0}, "--nadir is 95; give degrees from 0 to 80"),
        ({"seam": -1.0}, "--seam is -1; give degrees from 0 to 30"),
        ({"camera_height": 0.0}, "--camera-height is 0; give a positive number of metres"),
        ({"frames": 1}, "--frames is 1; give a number from 2 to 500"),
    ],
)
def test_wrong_numbers_are_named_as_they_were_given(tmp_path, words, said):
    with pytest.raises(InputError, match=said):
        map_command(tmp_path, **words)
