"""New images that are localized in a map: which they are, and what their scene says."""

import cv2
import numpy as np
import pytest
from image_samples import picture

from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.datasets import load_scene
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.mapping.images.photographs import Photographs, photographs
from spherloc.mapping.scenes.new_images import NewImages, new_images_of
from spherloc.mapping.scenes.new_queries import add_new_images
from spherloc.mapping.scenes.scene_files import (
    MODEL,
    UNITS_UNKNOWN,
    MapHead,
    _camera,
    _queries,
    own_queries,
    write_new_scene,
)
from spherloc_viz.commands.map import (
    _calibrated,
    _sizes,
)


def test_every_camera_of_several_has_queries_and_references():
    """In the order of names, every fourth image of four cameras is the same one's."""
    cameras = ("FV", "MVL", "MVR", "RV")
    names = [f"{time:05d}_{camera}.png" for time in range(6) for camera in cameras]
    chosen = own_queries(names)
    counts = [sum(name.endswith(f"_{camera}.png") for name in chosen) for camera in cameras]
    assert sum(counts) == 6 and max(counts) == 2 and min(counts) == 1 and chosen == sorted(chosen)
    assert own_queries([f"{k}.png" for k in range(9)]) == ["3.png", "7.png"] and own_queries(["a.png"]) == ["a.png"]


def test_new_images_are_counted_by_their_size(tmp_path, rng):
    """Before a map is made, a folder without images is refused."""
    new, empty = tmp_path / "new", tmp_path / "empty"
    for folder in (new, empty):
        folder.mkdir()
    for name, size in (("a.png", (400, 200)), ("b.png", (400, 200)), ("c.png", (300, 200))):
        picture(new / name, *size, rng)
    (new / "d.jpg").write_text("no image")
    (empty / "notes.txt").write_text("nothing")
    assert _sizes(NewImages(new, None)) == "2 of 400 x 200 pixels, 1 of 300 x 200 pixels, 1 that cannot be read"
    mapped = Photographs(tuple(view for view in photographs(new, {}).views if view.camera.width == 400), (), {})
    found, remarks = new_images_of(new, mapped)
    assert found == NewImages(new, None), "all that can be are of the map's camera"
    damaged, unknown = remarks
    assert damaged.startswith("1 image was left out, damaged or empty: d.jpg;")
    assert unknown.startswith("1 of 3 images were left out, as their camera is not known; the first is c.png with")
    assert unknown.endswith("300 x 200 pixels; put its calibration into that folder.")
    for name in ("a.png", "b.png"):
        (new / name).unlink()
    words = r"1 of 300 x 200 pixels, are not full panoramas \(2 to 1\); put their calibration into that folder\.$"
    with pytest.raises(InputError, match=f"new: its photographs, {words}"):
        new_images_of(new, mapped)
    with pytest.raises(InputError, match="empty: has no images; give a folder with images that are to be localized"):
        new_images_of(empty, mapped)
    with pytest.raises(InputError, match=r"c\.png: is an image; give a folder with it and others that are to be local"):
        new_images_of(new / "c.png", mapped)


def test_new_images_of_cameras_that_were_given(tmp_path, rng):
    """Their calibration is not beside the images of the map, only in its model."""
    images, model, new = tmp_path / "images", tmp_path / "map" / "model", tmp_path / "new"
    for folder in (images, model, new):
        folder.mkdir(parents=True)
    for name, width in (("a.png", 400), ("b.png", 320)):
        picture(images / name, width, 240, rng)
        picture(new / name, width, 240, rng)
    lenses = "1 OPENCV_FISHEYE 400 240 90 90 200 120 0 0 0 0\n2 OPENCV_FISHEYE 320 240 95 95 160 120 0 0 0 0\n"
    (model / "cameras.txt").write_text(lenses)
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 1 0 0 2 b.png\n\n")
    (model / "points3D.txt").write_text("")
    scene = tmp_path / "map" / "scene.toml"
    scene.write_text(f'kind = "colmap"\nname = "given"\nmodel = "{MODEL}"\nimages = "../images"\n')
    path, remarks = add_new_images(scene, new)
    assert remarks == () and 'queries = ["a.png", "b.png"]' in path.read_text()
    assert [line for line in path.read_text().splitlines() if line.startswith("fx")] == ["fx = 90.0", "fx = 95.0"]


@pytest.mark.parametrize("name", ["scene", "lens", "lens_front"])
def test_a_scene_of_new_images_is_not_called_as_another_file_of_the_map(tmp_path, name):
    images = NewImages(tmp_path / name, None)
    path = write_new_scene(MapHead("m", "", "..", UNITS_UNKNOWN, ()), tmp_path, images, Equirectangular(64, 32))
    assert path.name == f"new_{name}.toml"


