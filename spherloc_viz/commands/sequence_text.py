"""What ``spherloc localize`` prints of a sequence."""

from collections.abc import Collection, Iterator, Sequence
from statistics import median

from spherloc.datasets.map_scene import LIKE_REFERENCE, MapScene
from spherloc.diagnosis.causes import Cause
from spherloc.errors import shorten
from spherloc.experiments.configuration import Configuration
from spherloc.experiments.results import DOUBTFUL, LOCALIZED, PICTURE, POSED, UNREADABLE, QueryResult, SequenceResults
from spherloc.experiments.sequence import INITIALISED
from spherloc.experiments.summary import SuccessRate, Summary, TrajectoryError, success_rates, timed
from spherloc.frontend.gravity_from_lines import why_not_found
from spherloc.frontend.pipeline import NO_POINT
from spherloc.mapping.scenes.joint_outcome import TRIED, tried_anew
from spherloc.metrics import AWAY, said_length
from spherloc_viz.layers.where_taken import nearest

MAX_TOLD, MAX_EACH = 5, 20
MIN_BEYOND = 4
"""Number of localized queries with gravity beyond its bound from which on they have a common reason."""
FAR = 1e5
"""Coordinates of a wrong pose can be larger; they are rounded."""


def sequence_text(results: SequenceResults, summary: Summary, scene: MapScene) -> str:
    """The summary as text for users."""
    setting = results.configuration
    lines = [
        f"{setting.name} ({setting.scene}), {setting.estimator}, seed {setting.seed}",
        f"  {summary.localized} of {summary.done} queries are localized, {summary.doubtful} more have a doubtful pose"
        + (f", of {summary.queries} in the scene" if summary.done < summary.queries else ""),
    ]
    if not setting.metric:
        lines.append("  units are unknown: lengths are in units of the map, and so are the limits")
    first = sum(any(remark.startswith(INITIALISED) for remark in row.remarks) for row in results.rows)
    if first:
        lines.append(f"  {first} initialised by {setting.options['initialise']}, the others tracked")
    if anew := sum(row.status == LOCALIZED and tried_anew(row) for row in results.rows):
        lines.append(f"  {anew} of them around the poses that queries taken together with them give")
    lines += [f"  {line}" for line in _wrong(results, scene.extent_m)]
    rates = (*summary.success, *summary.registration_success)
    lines += [f"  success {_rate(rate, setting.unit)}" for rate in rates if rate.judged or not summary.without_truth]
    lines += [f"  {line}" for line in _by_folder(results)]
    error_m = summary.median_translation_error_m
    if summary.median_rotation_error_deg is not None and error_m is not None:
        lines.append(
            f"  median error {summary.median_rotation_error_deg:.3f} deg and "
            f"{said_length(error_m, scene.extent_m, setting.length(error_m))}, of queries with a pose"
        )
    lines += [f"  {line}" for line in _trajectory_lines(summary.trajectory, setting, scene.extent_m)]
    if scene.about_truth and summary.success:
        lines.append(f"  {scene.about_truth[0].lower()}{scene.about_truth[1:].removesuffix('.')}")
    if summary.median_registration_error_m is not None:
        lines.append(f"  median registration error {setting.length(summary.median_registration_error_m)}")
    if summary.mean_f1 is not None:
        lines.append(
            f"  inliers against matches within 8 px of the truth: mean precision {summary.mean_precision:.3f}, "
            f"recall {summary.mean_recall:.3f}, F1 {summary.mean_f1:.3f}"
        )
    if summary.median_estimating_ms is not None:
        lines.append(
            f"  median time {summary.median_matching_ms or 0:.0f} ms for matching, "
            f"{summary.median_estimating_ms:.1f} ms for estimating"
        )
    lines += [f"  {line}" for line in (*gravity_by_source(results.rows), *without_lines(results.rows))]
    lines += [
        f"  {line}"
        for line in (*_skipped(summary), *_each(results, scene), *_without_pose(results.rows), *_remarks(results.rows))
    ]
    if not timed(results.rows):
        none = any(row.timestamp_s is None for row in results.rows)
        why = "not all queries have a time" if none else "those of the queries do not always grow"
        lines.append(f"  trajectory: times are places in the sequence, as {why}")
    if (picture := results.folder / PICTURE).exists():
        lines.append(f"  picture: {picture}")
    return "\n".join([*lines, f"  written to {results.folder}"])


