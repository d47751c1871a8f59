"""Judges the media inside a scene's materials: the size that light crosses and the length that a pixel covers.

Where local diffuse reflection is wrong, it names the table of pre-integrated diffusion that is needed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.errors import UsageError, nearest
from whitefurnace.scenes.materials import Material, Scene
from whitefurnace.scenes.scale import MEDIA, Judgement, Medium, Triple, footprint, judge, length, length_text, medium

TABLE = 64
"""Texels on a side of a table of diffusion. Along n·l they are as far apart as those of an 8-bit diffuse ramp of 64."""

ROWS = 16384
"""Largest height of an image that --resolution takes."""

_NAMES = {
    "σa": "absorption",
    "sigma_a": "absorption",
    "absorption": "absorption",
    "σs": "scattering",
    "sigma_s": "scattering",
    "scattering": "scattering",
    "g": "g",
    "ior": "ior",
    "distance": "distance",
    "color": "color",
}


@dataclass(frozen=True)
class Inside:
    """The medium inside a material.

    material   its name, "" for the scene as a whole
    judgement  the judgement; None for a material without an inside, for the given `reason`
    size_of    names the size that light crosses
    table      options of `lut` with a file name as `output`; None where no table is needed, or where none can be made
               for the given `reason`
    """

    material: str
    judgement: Judgement | None
    size_of: str = ""
    reason: str = ""
    table: dict[str, Any] | None = None

    @property
    def head(self) -> str:
        """The material's name, with the size that light crosses."""
        size = None if self.judgement is None else self.judgement.size
        return (self.material or "the scene") + (f", {length_text(size)} across ({self.size_of})" if size else "")

    @property
    def lines(self) -> tuple[str, ...]:
        """Return sentences about the medium; the last is the command for its table, if it needs one."""
        said = [*(self.judgement.sentences if self.judgement else ()), *([self.reason] if self.reason else [])]
        if self.table is not None:
            numbers = "".join(f" --set {one}" for one in self.table.get("set", ()))
            said.append(
                f"lut diffusion -o {self.table['output']} --size {self.table['size']} --scheme "
                f"{self.table['scheme']}{numbers}"
            )
        return tuple(said)


@dataclass(frozen=True)
class Pixel:
    """The length in metres that a pixel covers, and the name of the camera."""

    metres: float
    of: str = ""

    @property
    def text(self) -> str:
        """Return a phrase that states the length."""
        return f"a pixel is {length_text(self.metres)}" + (f", as {self.of} sees the nearest of it" if self.of else "")


# ------------------------------------------------------------------------------------------------------------- options


def named_media(texts: Sequence[str], scene: Scene) -> dict[str, Medium]:
    """Return the media of texts `[MATERIAL:]MEDIUM`, by material; "" is the scene as a whole.

    MEDIUM is a name of scale.MEDIA, or numbers per mm such as `σa=.03/.17/.48,σs=.74/.88/1.01,g=0,ior=1.3`, one or
    three of each. `distance=0.1m,color=.9/.5/.1`, as in KHR_materials_volume, replaces σa. Without an ior the
    material's is used. Raises UsageError.
    """
    found: dict[str, Medium] = {}
    names = [m.name for m in scene.materials]
    for text in texts:
        # The name of a material may contain colons.
        name, _, rest = text.rpartition(":")
        if name and name not in names:
            raise UsageError(f"--medium {text}: no material is named {name!r}{nearest(name, names)}")
        if name in found:
            raise UsageError(f"--medium {text}: {name or 'the scene'} has a medium already")
        own = next((m for m in scene.materials if m.name == name), None)
        found[name] = _medium_of_values(text, rest, own) if "=" in rest else medium(rest)
    return found