def test_new_images_of_several_cameras(tmp_path, rng):
    """Each has the camera whose name is in its own, or that of its folder's name; their scene is read as it was
    written."""
    left, right = (KannalaBrandt(400, 300, focal, focal, 200.0, 150.0, (0.0,) * 4) for focal in (90.0, 95.0))
    mapped, flat, folders = (tmp_path / name for name in ("mapped", "flat", "folders"))
    for folder in (mapped, flat, folders / "left", folders / "right"):
        folder.mkdir(parents=True)
    for name in ("left_1.png", "right_1.png"):
        picture(mapped / name, 400, 300, rng)
    for place in (flat / "left_8.png", flat / "right_9.png", folders / "left" / "7.png", folders / "right" / "7.png"):
        picture(place, 400, 300, rng)
    picture(flat / "right_small.png", 200, 150, rng)
    known = photographs(mapped, {"left": left, "right": right})
    found, remarks = new_images_of(flat, known)
    assert found.views is not None and [view.camera.fx for view in found.views] == [90.0, 95.0]
    assert len(remarks) == 1 and "right_small.png" in remarks[0]
    inside, _ = new_images_of(folders, known)
    assert inside.views is not None
    assert [(view.name, view.camera.fx) for view in inside.views] == [("left/7.png", 90.0), ("right/7.png", 95.0)]
    (tmp_path / "small").mkdir()
    picture(tmp_path / "small" / "left.png", 200, 150, rng)
    with pytest.raises(InputError, match=r"and of no camera of the map \(400 x 300 pixels\); put their calibration in"):
        new_images_of(tmp_path / "small", known)

    pose = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, {}]]"
    references = "".join(
        f'[[references]]\nimage = "mapped/{name}_1.png"\ncam_from_map = {pose.format(at)}\n'
        f"[references.camera]\n{chr(10).join(_camera(camera))}\n"
        for at, (name, camera) in enumerate({"left": left, "right": right}.items())
    )
    for folder, views in (("flat", found.views), ("folders", inside.views)):
        lines = ['kind = "image-folder"', 'name = "new"', f'images = "{folder}"', *_queries(views, left)]
        (tmp_path / "scene.toml").write_text("\n".join([*lines, references]))
        scene = load_scene(tmp_path / "scene.toml")
        assert [(view.name, view.camera) for view in scene.queries] == [(view.name, view.camera) for view in views]
        assert not any("left out" in remark for remark in scene.remarks)


def test_new_images_of_other_cameras_than_the_map(tmp_path, rng):
    """A calibration beside them is theirs, also for images of the map's size; panoramas need none, of whatever size
    they are. A calibration that COLMAP has no model for is taken as it is, and the scene is read as it was written."""
    of_map = KannalaBrandt(400, 300, 90.0, 90.0, 200.0, 150.0, (0.0,) * 4)
    phone = Mei(400, 300, 350.0, 350.0, 200.0, 150.0, xi=0.0, distortion=(0.0,) * 4)
    headset = DoubleSphere(320, 240, 80.0, 80.0, 160.0, 120.0, xi=-0.2, alpha=0.55)
    images, model, new, flat = tmp_path / "images", tmp_path / "map" / "model", tmp_path / "new", tmp_path / "flat"
    for folder in (images, model, new / "phone", new / "headset", new / "round", flat):
        folder.mkdir(parents=True)
    for path in (images / "a.png", images / "b.png", new / "phone" / "1.png", flat / "of_map.png"):
        picture(path, 400, 300, rng)
    picture(new / "headset" / "1.png", 320, 240, rng)
    picture(flat / "headset.png", 320, 240, rng)
    for path, width in ((new / "round" / "1.png", 640), (new / "round" / "2.png", 800), (flat / "round.png", 640)):
        picture(path, width, width // 2, rng)
    (new / "phone" / "cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
    lens = "\n".join(["[camera]", *_camera(headset)])
    (new / "headset.toml").write_text(lens)
    (flat / "calibration.toml").write_text(lens)
    (model / "cameras.txt").write_text("1 OPENCV_FISHEYE 400 300 90 90 200 150 0 0 0 0\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n211 150 1\n2 1 0 0 0 1 0 0 1 b.png\n233 150 1\n")
    (model / "points3D.txt").write_text("1 0.5 0 4 128 128 128 0.5 1 0 2 0\n")
    scene = tmp_path / "map" / "scene.toml"
    head = f'model = "{MODEL}"\nimages = "../images"\nqueries = ["b.png"]\n[gravity]\nmap = [0.0, 1.0, 0.0]\n'
    scene.write_text(f'kind = "colmap"\nname = "m"\n{head}[masks]\nseam_deg = 2.0\nimages = "../mask.png"\n')
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((300, 400), 255, np.uint8))
    expected = {"phone/1.png": phone, "headset/1.png": headset}
    expected |= {f"round/{k}.png": Equirectangular(width, width // 2) for k, width in ((1, 640), (2, 800))}
    path, _ = add_new_images(scene, new)
    opened = load_scene(path)
    assert {view.name: view.camera for view in opened.queries} == expected
    assert {view.camera for view in opened.references} == {of_map}
    path, remarks = add_new_images(scene, flat)
    cameras = {"of_map.png": of_map, "headset.png": headset, "round.png": Equirectangular(640, 320)}
    assert {view.name: view.camera for view in load_scene(path).queries} == cameras
    assert remarks == ("The calibration found beside them: calibration.",)


def test_new_panoramas_are_told_from_raw_circles(tmp_path, rng):
    """Those of the map's size are its camera's; others of 2 to 1 may be two fisheye circles."""
    picture(tmp_path / "a.png", 400, 200, rng)
    circles = np.zeros((300, 600), np.uint8)
    for column in (150, 450):
        cv2.circle(circles, (column, 150), 149, 200, -1)
    cv2.imwrite(str(tmp_path / "raw.png"), circles)
    mapped = Photographs((View("m.png", Equirectangular(400, 200), tmp_path / "m.png"),), (), {})
    found, remarks = new_images_of(tmp_path, mapped)
    assert found.views is not None and [view.name for view in found.views] == ["a.png"]
    assert "two fisheye circles side by side and no panorama: raw.png" in remarks[0]
    assert new_images_of(tmp_path, mapped, panorama=True) == (NewImages(tmp_path, None), ())


def test_new_images_with_a_calibration_tell_nothing_of_the_lens_of_the_map(tmp_path, rng):
    """Another camera may make images of the same size."""
    picture(tmp_path / "a.png", 400, 300, rng)
    assert not _calibrated(tmp_path, (400, 300))
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
    assert _calibrated(tmp_path, (400, 300)) and not _calibrated(tmp_path, (300, 400))
