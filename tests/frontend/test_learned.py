"""Networks through OpenCV 5: small ones without training run as the published ones do; what is wrong is said."""

import cv2
import numpy as np
import pytest

from spherloc.errors import InputError
from spherloc.frontend.features import JOINED_NUMBERS, FeatureOptions, Features, extract
from spherloc.frontend.matching import MatchOptions, match
from spherloc.frontend.retrieval import real_descriptors
from tests.frontend.pictures import disc, fisheye, texture, view_of
from tests.frontend.small_networks import described_grid, nearest_place
from tests.needs import needs

CELLS = 16
SIDE = {"aliked": 640, "disk": 1024}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SPHERLOC_CACHE", str(tmp_path / "cache"))


def network(tmp_path, method):
    """Weights whose keypoints are the pixels in the middle of the cells, as each network says that."""
    side = SIDE[method]
    middle = np.arange(CELLS) * (side // CELLS) + side // CELLS // 2
    places = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    if method == "aliked":  # from the centre of the first pixel to that of the last
        places = (2.0 * places / (side - 1) - 1.0).astype(np.float32)
    path = tmp_path / f"{method}.onnx"
    path.write_bytes(described_grid(side, CELLS, places, batch=method == "disk"))
    return path


def colours(rng, size):
    """A picture (H, W, 3) of CELLS x CELLS evenly coloured cells, and their colours (N, 3), red first, 0 to 1."""
    cells = rng.integers(20, 256, (CELLS, CELLS, 3), dtype=np.uint8)
    image = cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST)
    return image, cells.reshape(-1, 3)[:, ::-1] / 255.0


@needs("opencv 5")
@pytest.mark.parametrize("method", SIDE)
@pytest.mark.parametrize("side", [320, 640, 1408])
def test_keypoints_lie_where_the_network_says(tmp_path, rng, method, side):
    """In the image's pixels, whatever its size: the centre of the network's pixel, not its corner."""
    image, expected = colours(rng, (side, side))
    view = view_of(tmp_path, image, fisheye(side))
    found = extract(view, FeatureOptions(method, weights=network(tmp_path, method)))
    step, part = side / CELLS, side / SIDE[method]
    middle = (np.arange(CELLS) + 0.5) * step + 0.5 * part
    places = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    assert len(found) == CELLS**2 and (np.diff(found.scores) <= 0.0).all()
    distance = np.abs(found.pixels[:, None] - places[None]).max(axis=2)
    which = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-3 and len(np.unique(which)) == CELLS**2
    assert np.allclose(found.scores, expected[which, 0], atol=0.02)
    wanted = expected[which] / (np.linalg.norm(expected[which], axis=1)[:, None] if method == "aliked" else 1.0)
    assert np.allclose(found.descriptors, wanted, atol=0.03)


@needs("opencv 5")
@pytest.mark.parametrize("method", SIDE)
def test_masks_and_grey_images(tmp_path, rng, method):
    """Also for the network that knows no mask; the strongest are kept."""
    circle = disc(320, 100)
    view = view_of(tmp_path, texture(rng, 320, 320), fisheye(320), mask=lambda: circle)
    weights = network(tmp_path, method)
    every = extract(view, FeatureOptions(method, weights=weights))
    some = extract(view, FeatureOptions(method, max_features=10, weights=weights))
    assert 40 < len(every) < 80 and np.hypot(*(every.pixels - 160.0).T).max() < 100.0
    assert len(some) == 10 and np.array_equal(some.pixels, every.pixels[:10])


@needs("opencv 5")
@pytest.mark.parametrize("method", SIDE)
def test_panoramas_are_seen_on_faces(tmp_path, rng, method):
    """Every feature lies within the image, and none is there twice."""
    view = view_of(tmp_path, texture(rng, 160, 320))
    found = extract(view, FeatureOptions(method, weights=network(tmp_path, method)))
    assert CELLS**2 * 4 < len(found) < CELLS**2 * 12
    assert (found.pixels >= 0).all() and (found.pixels <= (320, 160)).all()
    assert len(np.unique(found.pixels.round(3), axis=0)) == len(found)


@needs("opencv 5")
def test_other_weights_are_not_taken_from_the_cache(tmp_path, rng):
    view = view_of(tmp_path, texture(rng, 160, 160), fisheye(160))
    options = FeatureOptions("aliked", weights=network(tmp_path, "aliked"))
    first = extract(view, options)
    places = np.zeros((CELLS**2, 2), np.float32)
    options.weights.write_bytes(described_grid(640, CELLS, places, batch=False))
    second = extract(view, options)
    assert np.ptp(first.pixels) > 100 and np.ptp(second.pixels[:, 0]) < 1e-6


@needs("opencv 5")
def test_lightglue_gets_places_relative_to_the_images(tmp_path, rng):
    """A network that pairs the nearest places in images of different sizes."""
    places = rng.uniform(-1, 1, (50, 2))
    order = rng.permutation(50)[:40]
    # The product of (place, 1, 0) and (other, -|other|^2 / 2, 0) is largest for the nearest.
    flat = np.tile(np.float32([1, 0]), (40, 1))
    raised = np.column_stack([-0.5 * np.square(places).sum(axis=1), np.zeros(50)]).astype(np.float32)
    query = aliked_features((places[order] + 1) / 2 * (640, 480), flat, (640, 480))
    reference = aliked_features((places + 1) / 2 * (1000, 500), raised, (1000, 500))
    weights = tmp_path / "lightglue.onnx"
    weights.write_bytes(nearest_place(40, 50))
    found = match(query, reference, MatchOptions("lightglue", weights=weights))
    assert np.array_equal(found.query_index, np.arange(40)) and np.array_equal(found.reference_index, order)
    assert np.isnan(found.ratios).all()


