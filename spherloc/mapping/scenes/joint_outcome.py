"""Judges queries by each other: those that cameras fixed to each other took together, and those of a sequence.

Each query is localized by itself first. Then one that is far from its neighbours in a sequence is doubtful, as is one
that stands otherwise than most of its partners say; and one without a believed pose is tried anew around the pose that
a partner gives, with the references there, and is localized if the outcome is, as for any query.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np

from spherloc.datasets.map_scene import MapScene
from spherloc.experiments.results import LOCALIZED, UNREADABLE, QueryResult
from spherloc.experiments.sequence import How, solve_again
from spherloc.frontend.pipeline import SHORTLIST, ImageMatcher
from spherloc.frontend.view import Matches, Report, View
from spherloc.geometry import camera_centre, rotation_angle, transform
from spherloc.mapping.models.later import EXPECTED_RAD, MIN_INLIERS
from spherloc.mapping.rig import MIN_TOGETHER, TURNED_RAD, FixedCameras, rig_of
from spherloc.mapping.scenes.neighbours import jumps
from spherloc.metrics import said_length
from spherloc.trace import Trace
from spherloc.types import FloatArray

FACING = float(np.cos(np.radians(75.0)))
"""References that look to another side than the expected pose, by more than this angle, are not matched."""
TRIED = "Tried anew around the pose"
"""Beginning of the remark of a query that was tried around the pose that another one gives."""
_TOGETHER, _BETWEEN = "Taken together with", "Between"
"""Beginnings of the sentences with which queries are doubted."""

Run = tuple[QueryResult, Trace | None]
"""A query's result, and its trace if there is one."""


def judged_together(
    scene: MapScene,
    rows: Sequence[QueryResult],
    how: How,
    report: Report = lambda done, count: None,
    say: Callable[[str], None] = lambda sentence: None,
) -> Iterator[Run]:
    """The rows that change where all ``rows`` of a scene's queries are judged by each other, and the new traces of
    those that were localized anew by ``how``.

    What others said before against a row is judged anew, as there may be more of them now; no query is tried twice.
    ``report`` is called with the number of times done, of all at which several cameras took queries, and ``say`` with a
    sentence if the names of queries seem not to tell which were taken together.
    """
    before = {row.query: _words(row) for row in rows}
    judged = _Judged(scene, how, {row.query: _by_itself(row) for row in rows}, {})
    judged.compare_neighbours()
    rig = rig_of(scene.references)
    times: list[_Together] = []
    if rig is not None:
        views = [view for view in scene.queries if view.name in before]
        times = [_Together(judged, rig, partners) for partners in _partners(rig, views)]
    agree = [found for together in times for found in together.agreements()]
    if agree.count(False) >= max(MIN_TOGETHER, len(agree) / 2):
        say(
            f"{agree.count(False)} of {len(agree)} pairs of queries that were taken at the same time, as their names "
            "say, stand to each other otherwise than the cameras of the map do; they are not compared."
        )
        times = []
    yielded: set[str] = set()
    for done, together in enumerate(times, start=1):
        together.doubt()
        together.try_anew()
        report(done, len(times))
        for name in together.partners.values():
            yielded.add(name)
            if _words(judged.rows[name]) != before[name]:
                yield judged.rows[name], judged.traces.get(name)
    for name, row in judged.rows.items():
        if name not in yielded and _words(row) != before[name]:
            yield row, None


def _words(row: QueryResult) -> tuple[object, ...]:
    return row.status, row.message, row.remarks


def _partners(rig: FixedCameras, queries: Sequence[View]) -> list[dict[str, str]]:
    """The names of queries that were taken together, by camera, for each time of several."""
    found: dict[int, dict[str, str]] = {}
    for name, (camera, step) in rig.times_of(queries).items():
        found.setdefault(step, {})[camera] = name
    return [partners for _, partners in sorted(found.items()) if len(partners) > 1]


def tried_anew(row: QueryResult) -> bool:
    """Whether a query was tried around the pose that one taken together with it gives."""
    return any(remark.startswith(TRIED) for remark in row.remarks)


def _by_itself(row: QueryResult) -> QueryResult:
    """The row without what other queries said against it."""
    for why in row.doubts:
        if why.startswith((_TOGETHER, _BETWEEN)):
            message = row.message.removesuffix(why).rstrip()
            return replace(row, status=LOCALIZED, message=message, remarks=row.remarks[:-1])
    return row


