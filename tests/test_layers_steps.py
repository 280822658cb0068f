"""The steps of a run: how many there are, what they are called, and that what they say is true."""

import re
from collections import Counter
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from recording_samples import exact_run, lost_run, scene_problem

from spherloc.estimators import estimate
from spherloc.geometry import yaw_rotation
from spherloc.problem import Problem
from spherloc.solvers.two_point import two_point
from spherloc.trace import ConsensusStage, RansacStage, RefinementStage, Stage, Trace, TranslationStage, YawStage
from spherloc_viz import style
from spherloc_viz.layers import MAX_PICTURES, paint, ring, steps, yaw
from spherloc_viz.layers.ball_set import BallSet
from spherloc_viz.layers.frame import RunView
from spherloc_viz.layers.outcome import early_table
from spherloc_viz.layers.primitives import Balls, Label, Picture, Points, SceneItem, Segments, true_minus
from spherloc_viz.layers.ransac import MAX_IMPROVEMENTS
from spherloc_viz.layers.stage_arcs import StageArcs


@pytest.fixture(scope="module")
def mc() -> Trace:
    return estimate(scene_problem("panorama_outliers_80"), "mc")


@pytest.fixture(scope="module")
def exact() -> Trace:
    return estimate(scene_problem("mei_outliers_90"), "mc-exact")


@pytest.fixture(scope="module")
def ransac() -> Trace:
    return estimate(scene_problem("panorama_outliers_80"), "ransac-2p")


def at(trace: Trace, key: str) -> Picture:
    return paint(trace, [step.key for step in steps(trace)].index(key))


def keys_like(trace: Trace, pattern: str) -> list[str]:
    return [step.key for step in steps(trace) if re.fullmatch(pattern, step.key)]


def item(picture: Picture, name: str) -> SceneItem:
    return next(found for found in picture.scene if found.name == name)


def of(trace: Trace, kind: type[Stage]) -> Stage:
    stage = trace.stage(kind)
    assert stage is not None
    return stage


def number_before(text: str, word: str) -> int:
    """The number before a word of a caption."""
    found = re.search(rf"([\d,]+) {word}", text)
    assert found is not None, text
    return int(found[1].replace(",", ""))


def colored(picture: Picture, color: style.RGB) -> np.ndarray:
    """Numbers of the matches whose map points have a colour."""
    points = item(picture, "map/points")
    assert isinstance(points, Points)
    return np.flatnonzero((points.colors == np.array(color)).all(axis=1))


def test_the_gravity_step_says_where_gravity_comes_from(ransac: Trace) -> None:
    assert at(ransac, "gravity").step.caption.startswith("Gravity is known exactly in the camera")
    told = replace(ransac.problem, gravity_source="lines of the image", gravity_bound_rad=0.01)
    caption = at(estimate(told, "ransac-2p"), "gravity").step.caption
    assert caption.startswith("Gravity is known from lines of the image to within 0.57° in the camera")


# ---------------------------------------------------------------------------------------------- the timeline


@pytest.mark.parametrize("scene", ["panorama_outliers_80", "mei_outliers_90"])
@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p", "auto"])
def test_a_run_has_20_to_200_steps_in_stages(scene: str, estimator: str) -> None:
    trace = estimate(scene_problem(scene), estimator)
    headings = steps(trace)
    assert 20 <= len(headings) <= 200 and len({heading.key for heading in headings}) == len(headings)
    stages = [heading.stage for heading in headings]
    assert stages[0] == "Matches" and stages[-1] == "Outcome"
    runs = [stage for k, stage in enumerate(stages) if k == 0 or stage != stages[k - 1]]
    assert len(runs) == len(set(runs)), "a stage is in one piece"
    assert headings == steps(replace(trace)), "the same run has the same steps"


