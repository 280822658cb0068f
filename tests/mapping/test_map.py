"""Maps of photographs: rendered panoramas with known poses, on the way that the command takes, and what is refused."""

import copy
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from spherloc import registry
from spherloc.cameras.double_sphere import DoubleSphere
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.cameras.mei import Mei
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.query_gravity import read_gravity
from spherloc.errors import CalibrationError, InputError
from spherloc.estimators import estimate
from spherloc.files import lock
from spherloc.formats.colmap_files import read_model
from spherloc.frontend import trained
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.geometry import camera_centre, rotation_angle, so3_exp
from spherloc.mapping.advice import COMMAND, PAGE, for_a_page
from spherloc.mapping.alignment.line_gravity import gravity_by_lines
from spherloc.mapping.alignment.stated_gravity import read_stated_gravity
from spherloc.mapping.alignment.upright import Level, level_of, scale_by_height, upright_frame
from spherloc.mapping.images.frames import frames_of
from spherloc.mapping.images.full_panorama import two_circles
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.lens import for_colmap
from spherloc.mapping.images.photographs import Photographs, is_called, photographs
from spherloc.mapping.make import make_map, scale_of
from spherloc.mapping.models.kept_models import FILE as KEPT_MODELS
from spherloc.mapping.models.later import place_rest
from spherloc.mapping.models.misplaced import far_off, without_misplaced
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc.mapping.scenes.new_images import NewImages, new_images_of
from spherloc.mapping.scenes.new_queries import add_new_images, map_images
from spherloc.mapping.scenes.scene_files import (
    MODEL,
    SCENE,
    UNITS_UNKNOWN,
    MapHead,
    _camera,
    _queries,
    check_images_of,
    write_new_scene,
)
from spherloc.mapping.scenes.written import _gravity
from spherloc.problem import Problem
from spherloc_viz.commands.image_commands import map as map_command
from spherloc_viz.commands.map import (
    _calibrated,
    _kind,
    _of_the_map_before,
    _sizes,
    _stages,
    _take_frames,
    distance_of,
    how_of,
    main,
    scale_of_words,
)
from spherloc_viz.commands.map_report import map_report, summary
from tests.waiting import LIMIT_S

IMAGES = ("reference_002", "reference_003", "reference_004", "reference_005", "reference_006")


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Five panoramas of a square, 5.9 m apart, their poses, and the map that is made of them."""
    folder = tmp_path_factory.mktemp("walk")
    scene = load_scene(bundled_scenes()["campus_panorama"])
    poses = {}
    for view in scene.references:
        if view.name in IMAGES:
            view.make_file()
            cv2.imwrite(str(folder / f"{view.name}.png"), cv2.imread(str(view.path)))
            poses[f"{view.name}.png"] = view.cam_from_map
    told = []
    first, second = sorted(poses)[:2]
    apart = float(np.linalg.norm(camera_centre(poses[first]) - camera_centre(poses[second])))
    masks = Masks(nadir_deg=12.0)
    found = photographs(folder, {}, masks)
    output = tmp_path_factory.mktemp("map")
    measured = ScaleMeasurement(distance=(first, second, apart))

    def again():
        new = NewImages(folder, None)
        return make_map(MapRequest(found.views, folder, measured, new, masks), output, lambda *what: told.append(what))

    return poses, found, again(), again, told, output


def cut_out(panorama, camera, panorama_from_camera):
    """The image (H, W) or (H, W, 3) that another camera takes where a panorama was taken."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    bearings, seen = camera.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    places, _ = panorama.camera.project(bearings @ panorama_from_camera.T)
    u, v = np.where(seen[:, None], places - 0.5, -1.0).astype(np.float32).T.reshape(2, camera.height, -1)
    return cv2.remap(panorama.read(), u, v, cv2.INTER_LINEAR)


def test_a_map_has_the_poses_of_the_photographs(walk):
    """To scale and upright; yaw and origin are the map's own."""
    poses, _, made, *_ = walk
    assert sorted(made.written.poses) == sorted(poses)
    names = sorted(poses)
    true = np.stack([camera_centre(poses[name]) for name in names])
    centres = np.stack([camera_centre(made.written.poses[name]) for name in names])
    for i, one in enumerate(names):
        for j, other in enumerate(names[:i]):
            assert np.linalg.norm(centres[i] - centres[j]) == pytest.approx(np.linalg.norm(true[i] - true[j]), rel=0.08)
            turn = made.written.poses[one][:, :3] @ made.written.poses[other][:, :3].T
            assert rotation_angle(turn @ poses[other][:, :3] @ poses[one][:, :3].T) < np.radians(0.5)
        lean = made.written.poses[one][:, :3] @ [0, 0, 1] @ (poses[one][:, :3] @ [0, 0, 1])
        assert np.degrees(np.arccos(min(1.0, lean))) < 1.0  # the rendered map has z up, too
    assert (
        made.scale.source.startswith("reference_002.png and reference_003.png are 5.")
        and made.level.source == "vertical lines of 5 images"
    )
    assert not made.made.contradictions and not made.level.leaning


