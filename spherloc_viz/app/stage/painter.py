"""Draws a picture's primitives into one client's canvas; nodes that exist are changed instead of drawn again.

Colours arrive on the screen as the legend shows them.
"""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
import viser
import viser.transforms as vtf
from PIL import Image

from spherloc.types import ByteArray, FloatArray
from spherloc_viz import style
from spherloc_viz.app.stage.picking import inside, nearest, photograph, viewer_of
from spherloc_viz.app.web.viser_internals import update_node
from spherloc_viz.layers.frame import icosphere, one_color
from spherloc_viz.layers.primitives import Balls, Label, Mesh, Points, SceneItem, Segments, Textured
from spherloc_viz.layers.selection import HALO

# three.js, ACESFilmicToneMapping: matrix, rational curve (v^2 + A v - B) / (C v^2 + D v + E), matrix, at exposure 1.
_INTO = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_A, _B, _C, _D, _E = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081
_EXPOSURE = 1.0 / 0.6
_UNDO_OUT, _UNDO_INTO = np.linalg.inv(_OUT).T, np.linalg.inv(_INTO).T / _EXPOSURE

_SRGB = np.arange(256) / 255.0
_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
"""Linear light of every sRGB byte."""


def light_bytes(colors: ByteArray) -> ByteArray:
    """Linear bytes (..., 3), to be read only, for lines and batched meshes that show the sRGB bytes ``colors``
    (..., 3)."""
    return _light(colors.tobytes()).reshape(colors.shape)


@lru_cache(maxsize=64)
def _light(colors: bytes) -> ByteArray:
    """The same (K, 3) for the bytes of K colours, kept: most items have the colours of the run before."""
    light = _bytes(_before_filmic(np.frombuffer(colors, np.uint8).reshape(-1, 3)))
    light.flags.writeable = False
    return light


def surface_bytes(colors: ByteArray) -> ByteArray:
    """sRGB bytes (..., 3) for a single mesh, whose colour viser does decode, that show ``colors`` (..., 3)."""
    light = _before_filmic(colors)
    return _bytes(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


def _before_filmic(colors: ByteArray) -> FloatArray:
    """Linear light (..., 3) in [0, 1] which the filmic curve turns into the sRGB bytes ``colors``."""
    y = _LINEAR[np.asarray(colors, dtype=np.uint8)] @ _UNDO_OUT
    square, slope, rest = 1.0 - _C * y, _A - _D * y, -_B - _E * y
    v = (np.sqrt(np.maximum(slope**2 - 4.0 * square * rest, 0.0)) - slope) / (2.0 * square)
    return np.clip(v @ _UNDO_INTO, 0.0, 1.0)


def _bytes(values: FloatArray) -> ByteArray:
    return np.round(255.0 * values).astype(np.uint8)


UNLIT = "KHR_materials_unlit"


def textured_glb(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, image: np.ndarray) -> bytes:
    """The mesh with its texture (H, W, 3 or 4), unlit and visible from both sides, in the colours of the texture."""
    import trimesh  # takes a second
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    pixels = image.copy()
    pixels[..., :3] = surface_bytes(image[..., :3])
    holes = image.shape[2] == 4
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(pixels), doubleSided=True, alphaMode="MASK" if holes else "OPAQUE"
    )
    visual = TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
    # WebP takes a fifth of PNG; without light and shadow, the texture keeps its colours.
    return export_glb(trimesh.Scene(mesh), extension_webp=True, tree_postprocessor=_unlit)


def _unlit(tree: dict[str, Any]) -> None:
    for material in tree["materials"]:
        material.setdefault("extensions", {})[UNLIT] = {}
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), UNLIT})


OnPick = Callable[[tuple[int, ...], bool], None]
"""Called with the picked correspondences (indices in the problem) and whether they are added to the selection."""
OnPhotograph = Callable[[str, str], None]
"""Called with the layer and the name of a photograph whose dot was pressed."""

SHELLS = 12
"""Number of nodes into which the balls of one primitive are divided."""
MAX_ROUND = 400
"""If there are more dots, they have fewer faces."""
MAX_BATCHED = 3000
"""If there are more dots, they are drawn as a point cloud, which costs less."""
LARGEST_DOT, LARGEST_DOT_INSIDE = 0.012, 0.007
"""Largest radius of a dot as a share of its distance, and the same for a viewer inside a camera, since dots would hide
the photograph."""
RESIZED = 0.2
"""Relative change of a dot's radius from which on it is drawn anew."""
LABEL_SCALE = 0.9
"""Size of labels, relative to viser's own."""
PHOTOGRAPH = "sphere/image"
"""Name of the node of the photograph around the camera."""
PLACE = frozenset({"wxyz", "position"})
"""Settings of a node that are not properties of the shape drawn there."""


