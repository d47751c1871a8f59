"""Environments: an image, six faces or an array, checked and turned into a lat-long or a cube, with statistics.

Cubes have the GL-direct layout.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import FileError, InputError, UsageError
from whitefurnace.files import (
    check_choice,
    decode_srgb,
    digest_file,
    image_facts,
    is_light,
    light_digest,
    light_extent,
    light_files,
    read_image,
    read_radiance,
)
from whitefurnace.sphere.bad_pixels import check_bad_pixels, clean
from whitefurnace.sphere.faces import FACE_NAMES, face_files, without_repeats
from whitefurnace.sphere.layouts import (
    FACES,
    LAYOUTS,
    SIX_FACES,
    Layout,
    check_layout,
    faces_of,
    layout_of,
    placed,
)
from whitefurnace.sphere.solid_angles import cube_solid_angles, latlong_solid_angles

if TYPE_CHECKING:
    from whitefurnace.opencl.device import Device

__all__ = [
    "DEMO",
    "FACES",
    "FACE_NAMES",
    "LAYOUTS",
    "Environment",
    "Reading",
    "channel_range",
    "cube_solid_angles",
    "demo",
    "environment",
    "extent",
    "faces_of",
    "is_demo",
    "latlong_solid_angles",
    "read_environment",
    "source_digest",
    "source_files",
    "source_name",
    "statistics_of",
    "without_repeats",
]

DEMO = "demo"
"""The name of the built-in environment, where there is no file of that name."""

_BLOCK = 1 << 16  # texels looked at together: three channels in float64 stay in a core's cache
_RUN = 64  # texels of which the largest stands for all
_BRIGHTEST = 64
_FLOAT_MAX = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Reading:
    """The options of reading a source; `environment` documents them.

    bad_pixels: "refuse", "zero" or "clamp". layout: a name of `layouts.CHOICES`. fill: "black". None leaves the choice
    to the file.
    """

    rotate: float = 0.0
    exposure: float = 0.0
    bad_pixels: str = "refuse"
    layout: str | None = None
    layer: str | None = None
    fill: str | None = None

    def check(self) -> Reading:
        """Return it. Raises `UsageError` for an option that is out of its domain."""
        if not _is_number(self.rotate):
            raise UsageError(f"rotate is {self.rotate!r}, a finite angle in degrees was expected")
        if not _is_number(self.exposure) or abs(self.exposure) > 64:
            raise UsageError(f"exposure is {self.exposure!r}, a number of EV in [-64, 64] was expected")
        check_bad_pixels(self.bad_pixels)
        check_layout(self.layout)
        check_choice(self.layer, self.fill)
        return self

    def recipe(self) -> dict[str, str]:
        """The options that choose texels and their values, for the key of what is made of them."""
        return {
            "bad_pixels": self.bad_pixels,
            **{name: value for name in ("layout", "layer", "fill") if (value := getattr(self, name)) is not None},
        }


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


def environment(
    source: str | os.PathLike[str] | npt.NDArray[Any] | Environment,
    *,
    rotate: float = 0.0,
    exposure: float = 0.0,
    bad_pixels: str = "refuse",
    layout: str | None = None,
    layer: str | None = None,
    fill: str | None = None,
    nonfinite: str | None = None,
    device: Device | str | None = None,
) -> Environment:
    """Read an environment from an image file, six files, an array or another environment.

    source: an image in one of `LAYOUTS` (a 1 × 1 image is a constant); a .ktx, .ktx2, .dds, .env, .gltf or .glb file,
      of which level 0 is taken, a cube or such an image; six square images whose names end with px nx py ny pz nz, posx
      negx … or right left top bottom front back (front is +Z), as their folder, as a pattern, or as any one of them; an
      array (h, w) or (h, w, 1 | 3 | 4) of such an image, or (6, n, n) or (6, n, n, 1 | 3 | 4), of floats (linear
      Rec.709) or uint8 or uint16 (sRGB); or the word `demo`, the built-in sky.
    rotate: degrees about +Y that increase the azimuth atan2(z, x) of everything. Pixels are not resampled.
    exposure: EV in [-64, 64]. Radiance is multiplied by 2^exposure.
    bad_pixels: "refuse" NaN, infinite and negative values; make them "zero"; or "clamp": +inf becomes the largest value
      of the source's pixel type, the others 0. Negative values of up to 2e-5 of the energy become 0 in any case.
      `notices` says what was done. nonfinite: its older name.
    layout: "latlong", "horizontal-cross", "vertical-cross", "cross" (either), "horizontal-strip" or "row",
      "vertical-strip" or "column", "strip" (either), "openexr-cube", or "faces" (six files), in place of what the file
      states and of what its size says.
    layer: name of the part or layer of an OpenEXR file; by default the first part with R, G and B.
    fill: "black" for the pixels of the display window that the data window of a file has not.
    device: where `demo` is made.

    Raises `UsageError` for an option out of its domain, `FileError` for what cannot be read, `InputError` for what
    was read and is not an environment, and for `demo` `DeviceError`.
    """
    mode = check_bad_pixels(bad_pixels, nonfinite)
    return read_environment(source, Reading(rotate, exposure, mode, layout, layer, fill), device=device)


def read_environment(
    source: str | os.PathLike[str] | npt.NDArray[Any] | Environment,
    reading: Reading,
    *,
    device: Device | str | None = None,
) -> Environment:
    """Read an environment with the options of `environment`, and raise what it raises."""
    reading.check()
    turn = math.radians(math.remainder(reading.rotate, 360.0))
    exposure = reading.exposure
    if is_demo(source):
        from whitefurnace.opencl.device import choose_device

        if reading.layout is not None or reading.layer is not None:
            raise UsageError("the built-in environment demo is no file, and has no layout and no layer to choose")
        source = demo(choose_device(device) if device is None or isinstance(device, str) else device)
    if reading.layer is not None and not isinstance(source, (str, os.PathLike)):
        raise UsageError(f"layer {reading.layer!r} is of an OpenEXR file, and the source is none")
    if isinstance(source, Environment):
        if reading.layout is not None:
            raise UsageError(f"layout {reading.layout!r} is of a file or an array, an Environment has its own")
        if turn == 0 and exposure == 0:
            return source
        found = replace(
            source,
            rotation=math.remainder(source.rotation + turn, 2 * math.pi),
            texels=source.texels if exposure == 0 else source.texels.copy(),
        )
    elif isinstance(source, (str, os.PathLike)):
        path = Path(source)
        before = _stamps(path, reading.layout)
        files = _six(path, reading.layout)
        found = _from_image(path, reading) if files is None else _from_six(path, *files, reading)
        _check_unchanged(path, reading.layout, before, found.digest)
        found = replace(found, rotation=math.remainder(found.rotation + turn, 2 * math.pi))
    elif isinstance(source, np.ndarray):
        found = replace(_from_array(source, reading), rotation=turn)
    else:
        raise UsageError(
            f"an environment cannot be made from a {type(source).__name__}, "
            "a path, a numpy array or an Environment was expected"
        )
    if exposure != 0:
        _expose(found.texels, exposure, found.name)
        found = replace(found, exposure=found.exposure + exposure)
    return replace(found, statistics=statistics_of(found))


def is_demo(source: Any) -> bool:
    """Return whether a source is the built-in environment: the word `demo`, unless a path of that name exists."""
    return isinstance(source, (str, os.PathLike)) and str(source) == DEMO and not os.path.exists(source)


def demo(device: Device, height: int | None = None) -> Environment:
    """Return the built-in environment: sky, ground, and a sun of more than 1e5 times the mean radiance.

    height: rows of the lat-long, 512 by default.
    """
    from whitefurnace.sphere.demo import HEIGHT, demo_pixels

    return replace(environment(demo_pixels(device, HEIGHT if height is None else height)), name=DEMO)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)


def _six(path: Path, layout: str | None) -> tuple[list[Path], str] | None:
    """Return the six files that a path names with the name of their set, or None for a single file.

    Raises `InputError` for a folder or pattern that is to have the layout of an image.
    """
    if layout is None or layout == SIX_FACES:
        return face_files(path, whole=layout == SIX_FACES)
    if os.path.isdir(path):
        raise InputError(f"{path} is a folder, of which --layout {layout} cannot be read; faces can")
    return None


def source_files(source: str | os.PathLike[str], layout: str | None = None) -> dict[str, Path]:
    """Return the files that `environment` opens for a path, by their names relative to its folder.

    They are the file itself and the files that a glTF refers to, or six faces; none for the word `demo`. No other file
    is read, hashed, sent or listed for an environment. Raises the errors of `environment` for another kind of path.
    """
    if is_demo(source):
        return {}
    path = Path(source)
    files = _six(path, layout)
    return light_files(path) if files is None else {face.name: face for face in files[0]}


def source_digest(source: str | os.PathLike[str], layout: str | None = None) -> str:
    """Return the `digest` of the environment at a path, without decoding it. Raises `FileError`, `InputError`."""
    path = Path(source)
    files = _six(path, layout)
    return light_digest(path) if files is None else _of_faces(digest_file(face) for face in files[0])


def source_name(source: str | os.PathLike[str], layout: str | None = None) -> str:
    """Return the name of a source: a file's stem, that of a set of six files, or `demo`."""
    if is_demo(source):
        return DEMO
    path = Path(os.path.abspath(source))
    try:
        files = _six(path, layout)
    except (FileError, InputError):  # reading it says what is wrong
        files = None
    return files[1] if files is not None else path.name if path.is_dir() else path.stem