def maps_text(results: Sequence[SequenceResults]) -> str:
    """In which of several maps each of the same queries is localized, as text for users.

    ``results`` are those in each of the maps.
    """
    localized = [{row.query for row in one.rows if row.status == LOCALIZED} for one in results]
    queries = {row.query for one in results for row in one.rows}
    anywhere = set().union(*localized)
    lines = [f"{len(anywhere)} of {len(queries)} queries are localized in one of these {len(results)} maps"]
    lines += [
        f"  {len(names)} in {one.configuration.scene}{_names(names)}"
        for one, names in zip(results, localized, strict=True)
    ]
    if left := queries - anywhere:
        lines.append(f"  {len(left)} in none{_names(left)}")
    return "\n".join(lines)


def _names(names: Collection[str]) -> str:
    said = sorted(names)
    return f": {', '.join(said[:MAX_EACH])}{', …' if len(said) > MAX_EACH else ''}" if said else ""


def _wrong(results: SequenceResults, extent_m: float) -> Iterator[str]:
    """A line on the queries that are localized beyond all limits of the scene, in a map of that extent."""
    limits, wrong = results.configuration.thresholds, []
    for row in results.rows:
        turned, moved = row.rotation_error_deg, row.translation_error_m
        if row.status != LOCALIZED or turned is None or moved is None or not limits:
            continue
        if all(turned > degrees or moved > metres for degrees, metres in limits):
            off = said_length(moved, extent_m, results.configuration.length(moved))
            wrong.append(f"{row.query}: {turned:.3g} deg and {off} off")
    if wrong:
        more = f"; and {len(wrong) - MAX_TOLD} more, see results.csv" if len(wrong) > MAX_TOLD else ""
        yield f"wrong by the truth, though localized: {'; '.join(wrong[:MAX_TOLD])}{more}"


def _each(results: SequenceResults, scene: MapScene) -> Iterator[str]:
    """A line for each query with a pose, where these are few."""
    posed = [row for row in results.rows if row.status in POSED]
    if len(posed) > MAX_EACH:
        yield "where each was taken is in results.csv"
        return
    told, images = False, {view.name: view.path for view in scene.queries}
    for row in posed:
        turned, moved = row.expected_rotation_error_deg, row.expected_translation_error_m
        off = ""
        if row.status == LOCALIZED and turned is not None and moved is not None:
            told = True
            off = f", expected error {turned:.2g} deg and {results.configuration.length(moved)}"
        at = ", ".join(f"{value:.2f}" if abs(value) < FAR else f"{value:.2g}" for value in row.position_m)
        agree = f"{row.inliers or 0:,} of {row.matches or 0:,} matches agree"
        near = nearest(scene, row.cam_from_map, images.get(row.query)) if row.cam_from_map is not None else ""
        place = f"at ({at}), {near}" if near else f"at ({at})"
        if row.cam_from_map is not None and scene.is_away(row.cam_from_map):
            place = f"at {AWAY}"
        yield f"{row.query}: {row.status}{_why(row)}, {place}, {agree}{off}"
    if told:
        yield "expected errors are what the noise of the matches leaves; errors of the map and of the lens add to them"


def _why(row: QueryResult) -> str:
    """The cause, in brackets, of a pose that is not good; that of a doubtful one can be that the truth bears it out."""
    if row.diagnosis not in (None, str(Cause.OK)):
        return f" ({row.diagnosis})"
    right = row.status == DOUBTFUL and row.diagnosis is not None and row.rotation_error_deg is not None
    return " (right, as the truth shows)" if right else ""


def _trajectory_lines(error: TrajectoryError | None, setting: Configuration, extent_m: float) -> Iterator[str]:
    """Lines on ATE and RPE of all poses, in a map of that extent."""
    if error is None:
        return

    def said(length_m: float) -> str:
        return said_length(length_m, extent_m, setting.length(length_m))

    aligned = [
        f"{said(value)} {how}"
        for value, how in ((error.ate_rigid_m, "aligned rigidly"), (error.ate_similarity_m, "with scale"))
        if value is not None
    ]
    yield f"ATE of all {error.poses} poses: {', '.join([said(error.ate_m), *aligned])}"
    if error.rpe_m is not None:
        yield f"RPE from pose to pose: {said(error.rpe_m)}, {error.rpe_deg:.3f} deg"


