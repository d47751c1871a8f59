"""Assembles the text of each OpenCL program from the kernel files that it needs, with a digest of the whole.

`PROGRAMS` is the table of all programs; a function below it fills in each row: `integration` for an integral over
models, `octahedral` for the convolution of levels. Every file stands under its own `#line`, so that a compiler's
message names the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, wraps
from importlib import resources
from typing import Any

from whitefurnace.catalogue import Integral, Model
from whitefurnace.catalogue.user_text import MARK
from whitefurnace.opencl import constants
from whitefurnace.opencl.bindings import FUNCTIONS, VECTOR, bindings, is_isotropic, lanes
from whitefurnace.text import printable

LOBE_WIDTH = 0.05
"""Width in radians for which the rule of a user's BRDF grades its half vectors. Lobes ten times narrower are still
resolved."""

LEAST_COSINE = 1e-9
"""Smallest cosine at which a BRDF given as f(l, v) is evaluated. It stands for the limit at grazing, where some BRDFs
divide by the cosine."""

OUTLINE = ("Cx", "Cy", "Cz", "Ax", "Ay", "Az", "Bx", "By", "Bz", "length", "scale")
"""A panel of an area light's outline as `radiance_outline.cl` reads it, after the view."""


@dataclass(frozen=True)
class Source:
    """A program's text and its digest (sha256, hexadecimal)."""

    text: str
    digest: str


@dataclass(frozen=True)
class Assembly:
    """The recipe for the text of a program: one row of `PROGRAMS`.

    pieces: its pieces in order. A name is a kernel file, where {words} are filled in; `<name>` is a generated piece:
    `<bindings>` binds the slots, `<models>` are the texts of their models, `<grid>`, `<anterpolation>` and `<classes>`
    are constants of the host, and the others are given by the function that assembles the program.
    slots: slots that it may bind.
    cells: names of the numbers in a cell of its input, before the numbers of the models.
    defines: macros that its kernels require, as `NAME` or `NAME VALUE`; {words} are filled in.
    """

    pieces: tuple[str, ...]
    slots: tuple[str, ...] = ()
    cells: tuple[str, ...] = ("NoV",)
    defines: tuple[str, ...] = ()


_MODELS = ("<bindings>", "<models>")
_MICROFACETS = ("ndf", "masking", "fresnel")
_LEAST = f"LEAST_COSINE ((scalar){LEAST_COSINE!r})"
_WIDTH = f"LOBE_WIDTH ((scalar){LOBE_WIDTH!r})"
_OF_LIGHTS = ("NoV", "phi", *OUTLINE)

