"""Judges the media of a scene at its scale.

It decides whether absorption is visible over an object's size, and whether light leaves farther than a pixel from where
it entered. Diffuse light is subsurface scattering seen from far enough [Hoffman2012].

Lengths are in metres and coefficients per metre; three numbers are RGB.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from whitefurnace.catalogue.subsurface import AIR, JENSEN, WATER, beyond, diffuse_reflectance, within
from whitefurnace.errors import UsageError, nearest

Triple = tuple[float, float, float]

UNITS = {
    "nm": 1e-9,
    "um": 1e-6,
    "µm": 1e-6,
    "mm": 1e-3,
    "cm": 1e-2,
    "m": 1.0,
    "km": 1e3,
    "in": 0.0254,
    "ft": 0.3048,
    "yd": 0.9144,
    "mi": 1609.344,
}

NOTICEABLE = 2.3
"""Smallest ΔE*ab between two colours that people notice [Mahy1994]. A grey has it where 6 % of the light is lost."""

BLACK = 1 / (255 * 12.92)
"""Linear value of code 1 of 8-bit sRGB. A medium that transmits less than this is opaque."""

SHARE = 0.95
"""Share of the leaving light that must leave within a pixel for local diffuse to be right. At an edge of light at most
half of the rest, 2.5 %, is then missing a pixel inside, less than the 6 % that people notice."""

FAINT = 0.01
"""Diffuse reflectance below which a channel is black, however far its light goes."""

COLOURS = ("red", "green", "blue")

_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
"""Matrix from linear Rec.709 to CIE XYZ, D65."""


# ------------------------------------------------------------------------------------------------- lengths and pixels


def length(text: str) -> float:
    """Return a length such as `0.5mm` in metres. Raises UsageError."""
    match = re.fullmatch(r"\s*([0-9.]+(?:[eE][+-]?[0-9]+)?)\s*([^\s0-9]*)\s*", text)
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    if match is None or not math.isfinite(value) or value <= 0:
        raise UsageError(f"{text!r} is not a length above 0 with its unit, as 0.5mm")
    if match[2] not in UNITS:
        raise UsageError(f"{text!r}: a length has a unit{nearest(match[2].lower(), UNITS)}")
    return value * UNITS[match[2]]


def footprint(
    height: int, *, yfov: float | None = None, distance: float | None = None, ymag: float | None = None
) -> float:
    """Return the length in metres that a pixel of an image covers, for a camera as glTF describes it.

    height: height of the image in pixels. yfov, distance: vertical angle in radians of a perspective camera, and metres
    to the object. ymag: half the height in metres that an orthographic camera shows. Raises UsageError.
    """
    if height < 1:
        raise UsageError(f"an image of {height} rows has no pixel")
    if (yfov is None) == (ymag is None):
        raise UsageError("a pixel's footprint needs either yfov with a distance, or ymag")
    if ymag is not None:
        return 2 * _positive("ymag", abs(ymag)) / height
    assert yfov is not None
    if not 0 < yfov < math.pi:
        raise UsageError(f"yfov {yfov:g} is outside (0, π)")
    if distance is None:
        raise UsageError("a pixel's footprint needs the distance to what is seen")
    return 2 * _positive("distance", distance) * math.tan(yfov / 2) / height


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"{name} {value:g} is not a length above 0")
    return value


def length_text(metres: float) -> str:
    """Return a length in metres as text for users, such as 0.5 mm or 3.4 m."""
    if math.isinf(metres):
        return "any distance"
    for unit in ("km", "m", "mm", "µm"):
        if metres >= UNITS[unit]:
            return (
                f"{metres / UNITS[unit]:.2g} {unit}"
                if metres < 100 * UNITS[unit]
                else f"{metres / UNITS[unit]:.0f} {unit}"
            )
    return f"{metres * 1e9:.2g} nm"


# -------------------------------------------------------------------------------------------------------------- media


@dataclass(frozen=True)
class Medium:
    """A homogeneous medium.

    absorption, scattering  σa and σs per metre; σa may be infinite
    g                       mean cosine of scattering, in (-1, 1)
    ior                     index of refraction of its boundary, in [1, 3]

    Raises UsageError for values out of range.
    """

    absorption: Triple
    scattering: Triple = (0.0, 0.0, 0.0)
    g: float = 0.0
    ior: float = 1.5
    name: str = ""

    def __post_init__(self) -> None:
        for name in ("absorption", "scattering"):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != 3 or not all(value >= 0 for value in values):
                raise UsageError(f"{name} is three coefficients per metre from 0, not {getattr(self, name)!r}")
            object.__setattr__(self, name, values)
        if not all(map(math.isfinite, self.scattering)):
            raise UsageError("scattering is finite; without a mean free path it is a surface")
        if not -1 < self.g < 1:
            raise UsageError(f"g {self.g:g} is outside (-1, 1)")
        if not 1 <= self.ior <= 3:
            raise UsageError(f"ior {self.ior:g} is outside [1, 3]")

    @classmethod
    def of_volume(
        cls,
        attenuation_distance: float | None = None,
        attenuation_color: Sequence[float] = (1, 1, 1),
        *,
        scattering: Triple = (0.0, 0.0, 0.0),
        g: float = 0.0,
        ior: float = 1.5,
        name: str = "",
    ) -> Medium:
        """Return the medium of glTF's KHR_materials_volume, σa = -ln(colour)/distance.

        attenuation_distance: metres after which white light has the colour `attenuation_color`; None or infinity for no
        absorption. scattering, g, ior, name: fields of the medium; the extension has no scattering. Raises UsageError.
        """
        if attenuation_distance is None:
            attenuation_distance = math.inf
        if not attenuation_distance > 0:
            raise UsageError(f"attenuation distance {attenuation_distance:g} is not above 0")
        if len(attenuation_color) != 3 or not all(0 <= c <= 1 for c in attenuation_color):
            raise UsageError(f"attenuation colour {tuple(attenuation_color)} is not three numbers from 0 to 1")
        sigma = tuple(
            0.0
            if math.isinf(attenuation_distance) or c == 1
            else -math.log(c) / attenuation_distance
            if c > 0
            else math.inf
            for c in attenuation_color
        )
        return cls(sigma, scattering, g, ior, name)  # type: ignore[arg-type]

    @property
    def reduced(self) -> np.ndarray:
        """Reduced scattering σs' = σs (1 - g) per metre: isotropic scattering with the same effect."""
        return np.array(self.scattering) * (1 - self.g)

    @property
    def mean_free_path(self) -> Triple:
        """1/(σa + σs') in metres, infinite in a channel without either."""
        return _triple(_inverse(np.array(self.absorption) + self.reduced))

    @property
    def diffusion_length(self) -> Triple:
        """1/√(3 σa (σa + σs')) in metres, over which diffuse light falls to 1/e [Jensen2001]."""
        sigma = np.array(self.absorption)
        return _triple(_inverse(np.sqrt(3 * sigma * (sigma + self.reduced))))

    @property
    def albedo(self) -> Triple:
        """Diffuse reflectance of a body so large that no light crosses it [Jensen2001]."""
        return _triple(diffuse_reflectance(self.reduced, self.absorption, self.ior))

    @property
    def lost(self) -> Triple:
        """1 - α', the share of light that each collision absorbs under isotropic scattering; 1 where nothing
        scatters.
        """
        sigma, reduced = np.array(self.absorption), self.reduced
        whole = np.where(np.isfinite(sigma) & (reduced > 0), sigma + reduced, 1.0)
        return _triple(np.where(np.isfinite(sigma) & (reduced > 0), sigma, 1.0) / whole)

    @property
    def spread(self) -> Triple:
        """Radius in metres that 95 % of the leaving light stays within [Jensen2001]; 0 in a channel that reflects
        nothing.
        """
        return _triple(self._path * within(SHARE, self.lost, self.ior))

    def beyond(self, radius: float) -> Triple:
        """Return the share of the leaving light that leaves farther than `radius` metres from where it entered
        [Jensen2001].
        """
        path = self._path
        some = path > 0
        return _triple(np.where(some, beyond(radius / np.where(some, path, 1.0), self.lost, self.ior), 0.0))

    @property
    def _path(self) -> np.ndarray:
        """The mean free path, 0 in a channel that reflects nothing."""
        return np.where(np.array(self.lost) < 1, self.mean_free_path, 0.0)

    def parameters(self) -> dict[str, float]:
        """Return the medium's parameters for `lut diffusion --scheme dipole`, per mm."""
        given = {
            f"{name}_{c}": value * 1e-3
            for name in ("absorption", "scattering")
            for c, value in zip("rgb", getattr(self, name), strict=True)
        }
        return {**given, "g": self.g, "ior": self.ior}


