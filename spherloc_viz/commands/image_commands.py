"""What the commands take that localize images or make maps of them, or say why poses are wrong; the work is done by the
other modules of this folder."""

import shlex
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from spherloc.errors import InputError
from spherloc.files import is_file, is_folder
from spherloc_viz.commands.flags import (
    RECORDINGS,
    Flag,
    OptionalFloat,
    OptionalNumber,
    OptionalPath,
    OptionalRotation,
    OptionalText,
    Settings,
)
from spherloc_viz.given_files import known_as
from spherloc_viz.importing import importing


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
        estimator: auto (chooses between proving and sampling) if not given, mc (deterministic maximum consensus),
            mc-exact or another one, with options after commas; a wrong name lists them all. Give it once for each.
        initialise: Estimator that solves the first query, and each one that the other one does not localize or that
            follows such a one; the other one tracks in between.
        seed: Seed of the estimator, the same for every query.
        option: Options of all estimators, such as bound_px=4; none and inf are values where they make sense.
        queries: Only these: names, or places counted from 0, the last one not included; all if not given.
        output: Folder of the results; recordings/SCENE_ESTIMATOR_SEED if not given, with a number if that holds others,
            or recordings/comparison_SEED; the scene files of maps are called after their folders.
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

    def solving(name: str, folder: Path, *, numbered: bool = False) -> Solving:
        kept = Records(recordings or folder / "recordings", keep_gigabytes=keep_gigabytes) if record else None
        return Solving(*_name_and_options(name, option), folder, kept, initialise, numbered)

    names = estimator or ("auto",)
    if len(paths) == len(names) == 1:
        words = names[0] if initialise is None else f"{initialise}+{names[0]}"
        folder = output or RECORDINGS / f"{_results_name(paths[0])}_{words}_{seed}"
        one = solving(names[0], folder, numbered=output is None)
        return localize_sequence(paths[0], [one], seed, queries, retry_failed)
    base = output or RECORDINGS / f"comparison_{seed}"
    each = {path: [solving(name, base / _results_name(path) / name) for name in names] for path in paths}
    return compare_sequences(each, seed, queries, retry_failed, base)