@dataclass(frozen=True, eq=False)
class _Judged:
    """Queries while they are judged by each other."""

    scene: MapScene
    how: How
    rows: dict[str, QueryResult]
    """By the query's name."""
    traces: dict[str, Trace | None]
    """Traces of the queries that were tried anew with success, by name."""

    @cached_property
    def views(self) -> Mapping[str, View]:
        """The queries by name."""
        return {view.name: view for view in self.scene.queries}

    def length(self, length_m: float) -> str:
        """A length in the map as text."""
        text = f"{length_m:.2g} {'m' if self.scene.metric else 'units'}"
        return said_length(length_m, self.scene.extent_m, text)

    def compare_neighbours(self) -> None:
        """Doubt queries that are far from those before and after them."""
        limit = self.scene.thresholds[-1][1]
        for name, jump in jumps(tuple(self.rows.values()), limit).items():
            self.rows[name] = self.rows[name].doubted(
                f"{_BETWEEN} {jump.before} and {jump.after}, which are {self.length(jump.apart)} apart, it is "
                f"{self.length(jump.away)} or more from both; it may be of a place that looks alike."
            )


class _Anew(NamedTuple):
    """A query that was tried around the pose that a partner gives."""

    row: QueryResult
    trace: Trace | None
    localized: bool
    """Whether it is localized about there."""


@dataclass(frozen=True, eq=False)
class _Together:
    """The queries that cameras fixed to each other took at one time."""

    judged: _Judged
    rig: FixedCameras
    partners: Mapping[str, str]
    """Names of the queries by camera."""

    def row(self, camera: str) -> QueryResult:
        """The row of a camera's query."""
        return self.judged.rows[self.partners[camera]]

    @property
    def sure(self) -> list[str]:
        """The cameras whose queries are localized."""
        return [camera for camera in sorted(self.partners) if self.row(camera).status == LOCALIZED]

    def expected(self, other: str, camera: str) -> FloatArray | None:
        """The pose (3, 4) of a camera's query by that of the other camera's; None if it is not known."""
        pose = self.row(other).cam_from_map
        return None if pose is None else self.rig.expected((other, pose), camera)

    def agree(self, other: str, camera: str) -> bool | None:
        """Whether two queries stand to each other as their cameras do; None if that is not known."""
        expected, pose = self.expected(other, camera), self.row(camera).cam_from_map
        return None if expected is None or pose is None else self.rig.agrees(expected, pose)

    def agreements(self) -> list[bool]:
        """Whether the localized queries stand to each other as their cameras do, pair by pair."""
        found = [self.agree(first, second) for first, second in combinations(self.sure, 2)]
        return [agree for agree in found if agree is not None]

    def doubt(self) -> None:
        """Doubt those localized queries against which more of the others speak than for them.

        Where only two are localized and disagree, the pose of one is believed if the other one is localized around it,
        too, but not the other way round, and if both together have more inliers there; else both are doubted.
        """
        sure = self.sure
        against = {one: [other for other in sure if self.agree(other, one) is False] for one in sure}
        wrong = [one for one in sure if len(against[one]) > sum(self.agree(other, one) is True for other in sure)]
        undecided = len(wrong) == len(sure) == 2
        if undecided and self._decide(wrong[0], wrong[1]):
            return
        said = {camera: self._stands_otherwise(camera, against[camera]) for camera in wrong}
        for camera, why in said.items():
            more = " It is not known which of the two is wrong." if undecided else ""
            self._put(self.row(camera).doubted(f"{why}{more}"))

    def _stands_otherwise(self, camera: str, others: Sequence[str]) -> str:
        """That a query stands otherwise than the best of the others says."""
        other = self._best(others)
        expected, found = self.expected(other, camera), self.row(camera).cam_from_map
        assert expected is not None and found is not None  # else they were not compared
        off = float(np.linalg.norm(camera_centre(expected) - camera_centre(found)))
        turned_rad = rotation_angle(found[:, :3] @ expected[:, :3].T)
        turned = f", and turned by {np.degrees(turned_rad):.0f}°" if turned_rad > TURNED_RAD else ""
        where = f"{self.judged.length(off)} from where it is found{turned}"
        return f"{_TOGETHER} {self.partners[other]}, it should be {where}."

    def _decide(self, first: str, second: str) -> bool:
        """Try both of two queries that disagree around the pose that the other one gives, and take what is decided;
        returns whether it is."""
        if tried_anew(self.row(first)) or tried_anew(self.row(second)):
            return False
        tried = {one: self._anew(other, one) for one, other in ((first, second), (second, first))}
        moved = [one for one, anew in tried.items() if anew.localized]
        if len(moved) == 1:
            camera, other = moved[0], second if moved[0] == first else first
            there = (tried[camera].row.inliers or 0) + (self.row(other).inliers or 0)
            if there > (self.row(camera).inliers or 0):
                self._take(tried[camera], other)
                return True
        for one, other in ((first, second), (second, first)):
            self._note_in_vain(one, other)
        return False

    def try_anew(self) -> None:
        """Try each query that has no believed pose around the pose that the best localized one gives."""
        for camera in sorted(self.partners):
            row = self.row(camera)
            known = [other for other in self.sure if self.expected(other, camera) is not None]
            if row.status in (LOCALIZED, UNREADABLE) or tried_anew(row) or not known:
                continue
            other = self._best(known)
            anew = self._anew(other, camera)
            if anew.localized:
                self._take(anew, other)
            else:
                self._note_in_vain(camera, other)

    def _best(self, cameras: Sequence[str]) -> str:
        """The camera whose query has most inliers."""
        return max(cameras, key=lambda camera: (self.row(camera).inliers or 0, camera))

    def _put(self, row: QueryResult) -> None:
        self.judged.rows[row.query] = row

    def _take(self, anew: _Anew, other: str) -> None:
        """Let a query that was tried anew around the pose that the other camera's gives be localized so."""
        said = f"{TRIED} that {self.partners[other]} gives, which was taken together with it, and localized."
        self._put(replace(anew.row, remarks=(*anew.row.remarks, said)))
        self.judged.traces[anew.row.query] = anew.trace

    def _note_in_vain(self, camera: str, other: str) -> None:
        said = f"{TRIED} that {self.partners[other]} gives, which was taken together with it, in vain."
        row = self.row(camera)
        kept = len(row.remarks) - len(row.doubts)  # a doubt stays the last one
        self._put(replace(row, remarks=(*row.remarks[:kept], said, *row.doubts)))

    def _anew(self, other: str, camera: str) -> _Anew:
        """A camera's query, tried around the pose that the other camera's gives."""
        judged, name, expected = self.judged, self.partners[camera], self.expected(other, camera)
        assert expected is not None
        view = judged.views[name]
        row, trace = solve_again(
            judged.scene,
            view,
            judged.rows[name].index,
            lambda: _matches_near(judged.scene, view, expected),
            judged.how,
        )
        there = row.cam_from_map is not None and self.rig.agrees(expected, row.cam_from_map)
        localized = row.status == LOCALIZED and (row.inliers or 0) >= MIN_INLIERS and there
        return _Anew(row, trace, localized)