def test_panoramas_straight_ahead_of_each_other_are_mapped(walk, tmp_path):
    """All three on one line along the optical axis, with which COLMAP by itself starts no map."""
    poses, found, *_ = walk
    views = [view for view in found.views if view.name[:-4] in IMAGES[2:]]
    for one, other in pairwise(views):
        turn = poses[other.name][:, :3] @ poses[one.name][:, :3].T
        way = poses[other.name][:, 3] - turn @ poses[one.name][:, 3]
        assert abs(way[2]) > 0.99 * np.linalg.norm(way)
    made = make_map(MapRequest(views, views[0].path.parent), tmp_path / "map")
    assert len(made.written.poses) == 3


@pytest.mark.parametrize(("installed", "features"), [(True, "sift+aliked"), (False, "sift")])
def test_the_best_installed_features_are_matched(monkeypatch, installed, features):
    monkeypatch.setattr(trained, "installed", lambda: installed)
    how = how_of()
    assert (how.features.method, how.matching.method) == (features, "lightglue" if installed else "nearest")
    assert how_of("sift").features.method == "sift"
    if not installed:
        with pytest.raises(InputError, match=r"--features aliked needs the extra 'learned' .*or give --features sift"):
            how_of("aliked")


def test_its_scenes_open(walk):
    _, _, made, _, _, output = walk
    scene = load_scene(made.written.scene)
    assert [view.name for view in scene.queries] == ["reference_005.png"]
    assert scene.gravity_map.tolist() == [0, 0, -1]
    problem = scene.problem()
    assert isinstance(problem, Problem) and problem.truth_inliers.sum() > 30
    new = load_scene(made.written.new_scene)
    assert len(new.queries) == 5 and len(new.references) == 5 and new.queries[0].camera == scene.queries[0].camera
    assert len(read_model(output / "model").images) == 5
    for view in (scene.queries[0], scene.references[0], new.queries[0]):  # the mask of the map is that of the scenes
        assert not view.usable_pixels()[-1].any() and view.usable_pixels()[200].all()


def test_gravity_that_a_file_states_goes_before_that_of_lines(walk, tmp_path):
    poses, found, *_, output = walk
    names = sorted(poses)
    rows = [" ".join(map(str, (name, *(9.8 * poses[name][:, :3] @ [0, 0, -1]), 0.5))) for name in names[:3]]
    (tmp_path / "gravity.txt").write_text("\n".join([*rows, "else.png 0 1 0"]))
    stated = read_stated_gravity(tmp_path / "gravity.txt", None, found.views)
    strange, without = stated.remarks
    assert "1 of its 4 rows belong to none of the photographs, the first is else.png" in strange
    assert "2 of 5 photographs have no gravity there, the first is reference_005.png" in without
    shutil.copytree(output, tmp_path / "map")
    images = found.views[0].path.parent
    new = NewImages(images, None)
    made = make_map(MapRequest(found.views, images, new_images=new, stated=stated), tmp_path / "map")
    assert made.level.source == "the gravity file of 3 images and vertical lines of 2 images"
    assert sorted(made.stated) == names[:3] and sorted(made.lines.found) == names[3:]
    assert "in doubt" not in "".join(summary(made, found))
    up = replace(made, written=replace(made.written, points=made.written.points * [1.0, 1.0, -1.0] + [0.0, 0.0, 9.0]))
    assert "of the points are above the cameras; the stated gravity must point down" in "".join(summary(up, found))
    doubted = replace(made, doubts=("gravity.txt: its gravity points <up>.",))
    assert "in doubt      gravity.txt: its gravity points <up>." in summary(doubted, found)
    assert '<p class="out">In doubt: gravity.txt: its gravity points &lt;up&gt;.</p>' in map_report(doubted, found)
    page = map_report(made, found)
    assert "<td>the gravity file, at most 1.5° off</td>" in page and "<td>lines of the image, at most " in page
    for name in names:
        lean = made.written.poses[name][:, :3] @ [0, 0, 1] @ (poses[name][:, :3] @ [0, 0, 1])
        assert np.degrees(np.arccos(min(1.0, lean))) < 0.5
    known = {view.name: view.gravity for view in load_scene(made.written.new_scene).queries}
    assert [name for name in names if known[name] is not None] == names[:3]
    assert known[names[0]].source == "the gravity file"
    alone = level_of(made.written.poses, {names[1]: stated.found[names[1]]})
    assert alone.source == "the gravity file of 1 image" and not alone.by_lines

    (tmp_path / "none.txt").write_text("else.png 0 1 0")
    with pytest.raises(InputError, match=r"none of the 5 photographs; it names 'else.png'; .* such as 'reference_0"):
        read_stated_gravity(tmp_path / "none.txt", None, found.views)


