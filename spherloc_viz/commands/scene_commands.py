"""What the commands take that solve problems; the work is done by the other modules of this folder."""

import os
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from spherloc.errors import InputError
from spherloc.files import is_file, is_folder
from spherloc_viz import given_files
from spherloc_viz.commands.flags import (
    INTERRUPTED,
    RECORDINGS,
    Flag,
    OptionalFloat,
    OptionalNumber,
    OptionalPath,
    OptionalText,
    Settings,
)


def run(
    scenes: Positional[tuple[Path, ...]],
    /,
    *,
    estimator: str = "mc",
    seed: OptionalNumber = None,
    option: Settings = (),
    set: Settings = (),
    spoil: OptionalText = None,
    mend: OptionalText = None,
    hide: OptionalText = None,
    json: Flag = False,
    record: bool = True,
    full: Flag = False,
    recordings: Path = RECORDINGS,
    keep_gigabytes: OptionalFloat = None,
    query: OptionalText = None,
    proof: OptionalPath = None,
) -> int:
    """Solve localization problems and record each run.

    Prints pose, inliers and time of every scene; where the truth is known, the errors; what is proven; and what is
    wrong with a run that failed or is doubtful. Ends with 0 if every scene is localized, 1 if one is doubtful or
    has no pose, 2 if an input is wrong.

    For example:

    spherloc run mei_outliers_80

    spherloc run scenes/*.toml --estimator ransac-2p --seed 7 --json

    spherloc run scenes/mei_outliers_90.toml --estimator ransac-2p --option iterations=5000 confidence=0.999

    spherloc run scenes/mei_outliers_90.toml --option gravity_sd_deg=inf robust=huber

    spherloc run scenes/mei_outliers_90.toml --set outlier_rate=0.5 outlier_kind=coherent --spoil 3,5 --hide 1

    Args:
        scenes: Scene files (TOML), names of bundled scenes, or recordings (.rrd), whose problem is solved.
        estimator: mc (deterministic maximum consensus), ransac-2p or another one; a wrong name lists them all.
        seed: Seed of the estimator and, in synthetic scenes, of the simulation; the scene's own if not given.
        option: Options of the estimator, such as bound_px=4; none and inf are values where they make sense.
        set: Changes to synthetic scenes, such as noise_px=2 or true_camera=30,1,0,2; a wrong one lists them all.
        spoil: Numbers of matches, such as 3,5, that get a wrong pixel; the first match is 0.
        mend: Numbers of matches that get the right pixel, where the truth is known.
        hide: Numbers of matches that are left out.
        json: Print one JSON object a scene, on one line; infinity is the text "inf".
        record: Write a recording of each run.
        full: Keep every step, arc and edge in the recordings, which makes them larger.
        recordings: Folder of the recordings.
        keep_gigabytes: Size limit of the recordings, GB (2, or their present size if larger). Above it the oldest
            successes without a label or note are deleted.
        query: Name of the query image, in scenes made of images; the first one if not given.
        proof: File (.npz) for the proof of what mc-exact says that no pose can explain; of one scene. Anyone can check
            it: python -m spherloc.proof_check FILE, which needs numpy only.
    """
    from spherloc.datasets import scene_path

    paths = [scene_path(scene) for scene in given_files.without_reviews(scenes)]
    if given_files.none_there(paths, given_files.check_scene_file):
        return 2
    from spherloc.datasets.variation import parse_variation
    from spherloc_viz.commands.run import Records, run_scenes

    variation = parse_variation(list(chain(*set)), spoil, mend, hide)
    kept = Records(recordings, full, keep_gigabytes) if record else None
    return run_scenes(
        paths, estimator, seed, list(chain(*option)), json, kept, query=query, variation=variation, proof=proof
    )