def _triple(values: Any) -> Triple:
    r, g, b = (float(value) for value in values)
    return r, g, b


def _inverse(values: np.ndarray) -> np.ndarray:
    return np.divide(1.0, values, out=np.full(values.shape, np.inf), where=values > 0)


MEDIA: Mapping[str, Medium] = {
    "water": Medium(_triple(1e3 * np.array(WATER)), ior=1.333, name="water"),
    "air": Medium((0.0, 0.0, 0.0), _triple(1e3 * np.array(AIR)), ior=1.0, name="air"),
    **{
        name: Medium(_triple(1e3 * np.array(a)), _triple(1e3 * np.array(s)), ior=ior, name=name)
        for name, (s, a, ior) in JENSEN.items()
    },
}
"""Measured media: water [PopeFry1997], air [Bruneton2008], and those of [Jensen2001], whose scattering is reduced."""


def medium(name: str) -> Medium:
    """Return the measured medium called `name`. Raises UsageError with the nearest name."""
    if name not in MEDIA:
        raise UsageError(f"unknown medium {name!r}{nearest(name, MEDIA)}")
    return MEDIA[name]


# ---------------------------------------------------------------------------------------------------------- judgement


@dataclass(frozen=True)
class Absorption:
    """The effect of absorption on light that crosses an object.

    verdict        "negligible", "matters" or "opaque"
    transmittance  e^(-σa size)
    difference     ΔE*ab of white seen through it; people notice 2.3
    half           metres after which half of the light is gone
    reason         a sentence for users
    """

    verdict: str
    transmittance: Triple
    difference: float
    half: Triple
    reason: str


