"""Draws the pictures of docs/concepts.md and docs/architecture.md from real runs: ``python -m scripts.pictures``.

Most come from the bundled scene of an MEI fisheye with 90 % outliers, seed 7, which the page's examples solve too.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import spherloc
from scripts.drawing import FAINT, INK, Drawing, Point
from spherloc.cameras.base import in_image
from spherloc.datasets.synthetic import SyntheticScene
from spherloc.geometry import camera_centre, yaw_of
from spherloc.metrics import ransac_success_probability
from spherloc.refine import residuals_px
from spherloc.trace import ConsensusStage, PositionStage, RefinementStage, TranslationStage, YawStage
from spherloc.types import FloatArray
from spherloc_viz import style

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "pictures"
SCENE, SEED = "mei_outliers_90", 7
GREEN, RED, GOLD = style.css(style.INLIER), style.css(style.OUTLIER), style.css(style.CLIQUE)
BLUE, LILAC, PINK = style.css(style.ESTIMATE), style.css(style.TRUTH), style.css(style.SAMPLE)
GREY = style.css(style.UNDECIDED)
COLORS = ("#f0b41e", "#009e73", "#d5463c", "#5b9be6", "#e65abe", "#a082d2", "#6ecdd7", "#dde3ea")


def problem() -> spherloc.Problem:
    """What the examples solve."""
    return spherloc.load_scene(spherloc.bundled_scenes()[SCENE]).problem(seed=SEED)


def sphere() -> Drawing:
    """Directions in a fisheye image, in a panorama and on the unit sphere."""
    drawing = Drawing(920, 330, "The same eight directions in a fisheye image, in a panorama, and on the unit sphere")
    scenes = spherloc.bundled_scenes()
    fisheye = spherloc.load_scene(scenes["fisheye_outliers_90"]).problem(seed=SEED).camera
    panorama = spherloc.load_scene(scenes["panorama_outliers_90"]).problem(seed=SEED).camera
    angle = np.radians([[-50, -10], [-38, 28], [-15, -30], [0, 8], [18, 40], [30, -18], [48, 14], [62, -36]])
    cos = np.cos(angle[:, 1])
    rays = np.column_stack([np.sin(angle[:, 0]) * cos, -np.sin(angle[:, 1]), np.cos(angle[:, 0]) * cos])
    for camera, left, width, name in ((fisheye, 24, 250, "fisheye image"), (panorama, 300, 330, "panorama")):
        scale = width / camera.width
        height = scale * camera.height
        top = 160 - height / 2
        drawing.box(left, top, width, height, "#0b0f14", "#3a4352")
        if camera is fisheye:
            drawing.circle((left + width / 2, 160), 0.49 * width, "#3a4352", fill="#1a222c")
        pixels, _ = camera.project(rays)
        for pixel, color, seen in zip(pixels, COLORS, in_image(camera, pixels), strict=True):
            if seen:
                drawing.dot((left + scale * pixel[0], top + scale * pixel[1]), color, 5.5)
        drawing.text(left + width / 2, 308, name, anchor="middle")
    centre, radius = np.array([780.0, 160.0]), 120.0
    drawing.circle(tuple(centre), radius, FAINT, fill="#1a222c")
    turned = rays @ _turn_y(0.0).T
    for start, axis in ((0, 1), (1, 0)):
        ring = np.linspace(0, 2 * np.pi, 60)
        circle = np.zeros((60, 3))
        circle[:, start], circle[:, 2] = np.cos(ring), np.sin(ring)
        circle[:, axis] = 0.0
        drawing.path(_seen(circle, centre, radius), "#3a4352", 1)
    for end, color in zip(_seen(turned, centre, radius), COLORS, strict=True):
        drawing.line(tuple(centre), end, color, 1.2)
        drawing.dot(end, color, 5.5)
    drawing.dot(tuple(centre), INK, 3)
    drawing.text(780, 308, "bearings on the unit sphere", anchor="middle")
    return drawing


def _turn_y(angle: float) -> FloatArray:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def _seen(points: FloatArray, centre: FloatArray, radius: float) -> list[Point]:
    """Points of the unit sphere as seen from somewhat above and behind."""
    tilt = np.radians(20.0)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    flat = (points @ turn.T)[:, :2]
    return [(float(x), float(y)) for x, y in centre + radius * flat]


def gravity() -> Drawing:
    """Six unknowns become four."""
    drawing = Drawing(920, 300, "Without gravity a pose has six unknowns; with known gravity four are left")
    for left, title, level in ((30, "gravity unknown: 6 unknowns", False), (490, "gravity known: 4 unknowns", True)):
        x, y = left + 150, 160
        drawing.text(left, 34, title, size=16)
        for axis, (dx, dy) in {"x": (95, 0), "y": (0, 88), "z": (66, -52)}.items():
            drawing.arrow((x, y), (x + dx, y + dy), BLUE, 2.4)
            drawing.text(x + 1.14 * dx - 4, y + 1.14 * dy + 6, axis, color=BLUE, size=15)
        around = np.linspace(0.35, 2 * np.pi + 0.05, 50)
        rings = {"yaw": (70 * np.cos(around), 20 * np.sin(around), GOLD)}
        if not level:
            rings["pitch"] = (18 * np.cos(around), 62 * np.sin(around), PINK)
            rings["roll"] = (52 * np.cos(around), 52 * np.sin(around), GREEN)
        for name, (dx, dy, color) in rings.items():
            drawing.path(zip(x + dx, y + dy, strict=True), color, 2)
            row = list(rings).index(name)
            drawing.text(left + 300, 120 + 26 * row, name, color=color, size=15)
        drawing.text(left + 300, 120 + 26 * len(rings), "position x, y, z", color=BLUE, size=15)
        drawing.dot((x, y), INK, 6)
        if level:
            drawing.arrow((x - 100, y - 40), (x - 100, y + 70), RED, 3)
            drawing.text(x - 100, y + 92, "gravity", color=RED, size=15, anchor="middle")
    return drawing


def roots() -> Drawing:
    """f over yaw of a pair of right matches: two roots, and the arcs where noise lets f be zero."""
    trace = spherloc.estimate(problem(), "mc")
    stage, aligned = trace.stage(YawStage), trace.problem.aligned
    assert stage is not None and trace.problem.truth_inliers is not None
    right = set(np.flatnonzero(trace.problem.truth_inliers))
    place = {int(index): number for number, index in enumerate(aligned.index)}
    width = stage.hi_rad - stage.lo_rad
    pairs = {}
    for number, (i, j) in enumerate(stage.pairs):
        if i in right and j in right and np.radians(6) < width[number] < np.radians(14):
            pairs.setdefault((int(i), int(j)), []).append(number)
    (i, j), arcs = next((pair, numbers) for pair, numbers in pairs.items() if len(numbers) == 2)
    a, b = place[i], place[j]
    normal = np.cross(aligned.bearings[a], aligned.bearings[b])
    d = aligned.points[a] - aligned.points[b]
    yaw = np.radians(np.arange(-180, 181))
    f = np.cos(yaw) * (normal[0] * d[0] + normal[2] * d[2]) + np.sin(yaw) * (normal[0] * d[2] - normal[2] * d[0])
    f = (f + normal[1] * d[1]) / np.abs(f + normal[1] * d[1]).max()
    drawing = Drawing(920, 300, "One pair of matches: two yaws at which its rays can meet its points, and their arcs")
    left, right_x, middle, tall = 60, 890, 150, 100

    def at(angle: FloatArray | float) -> FloatArray:
        return left + (np.asarray(angle) + np.pi) / (2 * np.pi) * (right_x - left)

    for number in arcs:
        x0, x1 = float(at(stage.lo_rad[number])), float(at(stage.hi_rad[number]))
        drawing.box(x0, middle - tall, x1 - x0, 2 * tall, GOLD, opacity=0.35)
    drawing.line((left, middle), (right_x, middle), FAINT, 1)
    drawing.path(zip(at(yaw), middle - tall * f, strict=True), INK, 2)
    zeros = np.flatnonzero(np.diff(np.sign(f)))
    for zero in zeros:
        drawing.dot((float(at(yaw[zero] + 0.5 * np.radians(1))), middle), PINK, 6)
    assert trace.problem.truth_cam_from_map is not None
    true = float(at(yaw_of(aligned.align_pose(trace.problem.truth_cam_from_map))))
    drawing.line((true, middle - tall - 12), (true, middle + tall + 12), LILAC, 2, dash="5 4")
    drawing.text(true + 6, middle - tall - 4, "true yaw", color=LILAC, size=13)
    for degrees in range(-180, 181, 90):
        drawing.text(float(at(np.radians(degrees))), 286, f"{degrees}°", size=13, color=FAINT, anchor="middle")
    drawing.text(left, 26, "f(yaw) of one pair; dots: the two roots; gold: the yaw arcs that noise allows", size=14)
    return drawing


def ransac() -> Drawing:
    """Eq. 28 for samples of two and of six."""
    drawing = Drawing(920, 330, "Probability of an outlier-free sample by Eq. 28 against the number of samples")
    left, right, top, bottom = 70, 870, 66, 280
    draws = np.logspace(0, 7, 141)

    def at(count: float, chance: float) -> Point:
        return left + (right - left) * np.log10(count) / 7, bottom - (bottom - top) * chance

    for power in range(8):
        x, _ = at(10.0**power, 0)
        drawing.line((x, top), (x, bottom), "#262f3b", 1)
        drawing.text(x, bottom + 22, f"{10**power:,}", size=13, color=FAINT, anchor="middle")
    for chance in (0.0, 0.5, 1.0):
        drawing.text(left - 10, at(1, chance)[1] + 5, f"{chance:.0%}", size=13, color=FAINT, anchor="end")
        drawing.line(at(1, chance), at(1e7, chance), "#262f3b", 1)
    for size, color in ((2, GOLD), (6, PINK)):
        for rate, dash in ((0.5, ""), (0.2, "7 4"), (0.1, "2 4")):
            curve = [at(count, ransac_success_probability(rate, size, int(count))) for count in draws]
            drawing.path(curve, color, 2, dash=dash)
    drawing.text(left, 26, "P = 1 - (1 - w^n)^k over the number of samples k (Eq. 28)", size=15)
    drawing.text(
        left,
        48,
        "gold: n = 2; pink: n = 6; solid, dashed, dotted: share of right matches w = 50 %, 20 %, 10 %",
        13,
        FAINT,
    )
    drawing.text((left + right) / 2, bottom + 42, "samples k", size=13, color=FAINT, anchor="middle")
    return drawing


def arcs() -> Drawing:
    """How many arcs cover each yaw, around a circle and unrolled."""
    trace = spherloc.estimate(problem(), "mc")
    stage = trace.stage(YawStage)
    assert stage is not None and trace.problem.truth_cam_from_map is not None
    drawing = Drawing(920, 330, "Yaw arcs of all pairs: where most of them overlap is the yaw of the camera")
    centre, radius = np.array([165.0, 175.0]), 82.0
    drawing.circle(tuple(centre), radius, FAINT)
    yaw = np.radians(np.arange(len(stage.overlap)) / 4.0 - 180.0)
    reach = radius + 62.0 * stage.overlap / stage.overlap.max()
    drawing.path(
        [(float(x), float(y)) for x, y in centre + np.column_stack([reach * np.sin(yaw), -reach * np.cos(yaw)])],
        GREY,
        1.2,
        fill="#2a333f",
        closed=True,
    )
    drawing.circle(tuple(centre), radius, FAINT, fill="#141a22")
    chosen = np.random.default_rng(0).choice(len(stage.pairs), 60, replace=False)
    for number, arc in enumerate([*chosen, *stage.clique[:14]]):
        gold = number >= len(chosen)
        turn = np.linspace(stage.lo_rad[arc], stage.hi_rad[arc], 12)
        r = 20 + 58 * (number % 30) / 30
        drawing.path(
            [(float(centre[0] + r * np.sin(t)), float(centre[1] - r * np.cos(t))) for t in turn],
            GOLD if gold else FAINT,
            2.0 if gold else 1.0,
        )
    drawing.text(20, 28, "arcs of pairs (gold: those that share the best yaw)", size=14)
    left, right, top, bottom = 390, 890, 60, 280
    xs = left + (right - left) * (yaw + np.pi) / (2 * np.pi)
    ys = bottom - (bottom - top) * stage.overlap / stage.overlap.max()
    drawing.path([(left, bottom), *zip(xs.tolist(), ys.tolist(), strict=True), (right, bottom)], GREY, 1.2, "#2a333f")
    best = left + (right - left) * (stage.yaw_rad + np.pi) / (2 * np.pi)
    drawing.line((best, top - 10), (best, bottom), GOLD, 2)
    true = yaw_of(trace.problem.aligned.align_pose(trace.problem.truth_cam_from_map))
    x = left + (right - left) * (true + np.pi) / (2 * np.pi)
    drawing.line((x, top - 10), (x, bottom), LILAC, 2, dash="5 4")
    for degrees in range(-180, 181, 90):
        drawing.text(left + (right - left) * (degrees + 180) / 360, 302, f"{degrees}°", 13, FAINT, "middle")
    drawing.text(
        left, 28, f"{int(stage.overlap.max())} of {len(stage.pairs):,} arcs overlap (gold); dashed: the true yaw", 14
    )
    return drawing


def balls() -> Drawing:
    """Balls of the rotation clique from above, and those of the maximum clique."""
    trace = spherloc.estimate(problem(), "mc")
    stage = trace.stage(TranslationStage)
    assert stage is not None and trace.problem.truth_cam_from_map is not None
    drawing = Drawing(920, 390, "Balls of feasible camera positions from above; those of the maximum clique in gold")
    true = camera_centre(trace.problem.aligned.align_pose(trace.problem.truth_cam_from_map))
    clique = np.zeros(len(stage.pairs), bool)
    clique[stage.clique] = True
    near = 2.2 * float(np.quantile(stage.radii_m[stage.clique], 0.6))
    for left, span, title in (
        (0, 14.0, f"all {len(stage.pairs)} balls"),
        (460, round(near, 1), "the small ones of the clique"),
    ):
        middle, scale = np.array([left + 230.0, 215.0]), 300.0 / span
        drawing.text(left + 24, 30, f"{title}, {span:g} m across", size=14)
        drawing.box(left + 60, 60, 340, 310, "#0b0f14", "#3a4352")
        for gold in (False, True):
            for number in np.flatnonzero(clique == gold):
                offset = (stage.centres_m[number] - true)[[0, 2]] * scale * np.array([1, -1])
                r = float(stage.radii_m[number] * scale)
                if np.abs(offset).max() + r < 152:
                    spot = middle + offset
                    drawing.circle((float(spot[0]), float(spot[1])), max(r, 1.5), GOLD if gold else FAINT, opacity=0.8)
        drawing.dot((float(middle[0]), float(middle[1])), LILAC, 5)
    drawing.text(484, 48, f"gold: the maximum clique, {len(stage.clique)} balls; dot: the true position", 13, FAINT)
    return drawing


def exact() -> Drawing:
    """The bound over yaw of the exact search, and boxes of the search over positions."""
    trace = spherloc.estimate(problem(), "mc-exact")
    stage, certificate = trace.stage(ConsensusStage), trace.certificate
    assert stage is not None and certificate is not None
    drawing = Drawing(920, 340, "The exact search: no pose explains more than the bound; boxes close in on the camera")
    left, right, top, bottom = 50, 430, 66, 286
    most = float(stage.bound.max())
    ys = bottom - (bottom - top) * stage.bound / most
    xs = left + (right - left) * np.arange(len(ys)) / (len(ys) - 1)
    drawing.path([(left, bottom), *zip(xs.tolist(), ys.tolist(), strict=True), (right, bottom)], GREY, 1.2, "#2a333f")
    level = bottom - (bottom - top) * certificate.lower_bound / most
    drawing.line((left, level), (right, level), GREEN, 2)
    drawing.text(left, 28, "the most matches that any pose with this yaw can explain", 14)
    drawing.text(left, 48, f"green: the pose found explains {certificate.lower_bound}", 13, GREEN)
    for degrees in range(-180, 181, 90):
        drawing.text(left + (right - left) * (degrees + 180) / 360, 308, f"{degrees}°", 13, FAINT, "middle")
    scene = spherloc.load_scene(spherloc.bundled_scenes()["panorama_outliers_80"])
    assert isinstance(scene, SyntheticScene)
    other = spherloc.estimate(replace(scene, correspondences=1500).problem(SEED), "mc-exact")
    _boxes(drawing, other)
    return drawing


def _boxes(drawing: Drawing, trace: spherloc.Trace) -> None:
    stage = trace.stage(PositionStage)
    assert stage is not None
    low, high = stage.boxes_m[0]
    scale = 270.0 / float(max(high[0] - low[0], high[2] - low[2]))
    drawing.text(520, 28, f"{len(stage.boxes_m):,} boxes of positions from above, by level", 14)
    for box, level in zip(stage.boxes_m, stage.level, strict=True):
        x, y = 540 + scale * (box[0, 0] - low[0]), 50 + scale * (high[2] - box[1, 2])
        wide, tall = scale * (box[1, 0] - box[0, 0]), scale * (box[1, 2] - box[0, 2])
        drawing.box(float(x), float(y), float(wide), float(tall), "none", GOLD if level > 12 else FAINT, 0.5)
    assert trace.cam_from_map is not None
    place = camera_centre(trace.problem.aligned.align_pose(trace.cam_from_map))
    drawing.dot((float(540 + scale * (place[0] - low[0])), float(50 + scale * (high[2] - place[2]))), BLUE, 5)


def refinement() -> Drawing:
    """Residuals around the bound, and the ellipse of the position's error from above."""
    trace = spherloc.estimate(problem(), "mc")
    stage = trace.stage(RefinementStage)
    assert stage is not None and trace.cam_from_map is not None
    drawing = Drawing(920, 330, "Residuals of all matches at the refined pose, and the covariance of its position")
    aligned = trace.problem.aligned
    residuals = residuals_px(aligned, aligned.align_pose(trace.cam_from_map))
    bins = np.logspace(-1, 3.5, 46)
    counts, _ = np.histogram(np.clip(residuals, 0.11, 3000), bins)
    left, right, top, bottom = 50, 520, 60, 270
    bound = float(trace.options.bound_px)

    def at(px: float) -> float:
        return left + (right - left) * (np.log10(px) + 1) / 4.5

    for count, low, high in zip(counts, bins[:-1], bins[1:], strict=True):
        tall = (bottom - top) * count / counts.max()
        drawing.box(at(low), bottom - tall, at(high) - at(low) - 1, tall, GREEN if low < bound else RED)
    drawing.line((at(bound), top - 8), (at(bound), bottom), INK, 2, dash="5 4")
    drawing.text(at(bound) + 6, top + 2, f"bound {bound:g} px", 13)
    for px in (0.1, 1, 10, 100, 1000):
        drawing.text(at(px), bottom + 22, f"{px:g} px", 13, FAINT, "middle")
    drawing.text(left, 28, "residuals of all matches at the refined pose", 14)
    turn = aligned.map_turn
    error = turn @ stage.covariance[3:, 3:] @ turn.T
    flat = error[np.ix_([0, 2], [0, 2])]
    values, vectors = np.linalg.eigh(flat)
    around = np.linspace(0, 2 * np.pi, 60)
    shape = (np.column_stack([np.cos(around), np.sin(around)]) * np.sqrt(values)) @ vectors.T
    scale = 105.0 / (3.0 * np.sqrt(values.max()))
    assert trace.problem.truth_cam_from_map is not None
    off = camera_centre(aligned.align_pose(trace.problem.truth_cam_from_map))
    off = (off - camera_centre(aligned.align_pose(trace.cam_from_map)))[[0, 2]]
    centre = np.array([740.0, 170.0])
    for sds in (1, 2, 3):
        points = centre + sds * scale * shape * np.array([1, -1])
        drawing.path([(float(x), float(y)) for x, y in points], BLUE, 1.6, opacity=1.3 - 0.3 * sds, closed=True)
    drawing.dot((740, 170), BLUE, 4)
    spot = centre + scale * off * np.array([1, -1])
    drawing.dot((float(spot[0]), float(spot[1])), LILAC, 5)
    drawing.text(580, 28, "position from above: 1, 2, 3 standard deviations", 14)
    bar = 0.05 * scale
    drawing.line((740 - bar / 2, 300), (740 + bar / 2, 300), FAINT, 2)
    drawing.text(740 + bar / 2 + 8, 305, "5 cm", 13, FAINT)
    drawing.text(580, 48, "blue: the estimate; lilac: the truth", 13, FAINT)
    return drawing


