"""What the commands take that solve problems of scenes; the work is done by the other modules of this folder."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from spherloc.errors import InputError
from spherloc_viz import given_files
from spherloc_viz.commands.flags import (
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
