"""A map says whether the lens fits with which it was made: maps of points seen by fisheyes on a walk."""

from collections.abc import Callable
from math import radians
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.errors import InputError, StoppedError
from spherloc.frontend.view import View
from spherloc.geometry import so3_exp
from spherloc.mapping import checked_models as checks
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.models.lens_in_map import LensInMap, lens_in_map
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.request import MapRequest
from spherloc.mapping.scenes.new_images import NewImages
from spherloc.mapping.scenes.scene_files import lens_path, lenses_given, was_given, write_lenses

TRUE = KannalaBrandt(640, 640, 239.0, 239.0, 319.0, 322.0, (0.003, 0.001, 0.0, 0.0))
WRONG = KannalaBrandt(640, 640, 226.0, 226.0, 320.0, 321.0, (0.03, 0.0005, 0.0, 0.0))
"""Up to 2.6 degrees off between the middle of the field and its rim."""
POINTS, IMAGES, NOISE_PX = 500, 9, 0.3
Maps = Callable[..., Reconstruction]


@pytest.fixture
def maps(tmp_path: Path, rng: np.random.Generator) -> Maps:
    """Makes maps of a walk of ``count`` images along the optical axis, made with a camera; ``turned`` from side to side
    or not."""

    def mapped(camera: KannalaBrandt, *, turned: bool = True, count: int = IMAGES) -> Reconstruction:
        pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
        points = np.column_stack([rng.uniform(-4, 4, (POINTS, 2)), rng.uniform(0, 10, POINTS)])
        path, ids, poses, seen, visible = tmp_path / "matches.db", {}, {}, {}, {}
        described = pycolmap.Camera(
            model="OPENCV_FISHEYE",
            width=camera.width,
            height=camera.height,
            params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
        )
        with pycolmap.Database.open(str(path)) as database:
            described.camera_id = database.write_camera(described)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(described.sensor_id)
            rig_id = database.write_rig(rig)
            for number in range(count):
                name = f"{number}.png"
                yaw_rad = np.radians(20.0) * np.sin(2.0 * number) if turned else 0.0
                turn = so3_exp(np.array([0.02 * np.cos(number), yaw_rad, 0.0]) if turned else np.zeros(3))
                centre = np.array([0.1 * np.sin(number) if turned else 0.0, 0.0, 0.8 * number])
                poses[name] = np.column_stack([turn, -turn @ centre])
                pixels, inside = TRUE.project((points - centre) @ turn.T)
                seen[name] = np.nan_to_num(pixels) + rng.normal(0.0, NOISE_PX, pixels.shape)
                visible[name] = inside & np.all((pixels > 0) & (pixels < 640), axis=1)
                image = pycolmap.Image(name=name, camera_id=described.camera_id)
                image.image_id = ids[name] = database.write_image(image)
                frame = pycolmap.Frame()
                frame.rig_id = rig_id
                frame.add_data_id(image.data_id)
                database.write_frame(frame)
                database.write_keypoints(ids[name], seen[name].astype(np.float32))
            for one in poses:
                for other in poses:
                    if one < other:
                        both = np.flatnonzero(visible[one] & visible[other]).astype(np.uint32)
                        geometry = pycolmap.TwoViewGeometry()
                        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                        geometry.inlier_matches = np.column_stack([both, both])
                        database.write_matches(ids[one], ids[other], geometry.inlier_matches)
                        database.write_two_view_geometry(ids[one], ids[other], geometry)
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(described)
        for name, pose in poses.items():
            image = pycolmap.Image(name=name, keypoints=seen[name], camera_id=described.camera_id, image_id=ids[name])
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for number, point in enumerate(points):
            track = pycolmap.Track()
            elements = [ids[name] for name in poses if visible[name][number]]
            for element in elements:
                track.add_element(element, number)
            if len(elements) > 1:
                model.add_point3D(point, track, np.zeros(3, np.uint8))
        counts = np.zeros((count, count), np.int64)
        return Reconstruction(model, poses, counts, (), counts, path, ids)

    return mapped


def off_deg(camera: KannalaBrandt) -> float:
    """Largest difference of the angles to the optical axis from the true lens, within 75 degrees."""
    angles = np.radians(np.linspace(5.0, 75.0, 15))
    rays = np.column_stack([np.sin(angles), 0.0 * angles, np.cos(angles)])
    radii = TRUE.project(rays)[0][:, 0] - TRUE.cx
    found, _ = camera.unproject(np.column_stack([camera.cx + radii, np.full(len(radii), camera.cy)]))
    return float(np.degrees(np.abs(np.arctan2(np.hypot(found[:, 0], found[:, 1]), found[:, 2]) - angles).max()))


