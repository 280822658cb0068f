"""Cars, people and boxes that stand about in one picture and not in the map."""

from itertools import pairwise

import numpy as np

from spherloc.types import FloatArray
from spherloc.worlds import paint
from spherloc.worlds.mesh import MeshBuilder, joined, xyz
from spherloc.worlds.paint import Canvas
from spherloc.worlds.rays import RayScene
from spherloc.worlds.tiles import Tiles
from spherloc.worlds.world import Lane, World

CLEAR_M = {"car": 4.5, "person": 1.6, "box": 1.8}
"""Nothing stands closer to the camera."""
FARTHEST_M = 24.0
PAINTS = ((0.75, 0.1, 0.08), (0.1, 0.2, 0.5), (0.85, 0.85, 0.85), (0.12, 0.12, 0.13), (0.45, 0.5, 0.5), (0.8, 0.6, 0.1))


def with_occluders(world: World, centre: FloatArray, count: int, seed: int) -> RayScene:
    """The world with ``count`` things around a camera at ``centre`` (3,); the world itself without any."""
    if count == 0:
        return world.rays
    rng = np.random.default_rng([world.seed, seed, 29])
    builder = MeshBuilder(world.atlas)
    weights = np.array([lane.weight for lane in world.lanes])
    for _ in range(count):
        lane = world.lanes[int(rng.choice(len(world.lanes), p=weights / weights.sum()))]
        place, ahead = _place(world, lane, centre, rng)
        turn = float(np.arctan2(ahead[1], ahead[0]))
        match lane.sort:
            case "car":
                add_car(builder, rng, place, turn)
            case "person":
                add_person(builder, rng, place)
            case _:
                add_boxes(builder, rng, place)
    return RayScene(joined([world.mesh, builder.mesh()]))


def _place(world: World, lane: Lane, centre: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A spot on the ground (3,) in the lane, neither on the camera nor out of its sight, and the lane's direction."""
    shares = np.linspace(0, 1, 400)
    path, ahead = world.along(shares)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(path))])
    spots = path + rng.uniform(*lane.offset_m, (len(path), 1)) * left
    distance = np.linalg.norm((spots - centre)[:, :2], axis=1)
    free = np.flatnonzero((distance > CLEAR_M[lane.sort]) & (distance < FARTHEST_M))
    chosen = int(rng.choice(free)) if len(free) else int(distance.argmax())
    spot = spots[chosen].copy()
    spot[2] = 0.0
    return spot, ahead[chosen]


