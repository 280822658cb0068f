"""A world's mesh as binary glTF 2.0, small enough to be sent to a browser."""

import json
import struct

import cv2
import numpy as np

from spherloc.worlds.atlas import Atlas
from spherloc.worlds.mesh import Mesh

MOST_BYTES = 400_000
LEAST_TEXTURE_BYTES = 60_000
FLOAT, USHORT, UINT, UBYTE = 5126, 5123, 5125, 5121


def write_glb(mesh: Mesh, atlas: Atlas) -> bytes:
    """Vertices as they are (metres, the mesh's own frame), tints as vertex colours, and the atlas as a small JPEG."""
    height, width = atlas.texels.shape[:2]
    uv = np.round(np.clip(mesh.uv / (width, height), 0, 1) * 65535).astype(np.uint16)
    colour = np.full((len(mesh.tint), 4), 255, np.uint8)
    colour[:, :3] = np.round(np.clip(mesh.tint, 0, 1) * 255)
    small = len(mesh.vertices) <= 65535
    parts = [
        mesh.faces.astype(np.uint16 if small else np.uint32).tobytes(),
        mesh.vertices.astype(np.float32).tobytes(),
        uv.tobytes(),
        colour.tobytes(),
    ]
    parts.append(_jpeg(atlas, max(LEAST_TEXTURE_BYTES, MOST_BYTES - 3000 - sum(map(len, parts)))))
    views, binary = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)})
        binary += part + b"\0" * (-len(part) % 4)
    vertices = mesh.vertices.astype(np.float32)
    document = {
        "asset": {"version": "2.0", "generator": "spherloc"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 1, "TEXCOORD_0": 2, "COLOR_0": 3}, "indices": 0, "material": 0}
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                }
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 4, "mimeType": "image/jpeg"}],
        "accessors": [
            {"bufferView": 0, "componentType": USHORT if small else UINT, "count": mesh.faces.size, "type": "SCALAR"},
            {
                "bufferView": 1,
                "componentType": FLOAT,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 2, "componentType": USHORT, "normalized": True, "count": len(uv), "type": "VEC2"},
            {"bufferView": 3, "componentType": UBYTE, "normalized": True, "count": len(uv), "type": "VEC4"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    header = json.dumps(document, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    length = 12 + 8 + len(header) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, length),
            struct.pack("<I4s", len(header), b"JSON"),
            header,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        ]
    )


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
