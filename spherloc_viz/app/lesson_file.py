"""Lessons as files: a page with recorded scenes that opens without a server, and the hand-out."""

import json
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from html import escape
from pathlib import Path

import numpy as np

from spherloc.diagnosis import diagnose
from spherloc.errors import InputError
from spherloc.estimators import default_options, estimate
from spherloc.files import is_file
from spherloc.trace import Trace
from spherloc_viz import style
from spherloc_viz.app.catalog import Catalog, Run, RunRequest, SceneRequest
from spherloc_viz.app.controls.steps_panel import find_step
from spherloc_viz.app.link import Follower, PageView
from spherloc_viz.app.matches import match_drawing as drawing
from spherloc_viz.app.matches.image_panel import image_sizes, match_colors, photo_uri
from spherloc_viz.app.panels.folders import Roots
from spherloc_viz.app.review.opened import Opened
from spherloc_viz.app.stage import views
from spherloc_viz.app.stage.flat_picture import svg
from spherloc_viz.app.stage.still_page import Still, scene_script, scripts_in, with_policy
from spherloc_viz.app.stage.walls import MAX_BYTES, Walls
from spherloc_viz.app.web.page import QUIET, client_html
from spherloc_viz.layers import paint, steps, with_alternative
from spherloc_viz.layers.matches import match_view
from spherloc_viz.layers.primitives import Picture
from spherloc_viz.layers.withheld import OUTCOME, untold, withheld_by
from spherloc_viz.lessons import lessons
from spherloc_viz.lessons.html import (
    Form,
    Sheet,
    exported_page,
    handout_page,
    has_images,
    links_in,
    names_in,
    right_changes,
    setting_text,
    settings_in,
)
from spherloc_viz.lessons.lesson import Lesson, Moment, changed_state, state_parts
from spherloc_viz.lessons.numbers import number_text, numbers_of

ESTIMATOR = "mc"
"""Estimator of a link that names none."""


def _no_recordings(file: str) -> Opened:
    raise InputError("a link to a recording needs the playground that has it.")


@dataclass(frozen=True)
class LinkedRun:
    """What a link leads to."""

    run: Run
    view: PageView


class LinkedRuns:
    """Runs of links to the scenes that come with the project."""

    def __init__(self) -> None:
        self.catalog = Catalog(None)
        self._follower = Follower(self.catalog, Roots(()), self.catalog.problem, _no_recordings)
        self._last: Run | None = None

    def run(self, link: str) -> LinkedRun:
        """The run of a link; raises ``InputError`` for what of it cannot be followed."""
        scene = SceneRequest(next(iter(self.catalog.scenes)), 0)
        begin = RunRequest(scene, ESTIMATOR, default_options(ESTIMATOR, self.catalog.problem(scene)))
        followed = self._follower.follow(link, begin, PageView("", (), "dark"))
        if followed.remarks or followed.request is None:
            raise InputError(" ".join(followed.remarks))
        request = followed.request
        if self._last is None or self._last.request != request:
            problem = self.catalog.problem(request.scene)
            trace = estimate(problem, request.estimator, request.options, request.scene.seed)
            kept = request.scene.variation.kept(len(problem) + len(request.scene.variation.hidden))
            self._last = Run(request, trace, kept)
        return LinkedRun(self._last, followed.view)


ASPECT = 1.15
"""Width over height for which views are chosen: between those of a screen's canvas and of a phone's."""
LETTER = views.LETTER_PX / 300.0
"""Width of a letter by half the height of such a canvas."""
MAX_BYTES_OF_FILE = 8_000_000
BARE = "<style>#root button,[class*=Notifications-root]{display:none!important}</style>"
"""Viser's own buttons and notes would be dead in a file."""


