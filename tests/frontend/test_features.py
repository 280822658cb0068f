"""Features lie where the picture has them, only where it may be used, and the same ones wherever a seam falls."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from spherloc.errors import InputError
from spherloc.frontend import features as module
from spherloc.frontend import trained
from spherloc.frontend.feature_kinds import SIFT_CONTRAST, WEAK_SIFT_CONTRAST
from spherloc.frontend.features import ENOUGH, FeatureOptions, extract
from spherloc.frontend.matching import match
from tests.frontend.pictures import blobs, disc, fisheye, fisheye_of, texture, view_of
from tests.needs import require

CLASSICAL = ("sift", "orb")
"""What every OpenCV has, without weights."""


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SPHERLOC_CACHE", str(tmp_path / "cache"))


def nearest(pixels, others, width=None):
    """Index of the nearest of ``others`` (M, 2) for each of pixels (N, 2), and its distance; around a panorama."""
    box = None if width is None else (width, 1e6)
    distance, index = cKDTree(others if box is None else others % box, boxsize=box).query(pixels)
    return index, distance


@pytest.mark.parametrize("sigma_px", [2.5, 6.0, 14.0])
def test_sift_lies_at_the_centre_of_a_blob(tmp_path, rng, sigma_px):
    """In the convention of the cameras: half a pixel or OpenCV's quarter of a pixel would be seen."""
    grid = np.stack(np.meshgrid(np.linspace(80, 560, 4), np.linspace(80, 400, 3)), axis=-1).reshape(-1, 2)
    centres = grid + rng.uniform(-1, 1, grid.shape)
    found = extract(view_of(tmp_path, blobs(480, 640, centres, sigma_px), fisheye_of(640, 480)))
    index, _ = nearest(centres, found.pixels)
    error = found.pixels[index] - centres
    assert np.abs(error).max() < 0.15 + 0.02 * sigma_px
    assert np.abs(error.mean(axis=0)).max() < 0.05 + 0.01 * sigma_px
    # OpenCV's size is the diameter, 2 sigma, of the Gaussian that the blob resembles.
    assert np.allclose(found.sizes_px[index], 2 * sigma_px, rtol=0.25)


def test_an_image_with_few_features_gets_weaker_ones(tmp_path, rng):
    """Up to as many as are enough; one that has those keeps its own alone."""
    sift = cv2.SIFT_create(contrastThreshold=SIFT_CONTRAST, enable_precise_upscale=True)
    plain = (100 + 0.25 * (texture(rng, 200, 300).astype(float) - 128)).astype(np.uint8)
    few, found = len(sift.detect(plain, None)), extract(view_of(tmp_path, plain, fisheye_of(300, 200)))
    assert len(found) > 1.5 * few > 0 and np.all(np.diff(found.scores) <= 0.0)
    rich = texture(rng, 600, 900)
    many = len(sift.detect(rich, None))
    ours = extract(view_of(tmp_path, rich, fisheye_of(900, 600)))
    assert ENOUGH < len(ours) == many
    assert len(extract(view_of(tmp_path, plain, fisheye_of(300, 200)), FeatureOptions(max_features=few))) == few


def test_descriptors_of_sift_are_root_normalised(tmp_path, rng):
    """Unit vectors whose squares are the L1-normalised descriptors that OpenCV gives."""
    image = texture(rng, 200, 300)
    found = extract(view_of(tmp_path, image, fisheye_of(300, 200)))
    assert len(found) > 50 and found.descriptors.dtype == np.float32
    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)
    sift = cv2.SIFT_create(contrastThreshold=WEAK_SIFT_CONTRAST, enable_precise_upscale=True)
    keypoints, raw = sift.detectAndCompute(image, None)
    places = np.array([(*one.pt, one.size, np.radians(one.angle)) for one in keypoints])
    ours = np.column_stack([found.pixels - 0.5, found.sizes_px, found.angles_rad])
    twin = np.abs(ours[:, None] - places[None]).sum(axis=2).argmin(axis=1)
    assert np.allclose(ours, places[twin])
    assert np.allclose(found.descriptors**2, raw[twin] / raw[twin].sum(axis=1, keepdims=True), atol=1e-6)


