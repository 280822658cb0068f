"""The command line: all commands, and how errors and Ctrl-C end them."""

import contextlib
import io
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg
from tyro.extras import SubcommandApp

from spherloc.errors import SpherlocError, reason, show
from spherloc_viz import given_files
from spherloc_viz.commands import image_commands as of_images
from spherloc_viz.commands import recording_commands as of_runs
from spherloc_viz.commands import scene_commands as of_scenes
from spherloc_viz.commands.flags import (
    INTERRUPTED,
    RECORDINGS,
    Flag,
    OptionalFloat,
    OptionalPath,
    refuse_repeated,
    refuse_second_folder,
)
from spherloc_viz.importing import importing

BROKEN_PIPE = 141
"""Exit code where the reader of the output has gone, as shells have it."""


def play(
    scene: Positional[Annotated[Path | None, arg(metavar="[PATH]", help_behavior_hint="")]] = None,
    /,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    record: bool = True,
    recordings: Path = RECORDINGS,
    keep_gigabytes: OptionalFloat = None,
    allow: tyro.conf.UseAppendAction[tuple[Path, ...]] = (),
    token: Flag = False,
) -> int:
    """Open the playground in a browser and print its address.

    For example:

    spherloc play

    spherloc play panorama_outliers_90 --port 9000

    spherloc play RUN.rrd

    spherloc play --allow ~/maps

    spherloc play --host 0.0.0.0

    Args:
        scene: Scene file (TOML), bundled scene's name, or recording (.rrd), whose run is opened, to start with; a
            bundled scene if not given.
        host: Address to listen on. Beyond this machine the printed links carry tokens: one link is yours, the other is
            for an audience, which can only look.
        port: Port to listen on; 0 takes a free one.
        record: Write a recording of each run that is settled on.
        recordings: Folder of the recordings.
        keep_gigabytes: Size limit of the recordings, GB (2, or their present size if larger). Above it the oldest
            successes without a label or note are deleted.
        allow: Another folder that pages may open scenes from; give it once for each. Photographs that are dropped onto
            a page are kept in the first.
        token: Demand a token on this machine too, where others have accounts on it.
    """
    from spherloc.datasets import scene_path

    start = None if scene is None else scene_path(scene)
    if start is not None:
        given_files.check_scene_file(start)
    with importing():
        from spherloc_viz.app.server import serve

    serve(start, host, port, recordings, record=record, allow=allow, keep_gigabytes=keep_gigabytes, token=token)
    return 0


def lesson(
    name: Positional[Annotated[str | None, arg(metavar="[NAME]", help_behavior_hint="")]] = None,
    /,
    export: OptionalPath = None,
    handout: OptionalPath = None,
) -> int:
    """List the lessons, or write one as a file for machines without spherloc or for paper.

    The lessons themselves are at /learn of the playground. An exported lesson is one HTML file with the scenes of all
    its moments, which opens in any browser without a network; it has no sliders.

    For example:

    spherloc lesson

    spherloc lesson ransac --export ransac.html

    spherloc lesson ransac --handout ransac-handout.html

    Args:
        name: The lesson.
        export: HTML file to write, with recorded scenes.
        handout: HTML file to write, to be printed.
    """
    from spherloc_viz.commands.bundled import list_lessons, write_lesson

    if name is None:
        return list_lessons(export, handout)
    return write_lesson(name, export, handout)


def gallery(
    keys: Positional[tuple[str, ...]] = (),
    /,
    output: Path = RECORDINGS / "gallery",
    list: Flag = False,
) -> int:
    """Run and record the gallery: failures worth seeing, each with its story.

    Prints a line for each, and says what is not as its story tells; ends with 1 if there is such a case.

    For example:

    spherloc gallery

    spherloc gallery --list

    spherloc gallery table-vi-1 pairs-outvote --output my_gallery

    Args:
        keys: Cases by their keys; all if none is given.
        output: Folder of the recordings; those that it has of the same cases are replaced.
        list: Print keys, titles and stories, and run nothing.
    """
    from spherloc_viz.commands.progress import say
    from spherloc_viz.gallery import gallery_cases
    from spherloc_viz.gallery.regenerate import chosen, regenerate, stories

    cases = chosen(gallery_cases(), keys)
    if list:
        print(stories(cases))
        return 0
    return 1 if regenerate(cases, output, say) else 0