PROGRAMS: Mapping[str, Assembly] = {
    # Integrals over models, one value a cell.
    "integral": Assembly(
        ("real.clh", *_MODELS, "facet.clh", "ring.clh", "integrand/{integral}.clh", "integrate.cl"),
        slots=_MICROFACETS,
        defines=("{support}",),
    ),
    "integral with kinks": Assembly(
        ("real.clh", *_MODELS, "facet.clh", "ring.clh", "integrand/{integral}.clh", "kinked.cl"),
        slots=_MICROFACETS,
        defines=(
            "{support}",
            "KINKS {kinks}",
            "EDGES {edges}",
            "CELL_EDGES {edge_names}",
            "CELL_RESTS {rest_names}",
        ),
    ),
    "integral of an anisotropic NDF": Assembly(
        ("real.clh", *_MODELS, "facet.clh", "integrand/{integral}.clh", "stretched.cl"),
        slots=_MICROFACETS,
        cells=("NoV", "phi"),
        defines=("{support}",),
    ),
    "integral in closed form": Assembly(("real.clh", *_MODELS, "{file}"), slots=("ndf", "masking")),
    "fit of linearly transformed cosines": Assembly(
        ("real.clh", *_MODELS, "facet.clh", "ring.clh", "specular.clh", "ltc.cl"),
        slots=_MICROFACETS,
        cells=("NoV", "per_albedo", "xx", "xz", "zx", "zz"),
        defines=("HALF_ANGLE",),
    ),
    "rough boundary": Assembly(("real.clh", *_MODELS, "glass.cl"), slots=_MICROFACETS),
    "table of Smith's area": Assembly(
        ("real.clh", *_MODELS, "ring.clh", "area.cl"), slots=("ndf",), defines=("POLAR",)
    ),
    "albedo of a diffuse model": Assembly(
        ("real.clh", *_MODELS, "<scatter>", "hemisphere.cl"),
        slots=("diffuse",),
        defines=("SMOOTH", "AZIMUTH_PANELS 2", "COMPONENTS 1", _WIDTH, _LEAST),
    ),
    "albedo of a whole BRDF": Assembly(
        ("real.clh", *_MODELS, "ring.clh", "<scatter>", "hemisphere.cl"),
        slots=("brdf",),
        cells=("NoV", "phi"),
        defines=("HALF_ANGLE", "AZIMUTH_PANELS 4", "COMPONENTS 3", _WIDTH, _LEAST),
    ),
    "function of a model": Assembly(
        ("real.clh", *_MODELS, "<evaluate>", "evaluate.cl"), slots=(*_MICROFACETS, "diffuse", "brdf", "light"), cells=()
    ),
    "specular BRDF": Assembly(
        ("real.clh", *_MODELS, "specular.clh", "<evaluate>", "evaluate.cl"), slots=_MICROFACETS, cells=()
    ),
    # Reflected radiance.
    "light on a specular surface": Assembly(
        ("real.clh", *_MODELS, "facet.clh", "radiance_outline.cl"),
        slots=_MICROFACETS,
        cells=_OF_LIGHTS,
        defines=("COMPONENTS 1", _WIDTH, _LEAST),
    ),
    "light on a diffuse surface": Assembly(
        ("real.clh", *_MODELS, "<scatter>", "radiance_outline.cl"),
        slots=("diffuse",),
        cells=_OF_LIGHTS,
        defines=("SMOOTH", "COMPONENTS 1", _WIDTH, _LEAST),
    ),
    "light on a whole BRDF": Assembly(
        ("real.clh", *_MODELS, "<scatter>", "radiance_outline.cl"),
        slots=("brdf",),
        cells=_OF_LIGHTS,
        defines=("WHOLE", "COMPONENTS 3", _WIDTH, _LEAST),
    ),
    "environment on a surface": Assembly(
        ("real.clh", *_MODELS, "<scatter>", "radiance_nodes.cl"),
        slots=("diffuse", "brdf"),
        cells=("NoV", "phi"),
        defines=(_LEAST,),
    ),
    "environment on a specular surface": Assembly(
        ("real.clh", *_MODELS, "specular.clh", "<scatter>", "radiance_nodes.cl"),
        slots=(*_MICROFACETS, "diffuse"),
        cells=("NoV", "phi"),
        defines=(_LEAST,),
    ),
    "nodes in the frame of a surface": Assembly(("real.clh", "sphere.clh", "texels/{kind}.clh", "radiance_texels.cl")),
    "reflectance integral": Assembly(
        # samples.cl and special.clh define one macro in different ways: it is undefined between them.
        ("real.clh", "sphere.clh", *_MODELS, "<between>", "pyramid.cl", "samples.cl", "truth.cl"),
        slots=(*_MICROFACETS, "diffuse"),
        cells=(),
        defines=("{how}", "SETS {sets}"),
    ),
    # Prefiltering.
    "convolution with an NDF": Assembly(
        ("real.clh", *_MODELS, "window.clh", "lobe.clh", "prefilter.cl"), slots=("ndf",)
    ),
    "convolution with the cosine": Assembly(("real.clh", "window.clh", "lobe_cosine.clh", "prefilter.cl")),
    "texels near a narrow lobe": Assembly(
        ("real.clh", "sphere.clh", "texels/{kind}.clh", *_MODELS, "window.clh", "lobe.clh", "exact.cl"), slots=("ndf",)
    ),
    "convolution by the symmetries of the cube": Assembly(
        ("real.clh", "sphere.clh", "<classes>", "orbits.clh", "window.clh", "lobe_table.clh", "octahedral.cl")
    ),
    "bright texels under an NDF": Assembly(
        ("real.clh", "sphere.clh", "orbits.clh", *_MODELS, "lobe.clh", "apart.cl"), slots=("ndf",)
    ),
    "bright texels under the cosine": Assembly(("real.clh", "sphere.clh", "orbits.clh", "lobe_cosine.clh", "apart.cl")),
    "interpolation": Assembly(("real.clh", "sphere.clh", "<grid>", "grid.clh", "interpolate.cl")),
    "nodes and harmonics": Assembly(
        (
            "real.clh",
            "sphere.clh",
            "texels/{kind}.clh",
            "<grid>",
            "grid.clh",
            "<anterpolation>",
            "anterpolate.cl",
            "harmonics.cl",
        )
    ),
    "importance sampling": Assembly(("real.clh", "sphere.clh", "pyramid.cl", "samples.cl")),
    "means over texels": Assembly(("real.clh", "sphere.clh", "overlap.cl")),
    # Others.
    "built-in environment": Assembly(("real.clh", "demo.cl")),
    "limits of a device": Assembly(("real.clh", "yardstick.cl")),
}
"""Every program: its kernel files, the slots that it binds, and the macros that its kernels get."""


