"""Highlights the selected correspondences in a picture and dims all others."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from spherloc.consensus.yaw_arcs import yaw_arcs
from spherloc.geometry import tangent_basis, yaw_of
from spherloc.trace import ConsensusStage, Trace, TranslationStage, YawStage
from spherloc.types import ByteArray, FloatArray, IntArray
from spherloc_viz import style
from spherloc_viz.layers import ring
from spherloc_viz.layers.agreement import agreement, subset
from spherloc_viz.layers.frame import even, length, level_circles, one_color
from spherloc_viz.layers.primitives import Balls, Picture, Points, SceneItem, Segments
from spherloc_viz.layers.residuals import run_bounds, verdicts

LAYER = "selection"
DOTS = ("map/points", "sphere/bearings")
"""Names of the dots that show single correspondences: map points and bearings."""
HALO = 1.8
"""Radius of the ring around a dot, in radii of the dot."""
INNER, OUTER = 1.06, 1.24
"""Radii of the band of the selected arcs, in sphere radii: between the sphere and the ring of all arcs."""
STEP_RAD = np.radians(4.0)
DOT_CORNERS = 20
"""Number of points of each circle around a dot."""
LIFT = 0.3
"""Distance of the circles inside and outside from the sphere with the image, in radii of the circle."""


def with_selection(picture: Picture, trace: Trace, selected: tuple[int, ...]) -> Picture:
    """The picture with the selected correspondences (indices in the problem) highlighted and all others dimmed.

    Drawn are a ring around the map point and the bearing, the ray between them, and, where the picture shows pairs,
    the arcs, the balls and the agreeing pairs of the selected: of one correspondence all pairs with it, of several the
    pairs among them; those in the clique if there are any; evenly thinned, as the note of the step says. It is for the
    canvas only: other views tell inliers by the colours of the picture as it was.
    """
    if not selected:
        return picture
    chosen = np.array(sorted(selected), dtype=np.int64)
    items = {item.name: item for item in picture.scene}
    marks: list[SceneItem] = _halos(items, chosen)
    notes = [picture.step.note] if picture.step.note else []
    for draw in (_arcs, _balls, _edges):
        drawn, note = draw(items, trace, tuple(chosen.tolist()))
        marks += drawn
        notes += [note] if note else []
    scene = (*(_dimmed(item, chosen) for item in picture.scene), *marks)
    return replace(picture, step=replace(picture.step, note=" ".join(notes)), scene=scene)


def _dimmed(item: SceneItem, chosen: IntArray) -> SceneItem:
    """The item, with the colours of other correspondences moved towards grey."""
    if not isinstance(item, Points | Segments | Balls):
        return item
    if item.ids is not None:
        own = np.isin(item.ids, chosen).reshape(len(item.ids), -1)
        return replace(item, colors=_dim(item.colors, np.count_nonzero(own, axis=1) > 0))
    return replace(item, colors=_dim(item.colors, np.zeros(len(item.colors), bool))) if item.layer == "rays" else item


def _dim(colors: ByteArray, keep: NDArray[np.bool_]) -> ByteArray:
    grey = np.array(style.UNDECIDED, dtype=np.float64)
    dim = np.round((1.0 - style.DIM) * colors + style.DIM * grey).astype(np.uint8)
    return np.where(keep[:, None], colors, dim)


def _halos(items: dict[str, SceneItem], chosen: IntArray) -> list[SceneItem]:
    """Rims around the dots of the selected, and the rays between. On a wall or on the image only half of a dot is seen
    and nothing of its rim, so if few are selected, they get circles too."""
    out: list[SceneItem] = []
    places: dict[str, dict[int, FloatArray]] = {}
    radii_m: list[float] = []
    shown = even(chosen, style.MAX_SELECTED_DOTS)
    for name in DOTS:
        dots = items.get(name)
        if not isinstance(dots, Points) or dots.ids is None:
            continue
        at = np.flatnonzero(np.isin(dots.ids, shown))
        colors = one_color(style.SELECTED, len(at))
        out.append(Points(f"selection/{name}", LAYER, dots.positions[at], colors, HALO * dots.radius_m, rim=True))
        radii_m.append(HALO * dots.radius_m)
        places[name] = dict(zip(dots.ids[at].tolist(), dots.positions[at], strict=True))
    points, bearings = (places.get(name, {}) for name in DOTS)
    ends = np.array([[bearings[k], points[k]] for k in bearings if k in points]).reshape(-1, 2, 3)
    out.append(Segments("selection/rays", LAYER, ends, one_color(style.SELECTED, len(ends)), 3.0))
    centre = _sphere_centre(items)
    if centre is not None and len(chosen) <= style.MAX_SELECTED_CIRCLES:
        out.append(_circles(ends, centre, radii_m))
    return out


def _circles(ends: FloatArray, centre: FloatArray, radii_m: list[float]) -> Segments:
    """Circles across the rays (K, 2, 3): around each point, and around its bearing on both sides of the sphere."""
    turns = np.linspace(0.0, 2.0 * np.pi, DOT_CORNERS + 1)
    lines = [np.zeros((0, 2, 3))]
    for bearing, point in ends:
        outward = (bearing - centre) / np.linalg.norm(bearing - centre)
        circle = np.column_stack([np.cos(turns), np.sin(turns)]) @ tangent_basis(outward[None])[0]
        lift = LIFT * radii_m[1] * outward
        for place, radius_m in ((point, radii_m[0]), (bearing - lift, radii_m[1]), (bearing + lift, radii_m[1])):
            line = place + radius_m * circle
            lines.append(np.stack([line[:-1], line[1:]], axis=1))
    joined = np.concatenate(lines)
    return Segments("selection/circles", LAYER, joined, one_color(style.SELECTED, len(joined)), 2.5)


@lru_cache(maxsize=8)
def _pairs(stage: YawStage | TranslationStage, selected: tuple[int, ...]) -> tuple[IntArray, bool]:
    """Indices of the arcs or balls of the selected, those in the clique if there are any, and whether there are."""
    inside = np.isin(stage.pairs, selected)
    own = np.count_nonzero(inside, axis=1) >= min(2, len(selected))
    members = stage.clique[own[stage.clique]].astype(np.int64)
    return (np.sort(members), True) if len(members) else (np.flatnonzero(own), False)


def _note(what: str, drawn: int, count: int, agreeing: bool) -> str:
    """A sentence on pairs that are not drawn."""
    if drawn == count:
        return ""
    return f"{drawn} of {count:,} {what} of the selection{' in the clique' if agreeing else ''} are highlighted."


def _arcs(items: dict[str, SceneItem], trace: Trace, selected: tuple[int, ...]) -> tuple[list[SceneItem], str]:
    """Yaw arcs, on tracks of their own around the sphere."""
    stage, dots = trace.stage(YawStage), items.get("sphere/bearings")
    centre = _sphere_centre(items)
    if stage is None or "ring/arcs" not in items or centre is None or not isinstance(dots, Points):
        return [], ""
    own, agreeing = _pairs(stage, selected)
    drawn = even(own, style.MAX_SELECTED_ARCS)
    radius_m = float(np.linalg.norm(dots.positions[0] - centre))
    tracks = INNER + (OUTER - INNER) * (np.arange(len(drawn)) + 0.5) / max(1, len(drawn))
    low, width = stage.lo_rad[drawn], (stage.hi_rad - stage.lo_rad)[drawn]
    lines = []
    for start, turn, track in zip(low, width, tracks, strict=True):
        yaws = start + turn * np.linspace(0.0, 1.0, 2 + int(turn / STEP_RAD))
        line = centre + radius_m * track * ring.directions(yaws)
        lines.append(np.stack([line[:-1], line[1:]], axis=1))
    ends = np.concatenate([np.zeros((0, 2, 3)), *lines])
    arcs = Segments("selection/arcs", LAYER, ends, one_color(style.SELECTED, len(ends)), 2.5)
    return [arcs], _note("arcs", len(drawn), len(own), agreeing)


def _sphere_centre(items: dict[str, SceneItem]) -> FloatArray | None:
    surface = items.get("sphere/surface")
    vertices = getattr(surface, "vertices", None)
    return None if vertices is None else 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))


def _balls(items: dict[str, SceneItem], trace: Trace, selected: tuple[int, ...]) -> tuple[list[SceneItem], str]:
    """Balls of camera positions by their level circles, seen through other balls; of many the smaller half."""
    stage = trace.stage(TranslationStage)
    if stage is None or not any(isinstance(item, Balls) and item.layer == "balls" for item in items.values()):
        return [], ""
    own, agreeing = _pairs(stage, selected)
    by_size = own[np.argsort(stage.radii_m[own], kind="stable")]
    small = by_size[: max(1, len(by_size) // 2)] if len(by_size) > style.MAX_SELECTED_BALLS else by_size
    drawn = even(small, style.MAX_SELECTED_BALLS)
    ends = level_circles(stage.centres_m[drawn], stage.radii_m[drawn])
    marks = Segments("selection/balls", LAYER, ends, one_color(style.SELECTED, len(ends)), 2.0)
    return [marks], _note("balls", len(drawn), len(own), agreeing)


def _edges(items: dict[str, SceneItem], trace: Trace, selected: tuple[int, ...]) -> tuple[list[SceneItem], str]:
    """Pairs of the largest agreeing set, as lines on the map."""
    stage, points = trace.stage(ConsensusStage), items.get("map/points")
    if stage is None or "pairs/clique" not in items or not isinstance(points, Points):
        return [], ""
    members = [k for k in selected if k in stage.clique]
    if len(selected) == 1:
        pairs = [(k, other) for k in members for other in stage.clique.tolist() if other != k]
    else:
        pairs = list(combinations(members, 2))
    drawn = even(np.array(pairs, dtype=np.int64).reshape(-1, 2), style.MAX_DRAWN_PAIRS)
    lines = Segments("selection/pairs", LAYER, points.positions[drawn], one_color(style.SELECTED, len(drawn)), 2.0)
    return [lines], _note("pairs", len(drawn), len(pairs), True)


MAX_COMPARED = 200
"""If there are more correspondences, only the pairs of an even sample are computed."""


@dataclass(frozen=True)
class Traits:
    """Properties of several correspondences in one run."""

    count: int
    """Number of the correspondences."""
    kept: int
    """Number of those that the run calls inliers."""
    right: int | None
    """Number of true inliers; None if the truth is unknown."""
    median_px: float | None
    """Median residual at the run's pose, px; None without a pose, or if none of them has a bearing."""
    agree: int
    """Number of pairs among them that agree at the run's yaw."""
    pairs: int
    """Number of pairs among them, of at most ``MAX_COMPARED`` correspondences."""
    sentences: tuple[str, ...]
    """Sentences on what they have in common."""