def add_car(builder: MeshBuilder, rng: np.random.Generator, place: FloatArray, turn_rad: float) -> None:
    """A car 4.3 m long, standing at ``place`` (3,) along ``turn_rad``."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    tint = np.asarray(PAINTS[int(rng.integers(len(PAINTS)))])
    half = 0.86
    # (x, z) from the rear bumper over the roof to the front bumper.
    outline = [
        (-2.1, 0.3),
        (-2.15, 0.85),
        (-1.95, 1.0),
        (-1.35, 1.45),
        (0.35, 1.47),
        (1.05, 1.0),
        (2.0, 0.85),
        (2.15, 0.5),
    ]
    outline = [*outline, (2.1, 0.3)]
    glass = {2, 4}
    for number, ((x0, z0), (x1, z1)) in enumerate(pairwise(outline)):
        corners = [(x0, half, z0), (x0, -half, z0), (x1, -half, z1), (x1, half, z1)]
        tile, colour = ("car_glass", (1, 1, 1)) if number in glass else ("car_paint", tint)
        tile = "car_rear" if number == 0 else "car_front" if number == len(outline) - 2 else tile
        builder.quad(place + np.array(corners) @ axes, tile, tint=colour)
    for side in (-1, 1):
        body = np.array([(-2.15, side * half, 0.3), (2.15, side * half, 0.3), (2.15, side * half, 1.48)])
        box = [*body, (-2.15, side * half, 1.48)]
        _side(builder, place, axes, np.array(box), side, outline, tint)
        for x in (-1.3, 1.35):
            hub = place + np.array([x, side * (half + 0.01), 0.32]) @ axes
            builder.prism(hub - 0.2 * side * axes[1], hub, (0.32, 0.32), "tyre", 10)
            _disc(builder, hub, axes, side)


def _side(
    builder: MeshBuilder,
    place: FloatArray,
    axes: FloatArray,
    box: FloatArray,
    side: int,
    outline: list[tuple[float, float]],
    tint: FloatArray,
) -> None:
    """The flank: body up to the windows, and the windows themselves."""
    y = box[0, 1]
    for corners, tile, colour in (
        ([(-2.1, 0.3), (2.1, 0.3), (2.0, 0.85), (-2.15, 0.85)], "car_flank", tint),
        ([(-2.15, 0.85), (2.0, 0.85), (1.05, 1.0), (-1.95, 1.0)], "car_paint", tint),
        ([(-1.95, 1.0), (1.05, 1.0), (0.35, 1.47), (-1.35, 1.45)], "car_window", (1.0, 1.0, 1.0)),
    ):
        points = np.array([(x, y, z) for x, z in corners])
        if side > 0:
            points = points[[1, 0, 3, 2]]
        builder.quad(place + points @ axes, tile, tint=colour)


def _disc(builder: MeshBuilder, hub: FloatArray, axes: FloatArray, side: int) -> None:
    angle = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    round_ = np.column_stack([np.cos(angle), np.sin(angle)])
    rim = hub + 0.32 * (-side * round_[:, :1] * axes[0] + round_[:, 1:] * axes[2]) + 0.005 * side * axes[1]
    faces = [(0, k, k + 1) for k in range(1, 9)]
    builder.add(rim, faces, 0.5 + 0.5 * round_ * (1, -1), "wheel")


def add_person(builder: MeshBuilder, rng: np.random.Generator, place: FloatArray) -> None:
    """Somebody about 1.75 m tall, who stands at ``place`` (3,), metres."""
    tall = rng.uniform(0.93, 1.06)
    turn = rng.uniform(0, 2 * np.pi)
    across = np.array([-np.sin(turn), np.cos(turn), 0.0])
    ahead = np.array([np.cos(turn), np.sin(turn), 0.0])
    cloth, skin = rng.uniform(0.25, 1.0, 3), np.array([0.85, 0.62, 0.48]) * rng.uniform(0.45, 1.0)
    stride = rng.uniform(0.05, 0.25)
    up = np.array([0.0, 0.0, tall])
    for side in (-1, 1):
        hip = place + side * 0.09 * across + 0.86 * up
        foot = place + side * 0.1 * across + side * stride * ahead
        builder.prism(foot, hip, (0.07, 0.1), "trousers", 6)
        shoulder = place + side * 0.21 * across + 1.42 * up
        hand = place + side * 0.27 * across - side * stride * ahead + 0.8 * up
        builder.prism(hand, shoulder, (0.045, 0.065), f"shirt_{int(rng.integers(2))}", 6, tint=cloth)
    builder.prism(place + 0.82 * up, place + 1.46 * up, (0.17, 0.2), f"shirt_{int(rng.integers(2))}", 8, tint=cloth)
    builder.prism(place + 1.44 * up, place + 1.52 * up, (0.2, 0.06), "skin", 8, tint=cloth)
    builder.blob(rng, place + 1.64 * up, (0.1, 0.1, 0.13), "skin", 0.02, tint=skin, fine=1)


def add_boxes(builder: MeshBuilder, rng: np.random.Generator, place: FloatArray) -> None:
    """Two parcels, one on the other, at ``place`` (3,), metres."""
    height = 0.0
    for _ in range(2):
        half = np.append(rng.uniform(0.18, 0.36, 2), 0.0)
        rise = rng.uniform(0.3, 0.55)
        low = place - half + xyz(0, 0, height)
        builder.box(low, place + half + xyz(0, 0, height + rise), "cardboard", float(rng.uniform(0, np.pi)))
        height += rise


def occluder_tiles(rng: np.random.Generator) -> Tiles:
    """Paint is white where a tint is to give the colour."""
    cardboard = paint.mottle(paint.plain(128, 128, (0.66, 0.49, 0.31)), rng, 12, 0.06)
    paint.rectangle(cardboard, (0.42, 0, 0.58, 1), (0.80, 0.70, 0.48))
    paint.text(cardboard, "FRAGILE", (0.06, 0.62, 0.94, 0.86), (0.55, 0.12, 0.10), 2)
    tiles: Tiles = {
        "skin": ("person", paint.finish(paint.mottle(paint.plain(32, 32, (0.95, 0.92, 0.9)), rng, 4))),
        "trousers": ("person", paint.finish(paint.mottle(paint.plain(64, 32, (0.16, 0.19, 0.28)), rng, 12, 0.3))),
        "cardboard": ("box", paint.finish(cardboard)),
    }
    for number in range(2):
        shirt = paint.mottle(paint.plain(64, 64, (0.85, 0.85, 0.85)), rng, 12, 0.15)
        for stripe in range(8 * number):
            paint.rectangle(shirt, (0, stripe / 8, 1, stripe / 8 + 0.05), (0.25, 0.25, 0.3))
        tiles[f"shirt_{number}"] = ("person", paint.finish(shirt))
    return tiles | _car_tiles(rng)


def _car_tiles(rng: np.random.Generator) -> Tiles:
    flank = paint.plain(64, 256, (0.92, 0.92, 0.92))
    for at in (0.30, 0.52, 0.74):
        paint.rectangle(flank, (at, 0.0, at + 0.006, 0.85), (0.35, 0.35, 0.35))
        paint.rectangle(flank, (at + 0.02, 0.18, at + 0.06, 0.26), (0.5, 0.5, 0.5))
    paint.rectangle(flank, (0, 0.82, 1, 1), (0.25, 0.25, 0.25))
    front = paint.plain(64, 128, (0.92, 0.92, 0.92))
    paint.rectangle(front, (0.25, 0.35, 0.75, 0.7), (0.1, 0.1, 0.1))
    rear = paint.plain(64, 128, (0.92, 0.92, 0.92))
    for ends, colour in ((front, (1.0, 0.98, 0.85)), (rear, (0.85, 0.08, 0.05))):
        for left in (0.04, 0.78):
            paint.rectangle(ends, (left, 0.2, left + 0.18, 0.5), colour)
        paint.rectangle(ends, (0.36, 0.55, 0.64, 0.8), (0.97, 0.97, 0.97))
        paint.text(ends, f"SL {int(rng.integers(100, 999))}", (0.37, 0.56, 0.63, 0.79), (0.05, 0.05, 0.08), 1)
    glass = paint.plain(32, 64, (0.10, 0.13, 0.15))
    glass += np.linspace(0.25, 0.0, 32, dtype=np.float32)[:, None, None]
    window = glass.copy()
    paint.rectangle(window, (0.46, 0, 0.52, 1), (0.05, 0.05, 0.05))
    paintwork = paint.mottle(paint.plain(32, 64, (0.92, 0.92, 0.92)), rng, 3, 0.04)
    return {
        "car_paint": ("car", paint.finish(paintwork)),
        "car_flank": ("car", paint.finish(flank)),
        "car_front": ("car", paint.finish(front)),
        "car_rear": ("car", paint.finish(rear)),
        "car_glass": ("glass", paint.finish(glass)),
        "car_window": ("glass", paint.finish(window)),
        "tyre": ("car", paint.finish(paint.plain(32, 32, (0.06, 0.06, 0.06)))),
        "wheel": ("car", paint.finish(_wheel())),
    }


def _wheel() -> Canvas:
    wheel = paint.plain(64, 64, (0.05, 0.05, 0.05))
    y, x = np.mgrid[-1:1:64j, -1:1:64j]
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    wheel[(radius < 0.62) & (np.sin(5 * angle) > -0.3)] = (0.6, 0.6, 0.62)
    wheel[radius < 0.15] = (0.4, 0.4, 0.42)
    return wheel
