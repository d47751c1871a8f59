"""Writes a shader snippet in GLSL, HLSL or WGSL that reads an engine's files, from the preset that describes them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from whitefurnace.engines.presets import Engine, File
from whitefurnace.errors import UnsupportedError, UsageError, nearest
from whitefurnace.expression import LANGUAGES, Expression
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere.octahedral_map import atlas_places
from whitefurnace.text import printable

TYPES = {
    "glsl": {"float": "float", "vec2": "vec2", "vec3": "vec3", "vec4": "vec4"},
    "hlsl": {"float": "float", "vec2": "float2", "vec3": "float3", "vec4": "float4"},
    "wgsl": {"float": "f32", "vec2": "vec2f", "vec3": "vec3f", "vec4": "vec4f"},
}

MONOMIALS = (
    "1.0",
    "d.y",
    "d.z",
    "d.x",
    "d.x * d.y",
    "d.y * d.z",
    "(3.0 * d.z * d.z - 1.0)",
    "d.x * d.z",
    "(d.x * d.x - d.y * d.y)",
)
"""The basis without its constants, in the order of `harmonic`."""


def _line(text: str) -> str:
    """Return text for a comment: one line, without a backslash at its end, which would continue the comment."""
    return " ".join(text.split()).rstrip("\\")


class _Writer:
    """Writes lines of one shading language from named expressions; it knows how the languages differ."""

    def __init__(self, language: str) -> None:
        self.language, self.type = language, TYPES[language]
        self.lines: list[str] = []
        self.bound = 0

    def comment(self, text: str) -> None:
        self.lines.append(f"// {_line(text)}")

    def resource(self, kind: str, name: str, remark: str) -> None:
        """Declare a texture ("cube", "2d"), the sampler or nine vectors ("sh") at the next binding of group 0."""
        glsl = {"cube": "uniform samplerCube {};", "2d": "uniform sampler2D {};", "sh": "uniform vec3 {}[9];"}
        hlsl = {
            "cube": "TextureCube {};",
            "2d": "Texture2D {};",
            "sampler": "SamplerState {};",
            "sh": "uniform float3 {}[9];",
        }
        wgsl = {
            "cube": "var {}: texture_cube<f32>;",
            "2d": "var {}: texture_2d<f32>;",
            "sampler": "var {}: sampler;",
            "sh": "var<uniform> {}: array<vec3f, 9>;",
        }
        text = {"glsl": glsl, "hlsl": hlsl, "wgsl": wgsl}[self.language].get(kind)
        if text is not None:  # GLSL has the sampler in the texture
            place = f"@group(0) @binding({self.bound}) " if self.language == "wgsl" else ""
            self.lines.append(f"{place}{text.format(name)}  // {_line(remark)}")
            self.bound += 1

    def vector(self, *parts: str) -> str:
        return f"{self.type[f'vec{len(parts)}']}({', '.join(parts)})"

    def mix(self, a: str, b: str, t: str) -> str:
        return f"{'lerp' if self.language == 'hlsl' else 'mix'}({a}, {b}, {t})"

    def select(self, test: str, a: str, b: str) -> str:
        return f"select({b}, {a}, {test})" if self.language == "wgsl" else f"({test} ? {a} : {b})"

    def read(self, texture: str, at: str, lod: str) -> str:
        if self.language == "glsl":
            return f"textureLod({texture}, {at}, {lod})"
        if self.language == "hlsl":
            return f"{texture}.SampleLevel(linear_clamp, {at}, {lod})"
        return f"textureSampleLevel({texture}, linear_clamp, {at}, {lod})"

    def function(
        self,
        result: str,
        name: str,
        takes: Sequence[tuple[str, str]],
        first: Sequence[tuple[str, str, str]],
        value: str,
        remark: str = "",
    ) -> None:
        """Write a function; `first` has (type, name, expression) of variables that `value` may use."""
        if self.language == "wgsl":
            head = f"fn {name}({', '.join(f'{n}: {self.type[t]}' for t, n in takes)}) -> {self.type[result]} {{"
        else:
            head = f"{self.type[result]} {name}({', '.join(f'{self.type[t]} {n}' for t, n in takes)}) {{"
        self.lines.append(head + (f"  // {remark}" if remark else ""))
        for kind, variable, expression in first:
            declared = f"let {variable}" if self.language == "wgsl" else f"{self.type[kind]} {variable}"
            self.lines.append(f"    {declared} = {expression};")
        self.lines += [f"    return {value};", "}"]


def snippet(engine: Engine, language: str, levels: int, width: int, stem: str = "") -> str:
    """Return a part of a shader that reads a bake for `engine`.

    language: "glsl" (3.00 ES and newer), "hlsl" (shader model 4 and newer) or "wgsl". levels: number of levels. width:
    texels of a face edge of level 0. stem: stem of the files, for comments.

    The snippet declares the textures and defines these functions of unit vectors and the perceptual roughness r:
    specular_lod(r), specular_direction(n, v, r), specular_radiance(n, v, r), and irradiance(n), which is E/π. Where
    there is a table it also defines dfg(NoV, r), the texel as stored, and specular_albedo(F0, NoV, r) = F0·A + B,
    whatever form the table has.

    Raises UnsupportedError for an engine that gets no chain, and UsageError for another language.
    """
    if language not in LANGUAGES:
        raise UsageError(f"unknown shading language {language!r}{nearest(language, LANGUAGES)}")
    if not engine.holding("specular"):
        raise UnsupportedError(f"{engine.name} is given no prefiltered chain, so there is nothing for a shader to read")
    to, stem = _Writer(language), printable(stem)
    _header(to, engine, levels, width, stem)
    _resources(to, engine, levels, width, stem)
    _lookup(to, engine, levels, width)
    _octahedral(to, engine, levels, width)
    _irradiance(to, engine)
    _reads(to, engine)
    _split_sum(to, engine)
    return "\n".join(to.lines) + "\n"


def _name(file: File, stem: str) -> str:
    return file.name.replace("{stem}", stem or "STEM")


def _rows(engine: Engine) -> File | None:
    """Return the file that has the engine's harmonics."""
    if engine.sh is None:
        return None
    whole = (file for file in engine.holding("specular") if file.suffix in (".env", ".gltf"))
    return next(iter((*engine.holding("sh"), *whole)), None)