_CONSTANTS: Mapping[str, Callable[[], str]] = {
    "grid": constants.grid_defines,
    "anterpolation": constants.anterpolation_defines,
    "classes": constants.class_defines,
}
"""Generated pieces that hold constants of the host."""


@cache
def _file(name: str) -> str:
    return (resources.files("whitefurnace.kernels") / name).read_text("utf-8")


@cache
def everything() -> str:
    """Return a digest of all kernel files and shared constants, for results that many programs take part in."""
    digest, folders = hashlib.sha256(), [(resources.files("whitefurnace.kernels"), "")]
    digest.update("".join(make() for make in _CONSTANTS.values()).encode())
    while folders:
        folder, path = folders.pop()
        for item in sorted(folder.iterdir(), key=lambda item: item.name):
            if item.is_dir():
                folders.append((item, f"{path}{item.name}/"))
            elif item.name.endswith((".cl", ".clh")):
                digest.update(f"{path}{item.name}\n".encode() + item.read_bytes())
    return digest.hexdigest()


def assembled(
    program: str,
    slots: Mapping[str, Model] | None = None,
    area_terms: int = 0,
    *,
    cells: Sequence[str] | None = None,
    pieces: Mapping[str, str] | None = None,
    **words: str,
) -> Source:
    """Return the text of a program of `PROGRAMS` with its digest.

    slots: the models that it binds. area_terms: length of the table of Smith's area, 0 for none. cells: names of the
    numbers in a cell before those of the models, where the program leaves them open. pieces: texts of its generated
    pieces. words: values of the {words} in its file names and macros.
    """
    row, bound, texts = PROGRAMS[program], slots or {}, pieces or {}
    assert set(bound) <= set(row.slots), f"{program} binds {row.slots}, not {tuple(bound)}"
    lines: list[str] = []

    def add(name: str, text: str) -> None:
        quoted = printable(" ".join(name.split())).replace("\\", "/").replace('"', "'")
        lines.append(f'#line 1 "{quoted}"\n{text.rstrip()}\n')

    for piece in row.pieces:
        name = piece.strip("<>")
        if name == piece:
            file = piece.format(**words)
            add(file, _file(file))
        elif name == "bindings":
            defines = "".join(f"#define {define.format(**words)}\n" for define in row.defines)
            add(name, defines + bindings(bound, cells=row.cells if cells is None else cells, area_terms=area_terms))
        elif name == "models":
            for file in ("special.clh", *(("area_table.clh",) if area_terms else ())):
                add(file, _file(file))
            for entry in bound.values():
                if entry.text is None:
                    add(entry.kernel_file, _file(entry.kernel_file))
                    continue
                if entry.function:
                    add("user.clh", _file("user.clh"))
                add(MARK + (entry.path or entry.name), entry.text)
                if entry.function:
                    add("lanes", lanes(entry))
        else:
            add(name, _CONSTANTS[name]() if name in _CONSTANTS else texts[name])
    whole = "".join(lines)
    return Source(whole, hashlib.sha256(whole.encode()).hexdigest())


class EntryKey:
    """A model as a dictionary key. Two keys are equal only for the same entry, not for two entries of the same name."""

    def __init__(self, entry: Model) -> None:
        self.entry = entry

    def __eq__(self, other: object) -> bool:
        return isinstance(other, EntryKey) and self.entry is other.entry

    def __hash__(self) -> int:
        return id(self.entry)