def _references_around(expected: FloatArray, references: Sequence[View]) -> tuple[str, ...]:
    """Names of references that look to about the same side as a pose (3, 4), the nearest first."""
    here = camera_centre(expected)
    posed = [(view.name, view.cam_from_map) for view in references if view.cam_from_map is not None]
    apart = sorted(
        (float(np.linalg.norm(camera_centre(pose) - here)), name)
        for name, pose in posed
        if pose[2, :3] @ expected[2, :3] >= FACING
    )
    return tuple(name for _, name in apart)


def _matches_near(scene: MapScene, view: View, expected: FloatArray) -> Matches:
    """The matches of a query that are near to where a pose (3, 4) has them; where matches are found now, those with the
    references around that pose."""
    matcher = scene.matcher
    if isinstance(matcher, ImageMatcher):
        options = replace(matcher.options, references=SHORTLIST * matcher.options.references)
        pairs = {view.name: _references_around(expected, scene.references)}
        matcher = replace(matcher, options=options, pairs=pairs)
    found = matcher(view)
    bearings, seen = view.camera.unproject(found.pixels)
    there = transform(expected, found.points)
    near = seen & (np.sum(bearings * there, axis=1) >= np.cos(EXPECTED_RAD) * np.linalg.norm(there, axis=1))
    return replace(
        found,
        pixels=found.pixels[near],
        points=found.points[near],
        reference_index=found.reference_index[near],
        reference_pixels=found.reference_pixels[near],
        estimated_outlier_rate=None,
    )
