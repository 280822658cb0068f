"""Features are kept on disk, found again only for what they were computed from, and computed again when damaged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.frontend.features import FeatureOptions, extract
from tests.frontend.pictures import fisheye_of, texture, view_of


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SPHERLOC_CACHE", str(tmp_path / "cache"))


def cached(folder):
    return sorted((folder / "cache" / "features").glob("*"))


def test_the_second_time_comes_from_the_cache(tmp_path, rng):
    view = view_of(tmp_path, texture(rng, 150, 300))
    first = extract(view)
    (file,) = cached(tmp_path)
    with np.load(file, allow_pickle=False) as stored:
        changed = dict(stored)
    changed["table"][:, 4] += 1000.0
    np.savez(file, **changed)
    again = extract(view)
    assert np.array_equal(again.scores, first.scores + 1000.0)
    assert np.array_equal(again.pixels, first.pixels) and np.array_equal(again.descriptors, first.descriptors)
    assert not again.pixels.flags.writeable


def test_the_cache_knows_what_features_depend_on(tmp_path, rng):
    """Content, options, mask, and whether the picture is a panorama; not the file's name."""
    image = texture(rng, 100, 200)
    mask = np.ones((100, 200), bool)
    mask[:30] = False
    views = [view_of(tmp_path, image), view_of(tmp_path, image, mask=lambda: mask)]
    views += [
        view_of(tmp_path, image, fisheye_of(200, 100)),
        view_of(tmp_path, np.roll(image, 9, 0), name="rolled.png"),
    ]
    for number, view in enumerate(views, start=1):
        extract(view)
        assert len(cached(tmp_path)) == number
    extract(views[0], FeatureOptions("orb"))
    extract(views[0], FeatureOptions(max_features=10))
    extract(view_of(tmp_path, image, name="same content.png"))
    assert len(cached(tmp_path)) == len(views) + 2


@settings(max_examples=40)
@given(data=st.data())
def test_a_damaged_cache_is_computed_again(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("damaged")
    view = view_of(folder, texture(np.random.default_rng(0), 60, 120))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPHERLOC_CACHE", str(folder / "cache"))
        first = extract(view)
        (file,) = cached(folder)
        content = bytearray(file.read_bytes())
        if data.draw(st.booleans()):
            del content[data.draw(st.integers(0, len(content) - 1)) :]
        else:
            # The first and last bytes are the headers.
            place = data.draw(st.integers(0, len(content) - 1) | st.integers(0, 200) | st.integers(-300, -1))
            content[place] ^= 1 << data.draw(st.integers(0, 7))
        file.write_bytes(bytes(content))
        again = extract(view)
    assert len(first) > 5 and np.array_equal(again.pixels, first.pixels)
    assert np.array_equal(again.descriptors, first.descriptors) and np.array_equal(again.scores, first.scores)


def test_without_a_place_for_the_cache(tmp_path, rng, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("SPHERLOC_CACHE", str(tmp_path / "file"))
    view = view_of(tmp_path, texture(rng, 100, 200))
    assert np.array_equal(extract(view).pixels, extract(view).pixels)