class Painter:
    """The canvas of one client. Picking is done here, by the ray of the click, so that lines, dots of a point cloud and
    balls within balls can be picked too, and a small dot within some pixels."""

    def __init__(
        self,
        client: viser.ClientHandle | viser.ViserServer,
        on_pick: OnPick | None = None,
        on_photograph: OnPhotograph = lambda layer, name: None,
        label_scale: float = LABEL_SCALE,
    ) -> None:
        """``label_scale`` is the size of labels, relative to viser's own.

        ``on_pick`` and ``on_photograph`` are called on viser's threads, the former with () for a click on nothing;
        None is for a still page."""
        self._client, self._label_scale = client, label_scale
        self._drawn: dict[str, tuple[Any, tuple, SceneItem]] = {}
        self._textured: dict[str, tuple[Hashable, bytes | None]] = {}
        self._shown: tuple[SceneItem, ...] = ()
        self._names: frozenset[str] = frozenset()
        self.hidden: frozenset[str] = frozenset()
        """Names of nodes that are not shown."""
        self._seen_from: tuple[np.ndarray, bool] | None = None
        """Position (3,) of the viewer and whether it is inside a camera; None while dots of any size are good."""
        self._dots: tuple[tuple[Any, Points], ...] = ()
        """Nodes of dots, and what they show."""
        self.dark = True
        """Whether the background is dark."""
        self.clicked_x = 0.5
        """Horizontal position of the last click, as a share of the canvas' width."""
        self._backdrop: tuple[bytes, Any] | None = None
        self._backdrop_wanted = False
        if on_pick is not None:
            scene, extend = client.scene, partial(self._clicked, on_pick, on_photograph, True)
            scene.on_click()(partial(self._clicked, on_pick, on_photograph, False))
            scene.on_click(modifier="shift")(extend)
            scene.on_click(modifier="cmd/ctrl")(extend)
            scene.on_rect_select(modifier="shift")(partial(self._framed, on_pick))

    def draw(self, items: Iterable[SceneItem], layers: frozenset[str]) -> None:
        """Show these primitives, those of ``layers`` only, and hide all others."""
        names, shown = set(), []
        with self._client.atomic():
            for item in items:
                if item.layer == "ground" and isinstance(item, Segments) and not self.dark:
                    item = replace(item, colors=one_color(style.GROUND_ON_LIGHT, len(item.points)))
                if item.layer in layers:
                    shown.append(item)
                if isinstance(item, Textured) and (item.layer not in layers or self._glb(item) is None):
                    continue
                look = _look(item)
                for part in _parts(item):
                    self._put(part, look)
                    names.add(part.name)
            self._names = frozenset(name for name in names if self._drawn[name][2].layer in layers)
            drawn = [(handle, item) for handle, _, item in self._drawn.values()]
            self._dots = tuple((handle, item) for handle, item in drawn if isinstance(item, Points) and _round(item))
            self._limit_dots()
            self._follow()
        self._shown = tuple(shown)

    def scale_labels(self, scale: float) -> None:
        """Draw labels in this size, relative to viser's own, from now on."""
        self._label_scale = scale
        with self._client.atomic():
            for handle, _, item in self._drawn.values():
                if isinstance(item, Label):
                    update_node(handle, font_screen_scale=scale)

    def hide(self, names: frozenset[str]) -> None:
        """Do not show these nodes from now on; an empty set shows all again."""
        if names != self.hidden:
            self.hidden = names
            with self._client.atomic():
                self._follow()

    def follows(self, eye: np.ndarray, in_camera: bool) -> bool:
        """Whether ``see_from`` would change anything; needs no lock."""
        before = self._seen_from
        if before is not None and before[1] == in_camera and np.array_equal(before[0], eye):
            return False
        return (before is not None and before[1] != in_camera) or any(
            _resized(handle, item, (eye, in_camera)) for handle, item in self._dots
        )

    def see_from(self, eye: np.ndarray, in_camera: bool) -> None:
        """Limit the size of dots on the screen for a viewer at ``eye`` (3,), who may be inside a camera: then the map's
        mesh is not shown before the photograph."""
        self._seen_from = eye, in_camera
        with self._client.atomic():
            self._limit_dots()
            self._show_backdrop()

    def _limit_dots(self) -> None:
        for handle, item in self._dots:
            if self._seen_from is not None and _resized(handle, item, self._seen_from):
                update_node(handle, batched_scales=np.float32(_dot_radii_m(item, *self._seen_from)))

    def _follow(self) -> None:
        """Set which nodes are visible."""
        for name, (handle, _, _) in self._drawn.items():
            visible = name in self._names and name not in self.hidden
            if handle.visible != visible:
                handle.visible = visible

    def draw_backdrop(self, glb: bytes | None, aligned_from_map: np.ndarray, visible: bool) -> None:
        """Show the map's mesh, a binary glTF in the map frame, behind the pictures of a run; None for none.

        It belongs to the scene and not to the run; recordings, which must be small, do not contain it.
        """
        if self._backdrop is not None and self._backdrop[0] is not glb:
            self._backdrop[1].remove()
            self._backdrop = None
        if glb is None:
            return
        if self._backdrop is None:
            handle = self._client.scene.add_glb("/backdrop", glb, cast_shadow=False, receive_shadow=False)
            self._backdrop = (glb, handle)
        self._backdrop[1].wxyz = vtf.SO3.from_matrix(aligned_from_map).wxyz
        self._backdrop_wanted = visible
        self._show_backdrop()

    def _show_backdrop(self) -> None:
        """Show the map's mesh if it is wanted, but not before the photograph around a viewer in the camera."""
        if self._backdrop is not None:
            in_camera = self._seen_from is not None and self._seen_from[1]
            self._backdrop[1].visible = self._backdrop_wanted and not (in_camera and PHOTOGRAPH in self._names)

    def _put(self, item: SceneItem, look: tuple) -> None:
        handle, known, last = self._drawn.get(item.name, (None, None, None))
        if handle is None or known != look:
            glb = self._glb(item) if isinstance(item, Textured) else None
            handle = _add(self._client.scene, item, glb, self._label_scale)
        elif not _same(item, last):
            changing = _changing(item)
            update_node(handle, **{name: value for name, value in changing.items() if name not in PLACE})
            for name in PLACE & changing.keys():
                setattr(handle, name, changing[name])
        self._drawn[item.name] = (handle, look, item)

    def _glb(self, item: Textured) -> bytes | None:
        """The item as a binary glTF; None if it has no texture."""
        known = self._textured.get(item.name)
        if known is None or known[0] != item.key:
            image = item.image()
            glb = None if image is None else textured_glb(item.vertices, item.faces, item.uv, image)
            self._textured[item.name] = known = (item.key, glb)
        return known[1]

    def _clicked(
        self, on_pick: OnPick, on_photograph: OnPhotograph, extend: bool, event: viser.SceneClickEvent
    ) -> None:
        self.clicked_x = float(event.screen_pos[0])
        viewer = viewer_of(event.client.camera)
        ray = np.array(event.ray_origin), np.array(event.ray_direction), viewer.radians_per_pixel
        taken = photograph(self._shown, *ray)
        if taken is None:
            on_pick(nearest(self._shown, *ray), extend)
        else:
            on_photograph(*taken)

    def _framed(self, on_pick: OnPick, event: viser.SceneRectSelectEvent) -> None:
        on_pick(inside(self._shown, viewer_of(event.client.camera), event.screen_min, event.screen_max), False)