def _kind(file: File) -> str:
    return "2d" if file.layout == "octahedral" else "cube"


def _header(to: _Writer, engine: Engine, levels: int, width: int, stem: str) -> None:
    to.comment(
        f"{stem or 'STEM'} as whitefurnace bakes it for {engine.name}: {engine.title}"
        if engine.title
        else f"{stem or 'STEM'} as whitefurnace bakes it for {engine.name}"
    )
    to.comment(f"{'Proven' if engine.proven else 'Not proven in the engine'}: {engine.facts}.")
    for step in engine.steps:
        to.comment(f"- {step.replace('STEM', stem or 'STEM')}")
    to.comment("n, v: unit vectors to the outside and to the eye, y up; r: perceptual roughness; NoV = dot(n, v) >= 0.")


def _resources(to: _Writer, engine: Engine, levels: int, width: int, stem: str) -> None:
    specular = engine.holding("specular")[0]
    to.resource("sampler", "linear_clamp", "linear in all of min, mag and mip, clamped to the edge")
    codes = ", its texels through decode_rgbd" if specular.stored == "rgbd" else ""
    content = f"{_name(specular, stem)}: {levels} levels from {width} x {width}{codes}"
    to.resource(_kind(specular), "specular_map", content)
    for file in engine.holding("sheen")[:1]:
        to.resource(_kind(file), "sheen_map", f"{_name(file, stem)}: the same for Charlie's lobe")
    if (rows := _rows(engine)) is not None:
        order = ", x y z xx yy zz yz zx xy" if engine.sh == "babylon" else ""
        to.resource("sh", "sh", f"the rows of {_name(rows, stem)}{order}")
    elif engine.holding("irradiance"):
        to.resource("cube", "irradiance_map", _name(engine.holding("irradiance")[0], stem))
    for file in engine.holding("dfg")[:1]:
        codes = ", its texels through decode_rgbd" if file.stored == "rgbd" else ""
        to.resource("2d", "dfg_map", f"{_name(file, stem)}, its first row at v = 0{codes}")
    if any(file.stored == "rgbd" for file in (*engine.holding("specular"), *engine.holding("dfg"))):
        # A value between two codes is no colour, so texels must be decoded before they are filtered.
        power = to.vector("2.2", "2.2", "2.2")
        to.function(
            "vec3",
            "decode_rgbd",
            [("vec4", "code")],
            [],
            f"pow(code.rgb, {power}) / code.a",
            "once for each texel, before any filter",
        )