def localize(
    scenes: Positional[tuple[Path, ...]],
    /,
    *,
    estimator: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="NAME[,OPTION=VALUE...]")] = (),
    initialise: OptionalText = None,
    seed: int = 0,
    option: Settings = (),
    queries: Annotated[tuple[str, ...], arg(metavar="NAME|FIRST:LAST:STEP ...")] = (),
    output: OptionalPath = None,
    record: bool = True,
    recordings: OptionalPath = None,
    keep_gigabytes: OptionalFloat = None,
    retry_failed: Flag = False,
) -> int:
    """Localize a sequence of query images against a map, or compare estimators on several.

    Every finished query is safe in the output folder at once: stop it when you like, the same command goes on. The
    folder gets results.csv and results.jsonl (a row a query), trajectory.tum and truth.tum (camera poses in the map),
    vehicle.tum (those of the vehicle or device, where the dataset has the camera's place on it), trajectory.png
    (coloured by error), summary.json (success rates at the scene's limits, ATE, RPE), configuration.json, and a
    recording of each query. Several scenes or estimators have a folder each in it, and get
    comparison.csv and .md and a picture a scene with all trajectories. Ends with 0 if every query is localized, 1 if
    one is doubtful or has no pose, 2 if an input is wrong.

    For example:

    spherloc localize street_fisheye

    spherloc localize my_scene.toml --estimator mc-exact --queries 0:100:5 --output results/every_fifth

    spherloc localize my_scene.toml --queries left/0001.png left/0002.png --no-record

    spherloc localize street_fisheye --initialise mc-exact --estimator ransac-2p

    spherloc localize day.toml night.toml --estimator mc --estimator ransac-2p,iterations=100 --output results/both

    Args:
        scenes: Scene files (TOML) with query and reference images, or names of bundled scenes; spherloc scenes lists
            them and the kinds.
        estimator: mc (deterministic maximum consensus) if not given, mc-exact or another one, with options after
            commas; a wrong name lists them all. Give it once for each.
        initialise: Estimator that solves the first query, and each one that the other one does not localize or that
            follows such a one; the other one tracks in between.
        seed: Seed of the estimator, the same for every query.
        option: Options of all estimators, such as bound_px=4; none and inf are values where they make sense.
        queries: Only these: names, or places counted from 0, the last one not included; all if not given.
        output: Folder of the results; recordings/SCENE_ESTIMATOR_SEED if not given, or recordings/comparison_SEED; the
            scene files of maps are called after their folders.
        record: Write a recording of each query.
        recordings: Folder of the recordings; a folder of that name in the output folder if not given.
        keep_gigabytes: Size limit of the recordings, GB (2, or their present size if larger). Above it the oldest
            successes without a label or note are deleted.
        retry_failed: Do queries again that have no pose yet.
    """
    from spherloc.datasets.scene_file import check_there, scene_path

    paths = [scene_path(scene) for scene in scenes]
    if not paths:
        raise InputError("no scene given; name one or more scene files or bundled scenes, such as street_fisheye.")
    for path in paths:
        check_there(path)
    from spherloc_viz.commands.localize import Solving, compare_sequences, localize_sequence
    from spherloc_viz.commands.run import Records

    def solving(name: str, folder: Path) -> Solving:
        kept = Records(recordings or folder / "recordings", keep_gigabytes=keep_gigabytes) if record else None
        return Solving(*_name_and_options(name, option), folder, kept, initialise)

    names = estimator or ("mc",)
    try:
        if len(paths) == len(names) == 1:
            words = names[0] if initialise is None else f"{initialise}+{names[0]}"
            folder = output or RECORDINGS / f"{_results_name(paths[0])}_{words}_{seed}"
            return localize_sequence(paths[0], [solving(names[0], folder)], seed, queries, retry_failed)
        base = output or RECORDINGS / f"comparison_{seed}"
        each = {path: [solving(name, base / _results_name(path) / name) for name in names] for path in paths}
        return compare_sequences(each, seed, queries, retry_failed, base)
    except KeyboardInterrupt:
        # Without waiting for the thread that matches the next query; all that is done is on the disk.
        os._exit(INTERRUPTED)