def test_nothing_is_drawn_before_it_is_looked_at(mc: Trace, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("drawn")

    for name in ("colors", "standing", "aligned_pose"):
        monkeypatch.setattr(RunView, name, refuse)
    assert len(steps(replace(mc))) > 20


def test_pictures_are_kept_for_those_who_walk_back(mc: Trace) -> None:
    """Some of them, of one run; what is told and an image that is written later make another picture."""
    trace = replace(mc)
    first = paint(trace, 3)
    assert paint(trace, 4) is not first and paint(trace, 3) is first
    assert paint(trace, 3, told=False) is not first
    for index in range(4, 4 + MAX_PICTURES):
        paint(trace, index)
    again = paint(trace, 3)
    assert again is not first, "not all of them"
    assert [item.name for item in again.scene] == [item.name for item in first.scene]
    assert paint(replace(trace), 3) is not again


def test_charts_stay_and_the_newest_of_a_name_is_shown(mc: Trace) -> None:
    names = [tuple(chart.name for chart in paint(mc, index).charts) for index in range(len(steps(mc)))]
    assert names[0] == () and names[-1] == ("yaw", "refinement")
    assert all(set(before) <= set(after) for before, after in pairwise(names))
    assert at(mc, "yaw-arcs-10").charts[0].curves[0].y.max() < at(mc, "balls").charts[0].curves[0].y.max()


def two_matches() -> Problem:
    problem = scene_problem("panorama_outliers_80")
    labels = problem.truth_inliers
    assert labels is not None
    two = np.flatnonzero(labels)[:2]
    return replace(problem, pixels=problem.pixels[two], points=problem.points[two], truth_inliers=labels[two])


@pytest.mark.parametrize("estimator", ["mc", "mc-exact", "ransac-2p"])
@pytest.mark.parametrize("known", [True, False])
def test_two_matches_and_no_truth_can_be_told(estimator: str, known: bool) -> None:
    problem = two_matches()
    if not known:
        problem = replace(problem, truth_cam_from_map=None, truth_inliers=None)
    trace = estimate(problem, estimator)
    for index in range(len(steps(trace))):
        said = paint(trace, index).step.caption
        assert said.count(". ") == 1 and "nan" not in said
        assert known or not re.search("from the truth|In truth|right ones|from the true", said)


def test_a_run_without_a_pose_ends_with_its_stages() -> None:
    headings = steps(lost_run())
    assert headings[-1].title == "No pose" and [heading.stage for heading in headings][:5] == ["Matches"] * 5


# ---------------------------------------------------------------------------------------------- yaw


def covering(stage: YawStage, arcs: np.ndarray, yaws: np.ndarray) -> np.ndarray:
    """How many of the arcs cover each yaw, by looking at all of them."""
    offset = (yaws[:, None] - stage.lo_rad[arcs]) % (2 * np.pi)
    return np.count_nonzero(offset <= (stage.hi_rad - stage.lo_rad)[arcs] + 1e-15, axis=1)


def test_growing_arcs_overlap_as_often_as_they_say(mc: Trace) -> None:
    stage = of(mc, YawStage)
    assert isinstance(stage, YawStage)
    before: set[int] = set()
    keys = keys_like(mc, r"yaw-arcs-\d+")
    assert len(keys) >= 4
    for key in keys:
        size, picture = int(key.split("-")[-1]), at(mc, key)
        arcs = StageArcs(stage, np.zeros(0, dtype=bool)).spread(size)
        assert before < set(arcs.tolist()) and len(set(arcs.tolist())) == size
        before = set(arcs.tolist())
        most = covering(stage, arcs, stage.lo_rad[arcs]).max()
        said = "no two overlap" if most == 1 else f"at most {most:,} overlap"
        assert said in picture.step.caption and f"With {size:,} of" in picture.step.caption
        assert picture.charts[-1].curves[0].y.max() == most
        band = item(picture, "ring/arcs")
        assert isinstance(band, Segments) and band.ids is not None
        assert {tuple(pair) for pair in band.ids} <= {tuple(pair) for pair in stage.pairs[arcs]}


def test_a_candidate_yaw_lies_in_as_many_arcs_as_it_says(mc: Trace) -> None:
    stage = of(mc, YawStage)
    assert isinstance(stage, YawStage)
    everything, keys = np.arange(len(stage.lo_rad)), keys_like(mc, r"yaw-candidate-\d+")
    places = yaw.candidate_yaws(stage)
    assert len(keys) == len(places) >= 3 and (np.diff(places) > 0).all()
    for key, place in zip(keys, places.tolist(), strict=True):
        lo, hi = (np.radians(ring.degrees_of(place + part, 1440)) for part in (0, 1))
        inside = stage.lo_rad[(stage.lo_rad >= lo) & (stage.lo_rad < hi)]
        brute = covering(stage, everything, np.append(inside, lo)).max()
        picture = at(mc, key)
        assert number_before(picture.step.caption, "of") == brute == stage.overlap[place]
        near = np.take(stage.overlap, np.arange(place - 40, place + 41), mode="wrap")
        assert near.max() == brute
        band = item(picture, "ring/arcs")
        assert isinstance(band, Segments) and band.ids is not None
        pink = {tuple(pair) for pair in band.ids[(band.colors == np.array(style.SAMPLE)).all(axis=1)]}
        touched = covering(stage, everything, np.linspace(lo, hi, 50)[:1]) > 0
        assert touched.any() and pink


def test_candidate_yaws_are_held_against_those_before(mc: Trace) -> None:
    stage = of(mc, YawStage)
    assert isinstance(stage, YawStage)
    places = yaw.candidate_yaws(stage)
    for k, key in enumerate(keys_like(mc, r"yaw-candidate-\d+")):
        said, here = at(mc, key).step.caption, stage.overlap[places[k]]
        most = max(stage.overlap[places[:k]], default=0)
        assert ("beats the candidates before" in said) == bool(k and here > most)
        assert ("is in more" in said) == bool(here < most)


def test_roots_are_those_of_the_solver(mc: Trace, rng: np.random.Generator) -> None:
    view, aligned = RunView(mc), mc.problem.aligned
    compared = 0
    for first, second in rng.integers(0, len(mc.problem), (60, 2)):
        if first == second:
            continue
        roots = yaw.pair_roots(view, int(first), int(second))
        d, n = view.points[first] - view.points[second], np.cross(aligned.bearings[first], aligned.bearings[second])
        for root in roots.yaws_rad:
            assert abs(n @ yaw_rotation(root) @ d) < 1e-9 * np.linalg.norm(d)
        pair = np.array([[first, second]])
        solved, _, exists = two_point(aligned.bearings[pair], view.points[pair])
        np.testing.assert_allclose(np.sort(roots.yaws_rad[roots.in_front]), np.sort(solved[exists]), atol=1e-9)
        compared += np.count_nonzero(exists)
    assert compared > 20


def test_roots_are_both_arcs_of_one_pair_and_all_pairs_are_counted(mc: Trace) -> None:
    stage = of(mc, YawStage)
    assert isinstance(stage, YawStage)
    picture = at(mc, "yaw-roots")
    arcs = Counter(tuple(pair) for pair in stage.pairs.tolist())
    one, several = sum(count == 1 for count in arcs.values()), sum(count > 1 for count in arcs.values())
    none = stage.pairs_total - one - several
    more = " or more" if max(arcs.values()) > 2 else ""
    told = f"{several:,} have two arcs{more}, {one:,} have one, and {none:,} have none"
    assert told in picture.step.caption
    band, hands = item(picture, "ring/arcs"), item(picture, "ring/candidate")
    assert isinstance(band, Segments) and isinstance(hands, Segments) and band.ids is not None
    (pair,) = {tuple(pair) for pair in band.ids.tolist()}
    assert arcs[pair] == len(hands.points) == 2 and mc.inlier_mask[list(pair)].all()
    first = at(mc, "yaw-pair")
    same = item(first, "ring/arcs")
    assert isinstance(same, Segments) and len(same.points) == len(band.points), "the caption tells of both"
    assert set(colored(picture, style.SAMPLE)) == set(pair)
    assert f"Matches {pair[0]} and {pair[1]} " in at(mc, "yaw-pair").step.caption


def test_without_a_second_arc_the_other_root_is_explained() -> None:
    problem = scene_problem("panorama_outliers_80")
    trace = estimate(problem, "mc")
    stage = of(trace, YawStage)
    assert isinstance(stage, YawStage)
    single = np.flatnonzero([count == 1 for count in _arcs_of_same_pair(stage)])
    thin = replace(
        stage,
        pairs=stage.pairs[single],
        lo_rad=stage.lo_rad[single],
        hi_rad=stage.hi_rad[single],
        clique=np.flatnonzero(np.isin(single, stage.clique)).astype(np.int32),
    )
    said = at(replace(trace, stages=(thin, *trace.stages[1:])), "yaw-roots").step.caption
    assert re.search(r"opposite to its bearing|too wide|only comes near", said) and " 0 have two arcs, " in said


def _arcs_of_same_pair(stage: YawStage) -> list[int]:
    arcs = Counter(tuple(pair) for pair in stage.pairs.tolist())
    return [arcs[tuple(pair)] for pair in stage.pairs.tolist()]


def test_peaks_are_peaks_whatever_the_counts(rng: np.random.Generator) -> None:
    for _ in range(30):
        counts = rng.integers(0, 6, 200).astype(np.int32)
        reach = int(rng.integers(1, 20))
        found = ring.peaks(counts, reach, 200)
        for place in found:
            assert counts[place] == np.take(counts, np.arange(place - reach, place + reach + 1), mode="wrap").max() > 0
        for one, two in combinations(found.tolist(), 2):
            assert min(abs(one - two), 200 - abs(one - two)) > reach
        assert (np.diff(counts[found]) <= 0).all() and counts[found[0]] == counts.max()
    assert len(ring.peaks(np.zeros(50, np.int32), 3, 5)) == 0


# ---------------------------------------------------------------------------------------------- translation


def overlaps(stage: TranslationStage, a: int, b: int) -> bool:
    return bool(np.linalg.norm(stage.centres_m[a] - stage.centres_m[b]) <= stage.radii_m[a] + stage.radii_m[b] + 1e-12)


def test_the_first_balls_overlap_as_often_as_they_say(mc: Trace) -> None:
    stage = of(mc, TranslationStage)
    assert isinstance(stage, TranslationStage)
    order = BallSet(stage).order
    assert sorted(order.tolist()) == list(range(len(stage.radii_m)))
    half = len(order) // 2
    assert stage.radii_m[order[:half]].max() <= stage.radii_m[order[half:]].min(), "the smaller half comes first"
    for key in ("balls-10", "balls-30"):
        size, picture = int(key.split("-")[1]), at(mc, key)
        first = order[:size].tolist()
        brute = sum(overlaps(stage, a, b) for a, b in combinations(first, 2))
        assert f"; {brute:,} of their {size * (size - 1) // 2:,} pairs overlap" in picture.step.caption
        balls = item(picture, "balls/others")
        assert isinstance(balls, Balls) and balls.ids is not None
        assert {tuple(pair) for pair in balls.ids} <= {tuple(pair) for pair in stage.pairs[first]}


def test_greedy_cliques_are_cliques_that_nothing_can_join(mc: Trace) -> None:
    stage = of(mc, TranslationStage)
    assert isinstance(stage, TranslationStage)
    balls = BallSet(stage)
    for order in (balls.by_radius, np.argsort(-balls.degrees, kind="stable")):
        found = balls.greedy(order).tolist()
        assert found[0] == order[0] and all(overlaps(stage, a, b) for a, b in combinations(found, 2))
        for ball in set(range(len(balls))) - set(found):
            assert not all(overlaps(stage, ball, member) for member in found)
        assert len(found) <= len(stage.clique)
    assert f"grows to {len(found):,} balls" in at(mc, "clique-greedy-degree").step.caption


def test_members_of_the_clique_gather_around_the_camera(mc: Trace) -> None:
    stage = of(mc, TranslationStage)
    assert isinstance(stage, TranslationStage)
    for key in keys_like(mc, r"clique-\d+"):
        picture, size = at(mc, key), int(key.split("-")[1])
        gold = item(picture, "balls/clique-centres")
        assert isinstance(gold, Points) and len(gold.positions) == size
        assert {tuple(place) for place in gold.positions} <= {tuple(place) for place in stage.centres_m[stage.clique]}


def test_ids_are_numbers_of_the_problem() -> None:
    """Also where pixels without a bearing shift the numbers of all that follow."""
    problem = scene_problem("mei_outliers_80")
    pixels = problem.pixels.copy()
    pixels[[0, 5, 6]] = 1e6
    trace = estimate(replace(problem, pixels=pixels), "mc")
    view, usable = RunView(trace), set(np.flatnonzero(trace.problem.usable).tolist())
    assert len(usable) < len(problem)
    for index in range(len(steps(trace))):
        for found in paint(trace, index).scene:
            if isinstance(found, Segments | Balls) and found.ids is not None:
                assert found.ids.shape == (len(found.colors), 2) and set(found.ids.ravel().tolist()) <= usable
            if found.name == "pairs/sample":
                assert isinstance(found, Segments)
                np.testing.assert_array_equal(found.points, view.points[found.ids])


# ---------------------------------------------------------------------------------------------- consensus


def test_peaks_of_the_bound_come_from_the_highest_down(exact: Trace) -> None:
    stage = of(exact, ConsensusStage)
    assert isinstance(stage, ConsensusStage)
    keys = keys_like(exact, r"consensus-yaw-\d+")
    heights = []
    for key in keys:
        picture = at(exact, key)
        hand = next(curve for curve in picture.charts[-1].curves if curve.label == "candidate")
        height = int(stage.bound[int((hand.x[0] + 180.0) * 4)])
        heights.append(height)
        assert f"no pose explains more than {height} of" in picture.step.caption
        assert ("not excluded" in picture.step.caption) == (height > stage.support[0])
    assert len(keys) >= 5 and heights == sorted(heights, reverse=True) and heights[0] == stage.bound.max()


def test_a_bound_that_is_the_same_at_every_yaw_has_no_peaks() -> None:
    """A search over positions alone bounds all yaws together."""
    flat = exact_run(bound=np.full(1440, 26, np.int32))
    assert not keys_like(flat, r"consensus-yaw-\d+")
    picture = at(flat, "consensus-bound")
    assert picture.step.title == "What no pose can beat"
    bars = next(found for found in picture.scene if found.name == "ring/bars")
    assert isinstance(bars, Segments) and not (bars.colors == style.CLIQUE).all(axis=-1).any()
    names = [found.text for found in picture.scene if isinstance(found, Label)]
    assert "bound: at most 26 matches at any yaw" in names


def test_verified_poses_explain_as_many_as_they_say() -> None:
    """Repeated structure: several poses explain something."""
    problem = scene_problem("panorama_outliers_80")
    labels, truth = problem.truth_inliers, problem.truth_cam_from_map
    assert labels is not None and truth is not None
    points = problem.points.copy()
    moved = np.flatnonzero(labels)[::2]
    points[moved] += [2.0, 0.0, 1.0]
    trace = estimate(replace(problem, points=points), "mc-exact")
    stage = of(trace, ConsensusStage)
    assert isinstance(stage, ConsensusStage) and len(stage.support) > 1
    keys = keys_like(trace, r"consensus-pose-\d+")
    assert len(keys) == len(stage.support)
    for key, support in zip(keys, stage.support.tolist(), strict=True):
        picture = at(trace, key)
        assert len(colored(picture, style.INLIER)) == support and f"explains {support} of" in picture.step.caption


def test_members_of_the_set_are_drawn_in_all_pairs() -> None:
    picture = at(exact_run(), "consensus-clique-5")
    pairs = item(picture, "pairs/clique")
    assert isinstance(pairs, Segments) and pairs.ids is not None and len(pairs.points) == 10
    assert {frozenset(pair) for pair in pairs.ids.tolist()} == {
        frozenset(pair) for pair in combinations(colored(picture, style.CLIQUE).tolist(), 2)
    }


# ---------------------------------------------------------------------------------------------- samples, refinement


def test_many_improvements_are_thinned_evenly_with_both_ends(ransac: Trace) -> None:
    stage = of(ransac, RansacStage)
    assert isinstance(stage, RansacStage)
    many = np.arange(200) % len(stage.improved_at)
    long = replace(
        stage,
        iterations=1000,
        improved_at=np.arange(200, dtype=np.int32),
        samples=stage.samples[many],
        cam_from_map=stage.cam_from_map[many],
        inlier_masks=stage.inlier_masks[many],
        locally_optimized=stage.locally_optimized[many],
    )
    trace = replace(ransac, stages=(long, *ransac.stages[1:]))
    keys = keys_like(trace, r"sample-\d+")
    assert len(keys) == MAX_IMPROVEMENTS and (keys[0], keys[-1]) == ("sample-1", "sample-200")
    assert not keys_like(trace, r"sample-\d+-pose") and len(steps(trace)) <= 200
    assert f"{MAX_IMPROVEMENTS} of 200 improvements" in at(trace, "sample-1").step.note


def test_the_history_of_ransac_ends_where_the_step_is(ransac: Trace) -> None:
    stage = of(ransac, RansacStage)
    assert isinstance(stage, RansacStage)
    for k in range(len(stage.improved_at)):
        curve = at(ransac, f"sample-{k + 1}").charts[0].curves[0]
        assert curve.y.max() == np.count_nonzero(stage.inlier_masks[k])
    mask = stage.inlier_masks[-1]
    share, best = mask.mean(), int(stage.improved_at[-1]) + 1
    picture = at(ransac, "samples-drawn")
    assert f"drawn by then is {1 - (1 - share**2) ** best:.3g}." in picture.step.caption
    chances = next(chart for chart in picture.charts if chart.name == "chance").curves[0]
    np.testing.assert_allclose(chances.y, 1 - (1 - share**2) ** chances.x, atol=1e-12)


def test_a_sample_is_as_clean_as_it_says(ransac: Trace) -> None:
    stage, labels = of(ransac, RansacStage), ransac.problem.truth_inliers
    assert isinstance(stage, RansacStage) and labels is not None
    for k, sample in enumerate(stage.samples):
        if not stage.locally_optimized[k]:
            said = at(ransac, f"sample-{k + 1}-pose").step.caption
            assert f"In truth {np.count_nonzero(labels[sample])} of these 2 are right" in said


@pytest.mark.parametrize("name", ["mc", "exact", "ransac"])
def test_every_state_is_green_where_it_is_within_the_bound(name: str, request: pytest.FixtureRequest) -> None:
    trace = request.getfixturevalue(name)
    stage = of(trace, RefinementStage)
    assert isinstance(stage, RefinementStage)
    keys = keys_like(trace, r"refinement-\d+")
    assert len(keys) == len(stage.cost_px2)
    for k, key in enumerate(keys):
        picture = at(trace, key)
        assert len(colored(picture, style.INLIER)) == stage.inlier_counts[k]
        assert f"off by {np.sqrt(stage.cost_px2[k]):.3f} px RMS" in picture.step.caption
    inliers, outliers = at(trace, "refinement-inliers"), at(trace, "refinement-outliers")
    assert set(colored(inliers, style.INLIER)) == set(np.flatnonzero(trace.inlier_mask))
    assert set(colored(outliers, style.OUTLIER)) == set(np.flatnonzero(~trace.inlier_mask))
    assert outliers.step.caption.startswith(f"Rejected: {np.count_nonzero(~trace.inlier_mask):,},")


def test_negative_numbers_have_a_true_minus(mc: Trace) -> None:
    """A hyphen is for ranges and names."""
    told = [paint(mc, k).step for k, heading in enumerate(steps(mc)) if heading.stage == "Yaw"]
    words = " ".join(word for step in told for word in (step.title, step.caption, step.note))
    assert re.search(r"\N{MINUS SIGN}\d", words) and not re.search(r"(^|[^\w)])-\.?\d", words)
    assert (
        true_minus("-1 (-.5) Eq. 24-27, a-1, 2026-01-02, 1e-16")
        == "\N{MINUS SIGN}1 (\N{MINUS SIGN}.5) Eq. 24-27, a-1, 2026-01-02, 1e-16"
    )


def test_the_clique_tells_how_many_of_its_matches_the_run_keeps(mc: Trace) -> None:
    stage = of(mc, TranslationStage)
    assert isinstance(stage, TranslationStage)
    members = np.unique(stage.pairs[stage.clique])
    kept = int(np.count_nonzero(mc.inlier_mask[members]))
    told = f"of the {len(members)} matches, the run keeps {kept}."
    assert 0 < kept < len(members) and at(mc, "clique").step.note.endswith(told)


def test_times_of_stages_and_the_rest_are_the_whole_time(mc: Trace) -> None:
    def told(**times_ms: float) -> str:
        return dict((row[0], row[1]) for row in early_table(replace(mc, timings_ms=times_ms), None).rows)["solved in"]

    assert told(guess=0.5, refinement=1.0, total=5.0) == "5.0 ms (guess 0.5, refinement 1.0, the rest 3.5)"
    assert (
        told(guess=0.5, refinement=1.0, total=1.6) == "1.6 ms (guess 0.5, refinement 1.0)"
        and told(total=2.0) == "2.0 ms"
    )
