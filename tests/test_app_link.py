"""Links: what a page writes it reads again, and what anybody writes is a remark at worst."""

from dataclasses import replace
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spherloc.datasets import load_scene
from spherloc.datasets.variation import Variation
from spherloc.errors import RecordingError
from spherloc.estimators import default_options, estimate
from spherloc_viz.app.catalog import Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.link import MANY, MAX_LETTERS, ONCE, Follower, PageView, link_of
from spherloc_viz.app.matches.match_table import TableLook
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.app.review.opened import Opened
from tests.tiny_scene import write_tiny_scene

VIEW = PageView("outcome", (), "dark")


def no_recording(file: str) -> Opened:
    raise RecordingError(f"{file}: is not in the list any more; choose another run.")


class Place:
    """A page's catalog, and what it shows."""

    def __init__(self, folder: Path) -> None:
        self.scene = write_tiny_scene(folder)
        self.base = Catalog(self.scene)
        self.catalog, self.roots = self.base.branch(), Roots([folder])
        (self.label, *_) = self.catalog.scenes
        self.follower = Follower(self.catalog, self.roots, self.catalog.problem, no_recording)
        request = SceneRequest(self.label, 5)
        self.now = RunRequest(request, "mc", default_options("mc", self.catalog.problem(request)))

    def link(self, request: RunRequest, view: PageView) -> str:
        problem = self.catalog.problem(request.scene)
        trace = estimate(problem, request.estimator, request.options, request.scene.seed)
        return link_of(Run(request, trace, np.arange(len(problem))), view, self.catalog, self.base.scenes, self.roots)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    return Place(tmp_path_factory.mktemp("links"))


def test_what_is_written_is_read_again(place: Place) -> None:
    camera = list(place.catalog.cameras.values())[-1]
    variation = Variation(
        camera, 30, 0.1 + 0.2, 1 / 3, "coherent", true_camera=(1.5, -2.0, 1e-7, 3.0), spoiled=(3, 1), hidden=(7,)
    )
    scene = SceneRequest(place.label, 2**62, None, variation)
    options = replace(default_options("ransac-2p", place.catalog.problem(scene)), iterations=77, confidence=0.97)
    viewpoint = (1.5, -2.25, 3.0, 0.0, 0.125, -1e-05, 45.0)
    request = RunRequest(scene, "ransac-2p", options)
    view = PageView("sample-3", (2, 4), "light", "outcome", viewpoint, "Graph", compared=("mc", "ransac-2p"))
    view = replace(view, table=TableLook("outliers", "px", down=True), graph="list", side="Recordings")
    found = place.follower.follow(place.link(request, view), place.now, VIEW)
    assert (found.request, found.view, found.remarks) == (request, view, ())
    assert place.follower.follow("", place.now, VIEW).remarks == ()
    for view in (replace(VIEW, compared=("mc",), side="Compare"), replace(VIEW, compared=("mc",)), VIEW):
        link = place.link(place.now, view)
        assert place.follower.follow(link, place.now, VIEW).view.side == view.side
        assert ("side=" in link) is (view.compared != () and view.side == "Play")


def test_a_scene_of_an_allowed_folder_is_opened_again(place: Place) -> None:
    path = place.scene.with_name("other.toml")
    path.write_text(place.scene.read_text().replace('name = "', 'name = "another '))
    other = Place(place.scene.parent)
    label = other.catalog.add(load_scene(path), path)
    scene = SceneRequest(label, 1)
    link = other.link(RunRequest(scene, "mc", default_options("mc", other.catalog.problem(scene))), VIEW)
    assert "place=0%3Aother.toml" in link
    found = place.follower.follow(link, place.now, VIEW)
    assert found.remarks == () and found.request is not None
    assert found.request.scene == scene and place.catalog.path(label) == path.resolve()


