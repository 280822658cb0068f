"""What the commands about recorded runs take; the work is done by the other modules of this folder."""

import sys
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from spherloc.errors import InputError
from spherloc_viz.commands.flags import (
    RECORDINGS,
    Flag,
    OptionalFloat,
    OptionalNumber,
    OptionalPath,
    OptionalText,
    Settings,
)
from spherloc_viz.given_files import (
    check_recording_file,
    check_recordings_folder,
    is_recording,
    known_as,
    none_there,
    without_reviews,
)

RangeText = Annotated[str | None, arg(metavar="RANGE", help_behavior_hint="")]
DateText = Annotated[str | None, arg(metavar="DATE|AGE", help_behavior_hint="")]
Conditions = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="CONDITION")]


def runs(
    folder: Positional[Path] = RECORDINGS,
    /,
    *,
    failed: Flag = False,
    suspect: Flag = False,
    outcome: OptionalText = None,
    diagnosis: OptionalText = None,
    estimator: OptionalText = None,
    scene: OptionalText = None,
    source: OptionalText = None,
    label: OptionalText = None,
    text: OptionalText = None,
    outliers: RangeText = None,
    rotation_error: RangeText = None,
    position_error: RangeText = None,
    inliers: RangeText = None,
    correspondences: RangeText = None,
    time: RangeText = None,
    since: DateText = None,
    until: DateText = None,
    sort: str = "created",
    ascending: Flag = False,
    group: OptionalText = None,
    limit: OptionalNumber = None,
    json: Flag = False,
    csv: Flag = False,
) -> int:
    """List recorded runs: which failed, and of what.

    All that is asked must be true of a run. A range is '>0.9', '<=3', '0.5..0.9' or one number; a run whose number is
    unknown is in none. A new recording is read first, and its row kept in the folder's runs.sqlite.

    For example:

    spherloc runs --failed --outliers '>0.9' --estimator mc

    spherloc runs --group diagnosis --since 3d

    spherloc runs --diagnosis false-consensus --sort position-error --csv

    spherloc runs recordings --text "facade night" --label wrong-map --json

    Args:
        folder: Folder of the recordings.
        failed: Only runs that are known to have failed.
        suspect: Only runs whose diagnosis names a cause, also where the truth is not known.
        outcome: success, failure or unknown (there is no truth).
        diagnosis: A diagnosis or a part of its name, such as false-consensus; a wrong one lists them all.
        estimator: An estimator, such as mc.
        scene: A scene as it is recorded, or a problem's name; a wrong one lists some.
        source: Who ran it: page, command, sweep, sequence, gallery or unknown.
        label: A label that a reviewer gave, the whole of it.
        text: Words that all occur in scene, name, query image, message, diagnosis, note, labels, title or file.
        outliers: Share of wrong correspondences, 0 to 1.
        rotation_error: Degrees.
        position_error: Metres.
        inliers: Correspondences that agree with the pose.
        correspondences: All of them.
        time: Milliseconds.
        since: A date (2026-01-31), a time (2026-01-31T08:30), both UTC, or an age (90min, 2h, 3d, 1w).
        until: The same; a date is included.
        sort: created, outliers, rotation-error, position-error, time, inliers or another; a wrong one lists them all.
        ascending: The smallest or oldest first.
        group: Count the runs by diagnosis, outcome, estimator, scene, source, label or problem-key instead.
        limit: How many to list; 0 for all. A table has 50 if it is not given, JSON and CSV have all.
        json: Print JSON instead of a table.
        csv: Print CSV instead of a table.
    """
    check_recordings_folder(folder)
    from spherloc_viz.commands import runs as listing
    from spherloc_viz.recording.index.query import RunQuery, parse_range, parse_when

    def within(text: str | None):
        return None if text is None else parse_range(text)

    now = datetime.now(UTC)
    query = RunQuery(
        text=text,
        scene=scene,
        estimator=estimator,
        outcome=listing.outcome_of(outcome, failed),
        diagnosis=None if diagnosis is None else listing.diagnosis_of(diagnosis),
        doubtful=suspect or None,
        label=label,
        source=listing.source_of(source),
        outlier_rate=within(outliers),
        rotation_error_deg=within(rotation_error),
        translation_error_m=within(position_error),
        inliers=within(inliers),
        correspondences=within(correspondences),
        time_ms=within(time),
        since=None if since is None else parse_when(since, now),
        until=None if until is None else parse_when(until, now, end=True),
        sort=listing.sort_key(sort),
        descending=not ascending,
    )
    return listing.print_runs(folder, query, group, limit, _form(json, csv))