def asked(made: Reconstruction) -> LensInMap:
    found = lens_in_map(made, lambda *_: None)
    assert found is not None
    return found


def test_a_map_with_a_wrong_lens_tells_the_true_one(maps):
    made = maps(WRONG)
    before = {name: pose.copy() for name, pose in made.poses.items()}
    found = asked(made)
    assert off_deg(WRONG) > 1.5
    assert off_deg(found.camera) < 0.3
    assert np.degrees(found.moved_rad) > 1.0 > np.degrees(found.bound_rad)
    (camera,) = made.model.cameras.values()
    assert camera.model.name == "OPENCV_FISHEYE" and camera.params[0] == WRONG.fx, "the map itself stays as it is"
    for name, pose in before.items():
        now = made.model.image(made.ids[name]).cam_from_world().matrix()
        np.testing.assert_allclose(np.asarray(now), pose, atol=1e-12)


def test_a_map_with_the_true_lens_keeps_it(maps):
    found = asked(maps(TRUE))
    assert np.degrees(found.moved_rad) < 0.2
    assert off_deg(found.camera) < 0.2


def test_a_walk_straight_ahead_fixes_the_lens_less(maps, tmp_path):
    turned = asked(maps(TRUE))
    (tmp_path / "matches.db").unlink()
    straight = lens_in_map(maps(TRUE, turned=False), lambda *_: None)
    assert straight is None or straight.bound_rad > 5.0 * turned.bound_rad


def test_small_maps_and_other_cameras_are_not_asked(maps, tmp_path):
    assert lens_in_map(maps(TRUE, count=7), lambda *_: None) is None
    (tmp_path / "matches.db").unlink()
    of_calibration = KannalaBrandt(640, 640, 239.0, 240.0, 319.0, 322.0, (0.003, 0.001, 0.0, 0.0))
    assert lens_in_map(maps(of_calibration), lambda *_: None) is None


@pytest.fixture
def checked(monkeypatch, tmp_path):
    """What is made of a map with the lens ``WRONG`` of which lenses are said, one after another; ``anew`` is the number
    of images of the map that is made anew, None if it cannot be made."""

    def matches(name: str) -> Path:
        paths = [tmp_path / f"matches_{name}{end}.db" for end in ("", "_whole")]
        for path in paths:
            path.touch()
        return paths[1]

    def of(*said: tuple[float, float] | None, anew: int | None = 8):
        for left in tmp_path.glob("matches_*"):
            left.unlink()
        matches("of_other_settings")
        views = [View(f"{number}.png", WRONG, Path(f"{number}.png")) for number in range(8)]
        new = NewImages(tmp_path, (View("new.png", WRONG, Path("new.png")), View("other.png", TRUE, Path("other.png"))))
        request = MapRequest(views, tmp_path, new_images=new, lens=CalibratedLens(WRONG, "It was found."))
        before = SimpleNamespace(models=[SimpleNamespace(poses=dict.fromkeys(range(8)), database=matches("a"))])
        answers = [None if one is None else LensInMap(TRUE, radians(one[0]), radians(one[1])) for one in said]

        def built(*_):
            database = matches("b")
            if anew is None:
                raise InputError("COLMAP could not start a map.")
            return SimpleNamespace(models=[SimpleNamespace(poses=dict.fromkeys(range(anew)), database=database)])

        monkeypatch.setattr(checks, "lens_in_map", lambda *_: answers.pop(0))
        monkeypatch.setattr(checks, "_built", built)
        found, _ = checks._with_lens_of_map(
            tmp_path, checks.CheckedModels(request, before), request.lens, lambda *_: None
        )
        assert not answers
        return found, found.built is not before

    return of


def test_a_map_that_fits_another_lens_clearly_better_is_made_anew(checked):
    found, anew = checked((2.0, 0.02), (0.1, 0.02))
    assert anew and not found.doubts
    assert found.corrected_rad == radians(2.0)
    assert found.request.lens == CalibratedLens(
        TRUE,
        "It was found. A first map was fitted better by a lens whose directions differ by up to 2.0°, which is taken "
        "instead.",
    )
    assert {view.camera for view in found.request.views} == {TRUE}
    assert [view.camera for view in found.request.new_images.views] == [TRUE, TRUE]
    assert [path.name for path in found.unused] == ["matches_a.db", "matches_a_whole.db"]


