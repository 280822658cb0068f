"""What a page makes after its run is shown, while the page goes on to other runs."""

import threading
from types import SimpleNamespace
from typing import Any

from spherloc_viz.app.map_pictures import MapPictures
from tests.waiting import LIMIT_S, until


class Scenes:
    """A catalog with scenes of images, whose only picture is drawn when it may be, and simulations."""

    def __init__(self, missing: Any) -> None:
        self.drawing, self.go_on = threading.Event(), threading.Event()
        view = SimpleNamespace(path=missing, make_file=self._draw)
        self._images = SimpleNamespace(pictures=lambda problem: [view])

    def map_scene(self, label: str) -> Any:
        return self._images if label == "images" else None

    def known_mesh(self, label: str) -> bytes:
        return b"made"

    def _draw(self) -> None:
        self.drawing.set()
        assert self.go_on.wait(LIMIT_S)


def run_of(label: str) -> Any:
    return SimpleNamespace(
        request=SimpleNamespace(scene=SimpleNamespace(scene=label)), trace=SimpleNamespace(problem=0)
    )


def test_a_run_that_is_whole_stays_so_when_the_pictures_of_an_earlier_one_are_done(tmp_path: Any) -> None:
    """Else it would never be recorded."""
    scenes, redrawn = Scenes(tmp_path / "missing.png"), threading.Event()
    pictures = MapPictures(1, scenes, lambda words: None, redrawn.set, lambda job: job)  # type: ignore[arg-type]
    pictures.start()
    images, simulation = run_of("images"), run_of("simulation")
    pictures.want(images)
    assert scenes.drawing.wait(LIMIT_S) and not pictures.whole(images)
    pictures.want(simulation)
    assert pictures.whole(simulation)
    redrawn.clear()
    scenes.go_on.set()
    assert redrawn.wait(LIMIT_S)
    assert pictures.whole(simulation) and not pictures.whole(images)
    pictures.want(images)
    until(lambda: pictures.whole(images))
    pictures.close()