def explain_many(trace: Trace, numbers: IntArray) -> Traits:
    """The common properties of the correspondences of these indices (K,) in the problem."""
    known = verdicts(trace)
    places = np.flatnonzero(np.isin(trace.problem.aligned.index, numbers))
    places = even(places, MAX_COMPARED)
    agree, pairs = _agreeing(trace, places)
    errors = None if known.estimate is None else known.estimate.px[numbers]
    known_errors = np.empty(0) if errors is None else errors[~np.isnan(errors)]
    return Traits(
        count=len(numbers),
        kept=int(np.count_nonzero(known.kept[numbers])),
        right=None if known.right is None else int(np.count_nonzero(known.right[numbers])),
        median_px=float(np.median(known_errors)) if len(known_errors) else None,
        agree=agree,
        pairs=pairs,
        sentences=tuple(filter(None, (*_pair(trace, places), *_ball(trace, numbers), *_common(trace, numbers)))),
    )


def _agreeing(trace: Trace, places: IntArray) -> tuple[int, int]:
    pairs = len(places) * (len(places) - 1) // 2
    if trace.cam_from_map is None or not pairs:
        return 0, pairs
    aligned = trace.problem.aligned
    yaw = yaw_of(aligned.align_pose(trace.cam_from_map)[:, :3])
    return int(np.count_nonzero(agreement(aligned, run_bounds(trace).radians, yaw, places, places))) // 2, pairs


