"""Environments: an image, six faces or an array, checked and turned into a lat-long or a cube, with statistics.

Cubes have the GL-direct layout.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, InputError, UsageError
from whitefurnace.files import (
    decode_srgb,
    digest_file,
    image_facts,
    inside,
    is_light,
    light_digest,
    light_files,
    read_image,
    read_radiance,
)

FACES = ("+X", "-X", "+Y", "-Y", "+Z", "-Z")
FACE_NAMES = (
    ("px", "nx", "py", "ny", "pz", "nz"),
    ("posx", "negx", "posy", "negy", "posz", "negz"),
    ("right", "left", "top", "bottom", "front", "back"),
)


class Cell(NamedTuple):
    """The place of a face in an image: `turns` quarter turns counter-clockwise bring it upright."""

    column: int
    row: int
    turns: int = 0


class Layout(NamedTuple):
    """A placement of faces in an image, recognized by its aspect ratio `columns` : `rows`.

    cells: cells of the faces +X -X +Y -Y +Z -Z; none for a lat-long.
    """

    name: str
    columns: int
    rows: int
    cells: tuple[Cell, ...] = ()


# Faces are seen from inside, upright as in GL-direct, and cross faces join at the edges they share on the
# sphere: +Z is in the middle with +Y above it. In a vertical cross -Z hangs below -Y, upside down.
LAYOUTS = (
    Layout("latlong", 2, 1),
    Layout("horizontal cross", 4, 3, (Cell(2, 1), Cell(0, 1), Cell(1, 0), Cell(1, 2), Cell(1, 1), Cell(3, 1))),
    Layout("vertical cross", 3, 4, (Cell(2, 1), Cell(0, 1), Cell(1, 0), Cell(1, 2), Cell(1, 1), Cell(1, 3, 2))),
    Layout("horizontal strip", 6, 1, tuple(Cell(face, 0) for face in range(6))),
    Layout("vertical strip", 1, 6, tuple(Cell(0, face) for face in range(6))),
)
_CHANNELS = "RGBA"
_BLOCK = 1 << 16  # texels looked at together: three channels in float64 stay in a core's cache
_RUN = 64  # texels of which the largest stands for all
_BRIGHTEST = 64
_KEPT_SIZE = 512  # faces of up to 2 MiB of solid angles are kept: every level and image asks for the same
_FLOAT_MAX = np.finfo(np.float32).max


@dataclass(frozen=True)
class Environment:
    """Radiance from every direction, linear Rec.709, piecewise constant over `texels`.

    texels      float32, C-contiguous: "latlong" (h, w, 3), row 0 at +Y, u = atan2(z, x)/2pi + 1/2 from left to right;
                "cube" (6, n, n, 3), GL-direct: +X -X +Y -Y +Z -Z, rows top-down
    coverage    the fourth channel, float32 (h, w) or (6, n, n) in [0, 1]; None where it is 1 everywhere
    rotation    radians in [-pi, pi] that are still to be added to the azimuth atan2(z, x) of everything
    exposure    EV by which `texels` have been multiplied already
    name        stem of the source
    layout      name of the layout it was read from: one of `LAYOUTS`, "six faces" or "cube" (an array of six faces)
    digest      sha256 of the source's bytes in hex; options are not in it
    notices     sentences about data that were converted, clamped or left out
    statistics  width and height in texels, of one face for a cube; mean (R, G, B) over the sphere; maximum, that of the
                mean of a texel's channels, and max_over_mean, its ratio to the mean (1 for black); brightest, the
                direction (x, y, z) of that texel, rotation included; brightest_share, in [0, 1], the share of the
                energy in the 64 texels with the most (0 for black)
    """

    kind: Literal["latlong", "cube"]
    texels: npt.NDArray[np.float32]
    coverage: npt.NDArray[np.float32] | None
    rotation: float
    name: str
    layout: str
    digest: str
    exposure: float = 0.0
    notices: tuple[str, ...] = ()
    statistics: dict[str, Any] = field(default_factory=dict)


def latlong_solid_angles(height: int, width: int) -> npt.NDArray[np.float64]:
    """Return the solid angle, in steradians, of one texel in each row of a lat-long: (height,).

    It is (2π/width)(cos θ0 - cos θ1) for the polar angles of the row's edges.
    """
    centre = (np.arange(height) + 0.5) * (math.pi / height)
    # As a product of sines: the difference of cosines cancels at the poles.
    return (2 * math.pi / width) * 2 * np.sin(centre) * math.sin(0.5 * math.pi / height)


def cube_solid_angles(size: int) -> npt.NDArray[np.float64]:
    """Return the solid angles, in steradians, of the texels of one cube face: (size, size), read-only.

    They are differences over the corners of atan(x y/√(1 + x² + y²)), the solid angle between the face's centre and (x,
    y).
    """
    return _kept_solid_angles(size) if size <= _KEPT_SIZE else _cube_solid_angles(size)


@lru_cache(maxsize=12)
def _kept_solid_angles(size: int) -> npt.NDArray[np.float64]:
    angles = _cube_solid_angles(size)
    angles.flags.writeable = False
    return angles


def _cube_solid_angles(size: int) -> npt.NDArray[np.float64]:
    edge = np.arange(size + 1) * (2 / size) - 1
    x, y = edge[None, :], edge[:, None]
    corner = np.arctan(x * y / np.sqrt(1 + x * x + y * y))
    return np.diff(np.diff(corner, axis=0), axis=1)


def environment(
    source: str | os.PathLike[str] | npt.NDArray[Any] | Environment,
    *,
    rotate: float = 0.0,
    exposure: float = 0.0,
    nonfinite: Literal["refuse", "zero"] = "refuse",
) -> Environment:
    """Read an environment from an image file, a folder of six faces, an array or another environment.

    source: an image in one of `LAYOUTS` (a 1 × 1 image is a constant); a .ktx, .ktx2, .dds, .env, .gltf or .glb file,
      of which level 0 is taken, a cube or such an image; a folder with six square images named px nx py ny pz nz, posx
      negx … or right left top bottom front back (front is +Z); an array (h, w) or (h, w, 1 | 3 | 4) of such an image,
      or (6, n, n) or (6, n, n, 1 | 3 | 4), of floats (linear Rec.709) or uint8 or uint16 (sRGB).
    rotate: degrees about +Y that increase the azimuth atan2(z, x) of everything. Pixels are not resampled.
    exposure: EV in [-64, 64]. Radiance is multiplied by 2^exposure.
    nonfinite: "refuse" NaN, infinite and negative values, or make them "zero" and say so in `notices`.

    Raises `UsageError` for an option out of its domain, `FileError` for what cannot be read, and `InputError` for what
    was read and is not an environment.
    """
    check_options(rotate, exposure, nonfinite)
    turn = math.radians(math.remainder(rotate, 360.0))
    zero = nonfinite == "zero"

    if isinstance(source, Environment):
        if turn == 0 and exposure == 0:
            return source
        found = replace(
            source,
            rotation=math.remainder(source.rotation + turn, 2 * math.pi),
            texels=source.texels if exposure == 0 else source.texels.copy(),
        )
    elif isinstance(source, (str, os.PathLike)):
        path = Path(source)
        before = _stamps(path)
        found = _from_folder(path, zero) if os.path.isdir(path) else _from_image(path, zero)
        _check_unchanged(path, before, found.digest)
        found = replace(found, rotation=turn)
    elif isinstance(source, np.ndarray):
        found = replace(_from_array(source, zero), rotation=turn)
    else:
        raise UsageError(
            f"an environment cannot be made from a {type(source).__name__}, "
            "a path, a numpy array or an Environment was expected"
        )
    if exposure != 0:
        _expose(found.texels, exposure, found.name)
        found = replace(found, exposure=found.exposure + exposure)
    return replace(found, statistics=statistics_of(found))


def check_options(rotate: object, exposure: object, nonfinite: object) -> None:
    """Raise `UsageError` for an option of `environment` that is out of its domain."""
    if not _is_number(rotate):
        raise UsageError(f"rotate is {rotate!r}, a finite angle in degrees was expected")
    if not _is_number(exposure) or abs(exposure) > 64:  # type: ignore[arg-type]
        raise UsageError(f"exposure is {exposure!r}, a number of EV in [-64, 64] was expected")
    if nonfinite not in ("refuse", "zero"):
        raise UsageError(f"nonfinite is {nonfinite!r}, 'refuse' or 'zero' was expected")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)


def source_files(source: str | os.PathLike[str]) -> dict[str, Path]:
    """Return the files that `environment` opens for a path, by their names relative to its folder.

    They are a file and what a glTF keeps beside it, or the six faces in a folder. Nothing else is read, hashed, sent or
    listed for an environment. Raises as `environment` does for what is not one.
    """
    path = Path(source)
    return {face.name: face for face in _face_paths(path)} if os.path.isdir(path) else light_files(path)


def source_digest(source: str | os.PathLike[str]) -> str:
    """Return the `digest` of the environment at a path, without decoding it. Raises `FileError`, `InputError`."""
    path = Path(source)
    if os.path.isdir(path):
        return _of_faces(digest_file(face) for face in _face_paths(path))
    return light_digest(path)


def extent(source: str | os.PathLike[str]) -> tuple[str, int, int]:
    """Return the shape of an environment from its header alone: ("latlong" or "cube", rows, columns).

    For a cube these are the rows and columns of a face, and for a texture the sizes of level 0. Raises the errors of
    `environment` for a header.
    """
    path = Path(source)
    if os.path.isdir(path):
        size = image_facts(_face_paths(path)[0]).height
        return "cube", size, size
    if is_light(path):
        pixels, cube, _ = read_radiance(path)
        if cube:
            return "cube", pixels.shape[1], pixels.shape[2]
        height, width = pixels.shape[:2]
    else:
        facts = image_facts(path)
        height, width = facts.height, facts.width
    layout = _layout_of((height, width), str(path))
    size = width // layout.columns
    return ("cube", size, size) if layout.cells else ("latlong", height, width)


def _of_faces(digests: Iterable[str]) -> str:
    return hashlib.sha256("".join(digests).encode()).hexdigest()


_FRESH = 2_000_000_000  # ns: the coarsest times that file systems keep (FAT), and far over a kernel's tick


def _stamps(path: Path) -> tuple[tuple[int, ...], ...] | None:
    """Return data that change when the files of a path are written to; None where they cannot be listed."""
    try:
        return tuple(
            (s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns)
            for s in (os.stat(file) for file in source_files(path).values())
        )
    except (OSError, ValueError, FileError, InputError):
        return None


def _check_unchanged(path: Path, before: tuple[tuple[int, ...], ...] | None, digest: str) -> None:
    """Refuse a source that was written to between the digest and the last pixel. Raises `FileError`.

    Otherwise the manifest would state the digest of one file for the result of another.
    """
    after = _stamps(path)
    changed = before is None or after != before
    # A second write within a tick of the clock leaves the times unchanged, so bytes are compared too.
    if not changed and max(max(s[3:]) for s in after or ((0,),)) > time.time_ns() - _FRESH:
        changed = source_digest(path) != digest
    if changed:
        raise FileError(f"{path} changed while it was read; run this again when it is whole")


def _from_image(path: Path, zero: bool) -> Environment:
    if is_light(path):
        return _from_container(path, zero)
    image = read_image(path)
    layout = _layout_of(image.pixels.shape, str(path))
    notices = list(image.notices)
    _clean(image.pixels[None], layout, str(path), zero, notices)
    return _placed(image.pixels, layout, path.stem, image.digest, notices)


def _from_container(path: Path, zero: bool) -> Environment:
    """Level 0 of a cube, or a 2-D texture in one of the layouts."""
    pixels, cube, said = read_radiance(path)
    notices = list(said)
    if cube:
        _clean(pixels, None, str(path), zero, notices)
        return _cube(pixels, path.stem, "cube", light_digest(path), notices)
    layout = _layout_of(pixels.shape, str(path))
    _clean(pixels[None], layout, str(path), zero, notices)
    return _placed(pixels, layout, path.stem, light_digest(path), notices)


def _from_array(array: npt.NDArray[Any], zero: bool) -> Environment:
    where = f"the array of shape {array.shape}"
    if array.dtype.kind != "f" and array.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{where} holds {array.dtype}, floats, uint8 or uint16 were expected")
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(np.ascontiguousarray(array).data if array.size else b"")
    cube = array.ndim in (3, 4) and array.shape[0] == 6 and array.shape[1] == array.shape[2]
    if array.ndim == (3 if cube else 2):
        array = array[..., None]
    if array.ndim != (4 if cube else 3) or array.shape[-1] not in (1, 3, 4) or array.size == 0:
        raise InputError(
            f"{where} is not an environment; (h, w), (h, w, 1 | 3 | 4), (6, n, n) or (6, n, n, 1 | 3 | 4) was expected"
        )
    with np.errstate(over="ignore"):  # a double over the range of float32 is found as inf
        pixels = decode_srgb(array) if array.dtype.kind == "u" else np.array(array, np.float32, order="C")
    notices: list[str] = []
    if cube:
        _clean(pixels, None, where, zero, notices)
        return _cube(pixels, "array", "cube", digest.hexdigest(), notices)
    layout = _layout_of(pixels.shape, where)
    _clean(pixels[None], layout, where, zero, notices)
    return _placed(pixels, layout, "array", digest.hexdigest(), notices)


def _from_folder(folder: Path, zero: bool) -> Environment:
    paths = _face_paths(folder)
    images = []
    notices: list[str] = []
    size = 0
    for path in paths:
        image = read_image(path)
        height, width, _ = image.pixels.shape
        size = size or height
        if width != height or height != size:
            raise InputError(
                f"{path} is {width} x {height}, but the six faces must be squares of one size"
                + (f", here {size} x {size}" if width == height else "")
            )
        notices += image.notices
        _clean(image.pixels[None], None, str(path), zero, notices)
        images.append(image)
    channels = 4 if any(image.pixels.shape[2] == 4 for image in images) else 3
    cube = np.ones((6, size, size, channels), np.float32)
    for face, image in zip(cube, images, strict=True):
        have = image.pixels.shape[2]
        face[..., : max(have, 3)] = image.pixels  # grey spreads over the three
    digest = _of_faces(image.digest for image in images)
    return _cube(cube, folder.resolve().name, "six faces", digest, notices)


def _face_paths(folder: Path) -> list[Path]:
    try:
        files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        raise FileError(f"cannot read {folder}: {error.strerror or error}") from error
    by_stem: dict[str, list[Path]] = {}
    for path in files:
        by_stem.setdefault(path.stem.lower(), []).append(path)
    names = max(FACE_NAMES, key=lambda names: sum(name in by_stem for name in names))
    missing = [name for name in names if name not in by_stem]
    if len(missing) == 6:
        choices = ", or ".join(" ".join(names) for names in FACE_NAMES)
        raise InputError(f"{folder} holds no cube faces, six square images named {choices} were expected")
    if missing:
        raise InputError(
            f"{folder} lacks the cube {'faces' if len(missing) > 1 else 'face'} {', '.join(missing)}, "
            f"all of {' '.join(names)} were expected"
        )
    for name in names:
        if len(by_stem[name]) > 1:
            both = " and ".join(path.name for path in by_stem[name])
            raise InputError(f"{folder} holds the cube face {name} more than once ({both}), one file was expected")
    found = [by_stem[name][0] for name in names]
    for path in found:
        try:
            inside(folder, path.name)
        except ValueError:
            raise InputError(f"{path} is a link to a file outside {folder}; copy the file there") from None
    return found


def _layout_of(shape: tuple[int, ...], where: str) -> Layout:
    height, width = shape[:2]
    if height == width == 1:
        return LAYOUTS[0]
    for layout in LAYOUTS:
        if width * layout.rows == height * layout.columns:
            return layout
    known = ", ".join(f"{layout.name} {layout.columns}:{layout.rows}" for layout in LAYOUTS)
    raise InputError(
        f"{where} is {width} x {height}, an aspect ratio of {width / height:.4g} that no layout has "
        f"({known}, or a single pixel)"
    )


def _cells(layout: Layout, height: int, width: int) -> Iterator[tuple[slice, slice, int]]:
    n = width // layout.columns
    for column, row, turns in layout.cells:
        yield slice(row * n, (row + 1) * n), slice(column * n, (column + 1) * n), turns


def faces_of(pixels: npt.NDArray[np.float32]) -> tuple[str, npt.NDArray[np.float32]] | None:
    """Return the name of the layout that an image (h, w, c) has by its aspect ratio, and its texels.

    The texels of a lat-long are returned unchanged; those of other layouts become faces (6, n, n, c), GL-direct.
    Returns None where no layout has this aspect ratio.
    """
    try:
        layout = _layout_of(pixels.shape, "the image")
    except InputError:
        return None
    if not layout.cells:
        return layout.name, pixels
    height, width, _ = pixels.shape
    return layout.name, np.stack(
        [np.rot90(pixels[rows, columns], turns) for rows, columns, turns in _cells(layout, height, width)]
    )


def _placed(pixels: npt.NDArray[np.float32], layout: Layout, name: str, digest: str, notices: list[str]) -> Environment:
    if layout.cells:
        found = faces_of(pixels)
        assert found is not None
        return _cube(found[1], name, layout.name, digest, notices)
    return _made("latlong", pixels, name, layout.name, digest, notices)


def _cube(faces: npt.NDArray[np.float32], name: str, layout: str, digest: str, notices: list[str]) -> Environment:
    return _made("cube", faces, name, layout, digest, notices)


def _made(
    kind: Literal["latlong", "cube"],
    pixels: npt.NDArray[np.float32],
    name: str,
    layout: str,
    digest: str,
    notices: list[str],
) -> Environment:
    """Split coverage from radiance and spread grey over three channels."""
    coverage = None
    if pixels.shape[-1] == 4:
        if pixels[..., 3].max() > 1:
            np.minimum(pixels[..., 3], 1, out=pixels[..., 3])
            notices.append(f"{name}: coverage over 1 was clamped to 1")
        if pixels[..., 3].min() < 1:
            coverage = np.ascontiguousarray(pixels[..., 3])
    if pixels.shape[-1] == 1:
        pixels = np.repeat(pixels, 3, axis=-1)
    texels = np.ascontiguousarray(pixels[..., :3])
    return Environment(kind, texels, coverage, 0.0, name, layout, digest, notices=tuple(notices))


def _clean(faces: npt.NDArray[np.float32], layout: Layout | None, where: str, zero: bool, notices: list[str]) -> None:
    """Refuse values that are NaN, inf or negative in `faces` (1 or 6, h, w, c), or make them 0 in place. What
    no face of the layout covers does not count."""
    if faces.min() >= 0 and faces.max() <= _FLOAT_MAX:  # false where there is a NaN
        return
    nonfinite, negative = ~np.isfinite(faces), faces < 0
    negative &= ~nonfinite
    if layout is not None and layout.cells:
        _, height, width, _ = faces.shape
        used = np.zeros((1, height, width, 1), bool)
        for rows, columns, _ in _cells(layout, height, width):
            used[:, rows, columns] = True
        nonfinite &= used
        negative &= used
    for bad, what, rule, action in (
        (nonfinite, "not finite", "radiance must be finite", "set to 0"),
        (negative, "negative", "radiance must be at least 0", "clamped to 0"),
    ):
        count = int(np.count_nonzero(bad))
        if count == 0:
            continue
        face, y, x, channel = (int(i) for i in np.unravel_index(int(bad.argmax()), bad.shape))
        value = faces[face, y, x, channel]
        if not zero:
            place = f"pixel ({x}, {y})" + (f" of face {FACES[face]}" if len(faces) == 6 else "")
            colour = "grey" if faces.shape[-1] == 1 else _CHANNELS[channel]
            many = "the only value" if count == 1 else f"the first of {count} values"
            raise InputError(
                f"{where} holds {value} in channel {colour} of {place}, {many} that "
                f"{'is' if count == 1 else 'are'} {what}; {rule}, or --nonfinite zero has them {action}"
            )
        faces[bad] = 0
        notices.append(f"{where}: {count} {what} value{' was' if count == 1 else 's were'} {action}")


def _expose(texels: npt.NDArray[np.float32], exposure: float, name: str) -> None:
    with np.errstate(over="ignore", under="ignore"):
        np.multiply(texels, np.float32(2.0**exposure), out=texels)
    if not texels.max() <= _FLOAT_MAX:
        raise InputError(
            f"{name} multiplied by 2^{exposure:g} is over {_FLOAT_MAX:.3g}, the range of float32; "
            "a lower exposure is needed"
        )


def statistics_of(env: Environment) -> dict[str, Any]:
    """Return the statistics of an environment's texels, as `Environment.statistics` holds them."""
    height, width = env.texels.shape[-3:-1]
    rows = env.texels.reshape(-1, width, 3)
    if env.kind == "latlong":
        weights = latlong_solid_angles(height, width)[:, None]
    else:
        weights = cube_solid_angles(height)
    step = max(1, min(_BLOCK // width, height))
    total = np.zeros(3)
    brightest = np.zeros(0)
    maximum, at = -1.0, (0, 0)
    for face in range(len(rows) // height):
        for first in range(0, height, step):
            weight = weights[first : first + step]
            start = face * height + first
            # Channel by channel: NumPy sums over a last axis of three 20 times slower than over long rows.
            block = [rows[start : start + len(weight), :, k].astype(np.float64) for k in range(3)]
            weighted = block[0] + block[1]
            weighted += block[2]
            top = int(weighted.argmax())
            if weighted.flat[top] > maximum:
                maximum, at = float(weighted.flat[top]), (start + top // width, top % width)
            for k in range(3):
                # Not `dot`: BLAS wakes its threads for it, which costs 100 times the sum in processor time.
                if weight.shape[1] == 1:
                    total[k] += float((weight[:, 0] * block[k].sum(axis=1)).sum())
                else:
                    total[k] += float(np.einsum("ij,ij->", weight, block[k]))
            weighted *= weight
            brightest = np.concatenate([brightest, _largest(weighted.ravel(), _BRIGHTEST)])
    mean = total / (4 * math.pi)
    energy, level = float(total.sum()), float(mean.sum())
    share = float(_largest(brightest, _BRIGHTEST).sum()) / energy if energy > 0 else 0.0
    return {
        "width": width,
        "height": height,
        "mean": [float(value) for value in mean],
        "maximum": maximum / 3,
        "max_over_mean": maximum / level if level > 0 else 1.0,
        "brightest": [float(value) for value in _direction(env, *at)],
        "brightest_share": min(share, 1.0),
    }


def channel_range(texels: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return the smallest and the largest value of each channel of (..., 3) texels, (3,) each."""
    # NumPy reduces to a last axis of three 20 times slower than a plane at a time.
    planes = [texels[..., k] for k in range(3)]
    return np.array([plane.min() for plane in planes]), np.array([plane.max() for plane in planes])


def _largest(values: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.float64]:
    """Return the `count` largest of (n,) values, in no order; all of them where there are fewer."""
    if values.size > 2 * count * _RUN:
        # The count largest of the runs' maxima are as many values, so nothing below the least of them counts.
        tops = values[: values.size // _RUN * _RUN].reshape(-1, _RUN).max(axis=1)
        values = values[values >= np.partition(tops, -count)[-count]]
    return np.partition(values, -count)[-count:] if values.size > count else values


def _direction(env: Environment, row: int, column: int) -> tuple[float, float, float]:
    """Return the unit vector to the centre of a texel, with the rotation; rows of a cube run through its faces."""
    height, width = env.texels.shape[-3:-1]
    if env.kind == "latlong":
        polar = (row + 0.5) * math.pi / height
        azimuth = ((column + 0.5) / width - 0.5) * 2 * math.pi
        x, y, z = math.sin(polar) * math.cos(azimuth), math.cos(polar), math.sin(polar) * math.sin(azimuth)
    else:
        face, row = divmod(row, height)
        s, t = (2 * column + 1) / width - 1, (2 * row + 1) / height - 1
        x, y, z = ((1, -t, -s), (-1, -t, s), (s, 1, t), (s, -1, -t), (s, -t, 1), (-s, -t, -1))[face]
        norm = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / norm, y / norm, z / norm
    c, s = math.cos(env.rotation), math.sin(env.rotation)
    return x * c - z * s, y, x * s + z * c
