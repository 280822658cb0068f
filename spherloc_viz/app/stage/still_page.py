"""A scene as one HTML file that opens from the disk: viser's page with the scene, a title and a legend inside."""

import base64
import hashlib
import re
import secrets
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from spherloc.types import FloatArray
from spherloc_viz import style
from spherloc_viz.app.stage.painter import Painter
from spherloc_viz.app.stage.views import MIN_REACH
from spherloc_viz.app.web.page import QUIET, client_html
from spherloc_viz.app.web.viser_internals import start_viser, stop_viser
from spherloc_viz.layers.primitives import SceneItem

_one_at_a_time = threading.Lock()
"""Held while a viser server is started and stopped, since that changes global state of the process."""


@dataclass(frozen=True, eq=False)
class Still:
    """A scene with its title, note and view."""

    title: str
    note: str
    """A line under the title."""
    items: Sequence[SceneItem]
    backdrop: bytes | None
    """The map's mesh, a binary glTF in the map frame, if it is shown."""
    aligned_from_map: FloatArray
    """Rotation (3, 3) of that mesh."""
    position: FloatArray
    """(3,) position of the viewer."""
    target: FloatArray
    """(3,) point at which the viewer looks."""
    up: FloatArray
    """(3,) direction that is up in the picture."""
    field_of_view_rad: float
    """Vertical field of view."""
    dark: bool
    reach: float = MIN_REACH
    """Largest distance at which things are drawn."""


def still_html(still: Still) -> str:
    """The file. Takes about a second."""
    page = client_html().replace("</head>", f"<script>{scene_script(still)}</script></head>", 1)
    return with_policy(_embed(page, still))


def with_policy(page: str, more_scripts: Iterable[str] = ()) -> str:
    """The page with a policy by which it runs only its own scripts and ``more_scripts`` and uses no network."""
    policy = _policy([*scripts_in(page), *more_scripts])
    return page.replace("<head>", f'<head><meta http-equiv="Content-Security-Policy" content="{policy}">', 1)


def scripts_in(page: str) -> list[str]:
    """The scripts in a page."""
    return re.findall(r"<script\b(?![^>]*application/json)[^>]*>(.*?)</script>", page, flags=re.DOTALL)


def scene_script(still: Still) -> str:
    """A script that has viser's page (``client_html``) show the scene. Takes about a second.

    viser can save only the scene that a server shows to all clients, not that of one client. So a server is started.
    """
    layers = frozenset(item.layer for item in still.items)
    with _one_at_a_time:
        server: Any = start_viser(secrets.token_urlsafe(32))
        try:
            server.scene.world_axes.visible = False
            server.scene.set_up_direction("-y")
            camera = server.initial_camera
            camera.up, camera.fov = tuple(still.up), still.field_of_view_rad
            camera.far = still.reach
            camera.position, camera.look_at = tuple(still.position), tuple(still.target)
            server.gui.configure_theme(dark_mode=still.dark, show_logo=False, show_share_button=False)
            painter = Painter(server)
            painter.dark = still.dark
            painter.see_from(np.asarray(still.position), in_camera=False)
            painter.draw(still.items, layers)
            painter.draw_backdrop(still.backdrop, still.aligned_from_map, True)
            data = base64.b64encode(server.get_scene_serializer().serialize()).decode()
        finally:
            stop_viser(server)
    config = f"{{darkMode:{str(still.dark).lower()}}}"
    return f'window.__VISER_EMBED_DATA__="{data}";window.__VISER_EMBED_CONFIG__={config};'


def _embed(page: str, still: Still) -> str:
    """The page with its title and legend, which lie over the canvas."""
    color, ground = ("#e8e8ea", "rgba(20,22,26,.8)") if still.dark else ("#1a1b1e", "rgba(255,255,255,.85)")
    # At the bottom, since viser's own notifications appear at the top.
    where = "position:fixed;left:12px;max-width:calc(100% - 24px);bottom:12px;z-index:10;pointer-events:none"
    face = f"font-family:system-ui,sans-serif;font-size:13px;color:{color};background:{ground}"
    place = f"{where};{face};box-sizing:border-box;padding:.6em .9em;border-radius:.5em"
    dot = "display:inline-block;width:.75em;height:.75em;border-radius:50%;margin-right:.4em"
    legend = "".join(
        f'<span style="margin-right:1.1em;white-space:nowrap"><span style="{dot};background:{style.css(paint)}"></span>'
        f"{escape(meaning)}</span>"
        for paint, meaning in style.LEGEND
    )
    over = (
        f'<div style="{place}"><div style="font-size:17px;font-weight:600">{escape(still.title)}</div>'
        f'<div style="opacity:.75">{escape(still.note)}</div>'
        f'<div style="font-size:12.5px;line-height:1.6;padding-top:.3em">{legend}</div></div>'
    )
    head = f"<title>{escape(still.title)}</title>{QUIET}"
    page = re.sub(r"<title>[^<]*</title>", lambda match: head, page, count=1)
    at = page.rindex("</body>")
    return page[:at] + over + page[at:]


def _policy(scripts: Iterable[str]) -> str:
    """A policy under which nothing is fetched and no other script runs."""
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    return (
        f"default-src 'none'; script-src {allowed} 'strict-dynamic' 'wasm-unsafe-eval'; style-src 'unsafe-inline'; "
        "img-src data: blob:; font-src data:; worker-src blob: data:; connect-src data: blob:; base-uri 'none'; "
        "form-action 'none'"
    )


def viewpoint(camera: Any) -> dict[str, Any]:
    """Position, target, up and field of view of a client's camera."""
    return {
        "position": np.array(camera.position),
        "target": np.array(camera.look_at),
        "up": np.array(camera.up_direction),
        "field_of_view_rad": float(camera.fov),
        "reach": float(camera.far),
    }