def gravity_by_source(rows: Sequence[QueryResult]) -> Iterator[str]:
    """A line for each source of gravity: its number of queries, its bounds and its true errors; and one where most
    of its localized queries show it to be wrong."""
    by_source: dict[str, list[QueryResult]] = {}
    for row in rows:
        if row.gravity_source:
            by_source.setdefault(row.gravity_source, []).append(row)
    for source, told in by_source.items():
        bounds = [row.gravity_bound_deg for row in told if row.gravity_bound_deg is not None]
        errors = [row.gravity_error_deg for row in told if row.gravity_error_deg is not None]
        most = f" to {max(bounds):.2g}" if max(bounds) > min(bounds) else ""
        off = f"; off the truth by {median(errors):.3g} deg in the median, {max(errors):.3g} at most" if errors else ""
        queries = "query" if len(told) == 1 else "queries"
        yield f"gravity from {shorten(source)} in {len(told)} {queries}, within {min(bounds):.2g}{most} deg{off}"
        sure = [row for row in told if row.status == LOCALIZED]
        beyond = sum(row.diagnosis == Cause.GRAVITY_OFF for row in sure)
        if beyond >= MIN_BEYOND and 2 * beyond >= len(sure):
            why = (
                "they are held otherwise than the references"
                if source == LIKE_REFERENCE
                else "down in the map ([gravity] map of the scene file) may be tilted"
            )
            yield f"in {beyond} of {len(sure)} localized ones the matches show gravity to be beyond that: {why}"


def without_lines(rows: Sequence[QueryResult]) -> Iterator[str]:
    """A line for each of the first queries whose lines gave no gravity."""
    reasons = {row.query: why for row in rows for remark in row.remarks if (why := why_not_found(remark))}
    for query, why in list(reasons.items())[:MAX_TOLD]:
        yield f"no gravity from lines of {query}: {why}"
    if len(reasons) > MAX_TOLD:
        yield f"no gravity from lines of {len(reasons) - MAX_TOLD} more, see results.csv"


def _remarks(rows: Sequence[QueryResult]) -> Iterator[str]:
    """Lines on what was wrong with the files or the gravity of queries, each of which may be of several queries."""
    about: dict[str, list[str]] = {}
    for row in rows:
        known = (NO_POINT, INITIALISED, TRIED) if row.status in POSED else (INITIALISED, TRIED)
        for remark in row.remarks:
            if not why_not_found(remark) and not any(word in remark for word in known):
                about.setdefault(remark.removeprefix(f"{row.query}: "), []).append(row.query)
    for remark, queries in list(about.items())[:MAX_TOLD]:
        more = f" and {len(queries) - 1} more" if len(queries) > 1 else ""
        yield f"{queries[0]}{more}: {remark.removesuffix('.')}"
    if len(about) > MAX_TOLD:
        yield f"and {len(about) - MAX_TOLD} more remarks, see results.csv"


def _rate(rate: SuccessRate, unit: str) -> str:
    length = f"{rate.metres:g} {unit}"
    limits = length if rate.degrees is None else f"{rate.degrees:g} deg, {length}"
    what = "registration within " if rate.degrees is None else "within "
    if rate.rate is None or rate.low is None or rate.high is None:
        return f"{what}{limits}: nothing to judge"
    interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f} %"
    return f"{what}{limits}: {100 * rate.rate:.1f} % ({rate.successes} of {rate.judged}; 95 %: {interval})"


def _by_folder(results: SequenceResults) -> Iterator[str]:
    """A line for each folder of the queries with known truth, where there are several: those of one camera or one time
    of day. It has the success rates at the limits of the scene, in their order."""
    folders: dict[str, list[QueryResult]] = {}
    for row in results.rows:
        folders.setdefault(row.query.rpartition("/")[0], []).append(row)
    rates = {name: success_rates(rows, results.configuration.thresholds) for name, rows in folders.items()}
    judged = {name: told for name, told in rates.items() if told}
    if len(judged) < 2:
        return
    for name, told in list(judged.items())[:MAX_EACH]:
        cells = " / ".join(f"{100 * (rate.rate or 0.0):.1f}" for rate in told)
        yield f"  {shorten(name) or 'without a folder'}: {cells} % of {told[0].judged}"
    if len(judged) > MAX_EACH:
        yield f"  and {len(judged) - MAX_EACH} more folders, see results.csv"


def _skipped(summary: Summary) -> Iterator[str]:
    if summary.unreadable:
        yield f"not judged: {summary.unreadable} with an unreadable image"
    if summary.without_truth:
        none = not any(rate.judged for rate in summary.success)
        yield (
            "errors are unknown: these queries have no true poses"
            if none
            else f"not judged by the truth: {summary.without_truth} whose true pose is unknown"
        )
    if summary.not_registered:
        yield f"not judged by registration: {summary.not_registered} that could not be registered"


def _without_pose(rows: Sequence[QueryResult]) -> Iterator[str]:
    lost = [row for row in rows if row.status not in POSED]
    for row in lost[:MAX_TOLD]:
        what = row.message if row.query in row.message else f"{row.query}: {row.message}"
        yield f"{'unreadable' if row.status == UNREADABLE else 'no pose'}: {what}"
    if len(lost) > MAX_TOLD:
        yield f"and {len(lost) - MAX_TOLD} more without a pose, see results.csv"