def _parts(item: SceneItem) -> list[SceneItem]:
    """The item as nodes that are drawn one after another; none if there is nothing to draw.

    Balls can lie within balls, and a translucent surface hides things behind it that are drawn later. Within a node,
    viser draws by the distance of the centres, which is no help for balls around one point; but nodes are drawn in the
    order in which they were added. So balls are divided into nodes, the smallest balls first.
    """
    if not _size(item):
        return []
    if not isinstance(item, Balls):
        return [item]
    shells = np.array_split(np.argsort(item.radii_m, kind="stable"), min(SHELLS, len(item.radii_m)))
    return [
        Balls(f"{item.name}/{k}", item.layer, item.centers[at], item.radii_m[at], item.colors[at], item.opacity)
        for k, at in enumerate(shells)
    ]


def _size(item: SceneItem) -> int:
    """Number of shapes of an item; viser cannot draw a node with none."""
    match item:
        case Points():
            return len(item.positions)
        case Segments():
            return len(item.points)
        case Balls():
            return len(item.centers)
        case Mesh() | Textured():
            return len(item.faces)
        case Label():
            return int(item.text != "")


def _look(item: SceneItem) -> tuple:
    """Properties that need a new node when they change: kind, size, and what viser sets only once."""
    extra: tuple = ()
    match item:
        case Points():
            extra = (item.rim,)
        case Mesh():
            extra = (len(item.vertices), item.color, item.opacity)
        case Balls():
            extra = (item.opacity,)
        case Segments():
            extra = (item.width_px,)
        case Label():
            extra = ()
        case Textured():
            extra = (item.key,)
    return (type(item), _size(item), *extra)


