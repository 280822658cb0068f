"""Models of photographs, before level and scale, with the lens checked that the photographs told.

A lens that pairs of images told is asked of the models (``lens_in_map``). If they fit another one clearly better, they
are made anew with that, once; what then stays open is told.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import degrees, radians
from pathlib import Path

from spherloc.errors import InputError, StoppedError
from spherloc.frontend.masks import Masks
from spherloc.frontend.view import View
from spherloc.mapping.advice import advice
from spherloc.mapping.alignment.line_gravity import GravityByLines, gravity_by_lines
from spherloc.mapping.images.carried import carried_nadir_deg
from spherloc.mapping.images.folder_cameras import CalibratedLens
from spherloc.mapping.models.kept_models import kept_or_made
from spherloc.mapping.models.lens_in_map import lens_in_map
from spherloc.mapping.models.model import Reconstruction
from spherloc.mapping.models.reconstruction import reconstruct
from spherloc.mapping.parallel import Tell
from spherloc.mapping.request import MapRequest
from spherloc.mapping.two_view.matched import DATABASES, files_of

MOVED_RAD, DOUBT_RAD = radians(0.5), radians(1.0)
"""A map is made anew with a lens that it fits better if directions differ by the first angle, and the lens is in doubt
if, then, they still differ by the second or are not known better."""
CORRECTED = "A first map was fitted better by a lens whose directions differ by up to {:.1f}°, which is taken instead."
LENS_DOUBT = (
    "whether the lens, and so the shape of the map, is right: the map leaves directions open by {:.1f}°; photographs "
    "between which the camera was turned, or a calibration, make it sure"
)
UNTOLD_DOUBT = (
    "whether the lens, and so the shape of the map, is right: pairs of the photographs do not tell it, only the map "
    "does; photographs between which the camera was turned, or a calibration, make it sure"
)


@dataclass(frozen=True, eq=False)
class Built:
    """Models of photographs, before level and scale."""

    views: Sequence[View]
    """The photographs, without what moves with the camera."""
    masks: Masks | None
    carried_deg: float
    lines: GravityByLines
    models: tuple[Reconstruction, ...]


def _built(folder: Path, request: MapRequest, tell: Tell) -> Built:
    """The models of a request; raises as ``make_map``."""
    views, masks = request.views, request.masks
    carried_deg = carried_nadir_deg(views, tell) if request.find_carried else 0.0
    if carried_deg:
        views, _ = Masks(nadir_deg=carried_deg).on(views)
        masks = replace(masks or Masks(), nadir_deg=carried_deg)
    known = {} if request.stated is None else request.stated.found
    fixed = request.measured.fixed
    lines = gravity_by_lines(views, tell, known, {} if fixed is None else fixed.body_from_camera)
    believed = {**known, **({} if lines.unsure else lines.found)}
    down = [believed.get(view.name) for view in views]
    how = request.how
    models = kept_or_made(views, down, folder, how, fixed, lambda: reconstruct(views, down, folder, tell, how, fixed))
    return Built(views, masks, carried_deg, lines, models)


@dataclass(frozen=True, eq=False)
class CheckedModels:
    """What a map is made of, after its lens was checked."""

    request: MapRequest
    built: Built
    corrected_rad: float = 0.0
    """See ``Map``."""
    doubts: tuple[str, ...] = ()
    """A sentence on the lens, if it is in doubt."""
    unused: tuple[Path, ...] = ()
    """Files with the matches of models that were not taken, which nothing reads once the map with its lens is there."""


def checked_models(folder: Path, request: MapRequest, tell: Tell) -> CheckedModels:
    """The models, with the lens checked that the photographs told.

    Raises ``InputError`` also if neither their pairs nor the models tell that lens.
    """
    lens = request.lens
    if lens is None:
        return CheckedModels(request, _built(folder, request, tell))
    put_it = advice("calibration").format(files="their calibration")
    refused = InputError(f"{request.images}: its photographs have no calibration, and {lens.untold}. Or {put_it}.")
    try:
        checked, told = _with_lens_of_map(folder, CheckedModels(request, _built(folder, request, tell)), lens, tell)
    except StoppedError:
        raise
    except InputError as error:
        raise (refused if lens.untold else error) from None
    if lens.untold and not told:
        raise refused
    return replace(checked, doubts=(UNTOLD_DOUBT,)) if lens.untold else checked


def _with_lens_of_map(
    folder: Path, before: CheckedModels, lens: CalibratedLens, tell: Tell
) -> tuple[CheckedModels, bool]:
    """The models, made anew with the lens that they fit better if they do so clearly; a doubt if they contradict it or
    leave it open, and whether they tell it."""
    found, checked = lens_in_map(before.built.models[0], tell), before
    if found is not None and found.moved_rad > max(MOVED_RAD, found.bound_rad):
        better = lens._replace(camera=found.camera, how=f"{lens.how} {CORRECTED.format(degrees(found.moved_rad))}")
        request = before.request.with_lens(lens, better)
        known = set(folder.glob(DATABASES))
        try:
            anew = _built(folder, request, tell)
            again = lens_in_map(anew.models[0], tell)
            if again is not None and _images(anew) >= _images(before.built):
                unused = files_of(before.built.models[0].database)
                checked, found = CheckedModels(request, anew, found.moved_rad, unused=unused), again
        except StoppedError:
            raise
        except InputError:  # there is no map with that lens
            pass
        if checked is before:
            checked = replace(before, unused=tuple(sorted(set(folder.glob(DATABASES)) - known)))
    if found is None:
        return checked, False
    off_rad = max(found.moved_rad, found.bound_rad)
    if off_rad <= DOUBT_RAD:
        return checked, True
    return replace(checked, doubts=(LENS_DOUBT.format(degrees(off_rad)),)), False


def _images(built: Built) -> int:
    """Number of images in all models."""
    return sum(len(one.poses) for one in built.models)
