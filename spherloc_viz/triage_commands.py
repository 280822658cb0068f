"""The commands that compare sets of recorded runs; ``spherloc_viz.cli`` registers them."""

from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from spherloc_viz.arguments import OptionalFloat, OptionalNumber, OptionalPath, OptionalText
from spherloc_viz.given_files import check_recording_file, check_recordings_folder, is_recording

RECORDINGS = Path("recordings")
Settings = Annotated[tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]], arg(metavar="KEY=VALUE ...")]
Conditions = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="CONDITION")]


def compare(
    before: Positional[Path],
    after: Positional[Path],
    /,
    before_label: OptionalText = None,
    after_label: OptionalText = None,
    fail_if: Conditions = (),
    report: OptionalPath = None,
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """Compare two sets of runs on the same problems: what broke, what was mended, and by how much errors changed.

    Runs are paired by problem, estimator, options and seed, as far as the two sets share them. Tests are McNemar's
    exact one and Wilcoxon's signed-rank one. A condition is a quantity, a sign and a number, several joined by "and";
    quantities are new failures, mended, net failures, pairs, unpaired, failures, success (a share) and p (McNemar's).
    Ends with 0, or with 1 if a condition of --fail-if holds.

    For example:

    spherloc compare results/monday results/tuesday --fail-if "new failures > 0"

    spherloc compare results/monday results/tuesday --fail-if "success < 95 %" --report night.html

    spherloc compare recordings recordings --before-label v1 --after-label v2 --json

    Args:
        before: A folder of recordings, or a set of runs that the triage desk stored (.txt).
        after: The same, of the runs to be judged.
        before_label: Only runs with this label.
        after_label: Only runs with this label.
        fail_if: What must not be; give it once for each.
        report: An HTML file to write, with pictures of what broke and what was mended.
        json: Print one JSON object instead.
    """
    for place in (before, after):
        _check_place(place)
    from spherloc_viz.triage import compare_runs, wanted

    return compare_runs(before, after, (before_label, after_label), wanted(fail_if, report, json))


def rerun(
    runs: Positional[tuple[Path, ...]],
    /,
    *,
    estimator: OptionalText = None,
    option: Settings = (),
    seed: OptionalNumber = None,
    failed: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    label: OptionalText = None,
    out: OptionalPath = None,
    keep_gigabytes: OptionalFloat = None,
    fail_if: Conditions = (),
    report: OptionalPath = None,
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
) -> int:
    """Solve recorded problems again, with this version, other options or another estimator, and compare.

    Every problem is that of its recording, bit for bit. What is not changed stays as it was recorded: estimator,
    options and seed. The new runs are recorded. Ends as spherloc compare does.

    For example:

    spherloc rerun recordings --failed --estimator mc-exact

    spherloc rerun "recordings/sets/hard ones.txt" --option bound_px=5 --report bound.html

    spherloc rerun recordings --label regression --fail-if "new failures > 0"

    Args:
        runs: Recordings (.rrd), folders of recordings, or sets of runs that the triage desk stored (.txt).
        estimator: Another estimator, with its default options for the problem.
        option: Options to change.
        seed: Another seed for all.
        failed: Only runs that are known to have failed.
        label: Only runs with this label.
        out: Folder for the new recordings; recordings/rerun_TIME if not given.
        keep_gigabytes: What the new recordings may take (2, or what is there if that is more); beyond it the oldest
            successes are deleted.
        fail_if: What must not be, as for spherloc compare; give it once for each.
        report: An HTML file to write, with pictures of what broke and what was mended.
        json: Print one JSON object instead.
    """
    from spherloc.errors import InputError

    if not runs:
        raise InputError("no runs given; name recordings (.rrd), folders of them, or a set (.txt).")
    for place in runs:
        _check_place(place)
    from spherloc import registry

    if estimator is not None:
        registry.lookup("estimators", estimator)
    from spherloc_viz.batch import Records
    from spherloc_viz.recording.index.query import RunQuery
    from spherloc_viz.triage import rerun as do_rerun
    from spherloc_viz.triage import wanted

    asked = wanted(fail_if, report, json)
    folder = out or RECORDINGS / f"rerun_{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    query = RunQuery(outcome="failure" if failed else None, label=label)
    records = Records(folder, keep_gigabytes=keep_gigabytes)
    return do_rerun(runs, query, estimator, list(chain(*option)), seed, records, asked)


def _check_place(place: Path) -> None:
    """Raise ``SpherlocError`` if there are no runs to be had there."""
    if is_recording(place):
        check_recording_file(place)
    elif place.suffix == ".txt":
        from spherloc.errors import InputError

        if not place.is_file():
            raise InputError(f"{place}: no such set of runs; the triage desk stores them in the folder sets.")
    else:
        check_recordings_folder(place)


def diagnose(
    poses: Positional[Path],
    scenes: Positional[tuple[Path, ...]] = (),
    /,
    *,
    matches: OptionalPath = None,
    camera: OptionalPath = None,
    model: OptionalPath = None,
    database: OptionalPath = None,
    gravity: OptionalPath = None,
    map_down: tuple[float, float, float] = (0.0, 0.0, -1.0),
    bound_px: OptionalFloat = None,
    label: OptionalText = None,
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    record: bool = True,
    recordings: Path = RECORDINGS,
    keep_gigabytes: OptionalFloat = None,
) -> int:
    """Record and diagnose poses that another program found, such as hloc or COLMAP.

    Every pose becomes a run of the query of that name, with the scene's matches: what agrees with it, what is wrong
    with it, and a better pose where there is one. The playground, the triage desk and spherloc rerun take these runs
    as any other. Poses are x_cam = R x_map + t. Ends with 0 if all are localized, 1 if one is doubtful, 2 if a query
    had to be left out.

    For example:

    spherloc diagnose hloc_results.txt hloc.toml --label hloc

    spherloc diagnose poses.csv queries/*.toml --bound-px 4 --json

    spherloc diagnose poses.csv --matches matches.csv --camera camera.yaml --gravity gravity.txt

    spherloc diagnose outputs/results.txt_logs.pkl --model outputs/sfm --label hloc

    spherloc diagnose sparse/with_queries --model sparse/map --database database.db --gravity gravity.txt

    spherloc rerun recordings --label hloc --estimator mc-exact

    Args:
        poses: A CSV with the columns name, qw, qx, qy, qz, tx, ty, tz; hloc's results (lines of the same); hloc's log
            (.pkl), which has the matches too, so that no scene is needed; or the folder of a COLMAP model.
        scenes: Scene files whose queries they are: of a map with images (hloc, COLMAP and others), or matches in a CSV
            (kind "correspondences"), named by the problem, its image or the file. None with --matches.
        matches: The matches of all queries instead of scenes: a CSV with the columns name, u, v (px), X, Y, Z, and
            inlier (0 or 1) where that is known.
        camera: The calibration file of these queries.
        model: The COLMAP model of the map, for a log of hloc without scenes, or with --database.
        database: COLMAP's database instead of scenes: the verified matches of all images that --model lacks. With
            --gravity those that COLMAP could not register are solved by auto and diagnosed too.
        gravity: Where down is in these queries: rows of "image gx gy gz [sd_deg]". Without it the given poses say so,
            to within 5 degrees.
        map_down: With --matches, --database or a log, the vector that points down in the map.
        bound_px: Bound on the noise of an inlier, px; the scene's, or 3, if not given.
        label: A label for all of these runs.
        json: Print one JSON object a pose, on one line; infinity is the text "inf".
        record: Write a recording of each.
        recordings: Folder of the recordings.
        keep_gigabytes: What the recordings may take (2, or what is there if that is more); beyond it the oldest
            successes that nobody labelled are deleted.
    """
    from spherloc.datasets.scene_file import check_there, scene_path
    from spherloc.errors import InputError

    if not poses.exists():
        raise InputError(f"{poses}: no such file; give a file of poses, or the folder of a COLMAP model.")
    from spherloc.formats.hloc_log import is_log

    own = matches is None and database is None and not scenes
    logged = own and is_log(poses)
    if (model is not None) != (database is not None) and not (logged and database is None):
        raise InputError("--model, the map, goes with --database, which needs it, or with hloc's log (.pkl).")
    if sum((bool(scenes), matches is not None, database is not None)) > 1:
        raise InputError("the matches come from scenes, from --matches or from --database; give one of them.")
    if own and not logged:
        raise InputError("no scene given; name the scene files whose queries the poses are of, or give --matches.")
    if (matches is None) != (camera is None) or (gravity is not None and scenes):
        raise InputError(
            "--matches needs --camera and goes with it only; --gravity does not go with scenes, which say that."
        )
    files = [scene_path(scene) for scene in scenes]
    for file in files:
        check_there(file)
    if label is not None:
        from spherloc_viz.recording.reviews import checked_review

        checked_review([label], "")
    from spherloc_viz.batch import Records
    from spherloc_viz.given_poses import diagnose_poses

    kept = Records(recordings, keep_gigabytes=keep_gigabytes) if record else None
    if scenes:
        return diagnose_poses(poses, files, bound_px, label, json, kept)
    from spherloc.datasets.match_table import read_database_matches, read_logged_matches, read_match_table
    from spherloc_viz.progress import say

    wrong: tuple[InputError, ...] = ()
    if database is not None and model is not None:
        table, wrong = read_database_matches(database, model, gravity, map_down)
    elif matches is not None and camera is not None:
        table = read_match_table(matches, camera, gravity, map_down)
    else:
        table, wrong = read_logged_matches(poses, model, gravity, map_down)
    for error in wrong:
        say(f"{error} It is left out.")
    return diagnose_poses(poses, [table], bound_px, label, json, kept)