def test_one_command_localizes_new_photographs(walk, tmp_path, monkeypatch, capsys):
    """Those of the map itself; the same command again finds them done, and a map in metres of its own has its own."""
    _, found, *_, output = walk
    images = found.views[0].path.parent
    shutil.copytree(output, tmp_path / "map")
    monkeypatch.chdir(tmp_path)
    given = {"output": Path("map"), "localize": images, "nadir": 12.0, "features": "sift"}
    results = Path("recordings") / f"map_{images.name}_auto_0"
    assert map_command(images, distance=("reference_002.png", "reference_003.png", "3"), **given) == 0
    told = capsys.readouterr().out
    assert "5 of 5 queries are localized" in told and f"written to {results}" in told
    (place,) = (line for line in told.splitlines() if line.startswith("  reference_002.png: localized, at ("))
    assert "3 m from reference_003.png" in place and re.search(r", \d+ of \d+ matches agree", place)
    assert told.splitlines()[-1] == f"see it        spherloc play {Path('map') / images.name}.toml"
    assert len(list((results / "recordings").glob("*.rrd"))) == 5
    assert map_command(images, **given) == 0
    told = capsys.readouterr()
    assert f"{results}: 5 of 5 queries are done already" in told.err and "see it" in told.out
    assert map_command(images, distance=("reference_002.png", "reference_003.png", "6"), **given) == 0
    told = capsys.readouterr()
    assert f"those of this one go to {results}_2" in told.err and f"written to {results}_2" in told.out
    one, other = (np.loadtxt(folder / "trajectory.tum")[:, 1:4] for folder in (results, Path(f"{results}_2")))
    assert np.linalg.norm(np.diff(other, axis=0)) == pytest.approx(2.0 * np.linalg.norm(np.diff(one, axis=0)), rel=0.02)


def test_the_log_of_an_imu_levels_a_map(walk, tmp_path):
    """At rest its forces point up; the pictures were taken at the times in their names."""
    _, found, *_ = walk
    start = 1_625_133_000_000_000_000
    turn = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    down = np.array([0.1, 0.99, 0.05])
    force = -9.81 * turn.T @ down / np.linalg.norm(down)
    rows = [f"{start + k * 10_000_000},0,0,0,{force[0]},{force[1]},{force[2]}" for k in range(1000)]
    (tmp_path / "imu.csv").write_text("\n".join(rows))
    views = [replace(view, name=f"{start + 10**9 * (1 + 3 * k)}.png") for k, view in enumerate(found.views)]
    stated = read_stated_gravity(tmp_path / "imu.csv", turn, views)
    assert list(stated.found) == [view.name for view in views[:3]], "the log has ten seconds"
    for one in stated.found.values():
        np.testing.assert_allclose(one.down, down / np.linalg.norm(down), atol=1e-3)
        assert one.bound_rad == pytest.approx(np.radians(2.0)) and one.source == "the IMU"
    (remark,) = stated.remarks
    assert "imu.csv: 2 of 5 photographs have no gravity there" in remark
    level = Level(np.array([0.0, 1.0, 0.0]), "the IMU of 3 images", 0.2, {})
    lines = tomllib.loads("\n".join(_gravity(level, stated, tmp_path)))["gravity"]
    settings = read_gravity({key: value for key, value in lines.items() if key != "map"}, str(tmp_path / "s.toml"), 2.0)
    assert settings.imu is not None and np.array_equal(settings.imu.camera_from_imu, turn)
    with pytest.raises(InputError, match="each needs a time in its name"):
        read_stated_gravity(tmp_path / "imu.csv", turn, found.views)
    several = [replace(views[0], camera=Equirectangular(400, 200)), *views[1:]]
    with pytest.raises(InputError, match="are of 2 cameras, each of which is turned otherwise to the IMU"):
        read_stated_gravity(tmp_path / "imu.csv", turn, several)
    with pytest.raises(InputError, match="--camera-from-imu goes with --gravity FILE"):
        map_command(tmp_path, camera_from_imu=(0, -1, 0, 0, 0, -1, 1, 0, 0))
    with pytest.raises(InputError, match=r"imu\.csv: camera_from_imu is not a rotation"):
        map_command(tmp_path, gravity=tmp_path / "imu.csv", camera_from_imu=(0, -1, 0, 0, 0, -1, 2, 0, 0))