def aliked_features(pixels, descriptors, size, method="aliked"):
    ones = np.ones(len(pixels))
    return Features(pixels, ones.copy(), ones.copy(), ones.copy(), descriptors, method, size)


@needs("opencv 5")
@pytest.mark.parametrize("method", SIDE)
@pytest.mark.parametrize("content", [b"", b"no network", bytes(1000)])
def test_weights_that_are_none(tmp_path, rng, method, content):
    view = view_of(tmp_path, texture(rng, 100, 200))
    weights = tmp_path / "weights.onnx"
    weights.write_bytes(content)
    with pytest.raises(InputError, match=rf"weights\.onnx: OpenCV cannot use it for {method.upper()} \(.*give an ONNX"):
        extract(view, FeatureOptions(method, weights=weights))


@needs("opencv 5")
def test_weights_on_which_opencv_crashes(tmp_path, rng):
    """Bits found by trying: with them OpenCV 5.0.0 ends in a segmentation fault. Other versions may refuse the file."""
    weights = network(tmp_path, "aliked")
    content = bytearray(weights.read_bytes())
    for place, value in ((477, 2), (1003, 49), (1014, 190), (1675, 193), (1676, 102)):
        content[place] = value
    weights.write_bytes(content)
    with pytest.raises(InputError, match=r"aliked\.onnx: OpenCV .*give an ONNX file of ALIKED"):
        extract(view_of(tmp_path, texture(rng, 100, 200)), FeatureOptions("aliked", weights=weights))


@needs("opencv 5")
def test_weights_of_another_network(tmp_path, rng):
    view = view_of(tmp_path, texture(rng, 100, 200))
    weights = tmp_path / "lightglue.onnx"
    weights.write_bytes(nearest_place(3, 3))
    for method in SIDE:
        with pytest.raises(InputError, match=f"lightglue.onnx: OpenCV cannot use it for {method.upper()} "):
            extract(view, FeatureOptions(method, weights=weights))
    found = aliked_features(np.ones((3, 2)), np.ones((3, 2), np.float32), (10, 10))
    with pytest.raises(InputError, match=r"aliked\.onnx: OpenCV cannot use it for LightGlue "):
        match(found, found, MatchOptions("lightglue", weights=network(tmp_path, "aliked")))


@needs("opencv 5")
@pytest.mark.parametrize("method", SIDE)
def test_weights_that_are_missing(tmp_path, rng, method):
    view = view_of(tmp_path, texture(rng, 100, 200))
    for weights, said in ((tmp_path / "gone.onnx", "no such file"), (tmp_path, "a folder, not a file")):
        with pytest.raises(InputError, match=rf"{said}.*; give the ONNX file of {method.upper()}"):
            extract(view, FeatureOptions(method, weights=weights))


def test_lightglue_is_for_aliked(rng, tmp_path):
    found = aliked_features(np.ones((3, 2)), np.ones((3, 2), np.float32), (10, 10), method="disk")
    with pytest.raises(InputError, match="LightGlue is for aliked features, not disk"):
        match(found, found, MatchOptions("lightglue", weights=tmp_path / "any.onnx"))


@needs("opencv 5")
def test_joined_kinds_are_found_and_matched_each_by_its_own(tmp_path, rng):
    """SIFT's features and those of the network, in this order; nearest neighbours match the former, LightGlue the
    latter, and no match is between two kinds."""
    view = view_of(tmp_path, texture(rng, 160, 160), fisheye(160))
    weights = network(tmp_path, "aliked")
    sift, aliked = extract(view, FeatureOptions("sift")), extract(view, FeatureOptions("aliked", weights=weights))
    both = extract(view, FeatureOptions("sift+aliked", weights=weights))
    assert len(sift) > 20 and len(both) == len(sift) + len(aliked) and both.method == "sift+aliked"
    assert np.array_equal(both.pixels, np.concatenate([sift.pixels, aliked.pixels]))
    distances = np.linalg.norm(both.descriptors[: len(sift), None] - both.descriptors[None, len(sift) :], axis=2)
    assert distances.min() > 1.0
    assert np.array_equal(real_descriptors(both), real_descriptors(sift))

    lightglue = tmp_path / "lightglue.onnx"
    lightglue.write_bytes(nearest_place(len(aliked), len(aliked)))
    found = match(both, both, MatchOptions("lightglue", weights=lightglue))
    own = match(sift, sift), match(aliked, aliked, MatchOptions("lightglue", weights=lightglue))
    assert len(own[0]) > 10 and len(own[1]) > 10
    for side in ("query_index", "reference_index"):
        expected = np.concatenate([getattr(own[0], side), getattr(own[1], side) + len(sift)])
        assert np.array_equal(getattr(found, side), expected)
    assert (np.isnan(found.ratios) == (found.query_index >= len(sift))).all()


@needs("opencv 5")
def test_joined_kinds_of_an_image_without_any_of_one(tmp_path, rng):
    """An even image has no feature of SIFT; what is of the other kind keeps its place in the descriptors."""
    weights = network(tmp_path, "aliked")
    options = FeatureOptions("sift+aliked", weights=weights)
    even = extract(view_of(tmp_path, np.full((160, 160, 3), 90, np.uint8), fisheye(160), name="even.png"), options)
    other = extract(view_of(tmp_path, texture(rng, 160, 160), fisheye(160)), options)
    assert [len(part) > 0 for part in even.parts] == [False, True]
    assert even.descriptors.shape[1] == other.descriptors.shape[1]
    assert not even.descriptors[:, :JOINED_NUMBERS].any() and even.descriptors[:, JOINED_NUMBERS:].any(axis=1).all()
