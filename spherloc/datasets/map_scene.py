"""A map with reference images, and query images to be localized in it: what every loader of images returns."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spherloc import registry
from spherloc.cameras.principal_point import about_principal_points
from spherloc.datasets import scene_file
from spherloc.datasets.query_gravity import BOUND_SD, GravitySettings, MeasuredGravity, read_gravity
from spherloc.datasets.registration import Registration
from spherloc.errors import InputError, show
from spherloc.files import is_folder
from spherloc.frontend.masks import MAX_NADIR_DEG, MAX_SEAM_DEG, Masks, with_masked_lifts
from spherloc.frontend.pipeline import ImageMatcher, image_matcher
from spherloc.frontend.stored_matches import StoredMatches
from spherloc.frontend.view import Gravity, Matcher, Matches, NeedsPreparing, Report, View
from spherloc.geometry import camera_centre
from spherloc.metrics import extent_of, is_beyond
from spherloc.problem import Problem
from spherloc.refine import residuals_px
from spherloc.types import FloatArray

TRUE_INLIER_PX = 8.0
"""Matches this close to their true pixel count as true inliers (Sec. VI-B.1)."""

ASSUMED_DOWN_DEG = 5.0
"""Bound on the error of a map's gravity that is taken from how its cameras were held."""

LIKE_REFERENCE = "its most similar reference"
"""Source of a gravity that is taken from a reference."""

MAX_BOUND_RAD = float(np.radians(85.0))

Thresholds = tuple[tuple[float, float], ...]
"""Limits (degrees, metres) within which a localization counts as a success, strictest first."""

DEFAULT_THRESHOLDS: Thresholds = ((1.0, 0.1), (2.0, 0.25), (5.0, 0.5))


