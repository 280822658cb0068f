"""Undo, redo, and what is done to single matches by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spherloc.datasets.variation import Variation
from spherloc.estimators import options_type
from spherloc_viz.app.catalog import RunRequest, SceneRequest
from spherloc_viz.app.edits import Edits
from spherloc_viz.app.history import MAX_REQUESTS, SAME_MOVE_S, History, changed_fields

SCENE = SceneRequest("a scene", 0, None, Variation())


def request(seed: int = 0, noise_px: float | None = None, estimator: str = "mc", **options: float) -> RunRequest:
    scene = replace(SCENE, seed=seed, variation=Variation(noise_px=noise_px))
    return RunRequest(scene, estimator, options_type(estimator)(**options))


def test_undo_and_redo_walk_through_what_was_asked_for() -> None:
    history, requests = History(), [request(seed=k) for k in range(4)]
    assert history.ways() == (False, False) and history.step(-1) is None
    for k, asked in enumerate(requests):
        history.note(asked, 10.0 * k)
    assert history.ways() == (True, False) and history.step(1) is None
    assert [history.step(-1) for _ in range(4)] == [requests[2], requests[1], requests[0], None]
    assert history.ways() == (False, True)
    assert history.step(1) is requests[1]
    history.note(requests[1], 50.0)
    assert history.ways() == (True, True), "that the page asks for what was gone back to changes nothing"
    history.note(request(seed=9), 60.0)
    assert history.ways() == (True, False) and history.step(-1) is requests[1], "what was undone is forgotten"


def test_dragging_a_slider_is_one_move() -> None:
    history = History()
    history.note(request(), 0.0)
    for k in range(20):
        history.note(request(noise_px=1.0 + 0.1 * k), 5.0 + 0.05 * k)
    history.note(request(noise_px=3.0, seed=1), 6.0)
    assert history.step(-1) == request(noise_px=1.0 + 0.1 * 19) and history.step(-1) == request()
    assert history.step(-1) is None


def test_a_hand_that_rests_on_a_slider_has_not_let_go() -> None:
    history = History()
    history.note(request(), 0.0)
    for k, now_s in enumerate((10.0, 10.1, 13.0, 16.5, 20.0)):
        history.note(request(noise_px=1.0 + k), now_s)
    assert history.step(-1) == request() and history.ways() == (False, True)
    assert history.step(1) == request(noise_px=5.0)


def test_another_control_ends_a_move_though_it_has_the_same_name() -> None:
    """There is the noise of the scene, and the noise that the estimator expects."""
    history, requests = History(), [request()]
    for scene_px, option_px in ((2.0, 1.0), (2.0, 3.0), (4.0, 3.0)):
        scene = replace(SCENE, variation=Variation(noise_px=scene_px))
        requests.append(RunRequest(scene, "mc", options_type("mc")(noise_px=option_px)))
    for k, asked in enumerate(requests):
        history.note(asked, 0.1 * k)
    assert [history.step(-1) for _ in range(3)] == requests[2::-1]


def test_a_move_that_leads_back_is_none() -> None:
    history = History()
    history.note(request(seed=1), 0.0)
    history.note(request(), 10.0)
    for k, bound_px in enumerate((4.0, 5.0, 3.0)):
        history.note(request(bound_px=bound_px), 20.0 + k)
    assert request(bound_px=3.0) == request() and history.step(-1) == request(seed=1)
    assert history.step(1) == request() and history.ways() == (True, False)
    history.note(request(bound_px=4.0), 30.0)
    history.note(request(bound_px=3.0), 31.0)
    history.note(request(bound_px=6.0), 32.0)
    assert history.step(-1) == request() and history.step(-1) == request(seed=1)


def test_what_is_switched_to_and_fro_is_no_drag() -> None:
    history = History()
    requests = [request(estimator="ransac-2p", local_optimization=value) for value in (False, True, False)]
    for k, asked in enumerate(requests):
        history.note(asked, 0.1 * k)
    assert [history.step(-1) for _ in range(3)] == [requests[1], requests[0], None]


def test_the_oldest_moves_are_forgotten_in_the_middle_of_one_too() -> None:
    history = History()
    for k in range(MAX_REQUESTS + 7):
        history.note(request(seed=k), 10.0 * k)
    for k in range(30):
        history.note(request(seed=MAX_REQUESTS + 6, noise_px=1.0 + k), 10.0 * (MAX_REQUESTS + 8) + 0.1 * k)
    assert history.step(-1) == request(seed=MAX_REQUESTS + 6) and history.step(-1) == request(seed=MAX_REQUESTS + 5)


def test_single_changes_are_never_one_move() -> None:
    history, requests = History(), [request(), *(request(seed=k) for k in (1, 2, 3))]
    for k, asked in enumerate(requests):
        history.note(asked, 0.01 * k)
    assert [history.step(-1) for _ in range(3)] == requests[2::-1]


def test_estimators_that_are_chosen_one_after_another_are_single_changes() -> None:
    history, requests = History(), [request(estimator=name) for name in ("mc", "mc-exact", "ransac-2p", "mc")]
    for k, asked in enumerate(requests):
        history.note(asked, 0.1 * k)
    assert [history.step(-1) for _ in range(3)] == requests[2::-1]


def camera(x_m: float | None) -> RunRequest:
    place = None if x_m is None else (30.0, x_m, 0.0, 0.0)
    return replace(request(), scene=replace(SCENE, variation=Variation(true_camera=place)))


@pytest.mark.parametrize("gesture", [0, 7])
def test_dragging_the_camera_is_one_move_and_putting_it_back_another(gesture: int) -> None:
    history = History()
    history.note(camera(None), 0.0)
    for k in range(20):
        history.note(camera(0.1 * k), 5.0 + 0.05 * k, gesture)
    history.note(camera(None), 6.5, gesture + 1)
    assert history.step(-1) == camera(0.1 * 19) and history.step(-1) == camera(None) and history.step(-1) is None


def test_what_is_held_all_the_time_is_one_move_however_long_it_rests() -> None:
    history = History()
    history.note(request(), 0.0, 1)
    for k in range(4):
        history.note(request(noise_px=2.0 + k), 3.0 * SAME_MOVE_S * k, 2)
    history.note(request(noise_px=9.0), 12.0 * SAME_MOVE_S, 3)
    assert history.step(-1) == request(noise_px=5.0) and history.step(-1) == request()


def test_two_moves_of_one_slider_are_two() -> None:
    history = History()
    for k in range(3):
        history.note(request(noise_px=1.0 + k), (SAME_MOVE_S + 0.1) * k)
    assert history.step(-1) == request(noise_px=2.0)
    # After going back, the next move starts anew, however soon it comes.
    history.note(request(noise_px=7.0), 2.0 * (SAME_MOVE_S + 0.1))
    assert history.step(-1) == request(noise_px=2.0)


def test_it_remembers_so_many() -> None:
    history = History()
    for k in range(MAX_REQUESTS + 50):
        history.note(request(seed=k), 10.0 * k)
    steps = 0
    while history.step(-1) is not None:
        steps += 1
    assert steps == MAX_REQUESTS - 1


@pytest.mark.parametrize(
    "other, names",
    [
        (request(), set()),
        (request(seed=1), {"seed"}),
        (request(noise_px=2.0), {"noise_px"}),
        (request(bound_px=2.0), {"bound_px"}),
        (request(estimator="ransac-2p", seed=3), {"estimator"}),
        (request(seed=1, noise_px=2.0, bound_px=2.0), {"seed", "noise_px", "bound_px"}),
    ],
)
def test_what_differs(other: RunRequest, names: set[str]) -> None:
    assert changed_fields(request(), other) == names


NUMBERS = st.sets(st.integers(0, 30), max_size=8)


@settings(max_examples=50)
@given(first=NUMBERS, second=NUMBERS)
def test_selection(first: set[int], second: set[int]) -> None:
    edits = Edits()
    edits.select(first)
    assert edits.selected == tuple(sorted(first))
    edits.select(second, extend=True)
    expected = first - second if second <= first else first | second
    assert set(edits.selected) == expected
    edits.select(())
    assert edits.selected == ()


@settings(max_examples=50)
@given(moves=st.lists(st.tuples(st.sampled_from(["spoil", "mend", "hide"]), NUMBERS), max_size=8))
def test_the_last_word_on_a_match_counts(moves: list[tuple[str, set[int]]]) -> None:
    edits = Edits()
    edits.apply(SCENE)
    last: dict[int, str] = {}
    hidden: set[int] = set()
    for move, numbers in moves:
        edits.select(numbers)
        getattr(edits, move)()
        if move == "hide":
            hidden |= numbers
        else:
            last |= dict.fromkeys(numbers, move)
    found = edits.apply(SCENE).variation
    assert set(found.hidden) == hidden
    assert set(found.spoiled) == {number for number, move in last.items() if move == "spoil"}
    assert set(found.mended) == {number for number, move in last.items() if move == "mend"}


def test_edits_belong_to_a_problem() -> None:
    edits = Edits()
    edits.apply(SCENE)
    edits.select((3, 40))
    edits.spoil()
    assert edits.apply(SCENE).variation.spoiled == (3, 40)
    fewer = replace(SCENE, variation=Variation(correspondences=20))
    assert edits.apply(fewer).variation.spoiled == (3,), "there is no match 40 among twenty"
    assert edits.apply(SCENE).variation.spoiled == (3, 40), "and it is back when there is"
    assert edits.apply(replace(SCENE, seed=1)).variation.spoiled == ()
    assert edits.apply(SCENE).variation.spoiled == () and edits.selected == ()


def test_opening_a_wish_takes_over_its_edits() -> None:
    edits = Edits()
    edits.apply(SCENE)
    edits.select((3, 40))
    edits.write(replace(SCENE, variation=Variation(spoiled=(1,))))
    assert edits.selected == (3, 40), "Undo and Redo keep the selection"
    variation = Variation(spoiled=(1,), mended=(2,), hidden=(5,))
    opened = replace(SCENE, seed=4, variation=variation)
    edits.write(opened)
    assert edits.selected == (), "numbers of other matches"
    assert edits.apply(replace(opened, variation=Variation())).variation == variation
    edits.show_all()
    assert edits.apply(replace(opened, variation=Variation())).variation == replace(variation, hidden=())
    edits.clear()
    assert edits.apply(replace(opened, variation=Variation())).variation == Variation()


def test_places_of_selected_matches() -> None:
    edits = Edits()
    edits.select((2, 5, 9))
    assert edits.places(np.array([0, 2, 3, 9])) == (1, 3)