def _lookup(to: _Writer, engine: Engine, levels: int, width: int) -> None:
    language = to.language
    lod, bend = engine.lod_formula, engine.bend_formula
    alpha = [("float", "alpha", "r * r")]
    text = lod.shader(language, max_lod=f"{levels - 1}.0", width=f"{width}.0")
    to.function(
        "float",
        "specular_lod",
        [("float", "r")],
        alpha if "alpha" in lod.used else [],
        f"clamp({text}, 0.0, {levels - 1}.0)",
    )
    mirror = "reflect(-v, n)"
    bent = mirror if _zero(bend) else f"normalize({to.mix(mirror, 'n', bend.shader(language))})"
    to.function(
        "vec3",
        "specular_direction",
        [("vec3", "n"), ("vec3", "v"), ("float", "r")],
        alpha if "alpha" in bend.used else [],
        bent,
    )
    axes = [
        f"{'-' if row[k] < 0 else ''}d.{'xyz'[k]}"
        for row in np.asarray(engine.matrix)
        for k in (int(np.abs(row).argmax()),)
    ]
    to.function("vec3", "stored_direction", [("vec3", "d")], [], to.vector(*axes), "of the world, on the stored cube")


def _reads(to: _Writer, engine: Engine) -> None:
    least, blend = _least(engine), engine.blend_formula
    r = least or "r"
    for name in ("specular", "sheen"):
        if not engine.holding(name):
            continue
        file = engine.holding(name)[0]
        value = _read(to, f"{name}_map", file, f"stored_direction(specular_direction(n, v, {r}))", f"specular_lod({r})")
        alpha = [("float", "alpha", f"{r} * {r}")]
        if not _zero(blend):
            value = to.mix(value, "irradiance(n)", blend.shader(to.language, r=r))
        to.function(
            "vec3",
            f"{name}_radiance",
            [("vec3", "n"), ("vec3", "v"), ("float", "r")],
            alpha if "alpha" in blend.used else [],
            value,
        )


def _octahedral(to: _Writer, engine: Engine, levels: int, width: int) -> None:
    """Write the functions that read octahedral maps: the mips of a texture, or an atlas of them."""
    file = engine.holding("specular")[0]
    if file.layout != "octahedral":
        return
    part = []
    for along, across in ("xz", "zx"):
        folded = f"(1.0 - abs(a.{across})) * {to.select(f'a.{along} < 0.0', '-1.0', '1.0')}"
        part.append(to.select("a.y < 0.0", folded, f"a.{along}"))
    to.function(
        "vec2",
        "octahedral",
        [("vec3", "d")],
        [("vec3", "a", "d / (abs(d.x) + abs(d.y) + abs(d.z))")],
        f"0.5 + 0.5 * {to.vector(*part)}",
        "on a square of 1",
    )
    if file.suffix != ".exr":
        to.function(
            "vec3",
            "specular_map_at",
            [("vec3", "d"), ("float", "lod")],
            [],
            f"{to.read('specular_map', 'octahedral(d)', 'lod')}.rgb",
        )
        return
    # Level 0 at the left, the others below each other at its right: 1/2 + … + 1/2^(k-1) of `width` is above level k.
    b = file.border
    try:
        places = atlas_places(width, levels, b)
    except ValueError as error:
        raise UsageError(f"{engine.name}: {error}") from None
    across, down = (max(ends) + b for ends in zip(*((p.column + p.side, p.row + p.side) for p in places), strict=True))
    side = f"{width}.0 * exp2(-k)"
    later = to.vector(f"{width + 3 * b}.0", f"{b + width}.0 - 2.0 * side + {2 * b}.0 * (k - 1.0)")
    first = to.vector(f"{b}.0", f"{b}.0")
    texel = "e * side"
    if not b:  # a level's edge texels stand in for its border
        half = to.vector("0.5", "0.5")
        texel = f"clamp(e * side, {half}, side - {half})"
    corner = f"{to.select('k < 0.5', first, later)} + {texel}"
    at = f"({corner}) / {to.vector(f'{across}.0', f'{down}.0')}"
    to.function(
        "vec3",
        "specular_level",
        [("vec2", "e"), ("float", "k")],
        [("float", "side", side)],
        f"{to.read('specular_map', at, '0.0')}.rgb",
    )
    above = f"specular_level(e, {'k + 1.0' if levels > 1 else 'k'})"
    to.function(
        "vec3",
        "specular_map_at",
        [("vec3", "d"), ("float", "lod")],
        [("vec2", "e", "octahedral(d)"), ("float", "k", f"min(floor(lod), {max(levels - 2, 0)}.0)")],
        to.mix("specular_level(e, k)", above, "lod - k"),
    )