def _kept(make: Callable[..., Source]) -> Callable[..., Source]:
    """Keep the last texts of a function by its arguments: a level asks for its programs at every launch."""
    made = lru_cache(maxsize=64)(lambda *given: make(*(g.entry if isinstance(g, EntryKey) else g for g in given)))

    @wraps(make)
    def found(*given: Any) -> Source:
        return made(*(EntryKey(g) if isinstance(g, Model) else g for g in given))

    return found


# ---------------------------------------------------------------------------------------------- integrals


def integration(integral: Integral, slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """Return the program of one integral over the models of `slots`, in the order ndf, masking, fresnel.

    area_terms: length of the tabulated Smith area that the masking reads, 0 for a closed form.
    """
    program = "integral" if slots["ndf"].isotropic else "integral of an anisotropic NDF"
    return assembled(program, slots, area_terms, integral=integral.name, support=integral.support)


def kinked(integral: Integral, slots: Mapping[str, Model], edges: int, area_terms: int = 0) -> Source:
    """Return the program of one integral over models with kinks.

    edges: number of polar angles at which panels meet; a cell holds them after n·v, and then π/2 less each.
    """
    names = [[f"{kind}_{k}" for k in range(edges)] for kind in ("edge", "rest")]
    listed = [", ".join(f"cell_{name}" for name in some) for some in names]
    kinks = sum(entry.kinks.on_ring for entry in slots.values() if entry.kinks)
    return assembled(
        "integral with kinks",
        slots,
        area_terms,
        cells=("NoV", *names[0], *names[1]),
        integral=integral.name,
        support=integral.support,
        kinks=str(kinks),
        edges=str(edges),
        edge_names=listed[0],
        rest_names=listed[1],
    )


def closed(file: str, slots: Mapping[str, Model]) -> Source:
    """Return the program of an integral that has a kernel of its own, `file`, for the models of `slots`.

    `catalogue.registry.CLOSED` lists these.
    """
    return assembled("integral in closed form", slots, file=file)


def transformed(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """Return the program that fits linearly transformed cosines to a specular BRDF and measures the fit."""
    return assembled("fit of linearly transformed cosines", slots, area_terms)


def refraction(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """Return the program of the light that a rough boundary reflects and refracts: slots ndf, masking, fresnel."""
    return assembled("rough boundary", slots, area_terms)


def area(ndf: Model) -> Source:
    """Return the program that computes the projected area of an NDF, for the table of Smith's area."""
    return assembled("table of Smith's area", {"ndf": ndf})


def hemisphere(entry: Model) -> Source:
    """Return the program of the directional albedo of a BRDF f(l, v): a diffuse model, or a user's whole BRDF."""
    program = "albedo of a diffuse model" if entry.slot == "diffuse" else "albedo of a whole BRDF"
    return assembled(
        program,
        {entry.slot: entry},
        pieces={"scatter": _scatter("sum[0] += w * DIFFUSE_F(l, v);" if entry.slot == "diffuse" else _WHOLE)},
    )


def evaluation(function: str, slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """Return the program that evaluates `function` (`NDF_D`, `MASKING_V`, …) of `slots` at given arguments.

    `SPECULAR_F` is the specular BRDF at (l, v) of the slots ndf, masking and fresnel. A cell holds the function's own
    arguments, three rows for a vector, then the numbers of the models.
    """
    rows, values = [], []
    for k, kind in enumerate(FUNCTIONS[function].kinds(is_isotropic(slots))):
        names = [f"{k}{axis}" for axis in (*"xyz",)] if kind is VECTOR else [str(k)]
        rows += names
        values.append(f"vec3({', '.join(f'cell_{n}' for n in names)})" if kind is VECTOR else f"cell_{names[0]}")
    call = f"{function}({', '.join(values)})" if values else function
    if function == "BRDF_F":
        result = (
            f"const real3 f = {call}; STORE(f.x, g, out); STORE(f.y, g, out + (size_t)cells); "
            "STORE(f.z, g, out + 2 * (size_t)cells);"
        )
    else:
        result = f"STORE({call}, g, out);"
    return assembled(
        "specular BRDF" if function == "SPECULAR_F" else "function of a model",
        slots,
        area_terms,
        cells=rows,
        pieces={"evaluate": f"#define EVALUATE {result}\n"},
    )


# ---------------------------------------------------------------------------------------------- radiance

_WHOLE = "const real3 f = BRDF_F(l, v); sum[0] += w * f.x; sum[1] += w * f.y; sum[2] += w * f.z;"


def _scatter(body: str) -> str:
    """Define `scatter`, which adds w f(l, v) to one sum or to one for each channel."""
    return f"static inline void scatter(real *sum, real w, real3 l, real3 v CELL_PARAMETERS) {{ {body} }}\n"


def _scatter_of(slots: Mapping[str, Model], components: int) -> str:
    """Define `scatter` for the BRDF of all slots together."""
    if "brdf" in slots:
        return _scatter(_WHOLE)
    terms = [term for slot, term in (("ndf", "SPECULAR_F(l, v)"), ("diffuse", "DIFFUSE_F(l, v)")) if slot in slots]
    sums = " ".join(f"sum[{c}] += f;" for c in range(components))
    return _scatter(f"const real f = w * ({' + '.join(terms)}); {sums}")


def outline(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """Return the program of reflected radiance over the outline of an area light, for one summand of the BRDF."""
    if "ndf" in slots:
        return assembled("light on a specular surface", slots, area_terms)
    program, components = ("light on a diffuse surface", 1) if "diffuse" in slots else ("light on a whole BRDF", 3)
    return assembled(program, slots, area_terms, pieces={"scatter": _scatter_of(slots, components)})


def lit_nodes(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """Return the program of reflected radiance over a list of an environment's nodes, for the whole BRDF."""
    program = "environment on a specular surface" if "ndf" in slots else "environment on a surface"
    return assembled(program, slots, area_terms, pieces={"scatter": _scatter_of(slots, 3)})


def frame_nodes(kind: str) -> Source:
    """Return the program that turns nodes of a source, "latlong" or "cube", into the frame of a surface."""
    return assembled("nodes in the frame of a surface", kind=kind)


def truth(slots: Mapping[str, Model], how: str, sets: int, area_terms: int = 0) -> Source:
    """Return the program of the reflectance integral at surface points.

    slots: ndf, masking and fresnel, or diffuse. how: the macro that says how directions are drawn. sets: how many sets
    of the models' numbers it sums at once.
    """
    return assembled(
        "reflectance integral", slots, area_terms, how=how, sets=str(sets), pieces={"between": "#undef TO_REAL\n"}
    )


# ---------------------------------------------------------------------------------------------- prefiltering


@_kept
def convolution(ndf: Model | None) -> Source:
    """Return the program of the zonal convolution with the lobe of an NDF, or with the cosine of irradiance for
    None.
    """
    return (
        assembled("convolution with the cosine") if ndf is None else assembled("convolution with an NDF", {"ndf": ndf})
    )


@_kept
def near_texels(kind: str, ndf: Model) -> Source:
    """Return the program of the exact integral of a narrow lobe over the texels near its direction.

    kind: "latlong" or "cube", the form of the source.
    """
    return assembled("texels near a narrow lobe", {"ndf": ndf}, kind=kind)


@_kept
def octahedral() -> Source:
    """Return the program of the zonal convolution by the symmetries of the cube, with any lobe."""
    return assembled("convolution by the symmetries of the cube")


@_kept
def apart(ndf: Model | None) -> Source:
    """Return the program of the excess of bright texels under the lobe of an NDF, or under the cosine for None."""
    return (
        assembled("bright texels under the cosine")
        if ndf is None
        else assembled("bright texels under an NDF", {"ndf": ndf})
    )


@_kept
def interpolation() -> Source:
    """Return the program that interpolates levels from their values at the nodes of a grid."""
    return assembled("interpolation")


@_kept
def texels(kind: str) -> Source:
    """Return the program of a source's nodes, their anterpolation and spherical harmonics.

    kind: "latlong" or "cube", the form of the source.
    """
    return assembled("nodes and harmonics", kind=kind)


@_kept
def samples() -> Source:
    """Return the program of a cube's pyramid and the filtered importance sampling of it."""
    return assembled("importance sampling")


@_kept
def overlap() -> Source:
    """Return the program of exact areas of overlap, which makes level 0."""
    return assembled("means over texels")


def demo() -> Source:
    """Return the program of the built-in environment."""
    return assembled("built-in environment")


def yardstick() -> Source:
    """Return the program that measures the limits of a device: multiply-adds and memory."""
    return assembled("limits of a device")