def test_a_lens_that_fits_stays(checked):
    found, anew = checked((0.2, 0.02))
    assert not found.unused
    assert not anew and not found.doubts and not found.corrected_rad and found.request.lens.camera == WRONG
    found, anew = checked(None)
    assert not anew and not found.doubts


def test_what_a_map_does_not_tell_of_its_lens_is_a_doubt(checked):
    found, anew = checked((2.0, 1.0))
    assert not anew and found.request.lens.camera == WRONG
    assert "whether the lens, and so the shape of the map, is right" in found.doubts[0] and "5.0°" in found.doubts[0]
    found, anew = checked((2.0, 0.02), (1.2, 0.02))
    assert anew and "1.2°" in found.doubts[0]


@pytest.mark.parametrize("images", [7, None])
def test_a_map_that_is_worse_with_the_other_lens_is_not_taken(checked, images):
    said = [(2.0, 0.02)] if images is None else [(2.0, 0.02), (0.1, 0.02)]
    found, anew = checked(*said, anew=images)
    assert not anew and found.request.lens.camera == WRONG and not found.corrected_rad
    assert [path.name for path in found.unused] == ["matches_b.db", "matches_b_whole.db"]
    assert "2.0°" in found.doubts[0]


@pytest.mark.parametrize("said", [None, (2.0, 1.0), (0.2, 0.02)])
def test_a_lens_that_pairs_do_not_tell_must_be_told_by_the_map(monkeypatch, tmp_path, said):
    answer = None if said is None else LensInMap(TRUE, radians(said[0]), radians(said[1]))
    built = SimpleNamespace(models=[SimpleNamespace(poses=dict.fromkeys(range(8)))])
    monkeypatch.setattr(checks, "lens_in_map", lambda *_: answer)
    monkeypatch.setattr(checks, "_built", lambda *_: built)
    lens = CalibratedLens(WRONG, "It was tried.", "they do not tell their lens")
    request = MapRequest([View("a.png", WRONG, Path("a.png"))], tmp_path, lens=lens)
    if said == (0.2, 0.02):
        found = checks.checked_models(tmp_path, request, lambda *_: None)
        assert found.built is built and found.doubts == (checks.UNTOLD_DOUBT,)
        return
    with pytest.raises(InputError, match=r"have no calibration, and they do not tell their lens\. Or .*--camera"):
        checks.checked_models(tmp_path, request, lambda *_: None)


def test_a_map_that_cannot_be_made_with_a_lens_that_is_tried_says_that_it_is_the_lens(monkeypatch, tmp_path):
    def none(*_):
        raise InputError("no two of the photographs surely show the same place.")

    monkeypatch.setattr(checks, "_built", none)
    request = MapRequest([], tmp_path, lens=CalibratedLens(WRONG, "It was tried.", "they do not tell their lens"))
    with pytest.raises(InputError, match="they do not tell their lens"):
        checks.checked_models(tmp_path, request, lambda *_: None)
    request = MapRequest([], tmp_path, lens=CalibratedLens(WRONG, "It was found."))
    with pytest.raises(InputError, match="no two of the photographs"):
        checks.checked_models(tmp_path, request, lambda *_: None)


def test_a_full_disk_is_told_as_such(monkeypatch, tmp_path):
    """Not as a lens that is not told; what is done is kept then."""

    def stopped(*_):
        raise StoppedError("make room there")

    monkeypatch.setattr(checks, "_built", stopped)
    request = MapRequest([], tmp_path, lens=CalibratedLens(WRONG, "It was tried.", "they do not tell their lens"))
    with pytest.raises(StoppedError, match="make room"):
        checks.checked_models(tmp_path, request, lambda *_: None)
    monkeypatch.setattr(checks, "lens_in_map", lambda *_: LensInMap(TRUE, radians(2.0), radians(0.02)))
    with pytest.raises(StoppedError, match="make room"):
        checks._with_lens_of_map(
            tmp_path,
            checks.CheckedModels(request, SimpleNamespace(models=[None])),
            request.lens,
            lambda *_: None,
        )


def test_the_file_of_a_lens_says_whether_it_was_given(tmp_path):
    write_lenses(tmp_path, lenses_given([View("a.png", TRUE, tmp_path / "a.png")]))
    write_lenses(tmp_path, {"left": CalibratedLens(WRONG, "It was found.")})
    assert was_given(lens_path(tmp_path, "")) and not was_given(lens_path(tmp_path, "left"))
    assert not was_given(lens_path(tmp_path, "right"))
