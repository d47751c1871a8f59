"""Draws thumbnails of a bake: a panorama, and spheres that mirror its levels, through one tone curve."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.engines.presets import Engine
from whitefurnace.errors import InputError, UnsupportedError
from whitefurnace.files import write_png
from whitefurnace.inspection.contents import contents
from whitefurnace.prefiltering.reading import taps
from whitefurnace.rendering.shading import Lights, engine_in, level, read_lights, sphere, srgb
from whitefurnace.sphere.environments import cube_solid_angles
from whitefurnace.sphere.grids import cube_centres, latlong_centres
from whitefurnace.sphere.harmonics import irradiance_at

CELL = 64
"""Pixels of a sphere's cell, and rows of the panorama. A thumbnail of four levels has 448 × 64 pixels and 30 to 50 KB.
"""

FINE = 2 * CELL
"""Pixels with which a sphere is drawn. Its rim mirrors half of the world, and each pixel that is kept is a mean of
four."""

FACE = 32
"""Texels of a face edge from which thumbnails are drawn. The middle of a sphere of CELL pixels shows 25 of them."""

MOST_SPHERES = 12
LOOK = 1
"""Version of the thumbnails' look. Raise it when they change, so that existing ones are made again."""

WORLD = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
Matrix = tuple[tuple[int, int, int], ...]


def tone(linear: np.ndarray, exposure: float) -> np.ndarray:
    """Return radiance times `exposure` as sRGB in [0, 1], through the filmic curve of [Narkowicz2015].

    The curve is x(2.51x + .03) / (x(2.43x + .59) + .14). It reaches 1 at x = 7.2 and is cut there.
    """
    x = np.clip(np.nan_to_num(linear) * exposure, 0, 1e6)  # its squares are numbers
    return srgb(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14))


def exposure_of(texels: np.ndarray) -> float:
    """Return the factor that brings the middle of a level (6, s, s, 3) to a grey of .18.

    The middle is the log-average of luminance over the sphere [Reinhard2002, eq. 1], or a quarter of the mean where
    that is more. So rough levels, whose values are near the mean, are not burnt out by a lamp in a dark room or a sun.
    """
    luminance = np.maximum(texels.astype(np.float64) @ (0.2126, 0.7152, 0.0722), 0)
    weights = np.broadcast_to(cube_solid_angles(texels.shape[1]), luminance.shape) / (4 * math.pi)
    mean = float((luminance * weights).sum())
    if not mean > 0:
        return 1.0
    average = math.exp(float((np.log(np.maximum(luminance, 1e-4 * mean)) * weights).sum()))  # black has no logarithm
    return 0.18 / max(average, mean / 4)


def thumbnail(levels: Sequence[np.ndarray], matte: np.ndarray, matrix: Matrix = WORLD) -> np.ndarray:
    """Draw a picture (CELL, width, 4) uint8 in sRGB: a panorama, a metal sphere for each level, and a matte sphere.

    levels: cubes (6, s, s, 3). The panorama shows the first level with +X in its middle; the spheres are seen along -z
    and mirror their level. matte: irradiance (m, 3) at `normals()`. matrix: maps world directions to those of the
    cubes.
    """
    cubes = [_reduced(texels) for texels in levels[:MOST_SPHERES]]
    exposure = exposure_of(cubes[0])
    index, cover, _ = sphere(FINE)
    picture = np.zeros((CELL, (3 + len(cubes)) * CELL, 4), np.float32)
    picture[:, : 2 * CELL, :3] = tone(_read(cubes[0], "panorama", matrix), exposure).reshape(CELL, 2 * CELL, 3)
    picture[:, : 2 * CELL, 3] = 1
    for k, shown in enumerate([*(_read(cube, "mirror", matrix) for cube in cubes), matte], 2):
        cell = np.zeros((FINE * FINE, 4), np.float32)
        cell[index, :3] = tone(shown, exposure) * cover[:, None]
        cell[index, 3] = cover
        mean = _halved(cell.reshape(FINE, FINE, 4))
        mean[..., :3] /= np.maximum(mean[..., 3:], 1e-6)  # a PNG's colour is not multiplied by its alpha
        picture[:, k * CELL : (k + 1) * CELL] = mean
    return np.asarray(np.rint(picture * 255), np.uint8)


def normals() -> np.ndarray:
    """Return the normals (3, m) of the pixels of a sphere, drawn with twice as many pixels on a side as are kept."""
    return sphere(FINE)[2]


def write_thumbnail(path: str | os.PathLike[str], texels: tuple[Sequence[np.ndarray], np.ndarray, Matrix]) -> None:
    """Write the thumbnail of the result of `read_thumbnail` as a PNG. Raises FileError."""
    write_png(path, thumbnail(*texels), effort=5)  # a fifth of the time of 9, for 2 to 4 % more bytes


