"""``spherloc map``: a folder of photographs, or a video, becomes a map with a report, and scenes that open at once.

A page that makes a map starts ``python -m spherloc_viz.commands.map FOLDER OUTPUT SCALE`` and reads lines of JSON:
{"kind", "done", "count"} as it goes on, and at the end {"scene", "report", "summary"} or {"error"}. SCALE is as
``scale_of_words`` takes it. A termination signal ends it; what was done is kept and not done again.
"""

import json
import os
import shlex
import signal
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spherloc.cameras.base import Camera
from spherloc.cameras.equirectangular import Equirectangular
from spherloc.datasets.asl_layout import camera_of_folder
from spherloc.datasets.scene_file import read_table
from spherloc.errors import InputError, SpherlocError, StoppedError, reason, shorten, show
from spherloc.files import is_folder, is_image, names_in
from spherloc.frontend import trained
from spherloc.frontend.features import FeatureOptions
from spherloc.frontend.masks import Masks
from spherloc.frontend.matching import MatchOptions
from spherloc.frontend.pipeline import FrontendOptions
from spherloc.frontend.view import View
from spherloc.images import check_image, read_size
from spherloc.mapping.advice import advice, for_a_page
from spherloc.mapping.alignment.fixed_images import fixed_images
from spherloc.mapping.alignment.gravity_check import check_stated
from spherloc.mapping.alignment.positions import read_positions
from spherloc.mapping.alignment.sequence import sequence_data
from spherloc.mapping.alignment.stated_gravity import StatedGravity, read_stated_gravity
from spherloc.mapping.alignment.tag_gravity import stated_by_tags
from spherloc.mapping.alignment.true_poses import truth_words
from spherloc.mapping.images.folder_cameras import CalibratedLens, LensFinder
from spherloc.mapping.images.found_calibrations import calibrations_in
from spherloc.mapping.images.frames import FRAMES, FrameChoice, frames_of
from spherloc.mapping.images.given_cameras import given_cameras
from spherloc.mapping.images.photographs import Photographs, cameras_of, photographs
from spherloc.mapping.kept_scale import FILE as SCALE_FILE
from spherloc.mapping.kept_scale import keep_scale, kept_scale
from spherloc.mapping.make import Map, make_map
from spherloc.mapping.parallel import Tell
from spherloc.mapping.request import MapRequest, ScaleMeasurement
from spherloc.mapping.scenes.new_images import NewImages, new_images_of
from spherloc.mapping.scenes.scene_files import (
    LENS,
    MAP_FOLDER,
    check_images_of,
    kept_lens,
    lens_path,
    lenses_given,
    was_given,
    write_lenses,
)
from spherloc.registry import require
from spherloc.types import FloatArray
from spherloc_viz.commands.map_report import MAP_FEATURES, map_report, summary
from spherloc_viz.commands.progress import Advance, progress, say
from spherloc_viz.given_files import known_as

REPORT = "report.html"
ESTIMATOR = "auto"
"""What localizes new images."""
MAX_METRES = 1e6
"""Heights and distances are below this."""
MAX_SIZES = 4
"""Largest number of different sizes of new images that are named."""