def exported(lesson: Lesson, tell: Callable[[str], None], dark: bool = True) -> str:
    """A lesson as one HTML file with all of its scenes; ``tell`` is called with how far it is, in a few words.

    Raises ``InputError`` for a state that cannot be shown, and for a file of more than ``MAX_BYTES_OF_FILE``.
    """
    runs, found = LinkedRuns(), {state: place for place, state in enumerate(recorded_states(lesson))}
    said = [text for moment in lesson.moments for text in texts(moment)]
    asked = {name for text in said for name in names_in(text)}
    settings = {key: percent for text in said for key, percent in settings_in(text).items()}
    scripts, numbers = [], []
    for state, place in found.items():
        tell(f"scene {place + 1} of {len(found)}")
        linked = runs.run(state)
        scripts.append(scene_script(still_of(linked, runs, dark)))
        told = numbers_text(linked)
        values = state_parts(state)
        shown = {
            key: setting_text(values[key].rpartition("=")[2], settings[key]) for key in settings.keys() & values.keys()
        }
        numbers.append({name: told[name] for name in asked & told.keys()} | shown)
    viewer = client_html().replace("<title>Viser</title>", f"<title>scene</title>{QUIET}{BARE}", 1)
    data = [
        _data("viewer", json.dumps(viewer)),
        _data("numbers", json.dumps({str(place): one for place, one in enumerate(numbers)})),
        *(_data(f"scene-{place}", script) for place, script in enumerate(scripts)),
    ]
    images = {moment.state: _as_data(images_of(runs, moment.state)) for moment in lesson.moments if has_images(moment)}
    forms = [_recorded(found, numbers[found[_state(moment.state)]], images) for moment in lesson.moments]
    page = exported_page(lesson, forms, "\n".join(data))
    page = with_policy(page, [*scripts_in(viewer), *scripts])
    if len(page.encode()) > MAX_BYTES_OF_FILE:
        raise InputError(f"the lesson would be a file of {len(page.encode()) / 1e6:.1f} MB; make it two lessons.")
    return page


def handout_of(lesson: Lesson) -> str:
    """A lesson as HTML to be printed; its pictures are inside."""
    runs = LinkedRuns()

    @cache
    def told(state: str) -> tuple[dict[str, str], str]:
        linked = runs.run(state)
        return numbers_text(linked), svg(still_of(linked, runs, dark=False))

    sheets = []
    for moment in lesson.moments:
        answered, asked = (changed_state(moment.state, changes) for changes in (right_changes(moment), moment.before))
        sheets.append(Sheet(*told(answered), *told(asked)))
    return handout_page(lesson, sheets, lambda state: _as_data(images_of(runs, state)))


@lru_cache(maxsize=16)
def images_picture(state: str) -> str:
    """Query and reference of a moment's state, SVG; raises ``InputError`` if no moment of a lesson shows them."""
    shown = {_state(moment.state) for lesson in lessons() for moment in lesson.moments if has_images(moment)}
    if _state(state) not in shown:
        raise InputError("no lesson shows these images; the lessons are at /learn.")
    return images_of(LinkedRuns(), state)


def images_of(runs: LinkedRuns, state: str) -> str:
    """Query and reference of a state with their matches, SVG; raises ``InputError`` if it has none."""
    linked = runs.run(state)
    trace = linked.run.trace
    scene = runs.catalog.map_scene(linked.run.request.scene.scene)

    def draw(path: Path) -> None:
        """Rendered images are drawn when they are first needed."""
        for view in () if scene is None else scene.pictures(trace.problem):
            if view.path == path and not is_file(path):
                view.make_file()

    return images_svg(trace, paint(trace, find_step(steps(trace), linked.view.step)), draw)


def _as_data(image: str) -> str:
    return f"data:image/svg+xml;base64,{b64encode(image.encode()).decode()}"


@lru_cache(maxsize=64)
def picture(lesson: Lesson) -> str:
    """The picture that stands for a lesson, SVG."""
    runs = LinkedRuns()
    return svg(still_of(runs.run(lesson.moments[lesson.picture].state), runs, dark=False))


def recorded_states(lesson: Lesson) -> tuple[str, ...]:
    """All states that a lesson shows but for those of sliders and choices, each once."""
    found: dict[str, None] = {}
    for moment in lesson.moments:
        answers = () if moment.question is None else moment.question.answers
        links = [changes for text in texts(moment) for changes in links_in(text)]
        for changes in ("", moment.before, *(answer.go for answer in answers), *links):
            found[changed_state(moment.state, changes)] = None
    return tuple(found)


def texts(moment: Moment) -> tuple[str, ...]:
    """All Markdown of a moment."""
    asked = moment.question
    answers = () if asked is None else (asked.ask, *(part for one in asked.answers for part in (one.text, one.shows)))
    return moment.prose, moment.after, moment.notes, *answers