def test_images_are_added_to_a_map_that_is_made(walk, tmp_path):
    """The scene is the one that is written when the map is made with them."""
    _, found, made, _, _, _ = walk
    written, images = tomllib.loads(made.written.new_scene.read_text()), found.views[0].path.parent
    for scene in (made.written.scene, made.written.new_scene):
        assert add_new_images(scene, images) == (made.written.new_scene, ())
        assert tomllib.loads(made.written.new_scene.read_text()) == written
    assert map_images(made.written.scene).resolve() == images.resolve()
    some = tmp_path / "some"
    some.mkdir()
    (some / "a.png").write_bytes(found.views[0].path.read_bytes())
    (some / "b.png").write_bytes(b"no image")
    path, remarks = add_new_images(made.written.new_scene, some)
    assert path.name == "some.toml" and "1 image was left out, damaged or empty: b.png" in remarks[0]
    new = load_scene(path)
    assert [view.name for view in new.queries] == ["a.png"] and new.name == f"some in {images.name}"
    with pytest.raises(InputError, match=r"campus_panorama\.toml: is not the scene of a map"):
        add_new_images(bundled_scenes()["campus_panorama"], some)


def test_a_fisheye_is_localized_in_a_map_of_panoramas(walk, tmp_path):
    """Cut out of a panorama of the map, so that its pose there is known; its calibration lies beside it."""
    _, found, made, _, _, _ = walk
    lens = KannalaBrandt(500, 400, 150.0, 150.0, 250.0, 200.0, (0.01, 0.0, 0.0, 0.0))
    view, turn = found.views[1], so3_exp(np.array([0.1, 0.8, 0.0]))
    cv2.imwrite(str(tmp_path / "a.png"), cut_out(view, lens, turn))
    (tmp_path / "lens.toml").write_text("\n".join(["[camera]", *_camera(lens)]))
    path, _ = add_new_images(made.written.scene, tmp_path)
    try:
        scene = load_scene(path)
        pose = estimate(scene.problem(), "auto").cam_from_map
    finally:
        path.unlink()
    expected = turn.T @ made.written.poses[view.name]
    assert rotation_angle(pose[:, :3] @ expected[:, :3].T) < np.radians(0.3)
    assert np.linalg.norm(camera_centre(pose) - camera_centre(expected)) < 0.05


def test_what_is_done_is_not_done_again(walk):
    _, _, made, again, told, _ = walk
    assert ("pairs of images matched", 10, 10) in told
    told.clear()
    repeated = again()
    assert not any(what[0] == "pairs of images matched" for what in told)
    assert repeated.written.poses.keys() == made.written.poses.keys()
    assert len(repeated.written.points) == len(made.written.points)
    for name, pose in made.written.poses.items():
        np.testing.assert_array_equal(repeated.written.poses[name], pose)
    np.testing.assert_array_equal(repeated.written.points, made.written.points)


def test_models_are_kept_for_the_same_photographs_only(walk, tmp_path, monkeypatch):
    """Another scale takes them, too; a photograph that changed, another gravity, or a damaged file does not."""
    _, found, made, _, _, output = walk
    folder, images = tmp_path / "map", tmp_path / "photographs"
    shutil.copytree(output, folder)
    shutil.copytree(found.views[0].path.parent, images)  # with the times of the files
    views = [replace(view, path=images / view.path.name) for view in found.views]
    content = (folder / KEPT_MODELS).read_bytes()

    def asked(changed, stated=None):
        (folder / KEPT_MODELS).write_bytes(content)
        return make_map(MapRequest(changed, images, masks=Masks(nadir_deg=12.0), stated=stated), folder)

    def refuse(*_):
        raise InputError("made again")

    monkeypatch.setattr("spherloc.mapping.checked_models.reconstruct", refuse)
    unscaled = asked(views)
    assert not unscaled.scale.source
    share = np.linalg.norm(unscaled.written.points, axis=1) / np.linalg.norm(made.written.points, axis=1)
    np.testing.assert_allclose(share, share[0])
    gravity = tmp_path / "gravity.txt"
    gravity.write_text("".join(f"{view.name} 0 1 0\n" for view in views))
    for change in ("gravity", "photograph", "damage"):
        if change == "photograph":
            os.utime(views[0].path, (1.0, 1.0))
        if change == "damage":
            shutil.copystat(found.views[0].path, views[0].path)
            content = content[:2000] + bytes(100) + content[2100:]
        with pytest.raises(InputError, match="made again"):
            asked(views, read_stated_gravity(gravity, None, views) if change == "gravity" else None)
        assert not (folder / KEPT_MODELS).exists()