def steps(
    condition: Positional[str],
    folder: Positional[Path] = RECORDINGS,
    /,
    limit: OptionalNumber = None,
    json: Flag = False,
    csv: Flag = False,
) -> int:
    """List the steps of recorded runs for which a condition holds, such as those that had the right pose and lost it.

    The condition is SQL of columns, numbers, texts, comparisons, AND, OR, NOT, IN, BETWEEN, LIKE, IS NULL and
    arithmetic. Columns of a step: step (its number, from 1), stage, key (its name), agreeing (matches),
    rotation_error_deg, position_error_m (of its pose). Columns of its run: created, source, scene, name, estimator,
    seed, outcome, diagnosis, doubtful, correspondences, inliers, outlier_rate, steps, key_step, time_ms. What is
    unknown is NULL.
    Needs the extra "catalog".

    For example:

    spherloc steps "position_error_m < 0.1 AND outcome = 'failure'"

    spherloc steps "stage = 'Refinement' AND agreeing < 0.2 * correspondences" recordings --csv

    Args:
        condition: What must be true of a step.
        folder: Folder of the recordings.
        limit: How many steps to list; 0 for all. A table has 50 if it is not given, JSON and CSV have all.
        json: Print JSON instead of a table.
        csv: Print CSV instead of a table.
    """
    check_recordings_folder(folder)
    from spherloc_viz.commands.runs import print_steps

    return print_steps(folder, condition, limit, _form(json, csv))


def _form(json: bool, csv: bool) -> str:
    if json and csv:
        raise InputError("--json and --csv are two forms of one answer; give one of them.")
    return "json" if json else "csv" if csv else "table"


def view(
    recording: Positional[Path],
    /,
    web: Flag = False,
    step: OptionalNumber = None,
    port: int = 9090,
) -> int:
    """Open a recording in the Rerun viewer, paused at the step where the run was decided or went wrong.

    Shows its labels and note too.

    For example:

    spherloc view recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd

    spherloc view run.rrd --web --step 3

    Args:
        recording: A recording (.rrd).
        web: Serve the viewer to a browser on this machine instead of opening a window.
        step: The step to open at; 1 is the first, and the key step is taken if it is not given.
        port: Port of the web viewer; 0 takes a free one.
    """
    check_recording_file(recording)
    from spherloc_viz.recording.sandbox.examiner import examine
    from spherloc_viz.recording.viewer import step_of, view_in_window

    row = examine(recording)
    number = step_of(row, step)
    if web:
        from spherloc_viz.app.web.viewer import serve_recording

        serve_recording(recording, row, number, port)
    else:
        view_in_window(recording, row, number)
    return 0


def label(
    recordings: Positional[tuple[Path, ...]],
    /,
    add: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    remove: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    note: OptionalText = None,
) -> int:
    """Give recordings labels and a note, which lists and the Rerun viewer show; print what they are then.

    They lie beside the recording, in a file that ends with .review.rrd. Ends with 2 if a file is no recording.

    For example:

    spherloc label recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd --add wrong-map --note "See step 4."

    spherloc label recordings/*_mc_*.rrd --remove wrong-map --add "look again" --note ""

    Args:
        recordings: Recordings (.rrd), one or more.
        add: A label; give it once for each.
        remove: A label to take away; give it once for each.
        note: The note, in place of the one before; an empty one takes it away.
    """
    files = without_reviews(recordings)
    if none_there(files, check_recording_file):
        return 2
    from spherloc_viz.commands.runs import label_runs

    return label_runs(files, add, remove, note)


