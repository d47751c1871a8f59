"""glTF files of a square a material, for tests."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.files.png import encode_png

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
WHOLE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


def uri(data: bytes, mime: str = "application/octet-stream") -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"


def document(
    materials: list[dict[str, Any]], images: list[np.ndarray] | tuple[()] = (), uv: np.ndarray = WHOLE
) -> dict[str, Any]:
    """A square a material, 2 m wide, with its images as data URIs."""
    materials = json.loads(json.dumps(materials))  # tests change what they are given
    blob = SQUARE.tobytes() + uv.astype(np.float32).tobytes() + np.array([0, 1, 2, 0, 2, 3], np.uint16).tobytes()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": k}
                    for k in range(len(materials))
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [-1, -1, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": n} for at, n in ((0, 48), (48, 32), (80, 12))],
        "buffers": [{"byteLength": len(blob), "uri": uri(blob)}],
        "materials": materials,
        "images": [{"uri": uri(encode_png(image), "image/png")} for image in images],
        "textures": [{"source": k} for k in range(len(images))],
    }


def written(path: Path, doc: dict[str, Any]) -> Path:
    path.write_text(json.dumps(doc))
    return path


def as_glb(path: Path, doc: dict[str, Any]) -> Path:
    """With the buffer and the images in the binary chunk."""
    doc = json.loads(json.dumps(doc))
    blob = base64.b64decode(doc["buffers"][0].pop("uri").partition(",")[2])
    for image in doc["images"]:
        data = base64.b64decode(image.pop("uri").partition(",")[2])
        blob += bytes(-len(blob) % 4)
        image |= {"bufferView": len(doc["bufferViews"]), "mimeType": "image/png"}
        doc["bufferViews"].append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob += data
    doc["buffers"][0]["byteLength"] = len(blob)
    text = json.dumps(doc).encode()
    chunks = [(0x4E4F534A, text + b" " * (-len(text) % 4)), (0x004E4942, blob + bytes(-len(blob) % 4))]
    body = b"".join(struct.pack("<2I", len(data), kind) + data for kind, data in chunks)
    path.write_bytes(struct.pack("<4s2I", b"glTF", 2, 12 + len(body)) + body)
    return path


def helmet(path: Path) -> Path:
    """The scene of docs/scene.md: a metal whose roughness is a texture's, rubber, and a visor of rough glass."""
    wear = np.full((32, 32, 3), 255, np.uint8)
    wear[..., 1] = np.linspace(70, 160, 32).astype(np.uint8)[:, None]
    visor = {
        "KHR_materials_transmission": {"transmissionFactor": 1},
        "KHR_materials_ior": {"ior": 1.58},
        "KHR_materials_volume": {"thicknessFactor": 0.004},
    }
    return as_glb(
        path,
        document(
            [
                {
                    "name": "shell",
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [0.9, 0.6, 0.3, 1],
                        "metallicRoughnessTexture": {"index": 0},
                    },
                },
                {
                    "name": "rubber",
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [0.05, 0.05, 0.05, 1],
                        "metallicFactor": 0,
                        "roughnessFactor": 0.8,
                    },
                },
                {
                    "name": "visor",
                    "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.35},
                    "extensions": visor,
                },
            ],
            [wear],
        ),
    )
