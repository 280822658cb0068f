"""How things look on the screen: colours that arrive as the legend shows them, and meshes with a picture on them."""

from typing import Any

import numpy as np
from PIL import Image

from spherloc.types import ByteArray, FloatArray

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
    """Linear bytes (..., 3) for lines and batched meshes that show the sRGB bytes ``colors`` (..., 3)."""
    return _bytes(_before_filmic(colors))


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
    """The mesh with its picture (H, W, 3 or 4), unlit and seen from both sides, in the colours of the picture."""
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
    # WebP is a fifth of PNG; without light and shadow, the picture keeps its own.
    return export_glb(trimesh.Scene(mesh), extension_webp=True, tree_postprocessor=_unlit)


def _unlit(tree: dict[str, Any]) -> None:
    for material in tree["materials"]:
        material.setdefault("extensions", {})[UNLIT] = {}
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), UNLIT})