def test_the_report_says_what_is_in_the_map(walk):
    _, found, made, *_ = walk
    page = map_report(made, found)
    assert "5 of 5" in page and "Not in the map" not in page and "data:image/png;base64," in page
    smaller = map_report(replace(made, written=_less(made.written, "reference_004.png")), found)
    assert "4 of 5" in smaller and "reference_004.png: It has " in smaller
    alone = made.made.matches.copy()
    alone[3:, :3] = alone[:3, 3:] = 0
    pair = replace(made, made=replace(made.made, matches=alone), written=made.written)
    for name in ("reference_005.png", "reference_006.png"):
        pair = replace(pair, written=_less(pair.written, name))
    said = r"reference_006.png: It has [\d,]+ matches with reference_005.png, which is not in the map either"
    assert re.search(said, map_report(pair, found))
    off = replace(made, scale=replace(made.scale, off_m={"reference_003.png": 1.239}))
    assert "1.24 m" in map_report(off, found) and "off its position" not in page
    names = sorted(made.written.poses)
    off = replace(made, scale=replace(made.scale, off_m=dict(zip(names, (0.02, 0.03, 6.24, 0.02, 9.5), strict=True))))
    told = f"far from the given positions: {names[4]} 9.50 m, {names[2]} 6.24 m; the map is wrong there"
    assert told in "".join(summary(off, found)) and f"Images {told}" in map_report(off, found)
    assert "in doubt" not in "".join(summary(made, found))
    other = replace(made, corrected_rad=np.radians(2.96), doubts=("whether the lens is right",))
    for said in ("\n".join(summary(other, found)), map_report(other, found)):
        assert "corrected by up to 3.0°" in said and re.search("[Ii]n doubt:? +whether the lens is right", said)
    assert "corrected" not in page


def test_a_distance_to_an_image_that_is_not_in_the_map_leaves_the_units_unknown(walk):
    """The work is done by then, so that the map is written all the same, and says why."""
    _, _, made, *_ = walk
    name, other = sorted(made.written.poses)[:2]
    less = replace(made.made, poses={key: pose for key, pose in made.made.poses.items() if key != name})
    scale = scale_of(less, made.level, ScaleMeasurement(distance=(name, other, 5.9)))
    assert scale.source == "" and f"'{name}' did not get into the map" in scale.why_unknown
    assert scale_of(made.made, made.level, ScaleMeasurement(distance=(name, other, 5.9))).metres_per_unit > 0.0
    centres = {number: made.made.model.image(number).projection_center() for number in made.made.model.reg_image_ids()}
    far = np.array([
        [reach([np.linalg.norm(point.xyz - centres[seen.image_id]) for seen in point.track.elements])
         for reach in (min, max)]
        for point in made.made.model.points3D.values()
    ])  # fmt: skip
    nearest, farthest = scale.metres_per_unit * np.median(far, axis=0)
    assert nearest < 10.0 < farthest < 20.0  # units


def test_a_scale_that_was_given_in_millimetres_is_doubted(walk):
    pycolmap = registry.require("pycolmap", "colmap", "making a map")
    _, found, made, *_ = walk
    for larger, doubted in ((1.0, False), (1000.0, True), (0.001, True)):
        model = copy.deepcopy(made.made.model)
        model.transform(pycolmap.Sim3d(larger, pycolmap.Rotation3d(), np.zeros(3)))
        given = replace(made, made=replace(made.made, model=model))
        said = [line for line in summary(given, found) if "whether the scale was given in metres" in line]
        assert bool(said) == doubted == ("whether the scale was given in metres" in map_report(given, found))
        unknown = replace(given, scale=replace(made.scale, source=""))
        assert not any("given in metres" in line for line in summary(unknown, found))


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
    (tmp_path / "left" / "lens.toml").write_text(written(lens))
    (tmp_path / "right.toml").write_text(written(other))
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
    (flat / "slam_left.toml").write_text(written(lens))
    (flat / "slam_right.toml").write_text(written(other))
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


@pytest.fixture(scope="module")
def rig(walk, tmp_path_factory):
    """Two fisheyes at each place of the walk, cut from its panorama, one looking a right angle to the left."""
    poses, panoramas, *_ = walk
    folder, cut = tmp_path_factory.mktemp("rig"), {}
    front = KannalaBrandt(480, 480, 150.0, 150.0, 240.0, 240.0, (0.0, 0.0, 0.0, 0.0))
    left = KannalaBrandt(512, 400, 140.0, 141.0, 250.0, 205.0, (0.01, 0.0, 0.0, 0.0))
    for camera, name, turn_rad in ((front, "front", 0.0), (left, "left", -np.pi / 2)):
        (folder / name).mkdir()
        (folder / f"{name}.toml").write_text(written(camera))
        panorama_from_camera = so3_exp(np.array([0.0, turn_rad, 0.0]))
        for view in panoramas.views:
            cv2.imwrite(str(folder / name / view.name), cut_out(view, camera, panorama_from_camera))
            cut[f"{name}/{view.name}"] = panorama_from_camera.T @ poses[view.name]
    return folder, cut