def _pair(trace: Trace, places: IntArray) -> tuple[str, ...]:
    """A sentence on the arcs of two correspondences."""
    if len(places) != 2:
        return ()
    aligned = trace.problem.aligned
    bound_rad = run_bounds(trace).radians[places]
    bound_rad.setflags(write=False)
    _, lo, hi = yaw_arcs(subset(aligned, places), bound_rad)
    if not len(lo):
        return ("Their pair has no yaw arc: no yaw explains both, or they are too close to say anything.",)
    arcs = " and ".join(f"{_degrees(a)} to {_degrees(b)}" for a, b in zip(lo, hi, strict=True))
    return (f"Their pair has {'one yaw arc' if len(lo) == 1 else f'{len(lo)} yaw arcs'}: {arcs}.",)


def _ball(trace: Trace, numbers: IntArray) -> tuple[str, ...]:
    """A sentence on the ball of camera positions of two correspondences."""
    stage = trace.stage(TranslationStage)
    if len(numbers) != 2 or stage is None:
        return ()
    own = np.flatnonzero(np.isin(stage.pairs, numbers).all(axis=1))
    if not len(own):
        return (f"None of the run's {len(stage.pairs):,} balls is of their pair.",)
    radius = length(float(stage.radii_m[own[0]]), trace.problem.metric)
    member = "is in" if np.isin(own, stage.clique).any() else "is not in"
    return (f"Their ball has a radius of {radius} and {member} the maximum clique.",)


def _degrees(angle_rad: float) -> str:
    return f"{(np.degrees(angle_rad) + 180.0) % 360.0 - 180.0:.1f}°"


def _common(trace: Trace, numbers: IntArray) -> tuple[str, ...]:
    problem, known = trace.problem, verdicts(trace)
    unseen = int(np.count_nonzero(~problem.usable[numbers]))
    far = 0 if known.estimate is None else int(np.count_nonzero(np.isinf(known.estimate.px[numbers])))
    sentences = []
    if unseen:
        sentences.append(f"The camera does not see {unseen} of their pixels.")
    if far:
        sentences.append(f"{far} are more than 90° off at the estimated pose.")
    if known.truth is not None and known.estimate is not None:
        lost = ~known.kept[numbers] & (known.truth.px[numbers] <= known.limit_px[numbers])
        if lost.any():
            sentences.append(f"{np.count_nonzero(lost)} agree with the true pose and not with the estimated one.")
    if problem.reference_index is not None and len(problem.reference_images) > 1:
        references = np.unique(problem.reference_index[numbers])
        one = len(references) == 1
        name = problem.reference_images[int(references[0])].name
        sentences.append(f"All were matched with {name}." if one else f"They come from {len(references)} references.")
    return tuple(sentences)