def reindex(folder: Positional[Path] = RECORDINGS, /) -> int:
    """Read all recordings of a folder again and make its list of runs anew, with labels and notes.

    Says which files it leaves out and why. Ends with 0 if all are runs, 1 if some are left out.

    For example:

    spherloc reindex

    spherloc reindex results/night/recordings

    Args:
        folder: Folder of the recordings.
    """
    check_recordings_folder(folder)
    from spherloc_viz.commands.runs import reindex as read_all

    return read_all(folder)


def repeat(
    recordings: Positional[tuple[Path, ...]],
    /,
    json: Flag = False,
) -> int:
    """Solve the problem of a recording again, with its estimator, options and seed, and compare.

    The same are a pose that agrees in every bit, the inliers, the certificate and the message. If one differs, it says
    how, whether it is by rounding only, and which versions are not what they were. Ends with 0 if all are the same, 1
    if one differs, 2 if a file is no recording that can be repeated here.

    For example:

    spherloc repeat recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd

    spherloc repeat recordings/*_mc_*.rrd --json

    Args:
        recordings: Recordings (.rrd), one or more.
        json: Print one JSON object a recording, on one line; infinity is the text "inf".
    """
    files = without_reviews(recordings)
    if none_there(files, check_recording_file):
        return 2
    from spherloc_viz.commands.progress import solve
    from spherloc_viz.recording.replay import repeat_all

    return repeat_all(files, json, solve)


def rerun(
    runs: Positional[tuple[Path, ...]],
    /,
    *,
    estimator: OptionalText = None,
    option: Settings = (),
    seed: OptionalNumber = None,
    failed: Flag = False,
    label: OptionalText = None,
    out: OptionalPath = None,
    keep_gigabytes: OptionalFloat = None,
    fail_if: Conditions = (),
    report: OptionalPath = None,
    json: Flag = False,
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
        keep_gigabytes: Size limit of the new recordings, GB (2, or their present size if larger). Above it the oldest
            successes are deleted.
        fail_if: Condition that makes the exit code 1, as for spherloc compare; give it once for each.
        report: An HTML file to write, with pictures of what broke and what was mended.
        json: Print one JSON object instead.
    """
    if not runs:
        raise InputError("no runs given; name recordings (.rrd), folders of them, or a set (.txt).")
    for place in runs:
        _check_place(place)
    from spherloc import registry

    if estimator is not None:
        registry.lookup("estimators", estimator)
    from spherloc_viz.commands.compare import rerun as do_rerun
    from spherloc_viz.commands.compare import wanted
    from spherloc_viz.commands.run import Records
    from spherloc_viz.recording.index.query import RunQuery

    asked = wanted(fail_if, report, json)
    folder = out or RECORDINGS / f"rerun_{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    query = RunQuery(outcome="failure" if failed else None, label=label)
    records = Records(folder, keep_gigabytes=keep_gigabytes)
    return do_rerun(runs, query, estimator, list(chain(*option)), seed, records, asked)


def compare(
    before: Positional[Path],
    after: Positional[Path],
    /,
    before_label: OptionalText = None,
    after_label: OptionalText = None,
    fail_if: Conditions = (),
    report: OptionalPath = None,
    json: Flag = False,
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
    from spherloc_viz.commands.compare import compare_runs, wanted

    return compare_runs(before, after, (before_label, after_label), wanted(fail_if, report, json))


def _check_place(place: Path) -> None:
    """Raise ``SpherlocError`` if there are no runs to be had there."""
    if is_recording(place):
        check_recording_file(place)
    elif place.suffix == ".txt":
        if not place.is_file():
            raise InputError(f"{place}: no such set of runs; the triage desk stores them in the folder sets.")
    else:
        check_recordings_folder(place)


def check_proof(file: Positional[Path], /) -> int:
    """Check a proof that spherloc run --proof wrote, with numpy alone.

    Says what is proven, and ends with 0; or why the file proves nothing, and ends with 1.

    Args:
        file: The proof (.npz).
    """
    from spherloc.proof_check import Refused, check

    if file.suffix.lower() != ".npz" and (told := known_as(file)):
        raise InputError(told)
    try:
        print(check(file))
    except Refused as refused:
        print(f"refused: {refused}", file=sys.stderr)
        return 1
    return 0