def test_a_map_of_the_cameras_of_a_rig(rig, tmp_path):
    folder, poses = rig
    found = photographs(folder, {})
    made = make_map(MapRequest(found.views, folder), tmp_path)
    names = sorted(made.written.poses)
    assert len(names) >= 8 and len({name.partition("/")[0] for name in names}) == 2
    first = names[0]
    for name in names[1:]:
        turn = made.written.poses[name][:, :3] @ made.written.poses[first][:, :3].T
        assert rotation_angle(turn @ poses[first][:, :3] @ poses[name][:, :3].T) < np.radians(1.5), name
    scene = load_scene(made.written.scene)
    lenses = {view.name: view.camera for view in (*scene.queries, *scene.references)}
    assert {(lens.width, lens.height) for lens in lenses.values()} == {(480, 480), (512, 400)}
    problem = scene.problem()
    assert isinstance(problem, Problem) and problem.truth_inliers.sum() > 30
    assert "of 2 cameras" in _kind(found.views)
    path, _ = add_new_images(made.written.scene, folder)
    assert {view.name for view in load_scene(path).queries} == set(poses)
    for name in ("front", "left"):  # as of lenses that the photographs told: of one of them, of both
        (folder / f"{name}.toml").rename(tmp_path / f"{name}.toml")
        path, _ = add_new_images(made.written.scene, folder)
        told = {view.name: view.camera.width for view in load_scene(path).queries}
        assert told == {name: 480 if name.startswith("front") else 512 for name in poses}
    for name in ("front", "left"):
        (tmp_path / f"{name}.toml").rename(folder / f"{name}.toml")


def test_a_job_tells_what_went_wrong_in_a_line(tmp_path, rng, capsys):
    picture(tmp_path / "a.png", 400, 300, rng)
    assert main(tmp_path, tmp_path / "map") == 1
    (said,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert "put their calibration beside them, into that folder, and make the map again" in said["error"]
    with pytest.raises(InputError, match="give it with --camera FILE"):
        photographs(tmp_path, {})


def test_what_a_map_says_on_the_page_names_no_options(walk):
    """Errors, remarks and the summary: all words about options are those of ``advice``."""
    assert PAGE.keys() == COMMAND.keys() and not [words for words in PAGE.values() if "--" in words]
    sources = [path for path in Path(make_map.__code__.co_filename).parent.rglob("*.py") if path.name != "advice.py"]
    assert len(sources) > 10 and not [path for path in sources if re.search(r"--[a-z]", path.read_text("utf-8"))]
    _, found, made, *_ = walk
    unknown = replace(made, scale=replace(made.scale, source="", why_unknown=""), carried_deg=20.0)
    with for_a_page():
        on_the_page = summary(unknown, found)
    assert not [line for line in on_the_page if "--" in line]
    assert sum("--" in line for line in summary(unknown, found)) == 3


def _less(written, name):
    poses = {key: value for key, value in written.poses.items() if key != name}
    return replace(written, poses=poses)


def written(camera):
    rows = camera.to_dict().items()
    return "[camera]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in rows)


def picture(path, width, height, rng):
    assert cv2.imwrite(str(path), rng.integers(0, 255, (height, width), np.uint8))


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


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of the size of files")
def test_a_full_disk_is_told_in_a_sentence_and_what_is_done_is_kept(walk, tmp_path):
    """In a process of its own, since only that has the limit, and since pycolmap could end it."""
    limited = (
        "import resource, sys\nfrom pathlib import Path\nfrom spherloc_viz.commands.map import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
        "sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))"
    )
    command = [sys.executable, "-c", limited, str(walk[1].views[0].path.parent), str(tmp_path / "map")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 1, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])["error"]
    assert "cannot be written" in said and "make room there and make the map again" in said
    assert list((tmp_path / "map").glob("matches_*.db"))


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


def test_progress_follows_a_number_of_pieces_that_grows(monkeypatch, capsys):
    """As that of joins of maps, whose number is not known before."""
    monkeypatch.setattr("spherloc_viz.commands.progress.LINE_EVERY_S", -1.0)
    with _stages() as tell:
        for number in range(1, 4):
            tell("joins of maps tried", number, number)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"spherloc: {number} of {number} joins of maps tried." for number in range(1, 4)]


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


def test_images_far_from_all_others_are_named():
    """One that is three times as far from the nearest as any two others are from each other; of few images none."""
    poses = {f"{at}.png": np.column_stack([np.eye(3), [-at, 0.0, 0.0]]) for at in (0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 30.0)}
    assert far_off(poses) == {"30.0.png"}
    poses["-200.png"] = np.column_stack([np.eye(3), [0.0, 200.0, 0.0]])
    assert far_off(poses) == {"30.0.png", "-200.png"}
    near = {name: pose for name, pose in poses.items() if name not in ("30.0.png", "-200.png")}
    assert far_off(near | {"10.0.png": np.column_stack([np.eye(3), [-27.0, 0.0, 0.0]])}) == set()
    assert far_off({name: poses[name] for name in ("0.0.png", "1.0.png", "2.0.png", "30.0.png")}) == set()