def extent(source: str | os.PathLike[str], reading: Reading | None = None) -> tuple[str, int, int]:
    """Return the shape of an environment from its header alone: ("latlong" or "cube", rows, columns).

    For a cube these are the rows and columns of a face, and for a texture the sizes of level 0. Raises the errors of
    `environment` for a header.
    """
    path, how = Path(source), reading or Reading()
    if is_demo(source):
        from whitefurnace.sphere.demo import HEIGHT

        return "latlong", HEIGHT, 2 * HEIGHT
    files = _six(path, how.layout)
    if files is not None:
        size = image_facts(files[0][0], layer=how.layer, fill=how.fill, light=True).height
        return "cube", size, size
    stated, aspect = None, 1.0
    if is_light(path):
        cube, height, width = light_extent(path)
        if cube:
            return "cube", height, width
    else:
        facts = image_facts(path, layer=how.layer, fill=how.fill, light=True)
        height, width, stated, aspect = facts.height, facts.width, facts.layout, facts.aspect
    layout = layout_of((height, width), str(path), [], asked=how.layout, stated=stated, aspect=aspect)
    size = layout.size(height, width)
    return ("cube", size, size) if layout.cells else ("latlong", height, width)


def _of_faces(digests: Iterable[str]) -> str:
    return hashlib.sha256("".join(digests).encode()).hexdigest()


