"""Chooses the part and layer of an OpenEXR file that hold its light, and decides what its attributes mean for it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from whitefurnace.errors import InputError, UsageError, nearest
from whitefurnace.files.colour import REC709
from whitefurnace.files.exr_header import ENVMAPS, Part, read_parts

# CIE xy of red, green, blue and white.
_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
_AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
_REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
_P3D65 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
_ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)

# Linear spaces by the names of the ASWF's Color Interop Forum (the attribute colorInteropID), and by older names that
# OpenImageIO and OpenColorIO write.
_LINEAR = {
    **dict.fromkeys(("lin_rec709_scene", "lin_rec709", "lin_srgb", "linear", "scene_linear"), REC709),
    **dict.fromkeys(("lin_ap0_scene", "lin_ap0", "aces2065-1", "aces2065_1", "aces"), _AP0),
    **dict.fromkeys(("lin_ap1_scene", "lin_ap1", "acescg"), _AP1),
    **dict.fromkeys(("lin_rec2020_scene", "lin_rec2020"), _REC2020),
    **dict.fromkeys(("lin_p3d65_scene", "lin_p3d65"), _P3D65),
    **dict.fromkeys(("lin_adobergb_scene", "lin_adobergb"), _ADOBE),
}
# Names of spaces with a transfer function, of values that are no colour, and of CIE XYZ.
_NOT_LINEAR = re.compile(r"(srgb|g18|g22|g24|g26|pq|hlg|st2084|bt1886|acescct|acescc|rec709$|data$|raw$|lin_ciexyz).*")

# Layers of data that renderers write, by the last word of their name; the channels of some are named R, G and B.
_DATA = re.compile(
    r"(z|depth|n|ng|normals?|p|pref|(world)?position|uv|st|u|v|(object|material|instance|asset)?[ _]?id|index(ob|ma)"
    r"|crypto.*|motion.*|vectors?|velocity|denoising (normal|albedo|depth)|mist|mask|matte|debug.*)",
    re.IGNORECASE,
)
# Names of a channel that holds grey radiance where it is alone.
_GREY = ("Y", "L", "I", "R", "GREY", "GRAY", "LUMINANCE", "INTENSITY", "RADIANCE", "")
_SPELLED = {"RED": "R", "GREEN": "G", "BLUE": "B", "ALPHA": "A"}
_SHOWN = 8
_NAMED = 100
_LONGEST = 50


@dataclass(frozen=True)
class Choice:
    """The part and channels of an OpenEXR file that are read.

    part       number of the part
    channels   full names of the channels R, G, B and A, of R, G and B, or of a single grey one
    layout     "latlong" or "openexr cube", as the attribute envmap says, of the data window; None without it
    aspect     width of a pixel divided by its height
    primaries  CIE xy of red, green, blue and white that the file states, or None
    largest    the largest finite value that its channels can hold
    notices    sentences about what was chosen, left out and not applied
    """

    part: int
    channels: tuple[str, ...]
    layout: str | None
    aspect: float
    primaries: tuple[float, ...] | None
    largest: float
    notices: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Layer:
    """The channels of one part whose names have the same text before the last dot.

    names: full names by the last word in capitals.
    """

    part: int
    of: Part
    name: str
    names: dict[str, str]

    @property
    def label(self) -> str:
        """Name of the layer: that of its part, the text before its channels, or both."""
        if not self.of.name or self.name == self.of.name or self.name.startswith(f"{self.of.name}."):
            return self.name
        return f"{self.of.name}.{self.name}" if self.name else self.of.name

    @property
    def colour(self) -> bool:
        return all(name in self.names for name in "RGB")

    @property
    def grey(self) -> bool:
        if {"RY", "BY", "X"} & self.names.keys():  # chroma, or a vector
            return False
        return "Y" in self.names or (len(self.names) == 1 and next(iter(self.names)) in _GREY)

    @property
    def data(self) -> bool:
        """True if the name is that of a layer without light, such as depth or normals."""
        words = {self.name.rpartition(".")[2], self.label.rpartition(".")[2]} - {""}
        return any(_DATA.fullmatch(word) for word in words)

    @property
    def light(self) -> bool:
        return (self.colour or self.grey) and not self.data and not self.of.deep

    def shown(self) -> str:
        """The label with the channels."""
        words = ", ".join(map(_word, list(self.names.values())[:4])) + (", ..." if len(self.names) > 4 else "")
        return f"{_word(self.label)} ({words})" if self.label else words

    def picks(self) -> tuple[str, ...]:
        if self.colour:
            return tuple(self.names[name] for name in "RGBA" if name in self.names)
        return (self.names["Y"],) if "Y" in self.names else tuple(self.names.values())


def choose(path: Path, size: int, layer: str | None = None) -> Choice:
    """Choose the light of an OpenEXR file of `size` bytes.

    layer: name of a part, of a layer, or of both as PART.LAYER; by default the first part with R, G and B, of which the
    channels without a layer, or its only layer of colour.
    Raises `InputError` for a file without light and for one with several layers to choose from, `UsageError` for a name
    that no layer has, and the errors of `read_parts`.
    """
    parts = read_parts(path, size)
    layers = [found for k, part in enumerate(parts) for found in _layers(k, part)]
    if layer is not None:
        found = _named(path, layers, layer)
    else:
        found = _first(path, layers)
    notices = [f"{path}: {sentence}" for sentence in _chosen(found, layers, parts, layer is not None)]
    part = found.of
    wrong = [c.name for c in part.channels if c.name in found.picks() and c.kind == "uint"]
    if wrong:
        raise InputError(f"{path} holds 32-bit integers in {_listed(wrong)}, floats were expected")
    if any((c.across, c.down) != (1, 1) for c in part.channels if c.name in found.picks()):
        raise InputError(f"{path} holds channels of different sizes (subsampled), channels of one size were expected")
    envmap = part.attributes.get("envmap")
    layout = None
    if envmap is not None:
        if envmap >= len(ENVMAPS):
            raise InputError(f"{path} states the kind {envmap} of environment map (envmap), 0 and 1 are known")
        layout = ("latlong", "openexr cube")[envmap]
    elif part.data != part.display and _contains(part.data, part.display):
        notices.append(
            f"{path}: its display window of {part.display.width} x {part.display.height} was read, and what its data "
            f"window of {part.data.width} x {part.data.height} has around it was left out"
        )
    primaries = _primaries(path, part, notices)
    if ignored := _not_applied(part, primaries):
        notices.append(f"{path}: not applied: {', '.join(ignored)}")
    half = all(c.kind == "half" for c in part.channels if c.name in found.picks()[:3])
    return Choice(
        found.part,
        found.picks(),
        layout,
        part.attributes.get("pixelAspectRatio", 1.0),
        primaries,
        65504.0 if half else float(np.finfo(np.float32).max),
        tuple(notices),
    )


def _layers(number: int, part: Part) -> list[_Layer]:
    found: dict[str, dict[str, str]] = {}
    for channel in part.channels:
        layer, _, leaf = channel.name.rpartition(".")
        short = _SPELLED.get(leaf.upper(), leaf.upper())
        found.setdefault(layer, {}).setdefault(short, channel.name)
    return [_Layer(number, part, layer, names) for layer, names in found.items()]


def _first(path: Path, layers: Sequence[_Layer]) -> _Layer:
    """The layer that is read where none is named."""
    for kind in ("colour", "grey"):
        light = [found for found in layers if found.light and getattr(found, kind)]
        if not light:
            continue
        single = {next(iter(found.names)): found.of.name for found in layers if len(found.names) == 1}
        if kind == "grey" and {"R", "G", "B"} <= single.keys():
            raise InputError(
                f"{path} has R, G and B in parts of their own ({_listed([single[name] for name in 'RGB'])}), one part "
                "with all three was expected"
            )
        first = [found for found in light if found.part == light[0].part]
        plain = next((found for found in first if not found.name), None)
        if plain is not None or len(first) == 1:
            found = plain or first[0]
            if not found.colour and len(found.names) == 2 and len(layers) == 1:
                break  # grey and coverage: two channels
            return found
        raise InputError(
            f"{path} has {len(first)} layers of colour ({_listed([found.label for found in first])}); "
            "--layer NAME chooses one"
        )
    if len(layers) == 1 and not layers[0].of.deep:
        names = [channel.name for channel in layers[0].of.channels]
        shown = _listed(names)
        if len(names) == 2 and not {"RY", "BY"} & layers[0].names.keys():
            raise InputError(f"{path} has 2 channels ({shown}), 1, 3 or 4 were expected")
        if {"RY", "BY"} & layers[0].names.keys():
            raise InputError(f"{path} stores luminance and chroma ({shown}), channels R, G and B were expected")
        if layers[0].data and layers[0].colour:
            raise InputError(f"{path} holds {_word(layers[0].label)}, which is no light; --layer takes it all the same")
        if len(names) == 1:
            raise InputError(f"{path} has the one channel {shown}, which is no light: R, G and B, or Y were expected")
        raise InputError(f"{path} has {len(names)} channels ({shown}), but none named R, G and B, or Y")
    if all(found.of.deep for found in layers):
        raise InputError(f"{path} is a deep image, a flat one was expected")
    raise InputError(
        f"{path} has no layer of light, which has channels R, G and B, or Y; it has "
        f"{'; '.join(found.shown() + (', deep' if found.of.deep else '') for found in layers[:_SHOWN])}"
        + (
            "; --layer NAME takes one all the same"
            if any(found.colour and not found.of.deep for found in layers)
            else ""
        )
    )


def _named(path: Path, layers: Sequence[_Layer], name: str) -> _Layer:
    """The layer with a name: as it is or in another case, whole or its last word."""

    def names(found: _Layer) -> list[set[str]]:
        whole = {found.label, found.name, found.of.name} - {""}
        view = found.of.attributes.get("view")
        return [whole, {word.rpartition(".")[2] for word in whole} | ({view} if view else set())]

    for wanted, change in ((name, str), (name.casefold(), str.casefold)):
        for level in (0, 1):
            some = [found for found in layers if wanted in {change(one) for one in names(found)[level]}]
            light = [found for found in some if (found.colour or found.grey) and not found.of.deep]
            plain = [found for found in light if not found.name]
            if len(light) == 1:
                return light[0]
            if len(plain) == 1 and len({found.part for found in light}) == 1:
                return plain[0]
            if light:
                several = _listed([found.label or found.shown() for found in light])
                raise UsageError(f"{path}: layer {name!r} is one of several: {several}; give the whole name")
            if some:
                raise InputError(f"{path}: layer {name!r} holds {some[0].shown()}, channels R, G and B were expected")
    labels = [_word(found.label) for found in layers if found.label][:_NAMED]
    if not labels:
        raise UsageError(f"{path} has no layer {name!r}; its channels {layers[0].shown()} have no layer")
    raise UsageError(f"{path} has no layer {name!r}{nearest(name, labels)}")


def _word(text: str) -> str:
    """A text of the file for a message: short and printable."""
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "..."


def _listed(words: Sequence[str]) -> str:
    return ", ".join(map(_word, words[:_SHOWN])) + (f", and {len(words) - _SHOWN} more" if len(words) > _SHOWN else "")


def _chosen(found: _Layer, layers: Sequence[_Layer], parts: Sequence[Part], asked: bool) -> list[str]:
    """Sentences about what was read and what was left out."""
    said = []
    why = "" if asked else ", the first with R, G and B" if found.colour else ", the first with light"
    if len(parts) > 1:
        layer = f", layer {_word(found.name)}" if found.name else ""
        view = found.of.attributes.get("view")
        said.append(
            f"part {_word(found.of.name)}{layer} was read{why}"
            + (f" (view {_word(view)})" if view else "")
            + f"; parts left out: {_listed([part.name for part in parts if part is not found.of])}"
        )
    elif found.name:
        said.append(f"layer {_word(found.name)} was read" + ("" if asked else ", the only one of colour"))
    picks = found.picks()
    if rest := [c.name for c in found.of.channels if c.name not in picks]:
        said.append(f"channels left out: {_listed(rest)}")
    views = found.of.attributes.get("multiView", ())
    if len(views) > 1:
        view = next((view for view in views if view in found.name.split(".")), views[0])
        said.append(f"it has the views {_listed(views)}, of which {_word(view)} was read")
    if found.of.tile is not None and found.of.tile[2]:
        said.append("its smaller mip levels were left out")
    return said


def _contains(outer: tuple[int, ...], inner: tuple[int, ...]) -> bool:
    return outer[0] <= inner[0] and outer[1] <= inner[1] and outer[2] >= inner[2] and outer[3] >= inner[3]


def _primaries(path: Path, part: Part, notices: list[str]) -> tuple[float, ...] | None:
    """The primaries that a file states: by numbers, as an ACES container, or by the name of a linear colour space.

    Raises InputError for a name of what is not linear.
    """
    stated = part.attributes.get("chromaticities")
    aces = part.attributes.get("acesImageContainerFlag") == 1
    for attribute in ("colorInteropID", "oiio:ColorSpace"):
        name = part.attributes.get(attribute, "")
        key = name.lower().removesuffix(" ")
        if key in ("", "unknown"):
            continue
        if key in _LINEAR:
            stated = stated or _LINEAR[key]
        elif _NOT_LINEAR.match(key):
            raise InputError(
                f"{path} states the colour space {_word(name)} ({attribute}), a linear one was expected, such as "
                "lin_rec709_scene"
            )
        else:
            notices.append(
                f"{path}: states the colour space {_word(name)} ({attribute}), which is not known and not applied"
            )
    return stated or (_AP0 if aces else None)


def _not_applied(part: Part, primaries: tuple[float, ...] | None) -> list[str]:
    """What attributes say that changes how a picture is shown, and not the light in it."""
    said = part.attributes
    found = []
    if "whiteLuminance" in said:
        found.append(f"whiteLuminance ({said['whiteLuminance']:g} cd/m² where R, G and B are 1)")
    if "adoptedNeutral" in said:
        x, y = said["adoptedNeutral"]
        white = (primaries or REC709)[6:]
        if not np.allclose((x, y), white, rtol=0, atol=1e-3):  # the rounding of published white points
            found.append(f"adoptedNeutral ({x:g} {y:g})")
    found += [
        f"{name} ({_word(said[name])})"
        for name in ("renderingTransform", "lookModTransform", "wrapmodes")
        if said.get(name)
    ]
    for name in ("worldToCamera", "worldToNDC"):
        matrix = np.reshape(said.get(name, np.eye(4)), (4, 4))
        if not np.allclose(matrix[:3, :3], np.eye(3), rtol=0, atol=1e-6):  # rounding of a float32 rotation
            found.append(f"{name} (--rotate turns the environment)")
    return found