def test_an_image_that_stands_otherwise_than_its_pairs_say_is_left_out(walk):
    """By the rotations of its pairs in the map, or since the image that matches it best did not get into that."""
    poses, _, _, again, *_ = walk
    whole = again().made
    names, place = sorted(whole.poses), {name: index for index, name in enumerate(whole.ids)}
    pairs = [pair for pair in combinations(names, 2) if whole.matches[place[pair[0]], place[pair[1]]]]
    rotations = {(one, other): poses[other][:, :3] @ poses[one][:, :3].T for one, other in pairs}
    assert without_misplaced(whole, rotations) is whole

    def left_out(made, angle_deg, matches):
        turn = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
        turned = made.poses | {names[-1]: turn @ made.poses[names[-1]]}
        changed = replace(made, model=copy.deepcopy(made.model), poses=turned, matches=matches)
        return made.poses.keys() - without_misplaced(changed, rotations).poses.keys()

    assert left_out(whole, 5.0, whole.matches) == set() and left_out(whole, 40.0, whole.matches) == {names[-1]}
    first, second, last = (place[names[at]] for at in (0, 1, -1))
    few = np.zeros_like(whole.matches)
    for one, other, count in ((first, second, 300), (second, last, 100), (first, last, 90)):
        few[one, other] = few[other, one] = count
    rotations |= {(names[0], names[1]): poses[names[1]][:, :3] @ poses[names[0]][:, :3].T}
    rotations |= {(names[0], names[-1]): poses[names[-1]][:, :3] @ poses[names[0]][:, :3].T}
    rotations |= {(names[1], names[-1]): poses[names[-1]][:, :3] @ poses[names[1]][:, :3].T}
    assert left_out(whole, 0.0, few) == set()
    made = replace(whole, model=copy.deepcopy(whole.model)).without([names[1]])
    assert names[0] in left_out(made, 0.0, few)  # 90 matches for its place, and 300 with an image that is not there


def test_an_image_that_was_left_out_is_placed(walk, capfd):
    """Where it was, and from there COLMAP triangulates, silently; one that is said to be elsewhere stays out."""
    _, found, _, again, *_ = walk
    made, name, tell = again(), "reference_004.png", lambda *what: None
    unit = made.written.poses
    before = unit[name]
    gravity = gravity_by_lines(found.views, tell).found
    level = level_of(unit, gravity)
    less = replace(made.made, poses=unit).without([name])  # what was written was levelled and scaled
    assert place_rest(less, found.views, [name], gravity, level, tell) is less
    more = place_rest(less, found.views, (), gravity, level, tell)
    assert capfd.readouterr() == ("", "")
    assert sorted(more.poses) == sorted(unit)
    apart = np.linalg.norm(camera_centre(unit["reference_003.png"]) - camera_centre(unit["reference_005.png"]))
    names = sorted(unit)
    centres = [np.stack([camera_centre(poses[one]) for one in names]) for poses in (unit, more.poses)]
    lengths = [np.linalg.norm(one[:, None] - one[None], axis=2) for one in centres]
    scale = lengths[1].sum() / lengths[0].sum()
    assert np.abs(lengths[1] / scale - lengths[0]).max() < 0.02 * apart
    turn = more.poses[name][:, :3] @ more.poses[names[0]][:, :3].T
    assert rotation_angle(turn @ unit[names[0]][:, :3] @ before[:, :3].T) < np.radians(0.5)


def test_images_that_lean_against_the_map_are_told(walk):
    _, found, made, *_ = walk
    turned = dict(made.written.poses)
    name = sorted(turned)[2]
    turned[name] = np.column_stack([so3_exp(np.array([0.1, 0.0, 0.0])) @ turned[name][:, :3], turned[name][:, 3]])
    level = level_of(turned, gravity_by_lines(found.views, lambda *what: None).found)
    assert list(level.leaning) == [name] and level.leaning[name] == pytest.approx(np.degrees(0.1), abs=1.0)