def make(
    folder: Path,
    output: Path | None,
    camera: tuple[Path, str | None] | None,
    video: Path | None,
    measured: ScaleMeasurement,
    new_images: Path | None,
    *,
    panorama: bool,
    masks: Masks | None,
    find_carried: bool,
    positions: Path | None,
    gravity: tuple[Path, FloatArray | None] | None,
    features: str | None,
    frames: int | None,
) -> "Finished":
    """Make the map, and print the result; raises ``InputError``.

    ``camera`` is a calibration file, with the name of one of its cameras if all images have that. ``frames`` says how
    many images of ``folder`` are mapped, or taken from the ``video`` into it. With ``panorama``, images of 2 to 1 are
    panoramas in any case. With ``find_carried``, what moves with the camera below panoramas is left out, too.
    ``positions`` is a file of where the images were taken, ``gravity`` one of their gravity, with the rotation (3, 3)
    from the IMU to the camera if it is the log of an IMU, and ``features`` one of ``MAP_FEATURES``, the best installed
    if None.
    """
    end_without_a_trace()
    how = how_of(features)
    if not is_folder(folder) and (told := known_as(folder)):
        raise InputError(told)
    target = output or Path(MAP_FOLDER.format(folder.resolve().name))
    check_images_of(target, folder)
    with _stages() as tell, _compiled_for(new_images):
        if video is not None:
            _take_frames(video, frames or FRAMES, folder, tell)
        cameras, about_cameras = ({}, []) if camera is None else given_cameras(*camera, folder)
        for remark in about_cameras:
            say(remark)
        choice = FrameChoice(None if video is not None else frames, tell=tell)
        finder = _lens_finder(tell, folder, target, new_images)
        found = photographs(folder, cameras, masks, panorama, finder, choice)
        if positions is not None:
            measured = ScaleMeasurement(positions=read_positions(positions, found.views))
        elif measured == ScaleMeasurement():
            measured = kept_scale(target)
            if measured != ScaleMeasurement():
                say(f"The scale is as it was given before; to make the map without it, remove {target / SCALE_FILE}.")
        others, about_others = None, []
        if new_images is not None:
            others, about_others = new_images_of(new_images, found, panorama, choice, measured_gravity=gravity is None)
        wishes = _Wishes(
            how,
            measured,
            stated=None if gravity is None else read_stated_gravity(*gravity, found.views),
            new_images=others,
            masks=masks,
            find_carried=find_carried,
        )
        request, remarks = _request(folder, target, found, wishes, None if camera is None else camera[0], tell)
        for remark in (*remarks, *(f"{new_images}: {remark}" for remark in about_others)):
            say(remark)
        say(f"{len(found.views)} {_kind(found.views)} → {target}. Ctrl-C stops it; the same command goes on.")
        try:
            made = make_map(request, target, tell)
            found = _with_lens(found, made)
        except KeyboardInterrupt:
            say("stopped; what is done is kept, and the same command goes on from there.")
            raise
    report = target / REPORT
    try:
        _write(report, made, found, measured, cameras)
    except OSError as error:
        raise StoppedError(_unwritten(report, error)) from None
    print("\n".join(summary(made, found)))
    print(f"report        {report}")
    if "" in found.calibrated:
        lens = shlex.quote(str(target / LENS))
        print(f"lens          {target / LENS}, for other images of that camera: --camera {lens}")
    if others is not None:
        print(f"new images    {_sizes(others)}")
        if made.written.truth is not None:
            print(f"truth         {truth_words(made.written.truth)}")
    elif found.others:
        print(f"other images  {found.others:,}, of which --localize {shlex.quote(str(folder))} localizes some")
    if older := _of_the_map_before(target, made):
        print(f"out of date   {', '.join(older)}: of the map before; give their images with --localize again")
    scenes = tuple(one.written.new_scene for one in (made, *made.groups) if one.written.new_scene is not None)
    return Finished(made.written.scene, scenes, len(made.written.poses) == len(found.views))


@dataclass(frozen=True)
class _Wishes:
    """What a map is asked for besides its photographs."""

    how: FrontendOptions
    measured: ScaleMeasurement
    stated: StatedGravity | None = None
    """Gravity of a file that the user gave; else that of a recorded sequence or of the tags of images is taken."""
    new_images: NewImages | None = None
    masks: Masks | None = None
    find_carried: bool = True


def _request(
    folder: Path, target: Path, found: Photographs, wishes: _Wishes, calibration: Path | None, tell: Tell
) -> tuple[MapRequest, list[str]]:
    """What is asked for a map of photographs in ``folder``, with all that lies beside them, and remarks; ``target`` is
    the folder of the map, ``calibration`` a file or folder that the user gave."""
    unscaled = wishes.measured == ScaleMeasurement()
    data = sequence_data(folder, found.views, gravity=wishes.stated is None, positions=unscaled)
    stated = wishes.stated or data.stated
    about_gravity: Sequence[str] = ()
    if stated is None:
        stated, about_gravity = stated_by_tags(found.views, tell)
    else:
        stated = replace(stated, doubts=tuple(check_stated(stated, found.views, tell)))
        about_gravity = stated.doubts
    fixed, about_rig = fixed_images(folder, found.views, calibration)
    measured = replace(ScaleMeasurement(positions=data.positions) if unscaled else wishes.measured, fixed=fixed)
    request = MapRequest(
        found.views,
        folder,
        measured,
        wishes.new_images,
        wishes.masks,
        wishes.how,
        wishes.find_carried,
        stated,
        _lens_told(found, target),
    )
    of_gravity = () if stated is None else stated.remarks
    return request, [*found.remarks, *of_gravity, *data.remarks, *about_gravity, *about_rig]


@dataclass(frozen=True)
class Finished:
    """A map that is made and written."""

    scene: Path
    """Its scene file."""
    new_scenes: tuple[Path, ...]
    """Scene files of the new images, in the map and in those of images that could not be joined; none without them."""
    whole: bool
    """Whether all photographs are in the map."""