def path() -> Drawing:
    """The way of a match from a file to the page and into a recording."""
    drawing = Drawing(920, 420, "The way of a match from a file to the page and to a recording")
    core, screen = "#1f4e79", "#5a4a1f"
    boxes = {
        "images": (20, 40, "images, map", "your files", "#2a333f"),
        "frontend": (200, 40, "frontend", "features, matches, lifting", core),
        "csv": (20, 120, "CSV, arrays", "your matches", "#2a333f"),
        "datasets": (200, 120, "datasets", "a scene file's loader", core),
        "problem": (420, 80, "Problem", "matches, camera, gravity", core),
        "estimate": (420, 180, "estimate", "estimators, consensus, refine", core),
        "trace": (420, 280, "Trace", "every stage's arrays", core),
        "judge": (680, 180, "outcome, diagnosis", "believed, or why not", core),
        "layers": (200, 280, "layers", "steps and primitives", screen),
        "page": (20, 240, "app", "painter, plots, panels", screen),
        "recording": (20, 330, "recording", "one .rrd file", screen),
    }
    for x, y, name, words, color in boxes.values():
        drawing.box(x, y, 160 if x < 400 else 210, 58, color)
        middle = x + (80 if x < 400 else 105)
        drawing.text(middle, y + 25, name, 15, anchor="middle", weight="600")
        drawing.text(middle, y + 45, words, 12, "#c5cedb", "middle")
    for start, end in (
        ((180, 69), (200, 69)),
        ((180, 149), (200, 149)),
        ((280, 98), (280, 120)),
        ((360, 149), (420, 120)),
        ((525, 138), (525, 180)),
        ((525, 238), (525, 280)),
        ((630, 300), (700, 238)),
        ((420, 309), (360, 309)),
        ((200, 295), (180, 270)),
        ((200, 323), (180, 350)),
    ):
        drawing.arrow(start, end, INK, 2)
    drawing.path([(525, 338), (525, 372), (180, 372)], FAINT, 1.6, dash="5 4")
    drawing.text(350, 392, "data, bit for bit", 12, FAINT, "middle")
    drawing.path([(100, 388), (100, 408), (660, 408), (660, 109), (632, 109)], FAINT, 1.6, dash="5 4")
    drawing.text(672, 330, "replay: a recording", 12, FAINT)
    drawing.text(672, 348, "becomes a problem again", 12, FAINT)
    drawing.text(20, 24, "blue: spherloc, which knows no screen; brown: spherloc_viz, which draws", 13, FAINT)
    return drawing


PICTURES: tuple[Callable[[], Drawing], ...] = (
    sphere,
    gravity,
    roots,
    ransac,
    arcs,
    balls,
    exact,
    refinement,
    path,
)

if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for picture in PICTURES:
        file = FOLDER / f"{picture.__name__}.svg"
        file.write_text(picture().svg(), encoding="utf-8")
        print(file.name, file.stat().st_size)