def _results_name(path: Path) -> str:
    """What results of a scene file are called: its name, in a map after that of the map, and of the group in it."""
    from spherloc.mapping.scenes.scene_files import MODEL, SCENE

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
        camera: The calibration file of these queries; with hloc's log, of those that have no camera in it and are no
            images of the model.
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

    takes = is_log(poses) or poses.suffix.lower() == ".csv"
    if is_folder(poses):
        takes = is_file(poses / "images.bin") or is_file(poses / "images.txt")
    if not takes and (told := known_as(poses)):
        raise InputError(told)
    own = matches is None and database is None and not scenes
    logged = own and is_log(poses)
    if (model is not None) != (database is not None) and not (logged and database is None):
        raise InputError("--model, the map, goes with --database, which needs it, or with hloc's log (.pkl).")
    if sum((bool(scenes), matches is not None, database is not None)) > 1:
        raise InputError("the matches come from scenes, from --matches or from --database; give one of them.")
    if own and not logged:
        raise InputError("no scene given; name the scene files whose queries the poses are of, or give --matches.")
    if (matches is not None and camera is None) or (scenes and (camera is not None or gravity is not None)):
        raise InputError("--matches needs --camera; neither --camera nor --gravity goes with scenes, which say that.")
    if camera is not None and database is not None:
        raise InputError("--database has the cameras itself; leave out --camera.")
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
        table, wrong = read_logged_matches(poses, model, camera, gravity, map_down)
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
    frames: OptionalNumber = None,
    output: OptionalPath = None,
    camera_height: OptionalFloat = None,
    distance: Annotated[tuple[str, ...], arg(metavar="IMAGE IMAGE METRES", help_behavior_hint="")] = (),
    positions: OptionalPath = None,
    gravity: OptionalPath = None,
    camera_from_imu: OptionalRotation = None,
    mask: OptionalPath = None,
    nadir: OptionalFloat = None,
    seam: OptionalFloat = None,
    features: Annotated[str | None, arg(metavar="sift|aliked|sift+aliked")] = None,
    localize: OptionalPath = None,
    play: Flag = False,
) -> int:
    """Make a map of your own photographs: panoramas, or images of fisheyes and other wide cameras.

    Features, matches, COLMAP's structure from motion, which way is down, and scale if you give one; then a scene file
    that opens at once. Needs the extra colmap. Stop it when you like: the same command goes on. Ends with 0 if all
    images are in the map and all of --localize are localized, 1 if some are not (report.html says why an image is not
    in the map), 2 if an input is wrong.

    For example:

    spherloc map my_panoramas

    spherloc map my_fisheyes --camera calibration.yaml --camera-height 1.6

    spherloc map frames --video walk.mp4

    spherloc map dataset-room1_512_16 --frames 60

    spherloc map my_panoramas --localize new_photographs --play

    Args:
        folder: Folder of the photographs, of a folder for each camera, or a sequence in the layout of EuRoC or TUM-VI
            (mav0), whose IMU and ground truth are used; with --video, where its frames are put.
        camera: Calibration file, or a folder of them that are called as the cameras or as the images; without it, those
            beside the images are taken, full panoramas need none, and matches between the rest tell their lens.
        camera_name: Which camera of that file all images have; otherwise their name or their folder's says it.
        panorama: Images of about 2 to 1 are panoramas of the whole sphere, whatever they show or lies beside them.
        video: Take frames from this video first, the sharpest of each stretch.
        frames: How many images of each camera to map, the sharpest of each stretch of the video or of the folder; 40
            if not given, of a folder only if it has more than 500 images or a recorded sequence of more than 100.
        output: Folder of the map; FOLDER_map here if not given.
        camera_height: Metres of the cameras above the ground: gives the scale.
        distance: Two images by name and the metres between them: gives the scale.
        positions: Where the images were taken, which gives the scale: rows of image x y z, a table with columns image,
            lat, lon, or a trajectory (TUM, EuRoC) if their names hold the time. GPS in the photographs needs no file.
        gravity: Where down is in the photographs: rows of image gx gy gz [sd_deg], or with --camera-from-imu the log of
            an IMU, if their names hold the time. Without it, and for other photographs, their vertical lines say it.
        camera_from_imu: The rotation from the IMU's frame to the camera's, row by row.
        mask: An image that is black where a photograph may not be used, or a folder of them by the images' names.
        nadir: Leave out what is within so many degrees of straight down, such as the tripod; without it, what all
            panoramas show in the same direction down there is left out.
        seam: Leave out so many degrees on both sides of the seam between the two lenses of a 360-degree camera.
        features: What is matched: sift, aliked with LightGlue (the extra learned), or both; without it, both if that
            extra is installed.
        localize: Folder of other images, which are localized in the map as by spherloc localize; a scene is written
            that has them as queries. That of the map itself is taken, too, where images of it are not mapped. Of
            another camera than the map's they need its calibration beside them, unless they are panoramas.
        play: Open the playground on it in the end.
    """
    import numpy as np

    from spherloc.cameras.calibration import camera_names
    from spherloc.datasets.query_gravity import camera_from_imu as rotation_of
    from spherloc.frontend.masks import MAX_NADIR_DEG, MAX_SEAM_DEG, Masks
    from spherloc.mapping.request import ScaleMeasurement
    from spherloc_viz.commands.map import MAX_METRES, distance_of, make

    if sum(one is not None for one in (camera_height, distance or None, positions)) > 1:
        raise InputError("--camera-height, --distance and --positions all give the scale; keep one.")
    apart = distance_of(distance)
    if panorama and camera is not None:
        raise InputError("--panorama needs no --camera; keep one of them.")
    for flag, metres in (("--camera-height", camera_height), ("--distance", apart and apart[2])):
        if metres is not None and not 0.0 < metres < MAX_METRES:
            raise InputError(f"{flag} is {metres:g}; give a positive number of metres.")
    for flag, degrees, most in (("--nadir", nadir, MAX_NADIR_DEG), ("--seam", seam, MAX_SEAM_DEG)):
        if degrees is not None and not 0.0 <= degrees <= most:
            raise InputError(f"{flag} is {degrees:g}; give degrees from 0 to {most:g}.")
    if frames is not None and not 2 <= frames <= 500:
        raise InputError(f"--frames is {frames}; give a number from 2 to 500.")
    if camera_from_imu is not None and gravity is None:
        raise InputError("--camera-from-imu goes with --gravity FILE, the log of the IMU; give that file too.")
    turn = None if camera_from_imu is None else rotation_of(np.reshape(camera_from_imu, (3, 3)).tolist(), str(gravity))
    masked = any(one is not None for one in (mask, nadir, seam))
    masks = Masks(mask, nadir or 0.0, seam or 0.0) if masked else None
    measured = ScaleMeasurement(camera_height, apart)
    if camera is None and camera_name is not None:
        raise InputError(f"--camera-name {shlex.quote(camera_name)} goes with --camera FILE; give that file too.")
    if camera is not None and not is_folder(camera):
        camera_names(camera)  # before frames are taken from a video
    made = make(
        folder,
        output,
        None if camera is None else (camera, camera_name),
        video,
        measured,
        localize,
        panorama=panorama,
        masks=masks,
        find_carried=nadir is None,
        positions=positions,
        gravity=None if gravity is None else (gravity, turn),
        features=features,
        frames=frames,
    )
    code = max(0 if made.whole else 1, _localize_by_default(made.new_scenes))
    scene = next(iter(made.new_scenes), made.scene)
    if play:
        _play(scene)
    else:
        print(f"see it        spherloc play {shlex.quote(str(scene))}")
    return code


def _localize_by_default(scenes: Sequence[Path]) -> int:
    """Localize the same photographs in the maps of these scene files, as ``localize`` without options does in one."""
    if not scenes:
        return 0  # before what localizes is imported
    from spherloc_viz.commands.localize import Solving, localize_in_maps
    from spherloc_viz.commands.run import Records

    folders = {scene: RECORDINGS / f"{_results_name(scene)}_auto_0" for scene in scenes}
    solvings = {
        scene: Solving("auto", (), folder, Records(folder / "recordings", keep_gigabytes=None), numbered=True)
        for scene, folder in folders.items()
    }
    return localize_in_maps(solvings)


def _play(scene: Path) -> None:
    """Open the playground on a scene, as ``spherloc play`` does."""
    with importing():
        from spherloc_viz.app.server import serve

    serve(scene, "127.0.0.1", 0, RECORDINGS)
