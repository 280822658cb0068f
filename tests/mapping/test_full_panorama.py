"""Which images of about 2 to 1 are panoramas of the whole sphere."""

import cv2
import numpy as np
import pytest
from PIL import Image

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.mapping.images.full_panorama import are_full_panoramas
from spherloc.mapping.images.photographs import photographs

XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>'
)
SPHERE = 'GPano:ProjectionType="equirectangular"'
CROPPED = f'{SPHERE} GPano:CroppedAreaImageWidthPixels="400" GPano:FullPanoWidthPixels="800" '
CROPPED += 'GPano:CroppedAreaImageHeightPixels="200" GPano:FullPanoHeightPixels="400"'


def panorama(rng, height=200):
    """A panorama (H, 2 H) of smooth spots all over the sphere."""
    v, u = np.mgrid[:height, : 2 * height] + 0.5
    bearings, _ = Equirectangular(2 * height, height).unproject(np.column_stack([u.ravel(), v.ravel()]))
    waves = np.sin(bearings @ rng.normal(0.0, 6.0, (3, 12)) + rng.uniform(0.0, 6.0, 12)).sum(axis=1)
    return np.clip(128 + 25 * waves, 0, 255).astype(np.uint8).reshape(height, 2 * height)


def cropped(image):
    """A quarter of a panorama, of 2 to 1 too."""
    height, width = image.shape
    return cv2.resize(image[height // 4 : -height // 4, width // 4 : -width // 4], (width, height))


def written(folder, images):
    paths = [folder / f"{number}.png" for number in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        assert cv2.imwrite(str(path), image)
    return paths


def worn(image, how, rng):
    """A panorama as cameras, programs and the network leave it."""
    height, width = image.shape
    if how == "black poles":
        image = image.copy()
        image[: height // 6], image[-height // 6 :] = 0, 0
    elif how == "lenses of different brightness":
        image = np.where(np.arange(width) < width // 2, image * 0.9, image).astype(np.uint8)
    elif how == "JPEG":
        image = cv2.imdecode(cv2.imencode(".jpg", image, [1, 15])[1], cv2.IMREAD_GRAYSCALE)
    elif how == "noise":
        image = np.clip(image + rng.normal(0.0, 12.0, image.shape), 0, 255).astype(np.uint8)
    elif how == "night":
        image = image // 10
    elif how == "caption":
        image = image.copy()
        image[-height // 12 :] = rng.integers(0, 2, (height, width))[-height // 12 :] * 255
    return image


@pytest.mark.parametrize(
    "how", ["", "black poles", "lenses of different brightness", "JPEG", "noise", "night", "caption"]
)
def test_edges_tell_panoramas_from_crops(how, tmp_path, rng):
    for name in ("panoramas", "crops"):
        (tmp_path / name).mkdir()
    panoramas = [panorama(rng) for _ in range(5)]
    assert are_full_panoramas(written(tmp_path / "panoramas", [worn(one, how, rng) for one in panoramas]))
    assert not are_full_panoramas(written(tmp_path / "crops", [cropped(one) for one in panoramas]))


def test_a_crop_is_no_panorama_unless_that_is_said(tmp_path, rng):
    """Dark rims of a lens look alike at the left and at the right, but the upper and lower edges are no points."""
    images = [cropped(panorama(rng)) for _ in range(4)]
    rim = 1.0 - 0.9 * np.abs(np.linspace(-1.0, 1.0, 400)) ** 4
    written(tmp_path, [(image * rim).astype(np.uint8) for image in images])
    with pytest.raises(InputError, match=r"4 images of 400 x 200 pixels: twice as wide as high, but no full panoramas"):
        photographs(tmp_path, {})
    assert {view.camera for view in photographs(tmp_path, {}, panorama=True).views} == {Equirectangular(400, 200)}


def test_tags_say_what_is_a_panorama(tmp_path, rng):
    """Those of a part of one, as telephones make them, do not."""
    for name, tags, expected in (("whole.jpg", SPHERE, True), ("part.jpg", CROPPED, False), ("no.jpg", "", False)):
        Image.fromarray(cropped(panorama(rng))).save(tmp_path / name, xmp=XMP.format(tags).encode())
        assert are_full_panoramas([tmp_path / name]) == expected


@pytest.mark.parametrize("size", [(400, 199), (400, 202)])
def test_a_resized_panorama_is_one(size, tmp_path, rng):
    written(tmp_path, [cv2.resize(panorama(rng), size) for _ in range(3)])
    found = photographs(tmp_path, {})
    assert {view.camera for view in found.views} == {Equirectangular(*size)}
    assert found.remarks == (
        f"3 images of {size[0]} x {size[1]} pixels: taken for full panoramas, though not exactly twice as wide as "
        "high: the width has 360°, the height 180°.",
    )


def test_panoramas_that_are_not_2_to_1_are_told_so(tmp_path, rng):
    (tmp_path / "near").mkdir()
    (tmp_path / "far").mkdir()
    written(tmp_path / "near", [cv2.resize(panorama(rng), (400, 193)) for _ in range(3)])
    written(tmp_path / "far", [cv2.resize(panorama(rng), (400, 150)) for _ in range(3)])
    with pytest.raises(
        InputError, match=r"near: 3 images of 400 x 193 pixels: like panoramas, but these are .* or --panorama"
    ):
        photographs(tmp_path / "near", {}, find_lens=lambda *_: pytest.fail("a lens is sought"))
    assert len(photographs(tmp_path / "near", {}, panorama=True).views) == 3
    with pytest.raises(InputError, match=r"3 of 400 x 150 pixels, are no full panoramas, .* without --panorama"):
        photographs(tmp_path / "far", {}, panorama=True)


def test_an_image_that_is_left_out_for_its_shape_is_told_what_a_panorama_has(tmp_path, rng):
    written(tmp_path, [panorama(rng) for _ in range(3)])
    assert cv2.imwrite(str(tmp_path / "odd.png"), rng.integers(0, 255, (202, 400), np.uint8))
    assert photographs(tmp_path, {}).remarks == (
        "1 of 4 images were left out, as their camera is not known; the first is odd.png with 400 x 202 pixels; full "
        "panoramas are twice as wide as high.",
    )


def test_raw_images_of_two_lenses_are_called_that(tmp_path, rng):
    """Otherwise a lens would be sought in them."""
    v, u = np.mgrid[:200, :400]
    circle = np.hypot(u % 200 - 99.5, v - 99.5) < 99
    written(tmp_path, [np.where(circle, rng.integers(60, 255, (200, 400)), 5).astype(np.uint8) for _ in range(3)])
    with pytest.raises(
        InputError, match=r"are raw images of two lenses; have the camera's own program stitch them, or"
    ):
        photographs(tmp_path, {}, find_lens=lambda *_: pytest.fail("a lens is sought"))