def _lens_finder(tell: Tell, folder: Path, target: Path, new_images: Path | None) -> LensFinder:
    """What calibrates a lens of the photographs in ``folder``, or in a folder there, by them and by the new images of
    their size, if there is no calibration for these; a lens that is kept in ``target``, the folder of the map, is taken
    instead."""

    def find(paths: Sequence[Path], size: tuple[int, int]) -> CalibratedLens:
        from spherloc.mapping.images.unknown_lens import find_lens

        place = paths[0].parent
        path = lens_path(target, "" if place == folder else camera_of_folder(place))
        kept = kept_lens(path)
        if kept is not None and (kept.width, kept.height) == size:
            how = f"The lens is that of {path}, as before; that file says where it is from, and may be removed."
            return CalibratedLens(kept, how)
        more: list[Path] = []
        if new_images is not None and is_folder(new_images) and not _calibrated(new_images, size):
            new = [new_images / name for name in names_in(new_images) if is_image(name)]
            more = [path for path in new if _has_size(path, size)]
        found = find_lens([*paths, *more], size, tell)
        if found.untold and place != folder:  # a map of several cameras is not asked about a lens
            raise InputError(found.untold)
        return found

    return find


def _lens_told(found: Photographs, target: Path) -> CalibratedLens | None:
    """The lens of all photographs that they told, now or for the map that was in ``target`` before; None if they are of
    several cameras or their calibration was given."""
    if len(found.calibrated) != 1 or len(cameras_of(found.views)) != 1:
        return None
    ((name, lens),) = found.calibrated.items()
    return None if was_given(lens_path(target, name)) else lens


def _with_lens(found: Photographs, made: Map) -> Photographs:
    """The photographs with the lens with which their map was made."""
    return found if made.lens is None else replace(found, calibrated=dict.fromkeys(found.calibrated, made.lens))


def _calibrated(folder: Path, size: tuple[int, int]) -> bool:
    """Whether a calibration for images of that size lies in a folder."""
    return any((camera.width, camera.height) == size for camera in calibrations_in(folder).cameras.values())


def _has_size(path: Path, size: tuple[int, int]) -> bool:
    try:
        return check_image(path) == size
    except InputError:
        return False


def _write(
    report: Path, made: Map, found: Photographs, measured: ScaleMeasurement, given: Mapping[str, Camera]
) -> None:
    """Write the report of a map, and beside it the calibrations that its images told or that were ``given`` and what
    gave its scale, if anything did; raises ``OSError``."""
    report.write_text(map_report(made, found), encoding="utf-8")
    write_lenses(report.parent, found.calibrated or (lenses_given(found.views) if given else {}))
    if any(one.scale.source for one in (made, *made.groups)):
        keep_scale(report.parent, measured)


def _of_the_map_before(folder: Path, made: Map) -> list[str]:
    """Scene files of other images in the folder of a map that were written for an earlier map in it."""
    now = read_table(made.written.scene).get("about")
    older = []
    for name in names_in(folder):
        path = folder / name
        if path.suffix != ".toml" or path in (made.written.scene, made.written.new_scene):
            continue
        with suppress(InputError):
            table = read_table(path)
            if "map" in table and table.get("about") != now:
                older.append(name)
    return older


def _unwritten(report: Path, error: OSError) -> str:
    return f"{report}: cannot be written ({reason(error)}); the map is done: {advice('report again')}."


def _sizes(images: NewImages) -> str:
    """How many new images of which size there are, the most frequent first; unreadable ones count apart."""
    sizes: Counter[str] = Counter()
    known = None if images.views is None else [view.name for view in images.views]
    for name in filter(is_image, names_in(images.folder)) if known is None else known:
        try:
            width, height = read_size(images.folder / name)
            sizes[f"of {width} x {height} pixels"] += 1
        except InputError:
            sizes["that cannot be read"] += 1
    return ", ".join(f"{count} {size}" for size, count in sizes.most_common(MAX_SIZES))


def end_without_a_trace() -> None:
    """Let a termination signal simply end the process: once imported, pycolmap prints a stack trace at one."""
    require("pycolmap", "colmap", "making a map")
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def how_of(features: str | None = None) -> FrontendOptions:
    """Features with their usual matching, the best installed ones if None; raises ``InputError`` if they are unknown or
    not installed."""
    if features is None:
        features = "sift+aliked" if trained.installed() else "sift"
    if features not in MAP_FEATURES:
        raise InputError(f"--features is {show(features)}; give {', '.join(MAP_FEATURES)}.")
    if features == "sift":
        return FrontendOptions()
    if not trained.installed():
        raise InputError(
            f"--features {features} needs the extra 'learned' (pip install 'spherloc[learned]'); install it, or give "
            "--features sift."
        )
    return FrontendOptions(FeatureOptions(features), MatchOptions("lightglue"))


