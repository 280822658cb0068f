"""The picture of a map from above: images are seen in it, and the names that it has can be read."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from spherloc_viz.plots.map_above import map_above, names_at


@pytest.fixture
def drawn(monkeypatch):
    """Figures of which pictures were made."""
    figures, save = list[Figure](), Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *about, **how: (figures.append(self), save(self, *about, **how))
    )
    return figures


def images(places) -> dict[str, np.ndarray]:
    """Centres by name of images at places (N, 2)."""
    return {f"reference_{k:03d}.png": np.array([x, y, 1.5]) for k, (x, y) in enumerate(places)}


def around(rng, count: int = 2_000) -> np.ndarray:
    """Points within 10 m, and a tenth of them up to 3 km away."""
    points = rng.uniform(-10.0, 10.0, (count, 3))
    points[::10] *= 300.0
    return points


def test_points_far_away_do_not_shrink_the_images_to_a_dot(drawn, rng) -> None:
    centres = images(np.stack([np.linspace(-5.0, 5.0, 4), np.zeros(4)], axis=1))
    content, without = map_above(around(rng), centres, True, "metres")
    assert content.startswith(b"\x89PNG") and without == 0
    (axes,) = drawn[0].axes
    assert 10.0 < np.ptp(axes.get_xlim()) < 40.0 and axes.get_xlabel() == "metres"


def test_images_in_a_small_part_of_the_map_have_a_panel_of_their_own(drawn, rng) -> None:
    map_above(around(rng), images([(0.0, 0.0), (0.3, 0.1)]), True, "units")
    whole, alone = drawn[0].axes
    assert np.ptp(whole.get_xlim()) > 5.0 and np.ptp(alone.get_xlim()) < 1.0
    assert len(alone.texts) == 2 and not whole.texts
    assert map_above(np.zeros((0, 3)), images([(0.0, 0.0)]), True, "units")[1] == 0, (
        "nor does a map without points fail"
    )


def test_no_name_lies_over_another_and_those_left_out_are_counted(drawn, rng) -> None:
    """Sixty images on a walk that turns back beside itself."""
    along = np.concatenate([np.linspace(0.0, 20.0, 30), np.linspace(20.0, 0.0, 30)])
    places = np.stack([along, np.repeat([0.0, 1.5], 30)], axis=1)
    _, without = map_above(around(rng), images(places), True, "metres")
    (axes,) = drawn[0].axes
    texts = [text for text in axes.texts if isinstance(text, Annotation)]
    boxes = np.array([text.get_window_extent().extents for text in texts])
    edge = axes.get_window_extent().extents
    assert (boxes[:, :2] >= edge[:2]).all() and (boxes[:, 2:] <= edge[2:]).all()
    apart = (boxes[:, None, :2] >= boxes[None, :, 2:] - 1.0) | (boxes[:, None, 2:] <= boxes[None, :, :2] + 1.0)
    assert (apart.any(axis=2) | np.eye(len(boxes), dtype=bool)).all()
    names = {name for text in texts for name in text.get_text().splitlines()}
    assert without == 60 - len(names) > 0 and len(names) > 10


def test_names_of_images_at_one_place_stand_under_each_other() -> None:
    places = np.array([[0.0, 0.0], [10.0, 5.0], [0.1, -0.1], [10.0, 5.3]])
    assert [label.lines for label in names_at(places, list("abcd"))] == [("a", "c"), ("b",), ("d",)]
    (label,) = names_at(np.zeros((6, 2)), list("abcdef"))
    assert label.lines == ("a", "b", "c", "d", "and 2 more")


def test_a_line_joins_the_images_of_each_folder(drawn, rng) -> None:
    """Those of another camera do not follow the last one of the first."""
    centres = {f"cam{k % 2}/{k}.png": np.array([float(k), float(k % 2), 1.5]) for k in range(6)}
    map_above(around(rng), centres, True, "metres")
    assert [line.get_xdata().tolist() for line in drawn[0].axes[0].lines] == [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]]
    map_above(around(rng), centres, False, "metres")
    assert not drawn[1].axes[0].lines
