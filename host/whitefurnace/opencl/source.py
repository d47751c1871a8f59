"""Recipe -> one kernel text: only the files it needs, each under its own #line, and a digest of the whole."""
from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, wraps
from importlib import resources
from typing import Any

from whitefurnace.catalogue import Integral, Model
from whitefurnace.opencl import constants

# Kernel functions by the macro that binds them: the name's ending and its own arguments, s a number, v a vector,
# d a direction (a cosine for isotropic NDFs, a vector for anisotropic ones).
FUNCTIONS = {
    "NDF_D": ("D", "ss"),
    "NDF_AREA": ("area", "d"),
    "NDF_WIDTH": ("width", ""),
    "NDF_REACH": ("reach", ""),
    "NDF_STRETCH_X": ("stretch_x", ""),
    "NDF_STRETCH_Y": ("stretch_y", ""),
    "NDF_SAMPLE": ("sample", "s"),
    "MASKING_AT": ("at", "d"),
    "MASKING_V": ("V", "ssssss"),
    "MASKING_G": ("G", "ssssss"),
    "MASKING_G1": ("G1", "ss"),
    "FRESNEL_F": ("F", "s"),
    "DIFFUSE_F": ("f", "vv"),
    "BRDF_F": ("f", "vv"),
    "LIGHT_L": ("L", "v"),
    "LIGHT_C": ("C", "v"),
    "SPECULAR_F": ("f", "vv"),  # of the slots ndf, masking and fresnel together: specular.clh
}

LOBE_WIDTH = 0.05
"""Where the rule of a user's BRDF grades its half vectors, radians: lobes ten times narrower are still met."""

LEAST_COSINE = 1e-9
"""The least cosine a BRDF given as f(l, v) is asked at, for those that divide by it: the limit for all purposes."""


@dataclass(frozen=True)
class Source:
    """A program's text and its digest (sha256 hex)."""

    text: str
    digest: str


@cache
def _file(name: str) -> str:
    return (resources.files("whitefurnace.kernels") / name).read_text("utf-8")


@cache
def everything() -> str:
    """A digest of all kernel files, for programs that are put together as they are needed."""
    digest, folders = hashlib.sha256(), [(resources.files("whitefurnace.kernels"), "")]
    while folders:
        folder, path = folders.pop()
        for item in sorted(folder.iterdir(), key=lambda item: item.name):
            if item.is_dir():
                folders.append((item, f"{path}{item.name}/"))
            elif item.name.endswith((".cl", ".clh")):
                digest.update(f"{path}{item.name}\n".encode() + item.read_bytes())
    return digest.hexdigest()


def _assemble(parts: Sequence[str | tuple[str, str]]) -> Source:
    """Joins files (by name) and generated pieces (name, text), each with a #line that names it."""
    lines = []
    for part in parts:
        name, text = part if isinstance(part, tuple) else (part, _file(part))
        quoted = name.replace("\\", "/").replace('"', "'")
        lines.append(f'#line 1 "{quoted}"\n{text.rstrip()}\n')
    whole = "".join(lines)
    return Source(whole, hashlib.sha256(whole.encode()).hexdigest())


class _Very:
    """A model as the key of what is made from it: this very entry, not one of the same name."""

    def __init__(self, entry: Model) -> None:
        self.entry = entry

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Very) and self.entry is other.entry

    def __hash__(self) -> int:
        return id(self.entry)


def _kept(make: Callable[..., Source]) -> Callable[..., Source]:
    """The same text for the same arguments: a level asks for its programs at every launch."""
    made = lru_cache(maxsize=64)(lambda *given: make(*(g.entry if isinstance(g, _Very) else g for g in given)))

    @wraps(make)
    def found(*given: Any) -> Source:
        return made(*(_Very(g) if isinstance(g, Model) else g for g in given))

    return found


def arguments(function: str, isotropic: bool = True) -> str:
    """The own arguments of a kernel function, s for a number and v for a vector."""
    if function == "NDF_D" and not isotropic:
        return "v"
    return FUNCTIONS[function][1].replace("d", "s" if isotropic else "v")


def _model_text(entry: Model) -> str | tuple[str, str]:
    return entry.kernel_file if entry.text is None else (entry.path or entry.name, entry.text)


