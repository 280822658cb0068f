"""The worlds themselves: routes, meshes for a viewer, the cache of their pictures."""

import io
import shutil

import cv2
import numpy as np
import pytest
import trimesh
from world_cameras import camera

from spherloc.errors import InputError
from spherloc.geometry import camera_centre
from spherloc.worlds import WORLDS, Conditions, build_world, image_path, render, stored_range
from spherloc.worlds.conditions import CLEAR
from spherloc.worlds.mesh import MAX_BYTES
from spherloc.worlds.render import draw

KINDS = sorted(WORLDS)


@pytest.mark.parametrize("kind", KINDS)
def test_route(kind):
    world = build_world(kind)
    poses = world.route(40)
    centres = np.array([camera_centre(place) for place in poses])
    rotations = poses[:, :, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (40, 3, 3)), atol=1e-12
    )
    assert (np.linalg.det(rotations) > 0).all()
    np.testing.assert_allclose(rotations[:, 1], np.broadcast_to([0.0, 0.0, -1.0], (40, 3)), atol=1e-12)  # y is down
    ahead = np.diff(centres, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", ahead, rotations[:-1, 2]) > 0.7).all()  # it looks where it goes
    left = world.route(40, offset_m=0.5)
    steps = np.array([camera_centre(place) for place in left]) - centres
    np.testing.assert_allclose(np.einsum("ij,ij->i", steps, rotations[:, 0]), -0.5, atol=1e-9)
    turned = world.route(40, heading_deg=90.0)
    np.testing.assert_allclose(turned[:, 2, :3], -rotations[:, 0], atol=1e-12)  # to the left


@pytest.mark.parametrize("kind", KINDS)
def test_the_way_is_free(kind):
    """Nobody walks through walls, furniture or trees."""
    world = build_world(kind)
    for place in world.route(15):
        assert np.nanmin(draw(world, camera("equirectangular", width=64, height=32), place).range_m) > 0.2


@pytest.mark.parametrize("kind", KINDS)
def test_glb_is_the_mesh(kind):
    world = build_world(kind)
    content = world.glb()
    assert content is world.glb()  # a viewer knows by this that it has it already
    assert len(content) <= 1.1 * MAX_BYTES
    scene = trimesh.load_scene(io.BytesIO(content), file_type="glb")
    np.testing.assert_allclose(
        scene.bounds, [world.mesh.vertices.min(axis=0), world.mesh.vertices.max(axis=0)], atol=1e-4
    )
    (geometry,) = scene.geometry.values()
    assert len(geometry.faces) == len(world.mesh.faces)
    assert min(geometry.visual.material.baseColorTexture.size) >= 192


@pytest.mark.parametrize("kind", KINDS)
def test_seeds_differ(kind):
    first, other = build_world(kind, 0), build_world(kind, 1)
    assert first.provenance
    assert first.atlas.texels.shape != other.atlas.texels.shape or (first.atlas.texels != other.atlas.texels).any()


def test_unknown_worlds():
    with pytest.raises(InputError, match="no world 'moon'; there are street, apartment, campus"):
        build_world("moon")
    with pytest.raises(InputError, match="seed is -1"):
        build_world("street", -1)
    with pytest.raises(InputError, match="count from 1"):
        build_world("street").route(0)
    with pytest.raises(InputError, match="shares from 0 to 1"):
        build_world("street").route(3, start=float("nan"))


@pytest.fixture
def cached(monkeypatch, tmp_path):
    """A folder for the cache, and what is rendered into it."""
    monkeypatch.setenv("SPHERLOC_CACHE", str(tmp_path / "cache"))
    world, cam = build_world("apartment"), camera("equirectangular", width=64, height=32)
    return world, cam, world.route(1, start=0.3)[0]


def damaged(content, how):
    if how == "empty":
        return b""
    if how == "cut":
        return content[: len(content) // 2]
    flipped = bytearray(content)
    for at in range(len(content) // 3, len(content), max(1, len(content) // 40)):
        flipped[at] ^= 0xFF
    return bytes(flipped)


@pytest.mark.parametrize("suffix", [".png", ".npz"])
@pytest.mark.parametrize("how", ["empty", "cut", "flipped", "missing", "other"])
def test_damaged_cache_is_drawn_again(cached, suffix, how):
    first = render(*cached)
    path = image_path(*cached)
    assert path.is_file()
    file = path.with_suffix(suffix)
    good = file.read_bytes()
    if how == "missing":
        file.unlink()
    elif how == "other" and suffix == ".png":
        cv2.imwrite(str(file), np.zeros((5, 5, 3), np.uint8))
    elif how == "other":
        np.savez(file, range_m=np.zeros((5, 5), np.float32))
    else:
        file.write_bytes(damaged(good, how))
    again = render(*cached)
    assert (again.image == first.image).all()
    np.testing.assert_array_equal(again.range_m, first.range_m)
    assert file.read_bytes() == good


def test_cache_is_used_and_tells_pictures_apart(cached, monkeypatch):
    world, cam, place = cached
    first = render(world, cam, place)
    marked = first.image.copy()
    marked[0, 0] = (1, 2, 3)
    cv2.imwrite(str(image_path(world, cam, place)), marked)
    assert render(world, cam, place).image[0, 0].tolist() == [1, 2, 3]  # read, not drawn
    others = [
        image_path(build_world("apartment", 1), cam, place),
        image_path(world, camera("equirectangular", width=66, height=33), place),
        image_path(world, cam, place + 1e-6),
        image_path(world, cam, place, Conditions(noise=1)),
        image_path(world, cam, place, CLEAR, 1),
    ]
    assert len({*others, image_path(world, cam, place)}) == 6


def test_without_a_cache(cached, monkeypatch, tmp_path):
    file = tmp_path / "a file"
    file.write_text("")
    monkeypatch.setenv("SPHERLOC_CACHE", str(file))  # where no folder can be made
    picture = render(*cached)
    assert picture.image.shape == (32, 64, 3)
    assert stored_range(image_path(*cached), cached[1]) is None
    shutil.rmtree(tmp_path / "cache", ignore_errors=True)