@pytest.mark.parametrize("method", CLASSICAL)
def test_what_features_hold(tmp_path, rng, method):
    found = extract(view_of(tmp_path, texture(rng, 240, 480)), FeatureOptions(method))
    assert len(found) > 50 and found.method == method and found.image_size == (480, 240)
    assert found.pixels.shape == (len(found), 2) and found.pixels.dtype == np.float64
    assert (found.pixels >= 0.0).all() and (found.pixels <= (480, 240)).all()
    assert (found.sizes_px > 0.0).all() and (np.abs(found.angles_rad) <= 2 * np.pi).all()
    assert np.ptp(found.angles_rad) > 3.0
    assert (np.diff(found.scores) <= 0.0).all()
    assert (found.descriptors.dtype, found.descriptors.shape[1]) == ((np.float32, 128), (np.uint8, 32))[method == "orb"]
    with pytest.raises(ValueError, match="read-only"):
        found.pixels[0] = 0.0


def test_the_strongest_are_kept(tmp_path, rng):
    view = view_of(tmp_path, texture(rng, 240, 480))
    every, some = extract(view), extract(view, FeatureOptions(max_features=40))
    assert len(every) > 100 and len(some) == 40
    assert np.array_equal(some.pixels, every.pixels[:40])
    assert np.array_equal(some.descriptors, every.descriptors[:40])


def test_orb_keeps_no_more_than_asked(tmp_path, rng):
    view = view_of(tmp_path, texture(rng, 240, 480))
    assert 35 < len(extract(view, FeatureOptions("orb", max_features=40))) <= 40


@pytest.mark.parametrize("method", CLASSICAL)
def test_the_rim_of_a_fisheye_makes_no_features(tmp_path, rng, method):
    """Texture in the middle of a grey circle, and noise around that: the rim makes no features of any size."""
    circle = disc(400, 180)
    image = np.where(circle, 150, rng.integers(0, 60, (400, 400))).astype(np.uint8)
    image[disc(400, 90)] = texture(rng, 400, 400)[disc(400, 90)]
    masked = extract(view_of(tmp_path, image, fisheye(400), mask=lambda: circle), FeatureOptions(method))
    free = extract(view_of(tmp_path, image, fisheye(400)), FeatureOptions(method))
    radius = np.hypot(*(masked.pixels - 200.0).T)
    assert len(masked) > 20 and radius.max() < 110.0
    assert (np.hypot(*(free.pixels - 200.0).T) > 170.0).sum() > 20


@pytest.mark.parametrize("method", CLASSICAL)
def test_masked_features_use_up_no_places(tmp_path, rng, method):
    """What must not be used is much stronger than the rest, which gets all the places nonetheless."""
    image = texture(rng, 300, 300)
    image[:, 100:] = np.clip(128 + 0.5 * (image[:, 100:].astype(float) - 128), 0, 255)
    allowed = np.zeros((300, 300), bool)
    allowed[:, 110:] = True
    found = extract(
        view_of(tmp_path, image, fisheye(300), mask=lambda: allowed), FeatureOptions(method, max_features=30)
    )
    assert 25 < len(found) <= 30 and found.pixels[:, 0].min() > 110.0


@pytest.mark.parametrize("method", CLASSICAL)
def test_colour_and_grey_agree(tmp_path, rng, method):
    image = texture(rng, 150, 300)
    grey = extract(view_of(tmp_path, image, name="grey.png"), FeatureOptions(method))
    colour = extract(view_of(tmp_path, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), name="c.png"), FeatureOptions(method))
    assert len(grey) > 20 and np.array_equal(grey.pixels, colour.pixels)
    assert np.array_equal(grey.descriptors, colour.descriptors)


