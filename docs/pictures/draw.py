"""Draws the first picture of the README, with `whitefurnace bake` and `whitefurnace render`.

    python docs/pictures/draw.py ENVIRONMENT [--rotate DEG] [--exposure EV]

The spheres are the materials of a small glTF that this script writes. `render --truth` stores the picture that Filament
shows as linear radiance; here it is reduced to half its size and goes through one exposure and one tone curve.
"""

from __future__ import annotations

import argparse
import base64
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

HERE = Path(__file__).resolve().parent
COLUMNS, SIZE = 6, 152
ROWS = (
    ("gold", (1.0, 0.71, 0.29), 1),
    ("copper", (0.93, 0.52, 0.38), 1),
    ("steel", (0.62, 0.62, 0.63), 1),
    ("lacquer", (0.55, 0.02, 0.03), 0),
)


def scene(rows: list[str]) -> dict:
    """A glTF with a material for each sphere, all on one triangle."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    materials = [
        {
            "name": f"{name} {k}",
            "pbrMetallicRoughness": {
                "baseColorFactor": [*color, 1],
                "metallicFactor": metal,
                "roughnessFactor": k / (COLUMNS - 1),
            },
        }
        for name, color, metal in ROWS
        if name in rows
        for k in range(COLUMNS)
    ]
    uri = "data:application/octet-stream;base64," + base64.b64encode(corners.tobytes()).decode()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "buffers": [{"byteLength": corners.nbytes, "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": corners.nbytes}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]}
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": k} for k in range(len(materials))]}],
        "materials": materials,
    }


def tone(linear: np.ndarray, exposure: float) -> np.ndarray:
    """The filmic curve of [Narkowicz2015] and sRGB's transfer function, as uint8."""
    x = np.clip(linear * 2.0**exposure, 0, 1e6)
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return np.rint(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)


def layer(path: Path, name: str) -> np.ndarray:
    """(height, width, 3) of one layer of an EXR."""
    image = oiio.ImageBuf(str(path))
    pixels = image.get_pixels(oiio.FLOAT)
    names = list(image.spec().channelnames)
    return np.stack([pixels[..., names.index(f"{name}.{c}")] for c in "RGB"], -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("environment", type=Path)
    parser.add_argument("--rotate", default="0")
    parser.add_argument("--exposure", type=float, default=-0.8)
    parser.add_argument("--rows", default="gold,steel,lacquer")
    parser.add_argument("-o", "--output", type=Path, default=HERE / "spheres.png")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        gltf, picture = Path(folder, "spheres.gltf"), Path(folder, "picture.exr")
        gltf.write_text(json.dumps(scene(options.rows.split(","))))
        tool = [sys.executable, "-m", "whitefurnace"]
        source = str(options.environment.resolve())
        subprocess.run(
            [
                *tool,
                "bake",
                source,
                "-o",
                folder,
                "--for",
                "filament",
                "--size",
                "1024",
                "--rotate",
                options.rotate,
                "--quiet",
            ],
            check=True,
        )
        subprocess.run(
            [
                *tool,
                "render",
                str(Path(folder, options.environment.stem + ".json")),
                "--for",
                "filament",
                "-o",
                str(picture),
                "--truth",
                source,
                "--scene",
                str(gltf),
                "--columns",
                str(COLUMNS),
                "--size",
                str(2 * SIZE),
                "--tolerance",
                ".5",
                "--certify",
                "0",
            ],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        linear = layer(picture, "engine")
    height, width = linear.shape[0] // 2, linear.shape[1] // 2
    pixels = tone(linear, options.exposure).reshape(height, 2, width, 2, 3).mean((1, 3))
    oiio.ImageBuf(np.ascontiguousarray(np.rint(pixels).astype(np.uint8))).write(str(options.output))
    print(f"{options.output}: {options.output.stat().st_size} bytes")


if __name__ == "__main__":
    main()
