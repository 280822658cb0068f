"""A mesh with a picture on it as a binary glTF, the only form in which viser takes textures."""

from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from spherloc_viz.app.stage.colors import surface_bytes

UNLIT = "KHR_materials_unlit"


def textured_glb(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, image: np.ndarray) -> bytes:
    """The mesh with its picture (H, W, 3 or 4), unlit and seen from both sides, in the colours of the picture."""
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