@pytest.mark.parametrize("method", CLASSICAL)
def test_nothing_to_find(tmp_path, rng, method):
    """A flat picture and one without any usable pixel have no features, and no matches."""
    flat = extract(view_of(tmp_path, np.full((100, 200), 90, np.uint8)), FeatureOptions(method))
    mask = np.zeros((100, 200), bool)
    hidden = extract(view_of(tmp_path, texture(rng, 100, 200), mask=lambda: mask), FeatureOptions(method))
    assert len(flat) == len(hidden) == len(match(flat, hidden)) == 0
    assert flat.pixels.shape == (0, 2) and hidden.pixels.shape == (0, 2)


@pytest.mark.parametrize("size", [(1, 2), (2, 4), (7, 14), (31, 62)])
@pytest.mark.parametrize("method", CLASSICAL)
def test_tiny_pictures(tmp_path, rng, method, size):
    found = extract(view_of(tmp_path, texture(rng, *size)), FeatureOptions(method))
    assert len(np.unique(np.column_stack([found.pixels, found.sizes_px, found.angles_rad]), axis=0)) == len(found)


@pytest.mark.parametrize("roll, most", [(128, 0.06), (32, 0.2), (131, 0.2), (320, 0.2)])
def test_a_rolled_panorama_has_the_same_features(tmp_path, rng, roll, most):
    """Wherever the seam falls: by a fifth, which takes faces to faces, almost all; by any other most."""
    width = 640
    image = texture(rng, 320, width)
    plain = extract(view_of(tmp_path, image))
    rolled = extract(view_of(tmp_path, np.roll(image, roll, axis=1), name="rolled.png"))
    moved = (plain.pixels + np.array([roll, 0])) % (width, 1000)
    lost = nearest(moved, rolled.pixels, width)[1] > 0.7
    close = np.minimum(plain.pixels[:, 0], width - plain.pixels[:, 0]) < 30
    close |= np.minimum(moved[:, 0], width - moved[:, 0]) < 30
    assert len(plain) > 1000 and close.sum() > 100
    assert lost.mean() < most and lost[close].mean() < lost.mean() + 0.1
    assert abs(len(plain) - len(rolled)) < most * len(plain)