def _read(to: _Writer, texture: str, file: File, at: str, lod: str) -> str:
    return f"{texture}_at({at}, {lod})" if file.layout == "octahedral" else f"{to.read(texture, at, lod)}.rgb"


def _zero(formula: Expression) -> bool:
    return formula.text.strip() in ("0", "0.0")


def _least(engine: Engine) -> str:
    """Return the expression of the roughness that the engine shades with; empty where it is r itself."""
    return f"max(r, {engine.least!r})" if engine.least else ""


def _irradiance(to: _Writer, engine: Engine) -> None:
    zero, meaning = to.vector("0.0", "0.0", "0.0"), "E/pi"
    first = [("vec3", "d", "stored_direction(n)")]
    if _rows(engine) is not None and engine.sh == "babylon":
        # The inverse of harmonic.babylon: 3/2 and 4 undo the cosine kernel that Babylon.js divides out.
        value = (
            "1.5 * (sh[0] * d.x + sh[1] * d.y + sh[2] * d.z)",
            "sh[3] * (4.0 * d.x * d.x - 1.0) + sh[4] * (4.0 * d.y * d.y - 1.0) + sh[5] * (4.0 * d.z * d.z - 1.0)",
            "4.0 * (sh[6] * d.y * d.z + sh[7] * d.z * d.x + sh[8] * d.x * d.y)",
        )
        to.function("vec3", "irradiance", [("vec3", "n")], first, f"max({_sum(value)}, {zero})", meaning)
    elif _rows(engine) is not None and engine.sh is not None:
        factors = np.diag(harmonic.unscaled(np.eye(9), engine.sh)) * harmonic.COSINE * harmonic.FACTORS
        terms = [
            f"sh[0] * {_literal(factors[0])}",
            *(f"sh[{k}] * {_times(float(factors[k]), MONOMIALS[k])}" for k in range(1, 9)),
        ]
        value = (" + ".join(terms[:4]), " + ".join(terms[4:7]), " + ".join(terms[7:]))
        to.function("vec3", "irradiance", [("vec3", "n")], first, f"max({_sum(value)}, {zero})", meaning)
    else:
        cube = bool(engine.holding("irradiance"))
        file = engine.holding("irradiance" if cube else "specular")[0]
        read = _read(
            to,
            "irradiance_map" if cube else "specular_map",
            file,
            "stored_direction(n)",
            "0.0" if cube else "specular_lod(1.0)",
        )
        to.function(
            "vec3",
            "irradiance",
            [("vec3", "n")],
            [],
            read,
            meaning if cube else f"{meaning}, for which the level of r = 1 stands",
        )


def _sum(parts: Sequence[str]) -> str:
    return "\n        + ".join(parts)


def _times(factor: float, text: str) -> str:
    """Return factor · text, without a factor of 1; the factor has nine digits, more than float32."""
    return text if abs(factor - 1) < 1e-9 else f"({_literal(factor)} * {text})"


def _literal(value: float) -> str:
    text = f"{value:.9g}"
    return text if "." in text or "e" in text else f"{text}.0"


def _split_sum(to: _Writer, engine: Engine) -> None:
    if not engine.holding("dfg"):
        return
    table = engine.dfg
    least = _least(engine)
    texel = table.size
    along = {
        "NoV": f"(sqrt(NoV) * {texel - 1}.0 + 0.5) / {texel}.0" if table.NoV == "sqrt" else "NoV",
        "roughness": least or "r",
        "alpha": f"{least or 'r'} * {least or 'r'}",
    }
    channels = "rgb" if table.charlie else "rg"
    kind = "vec3" if table.charlie else "vec2"
    at = to.vector(along[table.x], along[table.y])
    to.function(
        kind,
        "dfg",
        [("float", "NoV"), ("float", "r")],
        [],
        f"{to.read('dfg_map', at, '0.0')}.{channels}",
        {"scale_bias": "(A, B", "multiscatter": "(of Fc, of 1"}[table.form]
        + (f", Charlie's albedo under {table.charlie_masking})" if table.charlie else ")"),
    )
    scaled = table.form == "scale_bias"
    ones = [to.vector(f"t.{c}", f"t.{c}", f"t.{c}") for c in "xy"]
    value = f"F0 * t.x + {ones[1]}" if scaled else to.mix(ones[0], ones[1], "F0")
    to.function(
        "vec3",
        "specular_albedo",
        [("vec3", "F0"), ("float", "NoV"), ("float", "r")],
        [(kind, "t", "dfg(NoV, r)")],
        value,
        "E of F0, with F90 = 1",
    )