@dataclass(frozen=True)
class Transport:
    """Where light that was scattered inside leaves.

    verdict is one of
    "clear"        almost no light is scattered: only refraction and absorption
    "cloudy"       some light is scattered, less than once on its way across: a volume
    "local"        diffuse light leaves within a pixel of where it entered
    "subsurface"   diffuse light leaves farther than a pixel from where it entered
    "translucent"  like "subsurface", and some light leaves on the other side
    """

    verdict: str
    mean_free_path: Triple
    diffusion_length: Triple
    albedo: Triple
    spread: Triple
    beyond: Triple
    reason: str


@dataclass(frozen=True)
class Judgement:
    """The needs of a medium at a scale. `absorption` is None without a size, `transport` without a pixel."""

    medium: Medium
    size: float | None
    pixel: float | None
    absorption: Absorption | None
    transport: Transport | None

    @property
    def subsurface(self) -> bool:
        """True if local diffuse is wrong and subsurface scattering is needed."""
        return self.transport is not None and self.transport.verdict in ("subsurface", "translucent")

    @property
    def sentences(self) -> tuple[str, ...]:
        """The reasons of absorption and transport, as sentences."""
        return tuple(part.reason for part in (self.absorption, self.transport) if part)

    def data(self) -> dict[str, Any]:
        """Return the judgement as JSON data, with None for infinite values."""
        return {**_plain(asdict(self)), "subsurface": self.subsurface}  # type: ignore[dict-item]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def judge(medium: Medium, size: float | None = None, pixel: float | None = None) -> Judgement:
    """Judge a medium in an object of `size` metres that is seen with pixels of `pixel` metres.

    The size decides about absorption. The pixel decides where light leaves; with the size, also whether light crosses
    the object. Raises UsageError for a length that is not above 0.
    """
    for name, value in (("size", size), ("pixel", pixel)):
        if value is not None:
            _positive(name, value)
    return Judgement(
        medium,
        size,
        pixel,
        None if size is None else _absorbed(medium, size),
        None if pixel is None else _left(medium, size, pixel),
    )