@pytest.mark.parametrize("width", [640, 500])
@pytest.mark.parametrize("row", [60.2, 90.3, 130.4])
@pytest.mark.parametrize("offset", [-0.4, 0.013, 0.3])
def test_a_blob_on_the_seam_is_found_once(tmp_path, width, row, offset):
    """Also where two faces meet there, and each places it a little beyond itself."""
    image = blobs(width // 2, width, [(offset, row)], 3.0, periodic=True)
    found = extract(view_of(tmp_path, image))
    strong = found.scores > 0.5 * found.scores.max()
    rows = np.column_stack([found.pixels, found.sizes_px, found.angles_rad])[strong]
    _, distance = nearest(found.pixels[strong], np.array([[offset, row]]), width)
    assert len(rows) >= 1 and distance.max() < 0.15
    for first, second in zip(*np.triu_indices(len(rows), 1), strict=True):  # it may have several orientations
        assert np.abs(np.angle(np.exp(1j * (rows[first, 3] - rows[second, 3])))) > 0.3


def test_features_match_across_the_seam(tmp_path, rng):
    """Content at the seam of one panorama, in the middle of the other."""
    width = 640
    image = texture(rng, 320, width)
    query = extract(view_of(tmp_path, image))
    reference = extract(view_of(tmp_path, np.roll(image, 317, axis=1), name="rolled.png"))
    pairs = match(query, reference)
    seam = np.minimum(query.pixels[:, 0], width - query.pixels[:, 0]) < 15
    matched = seam[pairs.query_index]
    expected = (query.pixels[pairs.query_index] + np.array([317, 0])) % (width, 1000)
    error = np.abs(expected - reference.pixels[pairs.reference_index])
    right = np.minimum(error, (width, np.inf) - error).max(axis=1) < 1.0
    assert seam.sum() > 10 and right[matched].sum() > 0.6 * seam.sum()
    assert right.mean() > 0.97


@pytest.mark.parametrize("panorama", [False, True])
def test_packaged_features_lie_at_the_same_places_in_a_smaller_image(tmp_path, rng, panorama):
    """Whether it is enlarged for the network or shrunk, or a panorama cut into faces."""
    require("learned")
    image = cv2.GaussianBlur(texture(rng, 700, 1400), (0, 0), 2.0)
    small = np.asarray(cv2.resize(image, (700, 350), interpolation=cv2.INTER_AREA), np.uint8)
    cameras = (None, None) if panorama else (fisheye_of(1400, 700), fisheye_of(700, 350))
    options = FeatureOptions("aliked")
    found = extract(view_of(tmp_path, image, cameras[0], "large.png"), options)
    others = extract(view_of(tmp_path, small, cameras[1], "small.png"), options)
    index, distance = nearest(others.pixels * 2.0, found.pixels)
    same = distance < 2.0
    assert same.mean() > 0.3
    assert np.abs(np.median((others.pixels * 2.0 - found.pixels[index])[same], axis=0)).max() < 0.1


def test_large_images_are_shrunk_for_detection(tmp_path, rng, monkeypatch):
    """Their features are still given in the image's own pixels, also where the sides shrink unlike each other."""
    monkeypatch.setattr(module, "MAX_PIXELS", 160_003)
    centres = np.array([(150.5, 200.25), (411.0, 120.0), (600.2, 300.7)])
    found = extract(view_of(tmp_path, blobs(441, 801, centres, 11.0), fisheye_of(801, 441)))
    index, distance = nearest(centres, found.pixels)
    assert distance.max() < 0.5
    assert np.allclose(found.sizes_px[index], 22.0, rtol=0.25)


@pytest.mark.parametrize(
    "options, reason",
    [
        ({"method": "surfer"}, "features 'surfer'.*sift, orb, akaze, surf, aliked, disk"),
        ({"method": ["sift"]}, "features"),
        ({"max_features": 0}, "max_features is 0.*1 to"),
        ({"max_features": 10**9}, "max_features"),
        ({"max_features": 4.0}, "max_features"),
        ({"max_features": True}, "max_features"),
        ({"method": "disk"}, "disk features need a file of weights"),
        ({"method": "aliked"}, r"aliked needs the extra 'learned' \(pip install 'spherloc\[learned\]'\) or a file"),
        ({"weights": Path("a.onnx")}, "sift features have no weights"),
    ],
)
def test_wrong_options(monkeypatch, options, reason):
    monkeypatch.setattr(trained, "installed", lambda: False)
    with pytest.raises(InputError, match=reason):
        FeatureOptions(**options)


@pytest.mark.parametrize("method", ["akaze", "surf"])
def test_what_this_opencv_may_lack(tmp_path, rng, method):
    """It is used where it is there, and named in one sentence where it is not."""
    view = view_of(tmp_path, texture(rng, 200, 400))
    there = f"{method.upper()}_create" in (*dir(cv2), *dir(getattr(cv2, "xfeatures2d", None)))
    try:
        found = extract(view, FeatureOptions(method))
    except InputError as error:
        assert f"{method.upper()} features are not in this OpenCV ({cv2.__version__}); " in str(error)
        assert not there or method == "surf"  # whose creator is there without it, too
    else:
        assert len(found) > 20 and len(match(found, found)) > 10


def test_what_cannot_be_read(tmp_path, rng):
    view = view_of(tmp_path, texture(rng, 100, 200))
    view.path.write_bytes(b"no image")
    with pytest.raises(InputError, match=r"picture\.png"):
        extract(view)
    view.path.unlink()
    with pytest.raises(InputError, match="no such file"):
        extract(view)
    assert not (tmp_path / "cache").exists()