_FRESH = 2_000_000_000  # ns: the coarsest times that file systems keep (FAT), and far over a kernel's tick


def _stamps(path: Path, layout: str | None) -> tuple[tuple[int, ...], ...] | None:
    """Return data that change when the files of a path are written to; None where they cannot be listed."""
    try:
        return tuple(
            (s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns)
            for s in (os.stat(file) for file in source_files(path, layout).values())
        )
    except (OSError, ValueError, FileError, InputError):
        return None


def _check_unchanged(path: Path, layout: str | None, before: tuple[tuple[int, ...], ...] | None, digest: str) -> None:
    """Refuse a source that was written to between the digest and the last pixel. Raises `FileError`.

    Otherwise the manifest would state the digest of one file for the result of another.
    """
    after = _stamps(path, layout)
    changed = before is None or after != before
    # A second write within a tick of the clock leaves the times unchanged, so bytes are compared too.
    if not changed and max(max(s[3:]) for s in after or ((0,),)) > time.time_ns() - _FRESH:
        changed = source_digest(path, layout) != digest
    if changed:
        raise FileError(f"{path} changed while it was read; run this again when it is whole")


def _from_image(path: Path, reading: Reading) -> Environment:
    if is_light(path):
        return _from_container(path, reading)
    image = read_image(path, layer=reading.layer, fill=reading.fill)
    notices = list(image.notices)
    layout = layout_of(
        image.pixels.shape, str(path), notices, asked=reading.layout, stated=image.layout, aspect=image.aspect
    )
    clean(image.pixels[None], layout, str(path), reading.bad_pixels, notices, largest=image.largest)
    return _placed(image.pixels, layout, path.stem, image.digest, notices)