def read_thumbnail(manifest: Path, stated: Mapping[str, Any]) -> tuple[Sequence[np.ndarray], np.ndarray, Matrix]:
    """Read the data of a thumbnail: (levels, irradiance, axes) from the files of the first engine that has a chain.

    `raw` comes first. If no engine has a chain, they come from an image. stated: the content of the manifest. Raises
    FileError and InputError for files that are missing, changed or not valid, and UnsupportedError where none can be
    decoded.
    """
    recipe = stated.get("recipe")
    names = recipe.get("for") if isinstance(recipe, Mapping) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise InputError(f"{manifest} names no engine that it was baked for")
    why: UnsupportedError | None = None
    for name in sorted(names, key=lambda name: (name != "raw", name != "exr", names.index(name))):
        engine, folder, stem = engine_in(manifest, name)
        try:
            lights = read_lights(engine, folder, stem)
        except UnsupportedError as error:  # it filters an image itself, or its format needs a package
            why = error
            if not engine.holding("environment"):
                continue
            image = contents(folder / engine.holding("environment")[0].name.replace("{stem}", stem))
            if image.kind != "lat-long" or not image.levels:
                continue
            return [_of_latlong(image.levels[0].texels[..., :3])], _harmonics(manifest, stated), WORLD
        levels = [texels if texels.ndim == 4 else _of_octahedral(texels, lights.border) for texels in lights.levels]
        return levels, _matte(manifest, stated, engine, lights), engine.matrix
    assert why is not None
    raise why


def _matte(manifest: Path, stated: Mapping[str, Any], engine: Engine, lights: Lights) -> np.ndarray:
    if lights.irradiance is None:
        return _harmonics(manifest, stated)
    return _read(_reduced(lights.irradiance), "normal", engine.matrix)


def _harmonics(manifest: Path, stated: Mapping[str, Any]) -> np.ndarray:
    """Return E/π at a sphere's normals, (m, 3), from the coefficients that every manifest has."""
    sh = stated.get("sh")
    try:
        values = np.array(sh["coefficients"] if isinstance(sh, Mapping) else None, np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape != (9, 3):
        raise InputError(f"{manifest} has no 9 × 3 coefficients of harmonics")
    return np.maximum(irradiance_at(values, normals()), 0)


def _of_octahedral(texels: np.ndarray, border: int) -> np.ndarray:
    """A cube of FACE² texels per face, read from an octahedral map in the same axes."""
    d = cube_centres(FACE, np.arange(6 * FACE * FACE))
    return level(texels, d, border).reshape(6, FACE, FACE, 3)


def _of_latlong(texels: np.ndarray) -> np.ndarray:
    """A cube of FACE² texels per face, read from a lat-long image whose rows are reduced to 2 FACE by means of four."""
    while texels.shape[0] > 2 * FACE and texels.shape[0] % 2 == 0 and texels.shape[1] % 2 == 0:
        texels = _halved(texels.astype(np.float32))
    rows, columns = texels.shape[:2]
    x, y, z = cube_centres(FACE, np.arange(6 * FACE * FACE))
    row = np.minimum(np.arccos(np.clip(y, -1, 1)) / math.pi * rows, rows - 1).astype(int)
    column = ((np.arctan2(z, x) / (2 * math.pi) + 0.5) * columns).astype(int) % columns
    return np.asarray(texels[row, column].reshape(6, FACE, FACE, 3))


def _reduced(texels: np.ndarray) -> np.ndarray:
    """Return a cube with a face edge of at most FACE texels, by means of four.

    NaN becomes 0, and infinite values become the largest finite one.
    """
    texels = np.asarray(texels, np.float32)
    finite = np.isfinite(texels)
    if not finite.all():
        texels = np.nan_to_num(texels, posinf=float(texels.max(initial=0.0, where=finite)), neginf=0.0)
    while texels.shape[1] > FACE and texels.shape[1] % 2 == 0:
        texels = _halved(texels)
    return texels


def _halved(texels: np.ndarray) -> np.ndarray:
    """Means (…, h/2, w/2, c) of 2 × 2 values (…, h, w, c)."""
    return np.asarray(
        (texels[..., ::2, ::2, :] + texels[..., 1::2, ::2, :] + texels[..., ::2, 1::2, :] + texels[..., 1::2, 1::2, :])
        / 4
    )


def _read(texels: np.ndarray, what: str, matrix: Matrix) -> np.ndarray:
    """A cube read seamlessly in the directions `what` ("panorama", "mirror" or "normal"): (m, 3)."""
    index, weights = _taps(texels.shape[1], what, matrix)
    return np.asarray(np.einsum("km,kmc->mc", weights, texels.reshape(-1, 3)[index]))


@lru_cache(maxsize=64)
def _taps(size: int, what: str, matrix: Matrix) -> tuple[np.ndarray, np.ndarray]:
    if what == "panorama":
        d = latlong_centres(CELL, 2 * CELL, np.arange(2 * CELL * CELL))
    else:
        d = normals()
        d = 2 * d[2] * d - np.array([[0.0], [0.0], [1.0]]) if what == "mirror" else d
    index, weights = taps(size, np.asarray(matrix, np.float64) @ d)
    return index.astype(np.int32), weights.astype(np.float32)