@pytest.mark.parametrize(
    ("key", "value", "remark"),
    [
        ("v", "2", "the link is of version '2', and this is version 1."),
        ("colour", "red", "the link says 'colour', which this version does not know."),
        ("scene", "nowhere", "the scene 'nowhere' is not open here"),
        ("place", "0:../../../etc/passwd", "not in an allowed folder"),
        ("place", "7:x.toml", "not allowed any more"),
        ("seed", "-1", "the seed '-1' is not a whole number"),
        ("seed", "9" * 19, "is not a whole number"),
        ("estimator", "magic", "the estimator 'magic' is unknown."),
        ("option", "bound_px=far", "option bound_px is 'far'"),
        ("option", "magic=1", "has no option 'magic'"),
        ("set", "outlier_rate=most", "setting outlier_rate is 'most'"),
        ("set", "outlier_rate=7", "outlier_rate"),
        ("set", "camera=/etc/passwd", "names a camera by its label"),
        ("camera", "/etc/passwd", "the camera '/etc/passwd' is unknown."),
        ("spoil", "1,b", "spoil is '1,b'"),
        ("hide", "99999", "99999"),
        ("select", "-3", "select is '-3'"),
        ("run", "../../etc/passwd", "is not in the list"),
        ("view", "1,2,3", "view is '1,2,3'; give a place"),
        ("view", "0,0,0,0,0,0,45", "view is"),
        ("view", "1,2,nan,0,0,0,45", "view is"),
        ("view", "1,2,3,0,0,0,999", "view is"),
        ("theme", "pink", "theme is 'pink'; give dark or light."),
        ("tab", "Play", "tab is 'Play'; give Yaw, Graph, "),
        ("side", "Share", "side is 'Share'; give Play, Compare, "),
        ("table", "outliers,size", "table is 'outliers,size'; give a filter (all, "),
        ("table", "wrong", "table is 'wrong'; give a filter"),
        ("compare", "mc,magic,mc", "the estimator 'magic' is unknown, so it is not compared."),
    ],
)
def test_what_is_wrong_is_a_remark_and_the_rest_is_opened(place: Place, key: str, value: str, remark: str) -> None:
    others = {"v": "1", "seed": "8", "estimator": "ransac-2p", "step": "bearings"}
    found = place.follower.follow(urlencode({**others, key: value}), place.now, VIEW)
    assert len(found.remarks) == 1 and remark in found.remarks[0], found.remarks
    if key in ("scene", "place", "run"):
        assert (found.request, found.view) == (None, VIEW), "what is meant for another run was done to this one"
        return
    assert found.view.step == "bearings" and found.request is not None
    assert found.request.estimator == ("mc" if key == "estimator" else "ransac-2p")
    if key != "seed":
        assert found.request.scene.seed == 8
    assert found.view.compared == (("mc",) if key == "compare" else ())
    place.catalog.problem(found.request.scene)


def test_a_recording_that_is_gone_is_solved_again_if_the_link_names_its_scene(place: Place) -> None:
    text = urlencode({"run": "gone.rrd", "scene": place.label, "seed": "8"})
    found = place.follower.follow(text, place.now, VIEW)
    assert len(found.remarks) == 1 and found.request is not None
    assert found.request.scene == SceneRequest(place.label, 8)


def test_a_step_and_matches_that_the_run_does_not_have_are_remarks(place: Place) -> None:
    found = place.follower.follow("step=sample-9&select=3,77,99", place.now, VIEW)
    assert found.missing("sample-5", range(50)) == ["the run has no match 77,99, which the link selects."]
    (step, _) = found.missing("outcome", range(50))
    assert step == "the run has no step 'sample-9'; the page shows its outcome."
    assert place.follower.follow("", place.now, VIEW).missing("yaw-clique", range(50)) == []


PAIRS = st.lists(st.tuples(st.sampled_from((*ONCE, *MANY)), st.text(max_size=12)), max_size=6)


@given(text=st.one_of(st.text(max_size=200), PAIRS.map(urlencode)))
def test_any_text_leads_to_a_run(place: Place, text: str) -> None:
    found = place.follower.follow(text, place.now, VIEW)
    request = place.now if found.request is None else found.request
    assert place.catalog.problem(request.scene) is not None


def test_a_long_link_is_not_written(place: Place) -> None:
    hidden = tuple(range(10_000, 10_000 + MAX_LETTERS // 6))
    scene = SceneRequest(place.label, 1)
    request = RunRequest(scene, "mc", default_options("mc", place.catalog.problem(scene)))
    assert place.link(request, PageView("outcome", hidden, "dark")) == ""


def test_a_staged_case_of_the_gallery_is_named_by_its_key(place: Place) -> None:
    text = "v=1&case=wrong-calibration_0&seed=4&estimator=mc&step=outcome"
    followed = place.follower.follow(text, place.now, VIEW)
    assert followed.remarks == () and followed.request is not None
    assert place.catalog.case(followed.request.scene.scene) == "wrong-calibration_0"
    assert "case=wrong-calibration_0" in place.link(followed.request, VIEW)
    for wrong, remark in (("nothing", "the gallery has no case 'nothing'"), ("pairs-outvote", "is not staged")):
        followed = place.follower.follow(f"v=1&case={wrong}", place.now, VIEW)
        assert remark in followed.remarks[0] and followed.request is None