def _from_container(path: Path, reading: Reading) -> Environment:
    """Level 0 of a cube, or a 2-D texture in one of the layouts."""
    if reading.layer is not None:
        raise UsageError(f"{path} is not OpenEXR and has no layer {reading.layer!r}")
    found = read_radiance(path)
    pixels, cube, largest, notices = found.texels, found.cube, found.largest, list(found.notices)
    if cube and reading.layout is not None:
        raise InputError(f"{path} is a cube, --layout {reading.layout} is of an image")
    layout = None if cube else layout_of(pixels.shape, str(path), notices, asked=reading.layout)
    clean(pixels if cube else pixels[None], layout, str(path), reading.bad_pixels, notices, largest=largest)
    digest = light_digest(path)
    if layout is None:
        made = _cube(pixels, path.stem, "cube", digest, notices)
    else:
        made = _placed(pixels, layout, path.stem, digest, notices)
    return replace(made, rotation=found.turn)


def _from_array(array: npt.NDArray[Any], reading: Reading) -> Environment:
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
    largest = 65504.0 if array.dtype == np.float16 else _FLOAT_MAX
    if cube and reading.layout is not None:
        raise UsageError(f"{where} is a cube, layout {reading.layout!r} is of an image")
    layout = None if cube else layout_of(pixels.shape, where, notices, asked=reading.layout)
    clean(pixels if cube else pixels[None], layout, where, reading.bad_pixels, notices, largest=largest)
    if layout is None:
        return _cube(pixels, "array", "cube", digest.hexdigest(), notices)
    return _placed(pixels, layout, "array", digest.hexdigest(), notices)


def _from_six(source: Path, paths: list[Path], name: str, reading: Reading) -> Environment:
    images = []
    notices: list[str] = []
    size = 0
    for path in paths:
        image = read_image(path, layer=reading.layer, fill=reading.fill)
        height, width, _ = image.pixels.shape
        size = size or height
        if width != height or height != size:
            raise InputError(
                f"{path} is {width} x {height}, but the six faces must be squares of one size"
                + (f", here {size} x {size}" if width == height else "")
            )
        if image.aspect != 1:
            raise InputError(f"{path} states a pixel aspect ratio of {image.aspect:g}, pixels of cube faces are square")
        if image.layout is not None and reading.layout != SIX_FACES:
            raise InputError(
                f"{path} states the layout {image.layout} (envmap), but it is one of six faces; --layout faces reads "
                "it all the same"
            )
        notices += image.notices
        images.append(image)
    channels = 4 if any(image.pixels.shape[2] == 4 for image in images) else 3
    cube = np.ones((6, size, size, channels), np.float32)
    for face, image in zip(cube, images, strict=True):
        have = image.pixels.shape[2]
        face[..., : max(have, 3)] = image.pixels  # grey spreads over the three
    digest = _of_faces(image.digest for image in images)
    each = [str(path) for path in paths]
    largest = min(image.largest for image in images)
    clean(cube, None, str(source), reading.bad_pixels, notices, largest=largest, each=each)
    return _cube(cube, name, "six faces", digest, notices)


def _placed(pixels: npt.NDArray[np.float32], layout: Layout, name: str, digest: str, notices: list[str]) -> Environment:
    if layout.cells:
        return _cube(placed(pixels, layout), name, layout.name, digest, notices)
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