def _medium_of_values(text: str, rest: str, own: Material | None) -> Medium:
    given: dict[str, str] = {}
    for part in rest.split(","):
        name, equals, value = part.partition("=")
        if not equals or name.strip() not in _NAMES:
            raise UsageError(
                f"--medium {text}: {part.strip()!r} is not one of {', '.join(dict.fromkeys(_NAMES))} with "
                f"its value{nearest(name.strip(), _NAMES)}"
            )
        if _NAMES[name.strip()] in given:
            raise UsageError(f"--medium {text}: {name.strip()} is there twice")
        given[_NAMES[name.strip()]] = value.strip()
    if ("distance" in given) != ("color" in given):
        raise UsageError(f"--medium {text}: distance and color are what absorbs together")
    if "distance" in given and "absorption" in given:
        raise UsageError(f"--medium {text}: give σa, or distance and color")

    def triple(name: str, usual: float) -> Triple:
        values = [_finite_value(text, name, v) for v in given.get(name, repr(usual)).split("/")]
        if len(values) not in (1, 3):
            raise UsageError(f"--medium {text}: {name} is one number, or three as R/G/B")
        r, g, b = values * (3 // len(values))
        return r, g, b

    def one(name: str, usual: float) -> float:
        return _finite_value(text, name, given[name]) if name in given else usual

    per_metre = _per_metre(triple("scattering", 0.0))
    g, ior = one("g", 0.0), one("ior", 1.5 if own is None else _ior(own))
    if "distance" in given:
        return Medium.of_volume(length(given["distance"]), triple("color", 1.0), scattering=per_metre, g=g, ior=ior)
    return Medium(_per_metre(triple("absorption", 0.0)), per_metre, g, ior)


def _finite_value(text: str, name: str, value: str) -> float:
    try:
        found = float(value)
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise UsageError(f"--medium {text}: {name} {value!r} is not a number")
    return found


def _per_metre(values: Triple) -> Triple:
    r, g, b = values
    return 1e3 * r, 1e3 * g, 1e3 * b


def pixel_of(scene: Scene, text: str | None = None, rows: int | None = None) -> Pixel | None:
    """Return the length that a pixel covers; None where neither `text` nor `rows` is given.

    text: a length such as `0.5mm`. rows: height in pixels of an image by the camera that shows the scene largest.
    Raises UsageError.
    """
    if text is not None and rows is not None:
        raise UsageError("give --pixel or --resolution, not both")
    if text is not None:
        return Pixel(length(text))
    if rows is None:
        return None
    if not 1 <= rows <= ROWS:
        raise UsageError(f"--resolution {rows} is outside [1, {ROWS}]")
    if not scene.cameras:
        raise UsageError("--resolution is of a camera, and the scene has none: give --pixel LENGTH")
    found = []
    for camera in scene.cameras:
        if camera.yfov is None:
            if camera.height:
                found.append(Pixel(footprint(rows, ymag=camera.height / 2), camera.name))
        elif distance := _distance(scene, np.array(camera.position)):
            found.append(Pixel(footprint(rows, yfov=camera.yfov, distance=distance), camera.name))
    if not found:
        raise UsageError("no camera sees the scene from a distance: give --pixel LENGTH")
    return min(found, key=lambda pixel: pixel.metres)


def _distance(scene: Scene, position: np.ndarray) -> float:
    """Distance to the box around the scene, from inside it to its middle; 0 where there is no box."""
    if scene.low is None or scene.high is None:
        return 0.0
    low, high = np.array(scene.low), np.array(scene.high)
    away = float(np.linalg.norm(position - np.clip(position, low, high)))
    return away or float(np.linalg.norm(position - (low + high) / 2))


# ----------------------------------------------------------------------------------------------------------- judgement


def inside(scene: Scene, pixel: Pixel | None, media: dict[str, Medium]) -> tuple[Inside, ...]:
    """Judge the medium inside each material, from `media` or from the material's KHR_materials_volume.

    pixel: length that a pixel covers, or None. Raises UsageError.
    """
    found = []
    for m in scene.materials:
        if m.name in media or m.has("volume"):
            found.append(_of(scene, pixel, m, media.get(m.name)))
    if "" in media:
        found.append(_judged(scene, pixel, None, media[""]))
    taken: set[str] = set()
    return tuple(
        one if one.table is None else replace(one, table={**one.table, "output": _file(one.material, taken)})
        for one in found
    )


def _of(scene: Scene, pixel: Pixel | None, m: Material, given: Medium | None) -> Inside:
    if given is None:
        if m["thickness"].most <= 0:
            return Inside(m.name, None, reason="its thickness is 0: thin walls, which have no inside")
        r, g, b = m["attenuation_color"].low
        given = Medium.of_volume(m["attenuation_distance"].least, (r, g, b), ior=_ior(m), name=m.name)
    return _judged(scene, pixel, m, given)


def _judged(scene: Scene, pixel: Pixel | None, m: Material | None, medium: Medium) -> Inside:
    size, size_of = _size(scene, m)
    judgement = judge(medium, size, None if pixel is None else pixel.metres)
    name = "" if m is None else m.name
    if not judgement.subsurface:
        return Inside(name, judgement, size_of)
    if not (all(s > 0 for s in medium.scattering) and all(map(math.isfinite, medium.absorption))):
        return Inside(name, judgement, size_of, "no table of diffusion: a channel of it does not scatter")
    # `lut diffusion` has no schemes for air and water; a medium given by numbers is a dipole.
    own = MEDIA.get(medium.name) == medium and medium.name not in ("air", "water")
    table: dict[str, Any] = {
        "kind": "diffusion",
        "output": "",
        "size": TABLE,
        "scheme": medium.name if own else "dipole",
    }
    if not own:
        # The dipole depends only on σs(1 - g), so g = 0 with the reduced scattering is the same and in `lut`'s range.
        r, g, b = medium.reduced.tolist()
        even = replace(medium, scattering=(r, g, b), g=0.0)
        table["set"] = [f"{key}={value:.9g}" for key, value in even.parameters().items()]
    return Inside(name, judgement, size_of, table=table)


def _size(scene: Scene, m: Material | None) -> tuple[float | None, str]:
    """Return the largest length that light crosses, and its name.

    It is a material's thickness, otherwise the shortest side of the scene's box.
    """
    if m is not None and m["thickness"].most > 0:
        return m["thickness"].most, "its thickness"
    sides = [side for side in scene.extent or () if side > 0]
    return (min(sides), "the least side of the scene") if sides else (None, "")


def _ior(m: Material) -> float:
    """The index of refraction within the range of a medium; glTF's 0, a mirror, becomes 1."""
    return min(max(m["ior"].most, 1.0), 3.0)


def _file(material: str, taken: set[str]) -> str:
    """Return a file name made from the name of a material, which may contain any characters."""
    stem = "diffusion" + "".join(f"_{part}" for part in re.findall(r"[A-Za-z0-9-]+", material)[:8])
    name, k = f"{stem}.npy", 2
    while name.lower() in taken:
        name, k = f"{stem}_{k}.npy", k + 1
    taken.add(name.lower())
    return name
