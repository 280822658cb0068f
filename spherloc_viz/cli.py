"""The command line: run, play, view, scenes."""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg
from tyro.extras import SubcommandApp

from spherloc.errors import SpherlocError

RECORDINGS = Path("recordings")

app = SubcommandApp()


@app.command
def run(
    scenes: Positional[tuple[Path, ...]],
    /,
    estimator: str = "mc",
    seed: int | None = None,
    option: Annotated[tuple[str, ...], arg(metavar="KEY=VALUE ...")] = (),
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    record: bool = True,
    recordings: Path = RECORDINGS,
) -> int:
    """Solve localization problems and record each run.

    Prints pose, inliers and time of every scene; where the truth is known, the errors; what is proven; and what is
    wrong with a run that failed or is doubtful. Ends with 0 if every scene has a pose, 1 if one has none, 2 if an
    input is wrong.

    For example:

    spherloc run scenes/mei_outliers_80.toml

    spherloc run scenes/*.toml --estimator ransac-2p --seed 7 --json

    spherloc run scenes/mei_outliers_90.toml --estimator ransac-2p --option iterations=5000 confidence=0.999

    spherloc run scenes/mei_outliers_90.toml --option gravity_sd_deg=inf robust=huber

    Args:
        scenes: Scene files (TOML), one or more.
        estimator: mc (deterministic maximum consensus), ransac-2p or another one; a wrong name lists them all.
        seed: Seed of the estimator and, in synthetic scenes, of the simulation; the scene's own if not given.
        option: Options of the estimator, such as bound_px=4; none and inf are values where they make sense.
        json: Print one JSON object a scene, on one line; infinity is the text "inf".
        record: Write a recording of each run.
        recordings: Folder of the recordings.
    """
    from spherloc_viz import batch

    return batch.run_scenes(scenes, estimator, seed, option, json, recordings if record else None)


@app.command
def play(
    scene: Positional[Path | None] = None,
    /,
    host: str = "127.0.0.1",
    port: int = 8080,
    record: bool = True,
    recordings: Path = RECORDINGS,
) -> int:
    """Open the playground in a browser and print its address.

    For example:

    spherloc play

    spherloc play scenes/panorama_outliers_90.toml --port 9000

    Args:
        scene: Scene file (TOML) to start with; a bundled one if not given.
        host: Address to listen on. Anybody who reaches it can use the playground, so keep it on this machine.
        port: Port to listen on; 0 takes a free one.
        record: Write a recording of each run that is settled on.
        recordings: Folder of the recordings.
    """
    from spherloc_viz.app.server import serve

    serve(scene, host, port, recordings, record)
    return 0


@app.command
def view(
    recording: Positional[Path],
    /,
    web: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    port: int = 9090,
) -> int:
    """Open a recording in the Rerun viewer, at the timeline of its steps.

    For example:

    spherloc view recordings/20260101T120000Z_street_mc_0_1a2b3c4d.rrd

    spherloc view run.rrd --web

    Args:
        recording: A recording (.rrd).
        web: Serve the viewer to a browser on this machine instead of opening a window.
        port: Port of the web viewer.
    """
    from spherloc_viz.recording.view import view as open_viewer

    open_viewer(recording, web=web, port=port)
    return 0


@app.command
def scenes() -> int:
    """List the bundled scenes.

    For example:

    spherloc scenes
    """
    from spherloc.datasets import bundled_scenes, load_scene

    for path in bundled_scenes().values():
        print(f"{path}  {load_scene(path).name}")
    return 0


def main() -> None:
    """Entry point: every error that a user can cause is one line on stderr and exit code 2."""
    try:
        code = app.cli(
            prog="spherloc",
            description="See why visual localization with fisheye and 360-degree cameras succeeds or fails.",
            sort_subcommands=False,
        )
    except SpherlocError as error:
        print(f"spherloc: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:
        sys.stderr.close()
        code = 141
    sys.exit(code)
