"""What masks leave out of images: files, folders, the ground below and the seam between two lenses."""

import tomllib

import cv2
import numpy as np
import pytest

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.cameras.kannala_brandt import KannalaBrandt
from spherloc.datasets import bundled_scenes, load_scene
from spherloc.errors import InputError
from spherloc.frontend.features import extract
from spherloc.frontend.masks import Masks, around, read_mask
from spherloc.frontend.triangulation import TriangulationLift
from spherloc.frontend.view import View, seen_pixels

FISHEYE = KannalaBrandt(320, 240, 90.0, 90.0, 160.0, 120.0, (0.0, 0.0, 0.0, 0.0))
PANORAMA = Equirectangular(400, 200)


def textured(path, camera, rng):
    cv2.imwrite(str(path), cv2.GaussianBlur(rng.integers(0, 255, (camera.height, camera.width), np.uint8), (0, 0), 1.5))
    return View(path.name, camera, path)


def halves(path, camera):
    """The left half is black."""
    mask = np.zeros((camera.height, camera.width), np.uint8)
    mask[:, camera.width // 2 :] = 255
    cv2.imwrite(str(path), mask)
    return path


@pytest.mark.parametrize("camera", [FISHEYE, PANORAMA], ids=["fisheye", "panorama"])
def test_no_feature_comes_from_under_a_mask(tmp_path, rng, camera):
    view = textured(tmp_path / "a.png", camera, rng)
    left = extract(view).pixels[:, 0] < camera.width / 2
    (masked,), said = Masks(halves(tmp_path / "mask.png", camera)).on([view])
    pixels = extract(masked).pixels
    assert 0.3 < left.mean() < 0.7 and len(pixels) > 50 and said == []
    assert (pixels[:, 0] > camera.width / 2).all()


def test_the_ground_and_the_seam_of_a_panorama(tmp_path, rng):
    view = textured(tmp_path / "a.png", PANORAMA, rng)
    (masked,), _ = Masks(nadir_deg=30.0, seam_deg=5.0).on([view])
    bearings, _ = PANORAMA.unproject(extract(masked).pixels)
    assert len(bearings) > 100
    assert (bearings[:, 1] < np.cos(np.radians(30.0))).all() and (
        np.abs(bearings[:, 2]) > np.sin(np.radians(5.0))
    ).all()
    # By hand: 60 of 180 rows below, and two bands of 10 degrees of longitude at the horizon.
    assert not around(PANORAMA, 30.0, 0.0)[167:].any() and around(PANORAMA, 30.0, 0.0)[:166].all()
    horizon = ~around(PANORAMA, 0.0, 5.0)[100]
    assert horizon.sum() == pytest.approx(400 * 20 / 360, abs=2) and horizon[100] and horizon[300] and not horizon[0]
    assert around(FISHEYE, 0.0, 0.0).all() and not around(FISHEYE, 45.0, 0.0)[239, 160]


def test_a_folder_has_masks_by_image_and_by_camera(tmp_path):
    folder = tmp_path / "masks"
    (folder / "left").mkdir(parents=True)
    white = np.full((240, 320), 255, np.uint8)
    for name in ("a.jpg.png", "b.png", "right.png", "left/c.png"):
        image = white.copy()
        image[0, 0] = 0
        cv2.imwrite(str(folder / name), image)
    names = ["a.jpg", "b.jpg", "right/x.jpg", "left/c.jpg", "left/d.jpg"]
    views, said = Masks(folder).on([View(name, FISHEYE, tmp_path / name) for name in names])
    assert [view.mask is not None for view in views] == [True, True, True, True, False]
    assert said == [f"1 of 5 images have no mask in {folder}, the first is left/d.jpg."]
    assert (seen_pixels(FISHEYE) & ~views[0].usable_pixels()).sum() <= 1


def test_grey_levels_are_cut_in_the_middle(tmp_path):
    """JPEG's ringing is no mask, and masks of 0 and 1 are."""
    image = np.zeros((20, 30), np.uint8)
    image[:, 10:] = 1
    cv2.imwrite(str(tmp_path / "ones.png"), image)
    assert (read_mask(tmp_path / "ones.png") == (image > 0)).all()
    cv2.imwrite(str(tmp_path / "ringing.png"), np.where(image, 240, 9))
    assert (read_mask(tmp_path / "ringing.png") == (image > 0)).all()


def test_masks_that_are_refused(tmp_path):
    view = View("a.jpg", FISHEYE, tmp_path / "a.jpg")
    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((240, 320), np.uint8))
    cv2.imwrite(str(tmp_path / "small.png"), np.ones((24, 32), np.uint8))
    for masks, sentence in (
        (Masks(tmp_path / "none"), "is neither a mask nor a folder"),
        (Masks(tmp_path / "empty"), "has a mask for none of the 1 images; .*such as a.png"),
        (Masks(tmp_path / "small.png"), "is 32 x 24 pixels, and no image is, such as a.jpg with 320 x 240"),
        (Masks(seam_deg=3.0), "is for panoramas"),
    ):
        with pytest.raises(InputError, match=sentence):
            masks.on([view])
    (masked,), _ = Masks(tmp_path / "black.png").on([view])
    with pytest.raises(InputError, match="completely black"):
        masked.usable_pixels()
    with pytest.raises(InputError, match="nadir_deg of masks is 90"):
        Masks(nadir_deg=90.0)


def test_a_scene_file_has_them_for_queries_and_references(tmp_path, rng):
    """Also in what triangulates the references' points; kinds that bring their features refuse them."""
    for name in ("q.png", "r0.png", "r1.png"):
        textured(tmp_path / name, FISHEYE, rng)
    halves(tmp_path / "mask.png", FISHEYE)
    camera = "\n".join(f"{key} = {value!r}".replace("'", '"') for key, value in FISHEYE.to_dict().items())
    rows = "\n".join(
        f'[[references]]\nimage = "r{at}.png"\ncam_from_map = [[1, 0, 0, {at}], [0, 1, 0, 0], [0, 0, 1, 0]]'
        for at in range(2)
    )
    text = f'kind = "image-folder"\nname = "x"\nimages = ["q.png"]\n[camera]\n{camera}\n[masks]\n%s\n{rows}\n'
    path = tmp_path / "scene.toml"
    path.write_text(text % 'images = "mask.png"')
    scene = load_scene(path)
    lift = scene.references[0].lift
    assert isinstance(lift, TriangulationLift)
    for view in (*scene.queries, *scene.references, lift.view, *lift.others):
        usable = view.usable_pixels()
        assert usable.any() and not usable[:, :160].any()
    for said, sentence in (
        ("", r"\[masks\]: is empty"),
        ("nadir_deg = 95", r"\[masks\]: nadir_deg is 95"),
        ("seam_deg = 2", r"\[masks\]: seam_deg of masks is for panoramas"),
        ('image = "mask.png"', "unknown key 'image'"),
    ):
        path.write_text(text % said)
        with pytest.raises(InputError, match=sentence):
            load_scene(path)
    rendered = bundled_scenes()["campus_panorama"].read_text()
    assert "masks" not in tomllib.loads(rendered)
    (tmp_path / "rendered.toml").write_text(rendered + "\n[masks]\nnadir_deg = 20\n")
    assert not load_scene(tmp_path / "rendered.toml").queries[0].usable_pixels()[-1].any()