def scenes(kind: Positional[Annotated[str | None, arg(metavar="[KIND]", help_behavior_hint="")]] = None, /) -> int:
    """List the bundled scenes and the kinds of scene files, or show how a kind is written.

    For example:

    spherloc scenes

    spherloc scenes kitti360

    Args:
        kind: A kind of scene file to be described, such as kitti360.
    """
    from spherloc_viz.commands.bundled import all_scenes, one_kind

    print(all_scenes() if kind is None else one_kind(kind))
    return 0


def plugins(json: Flag = False) -> int:
    """List what other packages add to spherloc, and what of it cannot be used.

    These are camera models, readers of calibration files, solvers, estimators, kinds of scene files, layers and
    lessons, which packages register by entry points, see docs/extending.md. Estimators and solvers are tried on a
    tiny problem. Ends with 0, or with 1 if something cannot be used; everything else works without it.

    For example:

    spherloc plugins

    spherloc plugins --json

    Args:
        json: Print one JSON object an extension, on one line, and nothing of what spherloc has itself.
    """
    from spherloc_viz.commands.progress import say
    from spherloc_viz.plugins import extensions, plugins_json, plugins_text

    found = extensions(say)
    if text := plugins_json(found) if json else plugins_text(found):
        print(text)
    return 1 if any(extension.problem for extension in found) else 0


COMMANDS = (
    play,
    lesson,
    gallery,
    of_scenes.run,
    of_images.localize,
    of_images.diagnose,
    of_images.map,
    of_scenes.sweep,
    of_scenes.verify,
    of_runs.runs,
    of_runs.steps,
    of_runs.view,
    of_runs.compare,
    of_runs.rerun,
    of_runs.repeat,
    of_runs.label,
    of_runs.reindex,
    of_runs.check_proof,
    scenes,
    plugins,
)
"""Commands in the order of the overview."""
app = SubcommandApp()
for _command in COMMANDS:
    app.command(_command)


def main() -> None:
    """Entry point: every error that a user can cause is one line on stderr and exit code 2."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names that are not UTF-8, or an ASCII-only terminal
            stream.reconfigure(errors="backslashreplace")
    try:
        refuse_repeated(sys.argv[1:], COMMANDS)
        refuse_second_folder(sys.argv[1:])
        code: Any = app.cli(
            prog="spherloc",
            description="See why visual localization with fisheye and 360-degree cameras succeeds or fails.",
            sort_subcommands=False,
        )
        _flush()
    except SystemExit as ended:
        code = ended.code
    except SpherlocError as error:
        _complain(str(error))
        code = 2
    except KeyboardInterrupt:
        code = INTERRUPTED
    except BrokenPipeError:
        code = BROKEN_PIPE
    except OSError as error:
        what = "" if error.filename is None else f" with {show(error.filename)}"
        _complain(f"the system cannot go on{what} ({reason(error)}); check the path, the output and the disks.")
        code = 2
    try:
        _flush()
    except OSError as error:
        code = code or (BROKEN_PIPE if isinstance(error, BrokenPipeError) else 2)
    sys.exit(code)


def _flush() -> None:
    """Raises ``OSError`` where the output cannot take it, after which Python does not try again at its end."""
    output = sys.stdout
    if output is None:
        return
    try:
        output.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
        raise


def _complain(sentence: str) -> None:
    with contextlib.suppress(OSError):  # standard error is closed
        print(f"spherloc: {sentence}", file=sys.stderr, flush=True)