@dataclass(frozen=True, eq=False)
class MapScene:
    """Queries, references and how to get from one to the other."""

    name: str
    """Name that users see."""
    where: str
    """Path of the scene file, for messages."""
    queries: tuple[View, ...]
    """Query images in the order of the sequence; at least one."""
    references: tuple[View, ...]
    """Images of the map, with poses; at least one."""
    matcher: Matcher
    """Finds 2D-3D correspondences of a query."""
    gravity_map: FloatArray
    """Unit vector (3,) pointing down in the map frame."""
    gravity_bound_rad: float = 0.0
    """Bound on the error of a query's known gravity, whether measured or taken from its reference."""
    gravity_sd_rad: float | None = None
    """Standard deviation of each of its two tilts; None takes a third of the bound."""
    gravity_map_bound_rad: float = 0.0
    """Bound on the error of ``gravity_map``, which adds to that of a query's gravity unless it follows from the map."""
    measured_gravity: MeasuredGravity | None = None
    """Measures gravity in a query whose ``gravity`` is None; None takes that of the query's most similar reference."""
    bound_px: float | None = None
    """Pixel bound asked of estimators; None leaves it to them."""
    thresholds: Thresholds = DEFAULT_THRESHOLDS
    """The dataset's own limits of success."""
    metric: bool = True
    """Whether the map's lengths are metres; if not, they are its own units, and so are the limits."""
    registration: Registration | None = None
    """Judges a pose by registering point clouds, where no true pose can be trusted."""
    vehicle_from_camera: FloatArray | None = None
    """Where the query camera is on the vehicle or device (3, 4): p_vehicle = R p_camera + t; None if not known."""
    mesh: Callable[[], bytes] | None = None
    """A binary glTF of the map in the map frame, metres, for the canvas."""
    cloud: FloatArray | None = None
    """Points (P, 3) of a map without a mesh, map frame, metres, for the canvas."""
    truth_source: str = ""
    """What the true poses come from, if it knew more than a query's image is to tell or was aligned with the map; empty
    for a measurement in the map's frame."""
    remarks: tuple[str, ...] = ()
    """What the loader skipped and why, in sentences."""
    matched_files: tuple[Path, ...] = ()
    """Files of another program that matches are read from."""
    kind: str = ""
    """The kind of its scene file, by which an extension is named whose own code fails while it matches; empty for a
    scene without a file."""

    def __post_init__(self) -> None:
        for what, views in (("query", self.queries), ("reference", self.references)):
            if not views:
                raise InputError(
                    f"{self.where}: there is no {what} image; {' '.join(self.remarks[:2]) or 'name some.'}"
                )
            twice = next((name for name, times in Counter(view.name for view in views).items() if times > 1), None)
            if twice is not None:
                raise InputError(f"{self.where}: the {what} image {show(twice)} is there twice; name it once.")

    @cached_property
    def _by_name(self) -> Mapping[str, View]:
        return {view.name: view for view in self.queries}

    @cached_property
    def _places(self) -> FloatArray:
        """Positions (K, 3) in the map frame: of its points, if they are known, and of its references with a pose."""
        poses = [view.cam_from_map for view in self.references if view.cam_from_map is not None]
        cloud = [] if self.cloud is None else [self.cloud]
        return np.vstack([np.empty((0, 3)), *(camera_centre(pose) for pose in poses), *cloud])

    @cached_property
    def _middle(self) -> FloatArray:
        return np.median(self._places, axis=0)

    @cached_property
    def extent_m(self) -> float:
        """The extent of the map (``spherloc.metrics.extent_of``), metres or units of the map; 0 if it is not known."""
        return extent_of(self._places)

    def is_away(self, cam_from_map: FloatArray) -> bool:
        """Whether a pose (3, 4) is absurdly far away from the map (``spherloc.metrics.is_beyond``)."""
        if not len(self._places):
            return False
        return is_beyond(float(np.linalg.norm(camera_centre(cam_from_map) - self._middle)), self.extent_m)

    def query(self, name: str | None = None) -> View:
        """The query image of that name, by default the first.

        Raises ``InputError`` if there is none of that name.
        """
        if name is None:
            return self.queries[0]
        if name not in self._by_name:
            some = ", ".join(view.name for view in self.queries[:5])
            more = f" and {len(self.queries) - 5} more" if len(self.queries) > 5 else ""
            raise InputError(f"{self.where}: no query image {show(name)}; there are {some}{more}.")
        return self._by_name[name]

    @property
    def problem_remarks(self) -> tuple[str, ...]:
        """The remarks that every problem of the scene has: ``remarks``, and where its true poses are from."""
        return (*self.remarks, self.about_truth) if self.truth_source else self.remarks

    @property
    def about_truth(self) -> str:
        """Where the true poses are from, as a sentence; empty for a measurement."""
        return f"The true poses are those of {self.truth_source}." if self.truth_source else ""

    def prepare(self, report: Report) -> None:
        """Do what is needed once for all queries, so that it can be watched: describing a large map takes a while."""
        if isinstance(self.matcher, NeedsPreparing):
            with registry.guarded("datasets", self.kind, self.where):
                self.matcher.prepare(report)

    def matches(self, view: View) -> Matches:
        """The correspondences of a query image, which ``matcher`` finds.

        Raises ``InputError`` as that does, and for whatever the scene's parts raise that an extension made.
        """
        with registry.guarded("datasets", self.kind, self.where):
            return self.matcher(view)

    def problem(self, seed: int | None = None, query: str | None = None) -> Problem:
        """The localization problem of a query image; images have nothing random, so ``seed`` changes nothing.

        Raises ``InputError`` if the image cannot be used, or if it has too few correspondences for a problem.
        """
        view = self.query(query)
        return self.problem_of(view, self.matches(view))

    def stored_problem(self, query: str | None = None) -> Problem | None:
        """``problem`` at once where its matches are stored, else None. Its ``pictures`` may not be drawn yet."""
        view = self.query(query)
        stored = self.matcher.stored(view) if isinstance(self.matcher, StoredMatches) else None
        return None if stored is None else self.problem_of(view, stored)

    def pictures(self, problem: Problem) -> tuple[View, ...]:
        """The query and the references of a problem of this scene."""
        shown = [problem.image, *problem.reference_images]
        by_path = {view.path: view for view in (*self.references, *self.queries)}
        return tuple(by_path[path] for path in shown if path in by_path)

    def problem_of(self, view: View, matches: Matches) -> Problem:
        """The problem of a query and the correspondences that were found for it.

        Gravity is the query's own if it is measured, else that of the most similar reference (Sec. III: a vehicle's
        roll and pitch are about those of the vehicle that mapped the place). Raises ``ProblemError`` for too few.
        """
        gravity, said = self._gravity(view, matches)
        bound_rad, sd_rad = self._gravity_error(gravity)
        problem = Problem(
            name=f"{self.name}, {view.name}",
            camera=view.camera,
            pixels=matches.pixels,
            points=matches.points,
            gravity_camera=gravity.down,
            gravity_map=self.gravity_map,
            gravity_bound_rad=bound_rad,
            gravity_sd_rad=sd_rad,
            gravity_source=gravity.source,
            bound_px=self.bound_px,
            metric=self.metric,
            truth_cam_from_map=view.cam_from_map,
            image=view.path,
            scene=self.where,
            reference_images=tuple(reference.path for reference in matches.references),
            reference_index=matches.reference_index,
            reference_pixels=matches.reference_pixels,
            estimated_outlier_rate=matches.estimated_outlier_rate,
            remarks=(*self.problem_remarks, *matches.remarks, *said),
            verified_without_point=matches.verified_without_point,
        )
        if view.cam_from_map is None:
            return problem
        aligned = problem.aligned
        close = residuals_px(aligned, aligned.align_pose(view.cam_from_map)) <= TRUE_INLIER_PX
        return replace(problem, truth_inliers=aligned.full_mask(close))

    def _gravity(self, view: View, matches: Matches) -> tuple[Gravity, tuple[str, ...]]:
        """Gravity of a query, and remarks on it."""
        posed = [reference for reference in matches.references if reference.cam_from_map is not None]
        nearby = self._like(posed[0]) if posed else None
        if view.gravity is not None:
            return view.gravity, _contradiction(view.gravity, nearby)
        said: tuple[str, ...] = ()
        if self.measured_gravity is not None:
            try:
                return self.measured_gravity(view, None if nearby is None else nearby.down), ()
            except InputError as error:
                said = (f"{error} Gravity is that of the most similar reference.",) if nearby else (str(error),)
        if nearby is None:
            raise InputError(
                f"{self.where}: gravity is not known in the query image {show(view.name)}, and none of its references "
                f"has a pose to take it from; give its gravity.{''.join(f' {remark}' for remark in said)}"
            )
        return nearby, said

    def _gravity_error(self, gravity: Gravity) -> tuple[float, float | None]:
        """Bound and standard deviation between the gravities of a query and of the map."""
        own = (self.gravity_bound_rad, self.gravity_sd_rad)
        bound_rad, sd_rad = own if gravity.bound_rad is None else (gravity.bound_rad, gravity.sd_rad)
        more_rad = 0.0 if gravity.by_map else self.gravity_map_bound_rad
        if not more_rad:
            return bound_rad, sd_rad
        known_rad = bound_rad / BOUND_SD if sd_rad is None else sd_rad
        return min(bound_rad + more_rad, MAX_BOUND_RAD), float(np.hypot(known_rad, more_rad / BOUND_SD))

    def _like(self, reference: View) -> Gravity:
        """Gravity of a query that has the roll and pitch of a reference."""
        down = np.asarray(reference.cam_from_map)[:, :3] @ self.gravity_map
        return Gravity(down / np.linalg.norm(down), LIKE_REFERENCE, by_map=True)