def _results_name(path: Path) -> str:
    """What results of a scene file are called: its name, in a map after that of the map, and of the group in it."""
    from spherloc.mapping.scene_files import MODEL, SCENE

    names, folder = [path.stem], path.resolve().parent
    while is_file(folder / SCENE) and is_folder(folder / MODEL):
        names.insert(0, folder.name)
        folder = folder.parent
    return "_".join(names)


def _name_and_options(text: str, common: Sequence[Sequence[str]]) -> tuple[str, tuple[str, ...]]:
    """The estimator of "NAME,OPTION=VALUE", and its options with those of all estimators before them."""
    name, *options = text.split(",")
    return name, (*chain(*common), *options)


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
    json: Flag = False,
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
        keep_gigabytes: Size limit of the recordings, GB (2, or their present size if larger). Above it the oldest
            successes without a label or note are deleted.
    """
    from spherloc.datasets.scene_file import check_there, scene_path

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
    from spherloc_viz.commands.diagnose import diagnose_poses
    from spherloc_viz.commands.run import Records

    kept = Records(recordings, keep_gigabytes=keep_gigabytes) if record else None
    if scenes:
        return diagnose_poses(poses, files, bound_px, label, json, kept)
    from spherloc.datasets.match_table import read_database_matches, read_logged_matches, read_match_table
    from spherloc_viz.commands.progress import say

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


def map(
    folder: Positional[Annotated[Path, arg(metavar="FOLDER")]],
    /,
    *,
    camera: OptionalPath = None,
    camera_name: OptionalText = None,
    panorama: bool = False,
    video: OptionalPath = None,
    frames: int = 40,
    output: OptionalPath = None,
    camera_height: OptionalFloat = None,
    distance: Annotated[tuple[str, str, float] | None, arg(metavar="IMAGE IMAGE METRES", help_behavior_hint="")] = None,
    positions: OptionalPath = None,
    mask: OptionalPath = None,
    nadir: OptionalFloat = None,
    seam: OptionalFloat = None,
    features: Annotated[str | None, arg(metavar="sift|aliked|sift+aliked")] = None,
    localize: OptionalPath = None,
) -> int:
    """Make a map of your own photographs: panoramas, or images of calibrated wide cameras.

    Features, matches, COLMAP's structure from motion, which way is down, and scale if you give one; then a scene file
    that opens at once. Needs the extra colmap. Stop it when you like: the same command goes on. Ends with 0 if all
    images are in the map, 1 if some are not (report.html says why), 2 if an input is wrong.

    For example:

    spherloc map my_panoramas

    spherloc map my_fisheyes --camera calibration.yaml --camera-height 1.6

    spherloc map frames --video walk.mp4 --localize new_photographs

    Args:
        folder: Folder of the photographs, or of a folder for each camera; with --video, where its frames are put.
        camera: Calibration file; without it, those beside the images are taken, and others of 2 to 1 are panoramas.
        camera_name: Which camera of that file all images have; otherwise their name or their folder's says it.
        panorama: Images of 2 to 1 are panoramas, whatever lies beside them.
        video: Take frames from this video first, the sharpest of each stretch.
        frames: How many frames to take.
        output: Folder of the map; FOLDER_map here if not given.
        camera_height: Metres of the cameras above the ground: gives the scale.
        distance: Two images by name and the metres between them: gives the scale.
        positions: Where the images were taken, which gives the scale: rows of image x y z, a table with columns image,
            lat, lon, or a trajectory (TUM, EuRoC) if their names hold the time. GPS in the photographs needs no file.
        mask: An image that is black where a photograph may not be used, or a folder of them by the images' names.
        nadir: Leave out what is within so many degrees of straight down, such as the tripod; without it, what all
            panoramas show in the same direction down there is left out.
        seam: Leave out so many degrees on both sides of the seam between the two lenses of a 360-degree camera.
        features: What is matched: sift, aliked with LightGlue (the extra learned), or both; without it, both if that
            extra is installed.
        localize: Folder of other images of that camera; a scene is written that localizes them in the map.
    """
    from spherloc.frontend.masks import Masks
    from spherloc.mapping.make import ScaleMeasurement
    from spherloc_viz.commands.map import MAX_METRES, cameras_of_file, make

    if sum(one is not None for one in (camera_height, distance, positions)) > 1:
        raise InputError("--camera-height, --distance and --positions all give the scale; keep one.")
    if panorama and camera is not None:
        raise InputError("--panorama needs no --camera; keep one of them.")
    for flag, metres in (("--camera-height", camera_height), ("--distance", distance and distance[2])):
        if metres is not None and not 0.0 < metres < MAX_METRES:
            raise InputError(f"{flag} is {metres:g}; give a positive number of metres.")
    if not 2 <= frames <= 500:
        raise InputError(f"--frames is {frames}; give a number from 2 to 500.")
    taken = None if video is None else (video, frames)
    masked = any(one is not None for one in (mask, nadir, seam))
    masks = Masks(mask, nadir or 0.0, seam or 0.0) if masked else None
    measured = ScaleMeasurement(camera_height, distance)
    cameras = cameras_of_file(camera, camera_name)
    return make(
        folder,
        output,
        cameras,
        taken,
        measured,
        localize,
        panorama=panorama,
        masks=masks,
        find_carried=nadir is None,
        positions=positions,
        features=features,
    )


def sweep(
    scenes: Positional[tuple[Path, ...]],
    /,
    *,
    over: str = "outlier_rate",
    values: Annotated[tuple[str, ...], arg(metavar="NUMBER|FIRST:LAST:STEP ...")] = ("0.5:0.95:0.05",),
    by: OptionalText = None,
    by_values: Annotated[tuple[str, ...], arg(metavar="NUMBER|FIRST:LAST:STEP ...")] = (),
    estimator: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg(metavar="NAME[,OPTION=VALUE...]")] = (),
    set: Settings = (),
    runs: int = 100,
    seed: int = 0,
    workers: int = 2,
    scheduler: OptionalText = None,
    out: OptionalPath = None,
    record: bool = True,
    recordings: Path = RECORDINGS,
    keep_gigabytes: OptionalFloat = None,
) -> int:
    """Compare estimators over the outlier rate, noise, number of correspondences or gravity error of a simulation.

    Every run is written at once: stop it when you like, the same command goes on, and with more --runs it adds to
    what is there. Writes a CSV with a row a run, a summary with a row a point (success with its 95 % Wilson interval,
    quartiles of errors and time), and a picture. All estimators get the same problems. Times are those of workers
    side by side; take one worker on an idle machine to compare them.

    For example:

    spherloc sweep mei_outliers_80 --estimator mc --estimator ransac-2p

    spherloc sweep scenes/mei_outliers_80.toml --over outlier_rate --values 0.5:0.98:0.04 --set noise_px=2
    --estimator ransac-2p,iterations=100 --estimator ransac-2p,iterations=1000 --runs 200

    spherloc sweep scenes/panorama_outliers_80.toml --over noise_px --values 0:10:1 --set outlier_rate=0
    --estimator mc-exact --estimator ransac-mlpnp --out results/noise.csv

    spherloc sweep scenes/fisheye_outliers_90.toml --estimator mc --scheduler tcp://host:8786

    spherloc sweep mei_outliers_80 --by correspondences --by-values 20 50 100 200 --runs 30

    spherloc sweep all --estimator all --runs 36 --keep-gigabytes 20

    Args:
        scenes: Scene files (TOML) of simulations, or names of bundled scenes; all for every bundled simulation.
        over: outlier_rate, noise_px, correspondences or gravity_error_deg.
        values: Values of it: numbers, or FIRST:LAST:STEP, the last one included.
        by: A second property; the sweep over the first one is done at each of its values, and a table and a map of
            both are written too.
        by_values: Its values.
        estimator: A registered estimator, with options after commas; give it once for each, or all. mc and
            ransac-2p if not given.
        set: Changes to the scene at all values, such as noise_px=2; a wrong one lists them all.
        runs: Problems at each value.
        seed: Seed of the first problem; the others count up from it.
        workers: Processes on this machine.
        scheduler: Address of a Dask scheduler, whose workers do the runs instead.
        out: CSV to write or go on with, of one scene; recordings/SCENE_OVER_SEED.csv if not given.
        record: Write a recording of each run, which takes several times as long as many a run; of a cluster's workers
            those on this machine do.
        recordings: Folder of the recordings.
        keep_gigabytes: Size limit of the recordings, GB (2, or their present size if larger). Above it the oldest
            successes without a label or note are deleted.
    """
    from spherloc.datasets.scene_file import check_there, scene_path

    if not scenes:
        raise InputError("no scene given; name one or more, such as mei_outliers_80, or all.")
    if [str(scene) for scene in scenes] == ["all"]:
        from spherloc_viz.commands.sweep import bundled_simulations

        scenes = bundled_simulations()
    files = [scene_path(scene) for scene in scenes]
    for file in files:
        check_there(file)
    if out is not None and len(files) > 1:
        raise InputError(f"--out {out} takes one scene, not {len(files)}; leave it out, and each gets a file.")
    from spherloc_viz.commands.run import Records
    from spherloc_viz.commands.sweep import all_estimators, sweep_two
    from spherloc_viz.commands.sweep import sweep as do_sweep

    chosen = all_estimators() if estimator == ("all",) else estimator or ("mc", "ransac-2p")
    kept = Records(recordings, keep_gigabytes=keep_gigabytes) if record else None
    if by is None and by_values:
        raise InputError("--by-values are given without --by; name the second property.")
    if by is not None and not by_values:
        raise InputError(f"--by {by} needs --by-values; give some, such as --by-values 50 100 200.")
    for file in files:
        if by is None:
            do_sweep(
                file,
                over,
                values,
                chosen,
                settings=list(chain(*set)),
                runs=runs,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                out=out or RECORDINGS / f"{file.stem}_{over}_{seed}.csv",
                records=kept,
            )
        else:
            sweep_two(
                file,
                over,
                values,
                chosen,
                by=by,
                by_values=by_values,
                settings=list(chain(*set)),
                runs=runs,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                out=out or RECORDINGS / f"{file.stem}_{over}_{by}_{seed}.csv",
                records=kept,
            )
    return 0


def verify(
    quick: Flag = False,
    only: Annotated[tuple[str, ...], arg(metavar="EXPERIMENT ...")] = (),
    kitti360: OptionalPath = None,
    newer_college: OptionalPath = None,
    matterport360: OptionalPath = None,
    workers: int = 2,
    scheduler: OptionalText = None,
    output: OptionalPath = None,
) -> int:
    """Check the paper's claims: run its simulations and write a page that says which reproduce.

    About an hour on two cores, two minutes with --quick. Stop it when you like: the same command goes on. Writes
    index.md, figures, claims.json and a CSV of all runs. The tables on real images take your copies of the datasets.

    For example:

    spherloc verify --quick

    spherloc verify --only fig6 fig7 --workers 8

    spherloc verify --kitti360 ~/KITTI-360 --matterport360 ~/Matterport360

    Args:
        quick: Few problems at few points, without the slowest methods.
        only: Only these experiments, such as fig6, or datasets, such as kitti360; a wrong name lists them all.
        kitti360: Folder of KITTI-360, for Table II.
        newer_college: Folder of the Newer College dataset, for Tables IV and V.
        matterport360: Folder of Matterport360, a folder a building in it, for Table III.
        workers: Processes on this machine.
        scheduler: Address of a Dask scheduler, whose workers do the runs instead.
        output: Folder of the page; verification here if not given, verification-quick with --quick.
    """
    from spherloc_viz.commands.verify import verify as do_verify

    folder = output or Path("verification-quick" if quick else "verification")
    given = {"kitti360": kitti360, "newer-college": newer_college, "matterport360": matterport360}
    datasets = {key: path for key, path in given.items() if path is not None}
    return do_verify(folder, quick, workers, scheduler, only, datasets)