def difference(colour: Sequence[float] | np.ndarray) -> float:
    """Return ΔE*ab between white and a colour in linear Rec.709 [CIE15]."""
    ratio = _XYZ @ np.asarray(colour, np.float64) / _XYZ.sum(1)
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
    return float(np.linalg.norm([116 * (f[1] - 1), 500 * (f[0] - f[1]), 200 * (f[1] - f[2])]))


def _percent(share: float) -> str:
    if share < 1e-4:
        return "less than 0.01 %"
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.4g} %"


def _absorbed(medium: Medium, size: float) -> Absorption:
    through = np.exp(-np.array(medium.absorption) * size)
    off = difference(through)
    half = _triple(math.log(2) * _inverse(np.array(medium.absorption)))
    least = int(np.argmin(through))
    which = f"{_percent(through[least])} of the {COLOURS[least]} light is left after {length_text(size)}, ΔE*ab " + (
        f"{off:.0f}" if off >= 10 else f"{off:.1f}"
    )
    if not any(medium.absorption):
        verdict, reason = "negligible", "nothing is absorbed"
    elif off < NOTICEABLE:
        verdict, reason = "negligible", f"absorption is not noticed: {which}, of the {NOTICEABLE} that are"
    elif through.max() < BLACK:
        verdict, reason = (
            "opaque",
            (f"nothing comes through: less than code 1 of 8-bit sRGB is left after {length_text(size)}"),
        )
    else:
        verdict, reason = "matters", f"absorption matters: {which}, where {NOTICEABLE} are noticed"
    return Absorption(verdict, _triple(through), off, half, reason)


def _left(medium: Medium, size: float | None, pixel: float) -> Transport:
    albedo, spread, share = np.array(medium.albedo), np.array(medium.spread), medium.beyond(pixel)
    counted = albedo >= FAINT
    farthest = int(np.argmax(np.where(counted, spread, -1)))
    widest = float(spread[farthest])

    def say(verdict: str, reason: str) -> Transport:
        return Transport(
            verdict, medium.mean_free_path, medium.diffusion_length, medium.albedo, medium.spread, share, reason
        )

    # The share of light that goes straight on decides between Hoffman's "clear" and "cloudy".
    straight = None if size is None else np.exp(-np.array(medium.scattering) * size)
    if not any(medium.scattering):
        return say("clear", "nothing scatters inside: light is refracted and absorbed, none is diffuse")
    if not counted.any():
        return say(
            "clear",
            "what scatters inside is absorbed there: light is refracted and absorbed, and less than "
            f"{_percent(FAINT)} is diffuse",
        )
    if size is not None and straight is not None:
        if difference(straight) < NOTICEABLE:
            return say(
                "clear",
                f"scattering is not noticed: {_percent(straight.min())} of the light or more goes "
                f"straight on over {length_text(size)}",
            )
        if medium.reduced.max() * size < 1:
            turned = length_text(1 / medium.reduced.max())
            return say(
                "cloudy",
                f"a volume, neither diffuse nor clear: light goes {turned} "
                f"before it has turned, farther than the {length_text(size)} of the object",
            )
    colour = COLOURS[farthest]
    if widest <= pixel:
        return say(
            "local",
            f"local diffuse is right: {_percent(SHARE)} of the {colour} light leaves within "
            f"{length_text(widest)} of where it entered, and a pixel is {length_text(pixel)}",
        )
    reach = (
        f"{_percent(share[farthest])} of the {colour} light leaves farther than a pixel of {length_text(pixel)} "
        f"from where it entered, and {_percent(SHARE)} within {length_text(widest)}"
    )
    if size is not None and widest > size:
        return say(
            "translucent",
            f"subsurface scattering is needed, and light comes through: {reach}, where the "
            f"object is {length_text(size)}",
        )
    return say("subsurface", f"subsurface scattering is needed: {reach}")