def _contradiction(stated: Gravity, nearby: Gravity | None) -> tuple[str, ...]:
    """A remark on a gravity that points up in the camera of the most similar reference; empty if it does not."""
    if nearby is None or stated.down @ nearby.down >= 0.0:
        return ()
    angle_deg = np.degrees(np.arccos(np.clip(stated.down @ nearby.down, -1.0, 1.0)))
    return (
        f"Gravity from {stated.source} is {angle_deg:.0f} degrees away from that of its most similar reference; it "
        "must point down, in the camera frame with x right, y down and z forward.",
    )


REQUIRED = {"kind", "name"}
"""Keys that a scene of images of every kind must have."""
OPTIONAL = {"about", "frontend", "gravity", "masks", "options", "thresholds", "units"}
"""Keys that it may have."""
OPTIONAL_EXAMPLE = """\
about = "a line about it"
units = "unknown"                      # the map has no scale; else lengths are metres
thresholds = [[1, 0.1], [5, 0.5]]      # limits of success, degrees and metres

[options]
bound_px = 4.0                         # of an inlier, for all estimators

[frontend]                             # docs/datasets.md has all of its keys
features = "sift"
references = 4                         # how many of the most similar references are matched

[masks]                                # pixels that are left out
nadir_deg = 25                         # degrees around the camera's own down
"""
"""``OPTIONAL`` as part of a scene file, without ``[gravity]``, whose keys differ by kind."""
UNITS: Mapping[str, bool] = {"metres": True, "unknown": False}
"""Values of ``units``, and whether lengths are metres then."""


