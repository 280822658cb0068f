"""The pages of the lessons: the list at ``/learn``, a lesson at ``/learn/NAME``, and their pictures."""

import asyncio
import base64
import hashlib
import re
from collections.abc import Callable

from aiohttp import web

from spherloc.errors import InputError
from spherloc_viz.app.web.access import SAFE, SORRY_POLICY, sorry_page

LEARN = "/learn"
PICTURES = f"{LEARN}/pictures/"
TEACHER = f"{LEARN}/teacher"
_one_at_a_time = asyncio.Lock()


def is_learning(path: str) -> bool:
    """Whether a path is that of a page of the lessons."""
    return path == LEARN or path.startswith(f"{LEARN}/")


async def learn_answer(request: web.Request) -> web.Response:
    """The list, a lesson, or a picture, for a request that the front door has checked."""
    # Here, since they import what sets texts and formulas, which the first picture of the playground needs none of.
    from spherloc_viz.app.lesson_file import handout_of, images_picture, picture
    from spherloc_viz.lessons import lesson_named, lessons
    from spherloc_viz.lessons.html import IMAGES, lesson_page, list_page, notes_page, teacher_page

    path = request.path
    if path.startswith(PICTURES):
        name = path.removeprefix(PICTURES)
        return await _picture(lambda: picture(lesson_named(name)))
    if path == IMAGES:
        state = request.query_string
        return await _picture(lambda: images_picture(state))
    try:
        if path.rstrip("/") == LEARN:
            return _html(list_page(lessons(), PICTURES))
        if path == TEACHER:
            return _html(teacher_page(lessons()))
        name, _, part = path.removeprefix(f"{LEARN}/").partition("/")
        lesson = lesson_named(name)
        if part == "notes":
            return _html(notes_page(lesson))
        if part == "handout":
            return _html(await asyncio.to_thread(handout_of, lesson))
        return _html(lesson_page(lesson, lessons()))
    except InputError as error:
        return _html(sorry_page(str(error)), SORRY_POLICY, 404)


async def _picture(make: Callable[[], str]) -> web.Response:
    """A picture, SVG; one is made at a time."""
    try:
        async with _one_at_a_time:
            image = await asyncio.to_thread(make)
    except InputError as error:
        return web.Response(status=404, text=f"{error}\n", headers=SAFE)
    headers = SAFE | {"Cache-Control": "max-age=3600"}
    return web.Response(text=image, content_type="image/svg+xml", headers=headers)


def _html(text: str, policy: str = "", status: int = 200) -> web.Response:
    headers = SAFE | {"Content-Security-Policy": policy or _policy(text), "Cache-Control": "no-cache"}
    return web.Response(status=status, text=text, content_type="text/html", charset="utf-8", headers=headers)


def _policy(html: str) -> str:
    """Only the page's own script runs, and only this server's page is shown in its frame."""
    scripts = re.findall(r"<script>(.*?)</script>", html, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    rules = {
        "default-src": "'none'",
        "script-src": " ".join(f"'sha256-{digest}'" for digest in hashes) or "'none'",
        "style-src": "'unsafe-inline'",
        "img-src": "'self' data:",
        "font-src": "data:",
        "frame-src": "'self'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "frame-ancestors": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())
