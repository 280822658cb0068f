"""``spherloc map``: a folder of photographs, or a video, becomes a map and scenes that open at once."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from spherloc.cameras.calibration import load_camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.errors import InputError
from spherloc.frontend.view import View
from spherloc.mapping.make import Map, Measured, make_map
from spherloc.mapping.photographs import Photographs, frames_of, photographs
from spherloc.mapping.upright import Tell
from spherloc_viz.map_report import map_report
from spherloc_viz.progress import progress, say

REPORT = "report.html"


def make(
    folder: Path,
    output: Path | None,
    camera: Path | None,
    video: tuple[Path, int] | None,
    measured: Measured,
    new_images: Path | None,
) -> int:
    """Make the map, and print what came of it and what to do next; 1 if not all images are in it.

    ``video`` is a file and a number of frames to take from it into ``folder``. Raises ``InputError``.
    """
    target = output or Path(f"{folder.resolve().name}_map")
    lens = None if camera is None else load_camera(camera)
    with _stages() as tell:
        if video is not None:
            _take_frames(*video, folder, tell)
        found = photographs(folder, lens)
        for remark in found.remarks:
            say(remark)
        say(f"{len(found.views)} {_kind(found.views[0])} → {target}. Ctrl-C stops it; the same command goes on.")
        made = make_map(found.views, folder, target, measured, new_images, tell)
    report = target / REPORT
    try:
        report.write_text(map_report(made, found), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{report}: cannot be written ({error.strerror}); give another --output.") from None
    print("\n".join(summary(made, found)))
    print(f"report        {report}")
    print(f"see it        spherloc play {made.written.scene}")
    print(f"localize      spherloc localize {made.written.new_scene or made.written.scene}")
    return 0 if len(made.written.poses) == len(found.views) else 1


def _take_frames(video: Path, count: int, folder: Path, tell: Tell) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); give another folder.") from None
    taken: list[str] = []

    def another(name: str) -> None:
        taken.append(name)
        tell("frames taken from the video", len(taken), count)

    frames_of(video, folder, count, another)


@contextmanager
def _stages() -> Iterator[Tell]:
    """Progress of one kind of work after another."""
    with ExitStack() as stack:
        running: dict[str, Callable[[str], None]] = {}
        done = 0

        def tell(kind: str, number: int, count: int) -> None:
            nonlocal done
            if kind not in running:
                stack.close()
                running.clear()
                running[kind] = stack.enter_context(progress(count, kind))
                done = 0
            while done < number:
                running[kind]("")
                done += 1

        yield tell


def _kind(view: View) -> str:
    size = f"{view.camera.width} x {view.camera.height} pixels"
    return (
        f"panoramas of {size}" if isinstance(view.camera, Equirectangular) else f"{view.camera.model} images of {size}"
    )


def _units_unknown(made: Map) -> str:
    return f"units unknown; {made.scale.why_unknown or '--camera-height or --distance gives metres'}"


def summary(made: Map, found: Photographs) -> list[str]:
    """What came of it, in lines."""
    written, missing = made.written, [view.name for view in found.views if view.name not in made.written.poses]
    lines = [
        f"in the map    {len(written.poses)} of {len(found.views)} images, {len(written.points):,} points, "
        f"{written.error_px:.2f} px mean error",
        f"down          from {made.level.source}; single images differ by {made.level.spread_deg:.1f}° (median)",
        f"scale         {made.scale.source or _units_unknown(made)}",
    ]
    if missing:
        lines.append(f"left out      {', '.join(missing[:5])}{', …' if len(missing) > 5 else ''}: see the report")
    for group in made.groups:
        lines.append(f"on its own    {len(group.written.poses)} images that could not be joined: {group.written.scene}")
    if made.made.contradictions:
        first, second = made.made.contradictions[0]
        lines.append(
            f"in doubt      {len(made.made.contradictions)} pairs of images see each other and hardly match (such as "
            f"{first}, {second}): places that look alike may have been taken for one"
        )
    return lines