def _bindings(slots: Mapping[str, Model], *, cells: Sequence[str] = ("NoV",), area_terms: int = 0) -> str:
    """The #defines that bind each slot to its model: parameter lists, values and functions.

    Lists begin with a comma, so that a model without parameters leaves nothing behind. A slot whose model
    needs another slot's function carries that slot's parameters too. `cells` names the rows of a cell before the
    models' numbers; `area_terms` is the length of the tabulated Smith area, 0 for none.
    """
    isotropic = "ndf" not in slots or slots["ndf"].isotropic
    lines = [f"#define DIRECTION {'real' if isotropic else 'real3'}",
             f"#define COS_OF(d) {'(d)' if isotropic else '((d).z)'}"]
    if not isotropic:
        lines.append("#define ANISOTROPIC")
    area = [f"ndf_area_{name}" for name in ("scale", "per_range", "grazing")]
    table = [*(("real", name) for name in area), ("const real *", "ndf_area_terms")] if area_terms else []
    if area_terms:
        lines.append(f"#define AREA_TERMS {area_terms}")
    own = {slot: [("real", f"{slot}_{name}") for name in entry.arguments] for slot, entry in slots.items()}
    bound: set[str] = set()
    for slot, entry in slots.items():
        needed = {name.split("_")[0].lower() for name in entry.needs} - {slot}
        listed = [n for other in sorted(needed) for n in own[other]] + own[slot]
        if slot == "ndf" or "ndf" in needed:
            listed += table
        upper = slot.upper()
        for kind, form in (("PARAMETERS", ", {0} {1}"), ("VALUES", ", {1}"), ("SCALARS", ", const scalar {1}")):
            kept = [n for n in listed if kind != "SCALARS" or n not in table]
            lines.append(f"#define {upper}_{kind} " + "".join(form.format(*n) for n in kept))
        for function in entry.provides:
            ending = FUNCTIONS[function][0]
            dummies = [f"a{k}" for k in range(len(arguments(function, isotropic)))]
            passed = dummies[:1] if function == "NDF_D" and not entry.takes_sin2 else dummies
            target, name = f"{slot}_{entry.name}_{ending}", function
            head = f"({', '.join(dummies)})" if dummies else ""
            if slot in ("ndf", "diffuse", "brdf", "light"):  # self-contained: its signature names its own numbers
                call = f"{target}({', '.join([*passed, *(f'{slot}_{n}' for n in entry.passed(function))])})"
                if function == "NDF_D":
                    # D is 0 for backfacing m, whatever the model, and a user's is divided by its norm: said once.
                    name, scaled = "NDF_D_FRONT", "" if entry.text is None else "ndf_per_norm * "
                    lines.append("#define NDF_D(a0) ((a0).z > 0 ? NDF_D_FRONT(a0) : (real)0)" if not isotropic else
                                 "#define NDF_D(a0, a1) ((a0) > 0 ? NDF_D_FRONT(a0, a1) : (real)0)")
                    call = f"({scaled}{call})"
            else:
                call = f"{target}({', '.join(passed)} {upper}_VALUES)"
            lines.append(f"#define {name}{head} {call}")
            bound.add(function)
    if area_terms:
        lines.append("#define NDF_AREA(d) area_of_table(d, " + ", ".join(area) + ", ndf_area_terms)")
    if "ndf" in slots:
        if slots["ndf"].text is not None:
            lines.append("#define NDF_WIDTH ndf_lobe_width")
        if "NDF_REACH" not in bound:
            # Polar angle; stretched slope for anisotropic ones, where A has α/r beyond r for the longest tail.
            lines.append(f"#define NDF_REACH ((real){'HALF_PI' if isotropic else '(PRECISION == 64 ? 1e14f : 1e7f)'})")
    if "masking" not in slots:
        lines.append("#define MASKING_AT(d) ((real)0)")
    rows = [*(f"cell_{name}" for name in cells), *(n for slot in slots for _, n in own[slot])]
    names = [n for slot in slots for n in own[slot]] + table
    lines.append("#define CELL_PARAMETERS " + "".join(f", {kind} {n}" for kind, n in names))
    lines.append("#define CELL_VALUES " + "".join(f", {n}" for _, n in names))
    lines.append("#define CELL_ARRAYS , __global const scalar *restrict cell_values")
    loads = [f"const real {n} = LOAD(g, cell_values + (size_t){k} * cells);" for k, n in enumerate(rows)]
    if area_terms:
        first = len(rows)
        for k, name in enumerate(area):
            loads.append(f"const real {name} = LOAD(g, cell_values + (size_t){first + k} * cells);")
        loads.append(f"real ndf_area_terms[AREA_TERMS]; for (int k = 0; k < AREA_TERMS; k++) "
                     f"ndf_area_terms[k] = LOAD(g, cell_values + (size_t)({first + len(area)} + k) * cells);")
    lines.append("#define CELL_LOAD " + " ".join(loads))
    return "\n".join(lines) + "\n"