def test_why_lines_give_no_gravity_is_told_of_each_image(walk, tmp_path):
    """In the summary of the first one, in the report of each, and with the number that is needed for a map."""
    _, found, made, *_ = walk
    assert made.lines.found.keys() == made.written.poses.keys() and not made.lines.why_not
    assert "no gravity" not in "".join(summary(made, found)) and "<td>lines of the image, at most " in map_report(
        made, found
    )
    name = sorted(made.lines.found)[1]
    assert cv2.imwrite(str(tmp_path / "blank.png"), np.full((200, 400), 90, np.uint8))
    blank = replace(found.views[1], path=tmp_path / "blank.png", camera=Equirectangular(400, 200), mask=None)
    lines = gravity_by_lines([found.views[0], blank], lambda *what: None)
    assert list(lines.found) == [found.views[0].name]
    assert lines.why_not == {name: "it has 0 straight edges, fewer than 5."}
    others = {key: value for key, value in made.lines.found.items() if key != name}
    told = replace(made, lines=replace(made.lines, found=others, why_not=lines.why_not))
    assert f"<td>none from its lines: {lines.why_not[name]}</td>" in map_report(told, found)
    (said,) = [line for line in summary(told, found) if line.startswith("no gravity ")]
    assert said.endswith(f"the lines of 1 of 5 images (see the report), such as {name}: {lines.why_not[name]}")
    level = level_of(made.written.poses, lines.found)
    assert level.source.endswith("vertical lines show it in 1 of 5 images and 3 are needed")


def test_photographs_of_an_unknown_camera_are_told_by_size(tmp_path, rng):
    for name, size in (("a.png", (64, 48)), ("b.png", (60, 60)), ("c.png", (64, 48))):
        picture(tmp_path / name, *size, rng)
    told = "2 of 64 x 48 pixels, 1 of 60 x 60 pixels, are not full panoramas .* calibrations of all"
    with pytest.raises(InputError, match=told):
        photographs(tmp_path, {})


def test_the_height_of_the_cameras_gives_the_scale(rng):
    """Cameras 1.6 m above a floor, in a model whose unit is 0.4 m and whose up is anywhere."""
    turn = so3_exp(np.array([0.3, -0.8, 0.5]))
    floor = np.column_stack([rng.uniform(-3, 3, (2000, 2)), rng.normal(0, 0.01, 2000)])
    walls = np.column_stack([rng.uniform(-3, 3, 2000), np.full(2000, 3.0), rng.uniform(0, 2.5, 2000)])
    table = np.column_stack([rng.uniform(-1, 1, (500, 2)), np.full(500, 0.75)])
    wrong = np.column_stack([rng.uniform(-3, 3, (1000, 2)), rng.uniform(-7, 0, 1000)])
    points = np.concatenate([floor, walls, table, wrong]) @ turn.T / 0.4
    centres = np.column_stack([np.linspace(-2, 2, 5), np.zeros(5), np.full(5, 1.6)]) @ turn.T / 0.4
    poses = {str(index): np.column_stack([np.eye(3), -centre]) for index, centre in enumerate(centres)}
    level = Level(turn @ [0.0, 0.0, -1.0], "a test", 0.0, {})
    scale = scale_by_height(poses, points, level, 1.6)
    assert scale.metres_per_unit == pytest.approx(0.4, rel=0.01)
    assert re.search(r"which 1,\d\d\d of [\d,]+ points below them show to 0\.\d%", scale.source)
    np.testing.assert_allclose(upright_frame(level) @ level.down, [0, 0, -1], atol=1e-12)
    with pytest.raises(InputError, match="too few to find the ground"):
        scale_by_height(poses, points[2000:4000], level, 1.6)
    with pytest.raises(InputError, match="lie at all depths"):
        scale_by_height(poses, points[4500:], level, 1.6)


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


def test_scenes_of_the_map_before_are_told(walk):
    _, _, made, *_ = walk
    folder = made.written.scene.parent
    other, text = folder / "other.toml", made.written.new_scene.read_text()
    other.write_text(text)
    try:
        assert _of_the_map_before(folder, made) == []
        other.write_text(text.replace("points. Units are", "points, as yesterday. Units are"))
        assert _of_the_map_before(folder, made) == ["other.toml"]
        assert load_scene(other).metric
        other.write_text(text.replace('units = "metres"', 'units = "unknown"'))
        with pytest.raises(InputError, match=r"units is 'unknown', but scene\.toml beside it has 'metres' for the"):
            load_scene(other)
    finally:
        other.unlink()


def test_a_distance_is_two_images_and_metres():
    assert distance_of(()) is None and distance_of(("a.jpg", "b.jpg", "12.5")) == ("a.jpg", "b.jpg", 12.5)
    for words in (("a.jpg", "b.jpg"), ("a.jpg", "b.jpg", "far"), ("a.jpg", "b.jpg", "3", "folder")):
        with pytest.raises(InputError, match=r"--distance is '.*'; give two images and the metres between them"):
            distance_of(words)


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


def test_all_folders_of_a_folder_count(tmp_path, rng):
    camera = KannalaBrandt(40, 30, 9.0, 9.0, 20.0, 15.0, (0.0,) * 4)
    for number in range(60):
        (tmp_path / f"{number:02}").mkdir()
        picture(tmp_path / f"{number:02}" / "a.png", 40, 30, rng)
    assert len(photographs(tmp_path, {"lens": camera}).views) == 60


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
