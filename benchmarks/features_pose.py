"""Poses of real fisheyes by SIFT, by ALIKED with LightGlue and by both, query by query: a Markdown table.

    .venv/bin/python -m benchmarks.features_pose [--data ../shared/data/aria_adt_fisheye] [--estimator ransac-2p]

The last image of each camera of a pair of glasses is localized with the first two of all cameras, with those of the
other two cameras, which look elsewhere, and with those of each camera alone. Gravity is that of the true pose, with a
bound of 1 degree. ALIKED needs the extra ``learned``. The last two columns judge without the truth, which is off
between cameras: the angle between the poses of the first two, and the median reprojection error, by the pose of each
kind, of matches that none of them has seen: the inliers of the pose by ORB.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from benchmarks.features import CAMERAS, DATA, RIGHT_PX, views
from spherloc.estimators import estimate
from spherloc.frontend import trained
from spherloc.frontend.features import FeatureOptions
from spherloc.frontend.matching import MatchOptions
from spherloc.frontend.pipeline import FrontendOptions, ImageMatcher
from spherloc.frontend.view import View
from spherloc.geometry import transform
from spherloc.metrics import evaluate, rotation_error_deg
from spherloc.problem import Problem
from spherloc.trace import Trace
from spherloc.warm_up import warm_up

DOWN_IN_MAP = (0.0, -1.0, 0.0)
BOUND_DEG = 1.0
KINDS = {
    "SIFT": (FeatureOptions("sift"), MatchOptions()),
    "ALIKED": (FeatureOptions("aliked"), MatchOptions("lightglue")),
    "both": (FeatureOptions("sift+aliked"), MatchOptions("lightglue")),
}
UNSEEN = FeatureOptions("orb"), MatchOptions()
ENOUGH_UNSEEN = 20


def localized(query: View, references: tuple[View, ...], options: FrontendOptions, estimator: str) -> Trace:
    """The query's pose by its matches with the references."""
    assert query.cam_from_map is not None
    matches = ImageMatcher(references, options)(query)
    problem = Problem(
        name=query.name,
        camera=query.camera,
        pixels=matches.pixels,
        points=matches.points,
        gravity_camera=query.cam_from_map[:, :3] @ DOWN_IN_MAP,
        gravity_map=np.array(DOWN_IN_MAP),
        gravity_bound_rad=float(np.radians(BOUND_DEG)),
        bound_px=RIGHT_PX,
        truth_cam_from_map=query.cam_from_map,
    )
    return estimate(problem, estimator, seed=0)


def median_px(pose: np.ndarray, unseen: Trace) -> str:
    """The median reprojection error by a pose of another trace's inliers, "-" where those are fewer than 20."""
    kept = unseen.inlier_mask
    if np.count_nonzero(kept) < ENOUGH_UNSEEN:
        return "-"
    seen, _ = unseen.problem.camera.project(transform(pose, unseen.problem.points[kept]))
    return f"{np.median(np.linalg.norm(seen - unseen.problem.pixels[kept], axis=1)):.2f}"


def row(name: str, query: View, references: tuple[View, ...], estimator: str) -> str:
    """A line of the table: the same query by all kinds of features."""
    inliers, turned, moved, poses, unseen_px = [], [], [], [], []
    unseen = localized(query, references, FrontendOptions(*UNSEEN, len(references)), estimator)
    for kind in KINDS.values():
        trace = localized(query, references, FrontendOptions(*kind, len(references)), estimator)
        problem = trace.problem
        score = evaluate(trace)
        inliers.append(f"{np.count_nonzero(trace.inlier_mask):,} of {len(problem):,}")
        turned.append("-" if score.rotation_error_deg is None else f"{score.rotation_error_deg:.2f}")
        moved.append("-" if score.translation_error_m is None else f"{100 * score.translation_error_m:.1f}")
        unseen_px.append("-" if trace.cam_from_map is None else median_px(trace.cam_from_map, unseen))
        if trace.cam_from_map is not None:
            poses.append(trace.cam_from_map)
    apart = f"{rotation_error_deg(*poses[:2]):.2f}" if len(poses) == len(KINDS) else "-"
    cells = [query.name.removeprefix("camera-").partition("_")[0], name]
    cells += [*(" / ".join(each) for each in (inliers, turned, moved)), apart, " / ".join(unseen_px)]
    return "| " + " | ".join(cells) + " |"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--estimator", default="ransac-2p")
    arguments = parser.parse_args()
    if not arguments.data.is_dir() or not trained.installed():
        print(f"Left out: it needs {arguments.data} and the extra 'learned'.")
        return 0
    warm_up(None, (arguments.estimator,))
    images = {name: views(arguments.data, name) for name in CAMERAS}
    heads = (
        "query",
        "references",
        f"inliers: {' / '.join(KINDS)}",
        "rotation error (deg)",
        "position error (cm)",
        "apart (deg)",
        "ORB (px)",
    )
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for own in CAMERAS:
        sets = {"all": CAMERAS, "other cameras": [name for name in CAMERAS if name != own]}
        sets |= {name.removeprefix("camera-"): [name] for name in CAMERAS}
        for name, cameras in sets.items():
            references = tuple(view for camera in cameras for view in images[camera][:2])
            print(row(name, images[own][2], references, arguments.estimator), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