def _take_frames(video: Path, count: int, folder: Path, tell: Tell) -> None:
    taken: list[str] = []

    def another(name: str) -> None:
        taken.append(name)
        tell("frames taken from the video", len(taken), count)

    for remark in frames_of(video, folder, count, another):
        say(remark)
    others = [name for name in names_in(folder) if is_image(name) and name not in taken]
    if others:
        say(f"{folder}: has {len(others)} more images, such as {shorten(others[0])}, which are mapped with the frames.")


def _compiled_for(new_images: Path | None) -> AbstractContextManager[None]:
    """While a map is made, compile what localizes the new images in it."""
    if new_images is None:
        return nullcontext()
    from spherloc.warm_up import compiled_meanwhile

    return compiled_meanwhile(ESTIMATOR)


@contextmanager
def _stages() -> Iterator[Tell]:
    """Progress of one kind of work after another."""
    with ExitStack() as stack:
        running: dict[str, Advance] = {}
        done = 0

        def tell(kind: str, number: int, count: int) -> None:
            nonlocal done
            if kind not in running:
                stack.close()
                running.clear()
                running[kind] = stack.enter_context(progress(count, kind))
                done = 0
            while done < number:
                running[kind]("", count)
                done += 1

        yield tell


def _kind(views: Sequence[View]) -> str:
    different = cameras_of(views)
    if len(different) > 1:
        return f"images of {len(different)} cameras"
    (camera,) = different.values()
    size = f"{camera.width} x {camera.height} pixels"
    return f"panoramas of {size}" if isinstance(camera, Equirectangular) else f"images of {size}, {camera.model}"


def distance_of(words: Sequence[str]) -> tuple[str, str, float] | None:
    """The two images and metres of the option ``--distance``; None without it. Raises ``InputError``."""
    if not words:
        return None
    try:
        first, second, metres = words
        found = first, second, float(metres)
    except ValueError:
        raise InputError(
            f"--distance is {show(' '.join(words))}; give two images and the metres between them, after the folder, "
            "such as --distance 1.jpg 5.jpg 12.5."
        ) from None
    if first == second:
        raise InputError(f"--distance names {show(first)} twice; give two images and the metres between them.")
    return found


def scale_of_words(words: str) -> ScaleMeasurement:
    """The measurement in a line: the height of the cameras in metres, or the names of two images (in quotes, if they
    have spaces) and their distance; none if it is empty. Raises ``InputError`` for anything else."""
    try:
        *images, metres = shlex.split(words) or [""]
        if not images and not metres:
            return ScaleMeasurement()
        value = float(metres)
        if 0.0 < value < MAX_METRES and len(images) == 0:
            return ScaleMeasurement(camera_height_m=value)
        if 0.0 < value < MAX_METRES and len(images) == 2:
            return ScaleMeasurement(distance=(images[0], images[1], value))
    except ValueError:
        pass
    raise InputError(
        f"the scale is {show(words)}; give the height of the cameras in metres, such as 1.6, or two photographs and "
        "their distance, such as 1.jpg 5.jpg 12.5."
    )


def main(folder: Path, output: Path, scale: str = "") -> int:
    """Make the map of a folder's photographs for a page that started this process, with a scale as ``scale_of_words``
    takes it; returns the exit code."""
    report = output / REPORT
    with for_a_page():
        try:
            check_images_of(output, folder)
            finder = _lens_finder(_progress, folder, output, None)
            found = photographs(folder, {}, find_lens=finder, choice=FrameChoice(tell=_progress))
            measured = scale_of_words(scale)
            if measured == ScaleMeasurement():
                measured = kept_scale(output)
            request, remarks = _request(folder, output, found, _Wishes(how_of(), measured), None, _progress)
            made = make_map(request, output, _progress)
            found = _with_lens(found, made)
            _write(report, made, found, measured, {})
        except SpherlocError as error:
            _tell({"error": str(error)})
            return 1
        except OSError as error:
            _tell({"error": _unwritten(report, error)})
            return 1
        others = "other images  open their folder in the list: they can be localized in this map"
        told = [*remarks, *summary(made, found), f"report        {report}", others]
    _tell({"scene": str(made.written.scene), "report": str(report), "summary": told})
    return 0


def _progress(kind: str, done: int, count: int) -> None:
    _tell({"kind": kind, "done": done, "count": count})


def _tell(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    if hasattr(os, "nice"):
        os.nice(5)  # lower priority than the page that started it
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]))