def cell_parameters(slots: Mapping[str, Model]) -> list[tuple[str, str]]:
    """(slot, number) in the order in which kernels read them: parameters and constants of each slot."""
    return [(slot, name) for slot, entry in slots.items() for name in entry.arguments]


def _models(slots: Mapping[str, Model], area_terms: int) -> list[str | tuple[str, str]]:
    """The texts of the models, and of the table where Smith's area comes from one."""
    return ["special.clh", *(["area_table.clh"] if area_terms else []), *(_model_text(m) for m in slots.values())]


def integration(integral: Integral, slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """The program of one integral over the models of `slots` (in the order ndf, masking, fresnel)."""
    isotropic = slots["ndf"].isotropic
    cells = ("NoV",) if isotropic else ("NoV", "phi")
    support = f"#define {integral.support}\n"
    return _assemble(["real.clh", ("bindings", support + _bindings(slots, cells=cells, area_terms=area_terms)),
                      *_models(slots, area_terms), "facet.clh", *(["ring.clh"] if isotropic else []),
                      f"integrand/{integral.name}.clh", "integrate.cl" if isotropic else "stretched.cl"])


def closed(file: str, slots: Mapping[str, Model]) -> Source:
    """The program of an integral that has a kernel of its own for these models (`catalogue.registry.CLOSED`)."""
    return _assemble(["real.clh", ("bindings", _bindings(slots)), *_models(slots, 0), file])


def transformed(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """The program that fits linearly transformed cosines to a specular BRDF and tells how far they are from it."""
    cells = ("NoV", "per_albedo", "xx", "xz", "zx", "zz")
    return _assemble(["real.clh", ("bindings", "#define HALF_ANGLE\n" + _bindings(slots, cells=cells,
                                                                                 area_terms=area_terms)),
                      *_models(slots, area_terms), "facet.clh", "ring.clh", "specular.clh", "ltc.cl"])


def refraction(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """The program of what a rough boundary reflects and refracts, of the slots ndf, masking and fresnel."""
    return _assemble(["real.clh", ("bindings", _bindings(slots, area_terms=area_terms)), *_models(slots, area_terms),
                      "glass.cl"])


def area(ndf: Model) -> Source:
    """The program that makes the table of Smith's area."""
    return _assemble(["real.clh", ("bindings", "#define POLAR\n" + _bindings({"ndf": ndf})), *_models({"ndf": ndf}, 0),
                      "ring.clh", "area.cl"])


def hemisphere(entry: Model) -> Source:
    """The program of the directional albedo of a BRDF f(l, v): a diffuse model, or a user's whole one."""
    smooth = entry.slot == "diffuse"
    result = ("sum[0] += w * DIFFUSE_F(l, v);" if smooth else
              "const real3 f = BRDF_F(l, v); sum[0] += w * f.x; sum[1] += w * f.y; sum[2] += w * f.z;")
    defines = (f"{'#define SMOOTH' if smooth else '#define HALF_ANGLE'}\n#define AZIMUTH_PANELS {2 if smooth else 4}\n"
               f"#define COMPONENTS {1 if smooth else 3}\n#define LOBE_WIDTH ((scalar){LOBE_WIDTH!r})\n"
               f"#define LEAST_COSINE ((scalar){LEAST_COSINE!r})\n")
    scatter = f"static inline void scatter(real *sum, real w, real3 l, real3 v CELL_PARAMETERS) {{ {result} }}\n"
    slots = {entry.slot: entry}
    cells = ("NoV",) if smooth else ("NoV", "phi")
    return _assemble(["real.clh", ("bindings", defines + _bindings(slots, cells=cells)),
                      *_models(slots, 0), *([] if smooth else ["ring.clh"]), ("scatter", scatter), "hemisphere.cl"])


def evaluation(function: str, slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """The program that evaluates `function` (`NDF_D`, `MASKING_V`, …) of `slots` at given arguments: `evaluate.cl`.

    `SPECULAR_F` is the specular BRDF at (l, v), of the slots ndf, masking and fresnel.

    A cell holds the function's own arguments, three rows for a vector, then the models' numbers.
    """
    isotropic = "ndf" not in slots or slots["ndf"].isotropic
    rows, values = [], []
    whole = function == "SPECULAR_F"
    for k, kind in enumerate(arguments(function, isotropic)):
        names = [f"{k}{axis}" for axis in ("xyz" if kind == "v" else ("",))]
        rows += names
        values.append(f"vec3({', '.join(f'cell_{n}' for n in names)})" if kind == "v" else f"cell_{names[0]}")
    call = f"{function}({', '.join(values)})" if values else function
    if function == "BRDF_F":
        result = (f"const real3 f = {call}; STORE(f.x, g, out); STORE(f.y, g, out + (size_t)cells); "
                  "STORE(f.z, g, out + 2 * (size_t)cells);")
    else:
        result = f"STORE({call}, g, out);"
    return _assemble(["real.clh", ("bindings", _bindings(slots, cells=rows, area_terms=area_terms)),
                      *_models(slots, area_terms), *(["specular.clh"] if whole else []),
                      ("evaluate", f"#define EVALUATE {result}\n"), "evaluate.cl"])


OUTLINE = ("Cx", "Cy", "Cz", "Ax", "Ay", "Az", "Bx", "By", "Bz", "length", "scale")
"""A panel of an area light's outline as `radiance_outline.cl` reads it, after the view."""


def _scatter(slots: Mapping[str, Model], components: int) -> str:
    """`scatter`: adds w f(l, v) of the slots, all together, to one sum or to one for each channel."""
    terms = [term for slot, term in (("ndf", "SPECULAR_F(l, v)"), ("diffuse", "DIFFUSE_F(l, v)")) if slot in slots]
    if "brdf" in slots:
        body = "const real3 f = BRDF_F(l, v); sum[0] += w * f.x; sum[1] += w * f.y; sum[2] += w * f.z;"
    else:
        body = f"const real f = w * ({' + '.join(terms)}); " + " ".join(f"sum[{c}] += f;" for c in range(components))
    return f"static inline void scatter(real *sum, real w, real3 l, real3 v CELL_PARAMETERS) {{ {body} }}\n"


def outline(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """The program of reflected radiance over the outline of an area light, of one summand of the BRDF."""
    specular = "ndf" in slots
    kind = "" if specular else "#define SMOOTH\n" if "diffuse" in slots else "#define WHOLE\n"
    components = 3 if "brdf" in slots else 1
    defines = (f"{kind}#define COMPONENTS {components}\n#define LOBE_WIDTH ((scalar){LOBE_WIDTH!r})\n"
               f"#define LEAST_COSINE ((scalar){LEAST_COSINE!r})\n")
    return _assemble(["real.clh", ("bindings", defines + _bindings(slots, cells=("NoV", "phi", *OUTLINE),
                                                                   area_terms=area_terms)),
                      *_models(slots, area_terms),
                      "facet.clh" if specular else ("scatter", _scatter(slots, components)), "radiance_outline.cl"])


def lit_nodes(slots: Mapping[str, Model], area_terms: int = 0) -> Source:
    """The program of reflected radiance over a list of an environment's nodes, of the whole BRDF."""
    defines = f"#define LEAST_COSINE ((scalar){LEAST_COSINE!r})\n"
    return _assemble(["real.clh", ("bindings", defines + _bindings(slots, cells=("NoV", "phi"),
                                                                   area_terms=area_terms)),
                      *_models(slots, area_terms), *(["specular.clh"] if "ndf" in slots else []),
                      ("scatter", _scatter(slots, 3)), "radiance_nodes.cl"])


def frame_nodes(kind: str) -> Source:
    """Nodes of a source of the kind "latlong" or "cube" in the frame of a surface."""
    return _assemble(["real.clh", "sphere.clh", f"texels/{kind}.clh", "radiance_texels.cl"])


@_kept
def convolution(ndf: Model | None) -> Source:
    """The zonal convolution with the lobe of an NDF, or with the cosine lobe of irradiance for None."""
    if ndf is None:
        return _assemble(["real.clh", "window.clh", "lobe_cosine.clh", "prefilter.cl"])
    return _assemble(["real.clh", ("bindings", _bindings({"ndf": ndf})), *_models({"ndf": ndf}, 0), "window.clh",
                      "lobe.clh", "prefilter.cl"])


@_kept
def near_texels(kind: str, ndf: Model) -> Source:
    """The exact integral of a narrow lobe over the texels near its direction, of a source of the kind "latlong" or
    "cube"."""
    return _assemble(["real.clh", "sphere.clh", f"texels/{kind}.clh", ("bindings", _bindings({"ndf": ndf})),
                      *_models({"ndf": ndf}, 0), "window.clh", "lobe.clh", "exact.cl"])


@_kept
def octahedral() -> Source:
    """The zonal convolution by the symmetries of the cube, of any lobe."""
    return _assemble(["real.clh", "sphere.clh", ("constants", constants.class_defines()), "orbits.clh", "window.clh",
                      "lobe_table.clh", "octahedral.cl"])


@_kept
def apart(ndf: Model | None) -> Source:
    """The excess of bright texels under the lobe of an NDF, or under the cosine of irradiance for None."""
    if ndf is None:
        return _assemble(["real.clh", "sphere.clh", "orbits.clh", "lobe_cosine.clh", "apart.cl"])
    return _assemble(["real.clh", "sphere.clh", "orbits.clh", ("bindings", _bindings({"ndf": ndf})),
                      *_models({"ndf": ndf}, 0), "lobe.clh", "apart.cl"])


@_kept
def interpolation() -> Source:
    """Levels from their values at the nodes of a grid."""
    return _assemble(["real.clh", "sphere.clh", ("constants", constants.grid_defines()), "grid.clh", "interpolate.cl"])


@_kept
def texels(kind: str) -> Source:
    """Nodes and anterpolation of a source of the kind "latlong" or "cube", and spherical harmonics."""
    shared = constants.grid_defines() + constants.anterpolation_defines()
    return _assemble(["real.clh", "sphere.clh", f"texels/{kind}.clh", ("constants", shared), "grid.clh",
                      "anterpolate.cl", "harmonics.cl"])


@_kept
def samples() -> Source:
    """The pyramid of a cube, and filtered importance sampling of it."""
    return _assemble(["real.clh", "sphere.clh", "pyramid.cl", "samples.cl"])


def truth(slots: Mapping[str, Model], how: str, sets: int, area_terms: int = 0) -> Source:
    """The reflectance integral of surface points: of the slots ndf, masking and fresnel, or of a diffuse model, with
    directions drawn as `how` says, for `sets` sets of numbers."""
    defines = f"#define {how}\n#define SETS {sets}\n"
    # samples.cl makes reals of what special.clh calls bits: one macro, of either.
    bound = defines + _bindings(slots, cells=(), area_terms=area_terms)
    return _assemble(["real.clh", "sphere.clh", ("bindings", bound), *_models(slots, area_terms),
                      ("between", "#undef TO_REAL\n"), "pyramid.cl", "samples.cl", "truth.cl"])


@_kept
def overlap() -> Source:
    """Exact areas of overlap, for level 0."""
    return _assemble(["real.clh", "sphere.clh", "overlap.cl"])


def demo() -> Source:
    """The built-in environment."""
    return _assemble(["real.clh", "demo.cl"])


def yardstick() -> Source:
    """What a device can do at most: multiply-adds and memory."""
    return _assemble(["real.clh", "yardstick.cl"])
