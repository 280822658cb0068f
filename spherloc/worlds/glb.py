"""A world's mesh as binary glTF 2.0, small enough to be sent to a browser."""

import json
import struct
from typing import Any

import cv2
import numpy as np

from spherloc.worlds.atlas import Atlas
from spherloc.worlds.mesh import Mesh

MOST_BYTES = 400_000
LEAST_TEXTURE_BYTES = 60_000
HEADER_BYTES = 2_000
FLOAT, USHORT, UINT, UBYTE = 5126, 5123, 5125, 5121


def write_glb(mesh: Mesh, atlas: Atlas) -> bytes:
    """Vertices as they are (metres, the mesh's own frame), tints as vertex colours, and the atlas as a small JPEG."""
    height, width = atlas.texels.shape[:2]
    vertices = mesh.vertices.astype(np.float32)
    uv = np.round(np.clip(mesh.uv / (width, height), 0, 1) * 65535).astype(np.uint16)
    colour = np.full((len(mesh.tint), 4), 255, np.uint8)
    colour[:, :3] = np.round(np.clip(mesh.tint, 0, 1) * 255)
    index = mesh.faces.astype(np.uint16 if len(vertices) <= 65535 else np.uint32)
    parts = [index.tobytes(), vertices.tobytes(), uv.tobytes(), colour.tobytes()]
    parts.append(_jpeg(atlas, max(LEAST_TEXTURE_BYTES, MOST_BYTES - HEADER_BYTES - sum(map(len, parts)))))
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + b"\0" * (-len(part) % 4)
    box = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
    count, whole = len(vertices), USHORT if index.itemsize == 2 else UINT
    accessors = [
        {"bufferView": 0, "componentType": whole, "count": index.size, "type": "SCALAR"},
        {"bufferView": 1, "componentType": FLOAT, "count": count, "type": "VEC3"} | box,
        {"bufferView": 2, "componentType": USHORT, "normalized": True, "count": count, "type": "VEC2"},
        {"bufferView": 3, "componentType": UBYTE, "normalized": True, "count": count, "type": "VEC4"},
    ]
    return _container(_document(accessors, views, len(binary)), binary)


def _document(accessors: list[dict[str, Any]], views: list[dict[str, Any]], length: int) -> dict[str, Any]:
    """The JSON part: one mesh with one matt material."""
    attributes = {"POSITION": 1, "TEXCOORD_0": 2, "COLOR_0": 3}
    matt = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {
        "asset": {"version": "2.0", "generator": "spherloc"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 0, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": matt}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/jpeg"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    header = json.dumps(document, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    chunks = struct.pack("<I4s", len(header), b"JSON") + header + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _jpeg(atlas: Atlas, most_bytes: int) -> bytes:
    """The largest of the atlas's smaller copies that fits, at the best quality that fits."""
    content = b""
    for image in atlas.pyramid[1:4]:
        for quality in (85, 70, 50):
            done, data = cv2.imencode(".jpg", image[..., 2::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
            content = data.tobytes() if done else b""
            if len(content) <= most_bytes:
                return content
    return content
