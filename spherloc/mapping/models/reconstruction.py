"""Structure from motion: features and matches of this project, two-view checks and bundle adjustment of COLMAP.

Panoramas stay panoramas: COLMAP's camera EQUIRECTANGULAR. Between two of them a match must fit an essential matrix and
not only a homography: a full sphere sees more than one plane, and matches that fit a single plane may be on a facade, a
poster or a floor that looks the same elsewhere.

Where places look alike, a map may take two for one (see ``model``). A second map is made from the strong pairs alone,
and the one with more images in all its parts, minus a penalty for contradictions, is taken. Where contradictions cut a
map, both are made again without the pairs that had joined its parts. Where cameras took images together, maps of each
by itself are another candidate, joined by these images (see ``rig``). Where a calibration says how the cameras are
fixed to each other, a map with such cameras is made first, and taken if it has nearly all images. What is still apart
is joined by single pairs (see ``joining``), but for images of several cameras that are no panoramas.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import Gravity, View
from spherloc.mapping.alignment.fixed_images import FixedImages
from spherloc.mapping.alignment.upright import level_of
from spherloc.mapping.models.colmap_options import pipeline_options
from spherloc.mapping.models.fixed_views import (
    fix_cameras,
    fixed_pairs,
    freed_if_loose,
    placed_by_calibration,
    with_single_images,
)
from spherloc.mapping.models.joining import joined_by_pairs
from spherloc.mapping.models.later import with_images
from spherloc.mapping.models.misplaced import fits, without_misplaced
from spherloc.mapping.models.model import Reconstruction, parted, poses_of, untangled, worth
from spherloc.mapping.models.pair_evidence import PairEvidence
from spherloc.mapping.models.part_scales import with_one_scale
from spherloc.mapping.parallel import Tell
from spherloc.mapping.rig import Shots, joint_of, one_camera, shots_of, went_apart, with_ties
from spherloc.mapping.two_view.matched import Matched, Names, match_all
from spherloc.mapping.two_view.pairs import MIN_MATCHES
from spherloc.registry import require
from spherloc.types import FloatArray

ROUNDS = 3
"""Largest number of times that maps are made, each time without the pairs that joined what was cut."""
STRONG = 0.3
"""A strong pair has this share of the matches of the best pair of either image."""
CUT_RAD = float(np.radians(15.0))
"""Largest angle between the rotation of a pair and that of its images in a map that was cut between them, if the pair
says the same as that map: wrong pairs agree with each other less well than right ones."""
WHOLE, HELD = 0.9, 250
"""A map of all pairs is taken if it has the first share of the images, and none of its parts is held by fewer matches:
in rendered flats those with images in the wrong room are held by 30 to 150, right ones of a square by 300 and more."""
_TRIES = (
    {"init_min_num_inliers": 50, "init_min_tri_angle": 4.0},
    {"init_min_num_inliers": 25, "init_min_tri_angle": 2.0},
    {"init_min_num_inliers": 15, "init_min_tri_angle": 1.0},
)
"""Conditions for the first pair of a model, tried one after another until there is a model."""


def reconstruct(
    views: Sequence[View],
    gravity: Sequence[Gravity | None],
    folder: Path,
    tell: Tell,
    how: FrontendOptions | None = None,
    fixed: FixedImages | None = None,
) -> tuple[Reconstruction, ...]:
    """Map images of one camera or several; the database in ``folder`` is kept, and what it has is used again.

    The map with most images comes first, then maps of other images that could not be joined with it.

    ``gravity`` is that from the images' vertical lines, ``how`` the features and their matching, SIFT if it is None.
    ``fixed`` says how their cameras are fixed to each other.

    Raises ``InputError`` if pycolmap is missing, if an image or the folder cannot be used, or if no two images fit
    together, and ``StoppedError`` if there is no room for the database.
    """
    pycolmap = require("pycolmap", "colmap", "making a map")
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # errors are reported here instead
    together = fixed_pairs(views, fixed)
    matched = match_all(pycolmap, views, gravity, folder, tell, how or FrontendOptions(), together)
    if fixed is not None and fixed.one_moment:
        placed = placed_by_calibration(pycolmap, matched, fixed)
        if placed is not None:
            return (placed,)
    rig = _with_fixed_cameras(pycolmap, matched, fixed, tell) if together else ()
    if rig and worth(rig[0]) >= WHOLE * len(views):
        return rig
    panoramas = all(isinstance(view.camera, Equirectangular) for view in views)
    shots, left = shots_of(views), matched
    known = {view.name: one for view, one in zip(views, gravity, strict=True) if one is not None}
    rigid = _rigid(pycolmap, matched, shots, known, tell)
    if rigid:
        counts = matched.counts()
        left = replace(left, same_place=with_ties(counts + matched.same_place, matched.names, shots) - counts)
    evidence = PairEvidence(matched) if panoramas or not shots else None
    held = _held(pycolmap, matched, evidence, tell) if evidence is not None and not panoramas else ()
    made = [held] if held else [rigid, *_of_sure_pairs(pycolmap, left, evidence, tell), rig]
    candidates = [models for models in made if models]
    if rigid:
        candidates = [models for models in candidates if not any(went_apart(one.poses, shots) for one in models)]
    if not candidates:
        raise InputError(
            f"COLMAP could not start a map from these {len(views)} photographs, although pairs of them match: they "
            "may have been taken from one place. Take them half a metre to two metres apart."
        )
    # Most images in all, then in one map, then that with fixed cameras, then those by strong pairs.
    best = max(reversed(candidates), key=lambda models: (sum(map(worth, models)), worth(models[0])))
    found = best if evidence is None else joined_by_pairs(best, matched, evidence, tell)
    return tuple(replace(one, unsure=matched.none_sure) for one in found)


def _of_sure_pairs(
    pycolmap: Any, matched: Matched, evidence: PairEvidence | None, tell: Tell
) -> list[tuple[Reconstruction, ...]]:
    """Models of the pairs that are sure, and of the strong ones among them, each made again without what was cut."""
    made = list[tuple[Reconstruction, ...]]()
    for _ in range(ROUNDS):
        cut = set[Names]()
        for keep in (0.0, STRONG):
            models, apart = _models_of(pycolmap, _UsedPairs(matched, matched.counts(), keep), tell, evidence)
            made.append(models)
            cut |= apart
        if not cut or evidence is None:
            break
        matched = matched.without(cut)
    return made


def _held(pycolmap: Any, matched: Matched, evidence: PairEvidence, tell: Tell) -> tuple[Reconstruction, ...]:
    """Models of all pairs, sure or not, if one has nearly all images and is well held together; else none.

    Many pairs that are not sure, but agree, place images better than few that are.
    """
    if not matched.unsure:
        return ()
    every = matched.with_unsure()
    models, _ = _models_of(pycolmap, _UsedPairs(every, every.counts()), tell, evidence)
    if not models or len(models[0].poses) < WHOLE * len(matched.ids):
        return ()
    return models if evidence.least_holding(models[0].poses) >= HELD else ()


def _with_fixed_cameras(
    pycolmap: Any, matched: Matched, fixed: FixedImages | None, tell: Tell
) -> tuple[Reconstruction, ...]:
    """Models in which cameras stand to each other as the calibration says; none without one."""
    if fixed is None or fixed.one_moment:
        return ()
    models, _ = _models_of(pycolmap, _UsedPairs(matched, matched.counts()), tell, fixed=fixed)
    return tuple(freed_if_loose(pycolmap, one) for one in models)


def _rigid(
    pycolmap: Any, matched: Matched, shots: Shots, gravity: Mapping[str, Gravity], tell: Tell
) -> tuple[Reconstruction, ...]:
    """Models of each camera by itself, joined where cameras took images together; none if no two are joined.

    ``gravity`` is that of images by name.
    """
    if not shots:
        return ()
    counts = matched.counts()
    models, _ = _models_of(pycolmap, _UsedPairs(matched, counts * one_camera(matched.names, shots)), tell)
    return _joined(models, shots, gravity, counts, with_ties(counts + matched.same_place, matched.names, shots))


@dataclass(frozen=True, eq=False)
class _UsedPairs:
    """The pairs of images from which models are made."""

    matched: Matched
    """All pairs that match."""
    counts: NDArray[np.int64]
    """(V, V) number of matches of each pair that may be used; 0 for others."""
    keep: float = 0.0
    """Least share of the matches of the best pair of either image."""

    def write(self, pycolmap: Any, database: Path) -> None:
        """Write a database of these pairs alone, since COLMAP uses all that a database has."""
        shutil.copyfile(self.matched.database, database)
        ids, counts, best = list(self.matched.ids.values()), self.counts, self.counts.max(axis=1)
        with pycolmap.Database.open(str(database)) as opened:
            for pair in combinations(range(len(ids)), 2):
                one, other = ids[pair[0]], ids[pair[1]]
                used = counts[pair] and counts[pair] >= self.keep * best[list(pair)].max()
                if not used and opened.exists_two_view_geometry(one, other):
                    opened.delete_two_view_geometry(one, other)
                    opened.delete_matches(one, other)


def _models_of(
    pycolmap: Any,
    used: _UsedPairs,
    tell: Tell,
    evidence: PairEvidence | None = None,
    fixed: FixedImages | None = None,
) -> tuple[tuple[Reconstruction, ...], set[Names]]:
    """Models of the pairs that are used, the largest first, and the pairs that joined what contradictions showed to be
    apart. With ``evidence``, models are cut, too, where images stand elsewhere than their pair says; with ``fixed``,
    cameras are fixed to each other."""
    matched, counts = used.matched, used.counts
    with TemporaryDirectory() as folder:  # COLMAP writes its models into a folder
        database = Path(folder) / "matches.db"
        used.write(pycolmap, database)
        if fixed is not None:
            with pycolmap.Database.open(str(database)) as opened:
                fix_cameras(pycolmap, opened, matched.ids, fixed)
        models = _models(pycolmap, database, Path(folder), len(matched.ids), tell)
    rotations, agreeing = matched.rotations(matched.verified), matched.rotations(matched.agreed)
    found, cut = list[Reconstruction](), set[Names]()
    for model in models:
        if fixed is None:
            every = counts + matched.same_place
            placed = Reconstruction(model, poses_of(model), counts, (), every, matched.database, matched.ids)
        else:
            placed = with_single_images(pycolmap, matched, model)
        whole = without_misplaced(placed, agreeing)
        if evidence is not None:
            whole = with_one_scale(whole, evidence)
        if len(whole.poses) > 1:
            parts, misplaced = _parts(whole.judged(), evidence)
            cut |= _cut(whole, parts, {pair: one for pair, one in rotations.items() if pair not in misplaced})
            found += parts
    return untangled(found), cut


def _parts(whole: Reconstruction, evidence: PairEvidence | None) -> tuple[list[Reconstruction], set[Names]]:
    """The parts of a model that do not contradict themselves, and the pairs that say that images stand elsewhere."""
    misplaced = set[Names]() if evidence is None else evidence.misplaced(whole.poses)
    parts = parted(whole, misplaced)
    if misplaced:
        further = [_parts(part, evidence) for part in parts]
        parts = [part for found, _ in further for part in found]
        misplaced = misplaced.union(*(more for _, more in further))
    return parts, misplaced


def _cut(whole: Reconstruction, parts: Sequence[Reconstruction], rotations: Mapping[Names, FloatArray]) -> set[Names]:
    """Those pairs of images in different parts of a model whose rotations (3, 3) put them where that had them."""
    part_of = {name: number for number, part in enumerate(parts) for name in part.poses}
    return {
        (one, other)
        for (one, other), rotation in rotations.items()
        if one in part_of
        and other in part_of
        and part_of[one] != part_of[other]
        and fits(whole.poses[one], whole.poses[other], rotation, CUT_RAD)
    }


def _joined(
    models: Sequence[Reconstruction],
    shots: Shots,
    gravity: Mapping[str, Gravity],
    counts: NDArray[np.int64],
    tied: NDArray[np.int64],
) -> tuple[Reconstruction, ...]:
    """Models of single cameras, joined where these took images together; none if no two are joined.

    ``gravity`` is that of images by name, ``counts`` and ``tied`` (V, V) the numbers of matches of all pairs, the
    latter with those taken from one place or together.
    """
    left = [replace(one, matches=counts, all_matches=tied) for one in models]
    joined: list[Reconstruction] = []
    while left:
        whole = left.pop(0)
        for other in list(left):
            try:
                downs = level_of(whole.poses, gravity).down, level_of(other.poses, gravity).down
            except InputError:  # its images do not agree on where down is
                continue
            joint = joint_of(whole.poses, other.poses, downs, shots)
            if joint is not None:
                more = {name: pose for name, pose in joint.poses.items() if name not in whole.poses}
                whole = replace(with_images(whole.without(joint.misfits), more), joined=True)
                left.remove(other)
        joined.append(whole)
    return untangled(joined) if len(joined) < len(models) else ()


def _models(pycolmap: Any, database: Path, folder: Path, count: int, tell: Tell) -> list[Any]:
    """COLMAP's models, the one with most images first; none if it finds no first pair."""
    options = pipeline_options(pycolmap)
    options.min_num_matches, options.min_model_size = MIN_MATCHES, 2
    mapper = options.mapper
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = MIN_MATCHES, 0.05
    # COLMAP starts with no pair that moved along the optical axis, where a narrow lens sees no depth; a wide one does.
    mapper.init_max_forward_motion = 1.0
    models: list[Any] = []
    for first_pair in _TRIES:
        for key, value in first_pair.items():
            setattr(mapper, key, value)
        found = _mapped(pycolmap, database, folder, options, lambda done: tell("images mapped", done, count))
        # A model whose bundle adjustment has diverged keeps its images and no points.
        whole = [model for model in found.values() if model.num_points3D() >= MIN_MATCHES]
        models = sorted(whole, key=lambda model: -model.num_reg_images())
        if models and models[0].num_reg_images() > count / 2:
            break
    return models


def _mapped(pycolmap: Any, database: Path, folder: Path, options: Any, tell: Callable[[int], None]) -> dict[int, Any]:
    """COLMAP's mapper, in a thread so that Ctrl-C ends it."""
    stop, done = pycolmap.CancellationToken(), 0

    def another() -> None:
        nonlocal done
        done += 1
        tell(done)

    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(
            pycolmap.incremental_mapping,
            str(database),
            str(folder),
            str(folder),
            options,
            next_image_callback=another,
            cancellation_token=stop,
        )
        try:
            while not wait([job], timeout=0.2).done:
                pass
        except KeyboardInterrupt:
            stop.cancel()
            raise
        return job.result()