@dataclass(frozen=True)
class MapSettings:
    """The values of the keys that all kinds of map scenes share."""

    kind: str
    name: str
    frontend: Mapping[str, Any]
    """The section [frontend], for ``image_matcher`` to check."""
    gravity: GravitySettings
    bound_px: float | None
    thresholds: Thresholds
    metric: bool
    masks: Masks | None
    """Masks of queries and references; None if the scene file has none."""

    def scene(
        self,
        path: Path,
        queries: Iterable[View],
        references: Iterable[View],
        gravity_map: FloatArray,
        remarks: Iterable[str] = (),
        assumed_down: bool = False,
        **others: Any,
    ) -> MapScene:
        """The scene of these images; ``path`` is its file, ``gravity_map`` the unit vector (3,) that points down in
        the map, which may be ``assumed_down`` without being known, and ``others`` are further fields of ``MapScene``.

        Without a ``matcher`` among them, the front end that [frontend] describes is taken. Raises ``InputError`` for a
        wrong [frontend] and if there is no query or no reference.
        """
        given, asked = tuple(references), tuple(queries)
        remarks = [*remarks, *about_principal_points((view.name, view.camera) for view in (*asked, *given))]
        if self.masks is not None:
            given, asked = self._masked(path, given, asked, remarks)
        gravity = self.gravity
        known, said = gravity.of_queries(asked, gravity_map, given)
        matcher = others.get("matcher")
        if matcher is None:
            others["matcher"] = image_matcher(given, self.frontend, str(path), path.parent)
        elif self.masks is not None:
            if not isinstance(matcher, ImageMatcher):
                raise InputError(
                    f"{path}: [masks] is for features that spherloc finds, and these are given; mask the images where "
                    "the features are found."
                )
            others["matcher"] = replace(matcher, references=given)
        return MapScene(
            name=self.name,
            where=str(path),
            queries=known,
            references=given,
            gravity_map=gravity_map,
            gravity_bound_rad=gravity.bound_rad,
            gravity_sd_rad=gravity.sd_rad,
            gravity_map_bound_rad=float(np.radians(ASSUMED_DOWN_DEG)) if assumed_down else gravity.map_bound_rad,
            measured_gravity=gravity.measured,
            bound_px=self.bound_px,
            thresholds=self.thresholds,
            metric=self.metric,
            remarks=(*remarks, *said),
            kind=self.kind,
            **others,
        )

    def _masked(
        self, path: Path, references: tuple[View, ...], queries: tuple[View, ...], remarks: list[str]
    ) -> tuple[tuple[View, ...], tuple[View, ...]]:
        """References and queries without what the masks leave out; adds to ``remarks``."""
        if self.masks is None or not references + queries:
            return references, queries
        try:
            masked, said = self.masks.on(references + queries)
        except InputError as error:
            raise InputError(f"{path} [masks]: {error}") from None
        remarks += said
        return with_masked_lifts(masked[: len(references)]), masked[len(references) :]


def read_settings(
    table: Mapping[str, Any], where: str, gravity_bound_deg: float, thresholds: Thresholds = DEFAULT_THRESHOLDS
) -> MapSettings:
    """The shared keys of a scene file; ``gravity_bound_deg`` and ``thresholds`` are the loader's defaults.

    Keys of the loader's own are for it to check, by ``scene_file.check_keys`` with ``REQUIRED`` and ``OPTIONAL``
    among the known ones. Raises ``InputError`` for a wrong value.
    """
    return MapSettings(
        kind=scene_file.text(table, "kind", where),
        name=scene_file.text(table, "name", where),
        frontend=scene_file.section(table, "frontend", where),
        gravity=read_gravity(scene_file.section(table, "gravity", where), where, gravity_bound_deg),
        bound_px=scene_file.bound_px(table, where),
        thresholds=_thresholds(table["thresholds"], where) if "thresholds" in table else thresholds,
        metric=_metric(table, where),
        masks=_masks(scene_file.section(table, "masks", where), where) if "masks" in table else None,
    )


def _masks(table: Mapping[str, Any], where: str) -> Masks:
    """The section ``[masks]``; paths are relative to the scene file."""
    place = f"{where} [masks]"
    scene_file.check_keys(table, set(), {"images", "nadir_deg", "seam_deg"}, place)
    if not table:
        raise InputError(f"{place}: is empty; give images, nadir_deg or seam_deg.")
    images = Path(where).parent / scene_file.text(table, "images", place) if "images" in table else None
    angles = {
        key: scene_file.number(table, key, place, 0.0, most)
        for key, most in (("nadir_deg", MAX_NADIR_DEG), ("seam_deg", MAX_SEAM_DEG))
        if key in table
    }
    return Masks(images, **angles)


def _metric(table: Mapping[str, Any], where: str) -> bool:
    """Whether the key ``units`` is "metres" (the default) and not "unknown"."""
    units = scene_file.text(table, "units", where) if "units" in table else "metres"
    if units not in UNITS:
        raise InputError(f"{where}: units is {show(units)}; give one of {', '.join(UNITS)}.")
    return UNITS[units]


def _thresholds(value: Any, where: str) -> Thresholds:
    """The limits of the key ``thresholds = [[deg, m], ...]``."""
    rows = len(value) if isinstance(value, list) else 0
    if not 1 <= rows <= 10:
        raise InputError(f"{where}: thresholds must be a list of pairs [degrees, metres], strictest first.")
    pairs = scene_file.numbers(value, (rows, 2), "thresholds", where)
    if not (pairs > 0).all():
        raise InputError(f"{where}: thresholds must be pairs of positive numbers [degrees, metres].")
    return tuple((float(degrees), float(metres)) for degrees, metres in pairs)


def folder(table: Mapping[str, Any], key: str, path: Path) -> Path:
    """An existing folder, given relative to the scene file ``path`` or absolutely.

    Raises ``InputError`` if there is none.
    """
    named = path.parent / scene_file.text(table, key, str(path))
    if not is_folder(named):
        raise InputError(f"{path}: {key} names the folder {named}, which does not exist; correct the path.")
    return named