def _same(item: SceneItem, other: SceneItem | None) -> bool:
    """Whether a node that shows ``item`` also shows ``other``; viser compares too, but slowly."""
    seen, known = vars(item), vars(other)
    return all(seen[name] is known[name] or np.array_equal(seen[name], known[name]) for name in _SHOWN[type(item)])


_SHOWN: dict[type[SceneItem], tuple[str, ...]] = {
    Points: ("positions", "colors", "radius_m"),
    Segments: ("points", "colors"),
    Balls: ("centers", "radii_m", "colors"),
    Mesh: ("vertices", "faces"),
    Textured: ("map_from_mesh",),
    Label: ("position", "text"),
}
"""Fields of an item that a node can follow without being added again."""


def _changing(item: SceneItem) -> dict[str, Any]:
    """The properties of a node that follow the item."""
    match item:
        case Points() if not _round(item):
            return {"points": np.float32(item.positions), "colors": item.colors, "point_size": 2.0 * item.radius_m}
        case Points():
            return _instances(item.positions, np.full(len(item.positions), item.radius_m), item.colors)
        case Segments():
            colors = np.repeat(light_bytes(item.colors)[:, None], 2, axis=1)
            return {"points": np.float32(item.points), "colors": colors}
        case Balls():
            return _instances(item.centers, item.radii_m, item.colors)
        case Mesh():
            return {"vertices": np.float32(item.vertices), "faces": np.uint32(item.faces)}
        case Textured():
            turn = item.map_from_mesh[:, :3]
            scale = float(np.cbrt(np.linalg.det(turn)))
            wxyz = vtf.SO3.from_matrix(turn / scale).wxyz
            return {"wxyz": wxyz, "position": item.map_from_mesh[:, 3], "scale": scale}
        case Label():
            return {"text": item.text, "position": item.position}


def _round(item: Points) -> bool:
    """Whether dots are drawn as spheres, and not as a point cloud."""
    return len(item.positions) <= MAX_BATCHED


def _dot_radii_m(item: Points, eye: np.ndarray, in_camera: bool) -> np.ndarray:
    """Radii (K,) of dots for a viewer at ``eye`` (3,), who may be inside a camera."""
    largest = (LARGEST_DOT_INSIDE if in_camera else LARGEST_DOT) * (HALO if item.rim else 1.0)
    return np.minimum(item.radius_m, largest * np.linalg.norm(item.positions - eye, axis=1))


def _resized(handle: Any, item: Points, seen_from: tuple[np.ndarray, bool]) -> bool:
    """Whether a node of dots has to change for a viewer there."""
    wanted, now = _dot_radii_m(item, *seen_from), handle.batched_scales
    return bool(np.any(np.abs(wanted - now) > RESIZED * now))


def _instances(positions: np.ndarray, radii_m: np.ndarray, colors: np.ndarray) -> dict[str, Any]:
    return {
        "batched_positions": np.float32(positions),
        "batched_scales": np.float32(radii_m),
        "batched_colors": light_bytes(colors),
    }


def _add(scene: viser.SceneApi, item: SceneItem, glb: bytes | None, label_scale: float) -> Any:
    name, props = f"/{item.name}", _changing(item)
    match item:
        case Points() if "points" in props:
            return scene.add_point_cloud(name, point_shape="circle", precision="float32", **props)
        case Points():
            fine = len(item.positions) <= MAX_ROUND
            return _add_batch(scene, name, 2 if fine else 1, None, props, "back" if item.rim else "front")
        case Segments():
            return scene.add_line_segments(name, thickness=item.width_px, thickness_units="screen", **props)
        case Balls():
            return _add_batch(scene, name, 3, item.opacity, props)
        case Mesh():
            return scene.add_mesh_simple(
                name,
                color=surface_bytes(np.array(item.color, np.uint8)),
                opacity=item.opacity,
                cast_shadow=False,
                receive_shadow=False,
                **props,
            )
        case Textured():
            assert glb is not None
            return scene.add_glb(name, glb, cast_shadow=False, receive_shadow=False, **props)
        case Label():
            return scene.add_label(name, font_screen_scale=label_scale, anchor="center-center", **props)


def _add_batch(
    scene: viser.SceneApi,
    name: str,
    subdivisions: int,
    opacity: float | None,
    props: dict[str, Any],
    side: Literal["front", "back"] = "front",
) -> Any:
    vertices, faces = icosphere(subdivisions)
    upright = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(props["batched_positions"]), 1))
    return scene.add_batched_meshes_simple(
        name,
        vertices,
        faces,
        batched_wxyzs=upright,
        opacity=opacity,
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
        side=side,
        # Many translucent surfaces cover each other; this material takes a third of the other's time without a GPU.
        material="standard" if opacity is None else "toon3",
        **props,
    )