def numbers_text(linked: LinkedRun) -> dict[str, str]:
    """The numbers of a run as prose has them."""
    return {name: number_text(value) for name, value in numbers_of(linked.run.trace).items()}


def still_of(linked: LinkedRun, runs: LinkedRuns, dark: bool) -> Still:
    """The canvas of a link, as the playground shows it."""
    run, view = linked.run, linked.view
    withheld = withheld_by(view.answers)
    trace = untold(run.trace, withheld) if withheld else run.trace
    timeline = steps(trace)
    index = find_step(timeline, view.step)
    picture = paint(trace, index, OUTCOME not in withheld)
    if index == len(timeline) - 1 and not withheld:
        alternative = diagnose(trace).alternative_cam_from_map
        if alternative is not None:
            picture = with_alternative(picture, trace, alternative)
    turn = trace.problem.aligned.map_turn
    mesh = runs.catalog.mesh(run.request.scene.scene)
    walls = Walls(mesh, turn) if mesh is not None and len(mesh) <= MAX_BYTES else None
    place = views.follow(picture, ASPECT, walls, LETTER)
    hidden = views.cut(picture, place, ASPECT, LETTER)
    layers = set(style.LAYERS) - ({"ground"} if mesh is not None else set())
    return Still(
        title="",
        note="",
        items=[item for item in picture.scene if item.layer in layers and item.name not in hidden],
        backdrop=mesh,
        aligned_from_map=turn,
        position=place.position,
        target=place.target,
        up=views.UP,
        field_of_view_rad=place.field_of_view_rad,
        dark=dark,
        reach=views.reach(place),
    )


def _state(state: str) -> str:
    return changed_state(state, "")


def _data(name: str, text: str) -> str:
    """Text that the page's script reads; viser's page has closing tags of its own."""
    return f'<script type="application/json" id="{name}">{text.replace("</", "<" + chr(92) + "/")}</script>'


def _recorded(places: Mapping[str, int], numbers: Mapping[str, str], images: Mapping[str, str]) -> Form:
    """The form of a moment with recorded scenes; ``numbers`` are those of its run, ``images`` addresses by state."""

    def number(name: str) -> str:
        return f'<output data-number="{name}">{escape(numbers[name])}</output>'

    def at(state: str) -> str:
        return f"at={places[_state(state)]}"

    def setting(key: str, shown: str) -> str:
        return f'<b data-number="{escape(key)}">{escape(shown)}</b>'

    def change(state: str, changes: str) -> str:
        return at(changed_state(state, changes))

    return Form(number, at, change, False, images.__getitem__, setting)


PHOTO_PX = 640
"""Width of both images together."""


def images_svg(trace: Trace, picture: Picture, draw: Callable[[Path], None]) -> str:
    """The images of a run at a step; ``draw`` is asked to make the file of each, if it is not there.

    Raises ``InputError`` for a problem without images.
    """
    problem = trace.problem
    if problem.image is None:
        raise InputError(f"{problem.name}: has no images.")
    colors = match_colors(picture, len(problem))
    view = match_view(problem, colors, trace.inlier_mask, (), None)
    paths = [problem.image] + ([] if view.reference is None else [problem.reference_images[view.reference]])
    for path in paths:
        draw(path)
    places, height = drawing.arrange([(problem.camera.width, problem.camera.height), *image_sizes(problem, view)])
    photos = [
        f'<image href="{escape(uri)}" x="{place.x:.0f}" y="{place.y:.1f}" width="{place.width:.0f}" '
        f'height="{place.height:.1f}" preserveAspectRatio="none"/>'
        for path, place in zip(paths, places, strict=True)
        if (uri := photo_uri(path, round(PHOTO_PX * place.width / drawing.WIDTH))) is not None
    ]
    parts = drawing.overlay(trace, view, colors, places, (), np.arange(len(problem)), bool(photos)).parts
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {drawing.WIDTH:.0f} {height:.1f}" '
        f'width="{drawing.WIDTH:.0f}" height="{height:.1f}">{"".join(photos)}{"".join(parts)}</svg>'
    )
