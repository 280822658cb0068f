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
from image_samples import camera_file
from scipy.spatial.transform import Rotation

from spherloc import registry
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.datasets.query_gravity import read_gravity
from spherloc.errors import InputError, StoppedError
from spherloc.estimators import estimate
from spherloc.formats.colmap_files import read_model
from spherloc.frontend import trained
from spherloc.frontend.masks import Masks
from spherloc.geometry import camera_centre, rotation_angle, so3_exp
from spherloc.mapping.advice import COMMAND, PAGE, for_a_page
from spherloc.mapping.alignment.line_gravity import gravity_by_lines
from spherloc.mapping.alignment.stated_gravity import read_stated_gravity
from spherloc.mapping.alignment.upright import Level, level_of, scale_by_height, upright_frame
from spherloc.mapping.checked_models import checked_models
from spherloc.mapping.images.photographs import photographs
from spherloc.mapping.make import make_map, scale_of
from spherloc.mapping.models.kept_models import FILE as KEPT_MODELS
from spherloc.mapping.models.later import place_rest
from spherloc.mapping.models.misplaced import far_off, without_misplaced
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc.mapping.scenes.new_images import NewImages
from spherloc.mapping.scenes.new_queries import add_new_images, map_images
from spherloc.mapping.scenes.scene_files import (
    _camera,
)
from spherloc.mapping.scenes.written import _gravity
from spherloc.problem import Problem
from spherloc_viz.commands.image_commands import map as map_command
from spherloc_viz.commands.map import (
    _kind,
    _of_the_map_before,
    how_of,
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


def test_what_was_masked_is_said(walk):
    _, found, made, *_ = walk
    assert "masked        12° around straight down" in summary(made, found)
    without = replace(made, masks=None)
    assert "masked" not in "".join(summary(without, found)) and "Masked" not in map_report(without, found)
    masked = replace(made, masks=Masks(Path("masks/car.png"), 25.0, 1.0))
    said = "what is black in car.png; 25° around straight down; 1° on both sides of the seam of two lenses"
    assert f"masked        {said}" in summary(masked, found) and said in map_report(masked, found)


def test_one_command_localizes_new_photographs(walk, tmp_path, monkeypatch, capsys):
    """Two of the map itself; the same command again finds them done, and a map in metres of its own has its own."""
    _, found, *_, output = walk
    images, new = found.views[0].path.parent, tmp_path / "new"
    new.mkdir()
    for view in found.views[:2]:
        shutil.copy(view.path, new)
    shutil.copytree(output, tmp_path / "map")
    monkeypatch.chdir(tmp_path)
    given = {"output": Path("map"), "localize": new, "nadir": 12.0, "features": "sift"}
    results = Path("recordings") / "map_new_auto_0"
    assert map_command(images, distance=("reference_002.png", "reference_003.png", "3"), **given) == 0
    told = capsys.readouterr().out
    assert "2 of 2 queries are localized" in told and f"written to {results}" in told
    (place,) = (line for line in told.splitlines() if line.startswith("  reference_002.png: localized, at ("))
    assert "3 m from reference_003.png" in place and re.search(r", [\d,]+ of [\d,]+ matches agree", place)
    assert told.splitlines()[-1] == f"see it        spherloc play {Path('map') / 'new'}.toml"
    assert len(list((results / "recordings").glob("*.rrd"))) == 2
    assert map_command(images, **given) == 0
    told = capsys.readouterr()
    assert f"{results}: 2 of 2 queries are done already" in told.err and "see it" in told.out
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
    with pytest.raises(InputError, match=r"the first is .*: it has no time, which its name may tell"):
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


def test_matches_that_were_not_taken_go_once_the_map_is_there(walk, monkeypatch):
    """As those of a first map whose lens was corrected: until then, a map that was stopped goes on from them."""
    _, _, _, again, _, output = walk
    unused = output / "matches_of_first.db"
    unused.touch()

    def checked(*given):
        return replace(checked_models(*given), unused=(unused,))

    def full(*given):
        raise StoppedError("the disk is full; make room.")

    monkeypatch.setattr("spherloc.mapping.make.checked_models", checked)
    with monkeypatch.context() as patch, pytest.raises(StoppedError):
        patch.setattr("spherloc.mapping.make.write_map", full)
        again()
    assert unused.exists()
    again()
    assert not unused.exists() and len(list(output.glob("matches_*_whole.db"))) == 1


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


@pytest.fixture(scope="module")
def rig(walk, tmp_path_factory):
    """Two fisheyes at each place of the walk, cut from its panorama, one looking a right angle to the left."""
    poses, panoramas, *_ = walk
    folder, cut = tmp_path_factory.mktemp("rig"), {}
    front = KannalaBrandt(480, 480, 150.0, 150.0, 240.0, 240.0, (0.0, 0.0, 0.0, 0.0))
    left = KannalaBrandt(512, 400, 140.0, 141.0, 250.0, 205.0, (0.01, 0.0, 0.0, 0.0))
    for camera, name, turn_rad in ((front, "front", 0.0), (left, "left", -np.pi / 2)):
        (folder / name).mkdir()
        (folder / f"{name}.toml").write_text(camera_file(camera))
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
        assert rotation_angle(turn @ poses[first][:, :3] @ poses[name][:, :3].T) < np.radians(2.5), name
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
