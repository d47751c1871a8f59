"""The functions that kernels call on models, and the `#define` lines that bind them to the models of a program.

A kernel calls a model by the name of its slot: `NDF_D`, `MASKING_V`, `FRESNEL_F`. For each program the host chooses one
model a slot and writes `#define NDF_D_FRONT(a0, a1) (ndf_ggx_D(a0, a1, ndf_alpha))`, so that a program holds exactly
the models that it needs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

from whitefurnace.catalogue import Model


class Kind(Enum):
    """The kinds of a kernel function's own parameters."""

    NUMBER = "number"
    """One `real`."""

    VECTOR = "vector"
    """One `real3`, in the frame of the surface, whose normal is +z."""

    DIRECTION = "direction"
    """The cosine of the angle to the normal where the NDF is isotropic, the unit vector where it is not."""


NUMBER, VECTOR, DIRECTION = Kind.NUMBER, Kind.VECTOR, Kind.DIRECTION

_PAIR_OF_DIRECTIONS = {"NoV": NUMBER, "NoL": NUMBER, "NoH": NUMBER, "VoH": NUMBER, "at_v": NUMBER, "at_l": NUMBER}


@dataclass(frozen=True)
class Function:
    """A function that the models of a slot provide.

    ending: end of its name in a kernel file, `D` in `ndf_ggx_D`.
    parameters: names of its own parameters in order; the numbers of the model follow them.
    anisotropic: the parameters that replace them where the NDF is anisotropic; None where nothing changes.
    """

    ending: str
    parameters: Mapping[str, Kind] = field(default_factory=dict)
    anisotropic: Mapping[str, Kind] | None = None

    def kinds(self, isotropic: bool) -> tuple[Kind, ...]:
        """Return the kinds of the function's own parameters, NUMBER or VECTOR.

        isotropic: True if the NDF of the program is isotropic.
        """
        chosen = self.parameters if isotropic or self.anisotropic is None else self.anisotropic
        here = NUMBER if isotropic else VECTOR
        return tuple(here if kind is DIRECTION else kind for kind in chosen.values())


FUNCTIONS: Mapping[str, Function] = {
    "NDF_D": Function("D", {"cos_m": NUMBER, "sin2_m": NUMBER}, anisotropic={"m": VECTOR}),
    "NDF_AREA": Function("area", {"v": DIRECTION}),
    "NDF_WIDTH": Function("width"),
    "NDF_REACH": Function("reach"),
    "NDF_STRETCH_X": Function("stretch_x"),
    "NDF_STRETCH_Y": Function("stretch_y"),
    "NDF_SAMPLE": Function("sample", {"u": NUMBER}),
    "MASKING_AT": Function("at", {"v": DIRECTION}),
    "MASKING_V": Function("V", _PAIR_OF_DIRECTIONS),
    "MASKING_G": Function("G", _PAIR_OF_DIRECTIONS),
    "MASKING_G1": Function("G1", {"NoV": NUMBER, "at_v": NUMBER}),
    "MASKING_KINK": Function("kink", {"NoV": NUMBER, "NoM": NUMBER}),
    "MASKING_KINK_2": Function("kink_2", {"NoV": NUMBER, "NoM": NUMBER}),
    "FRESNEL_KINK": Function("kink", {"NoV": NUMBER, "NoM": NUMBER}),
    "FRESNEL_F": Function("F", {"cos_d": NUMBER}),
    "DIFFUSE_F": Function("f", {"l": VECTOR, "v": VECTOR}),
    "BRDF_F": Function("f", {"l": VECTOR, "v": VECTOR}),
    "LIGHT_L": Function("L", {"l": VECTOR}),
    "LIGHT_C": Function("C", {"n": VECTOR}),
    "SPECULAR_F": Function("f", {"l": VECTOR, "v": VECTOR}),
}
"""Every function that kernels call on models, by the macro that binds it. `SPECULAR_F` is no model's: `specular.clh`
makes it from the slots ndf, masking and fresnel together."""

SELF_CONTAINED = ("ndf", "diffuse", "brdf", "light")
"""Slots whose functions take their model's numbers one by one; those of the others take whole lists (`…_VALUES`),
since they may need the numbers of another slot too."""

AREA_NUMBERS = ("ndf_area_scale", "ndf_area_per_range", "ndf_area_grazing")
"""The numbers before the terms of a table of Smith's area (`area_table.clh`)."""

Declared = tuple[str, str]
"""C type and name of one parameter."""


def is_isotropic(slots: Mapping[str, Model]) -> bool:
    """Return whether the models of a program do not depend on the azimuth: there is no NDF, or it is isotropic."""
    return "ndf" not in slots or slots["ndf"].isotropic


def bindings(slots: Mapping[str, Model], *, cells: Sequence[str] = ("NoV",), area_terms: int = 0) -> str:
    """Return the `#define` lines that bind each slot to its model: parameter lists, values and functions.

    slots: the models of the program, in the order in which a cell holds their numbers.
    cells: names of the numbers that a cell holds before those of the models.
    area_terms: length of the table of Smith's area that a cell holds after them; 0 for no table.

    Lists begin with a comma, so that a model without parameters adds nothing. A slot whose model calls a function of
    another slot also has the parameters of that slot.
    """
    isotropic = is_isotropic(slots)
    own: dict[str, list[Declared]] = {
        slot: [("real", f"{slot}_{name}") for name in entry.arguments] for slot, entry in slots.items()
    }
    table: list[Declared] = (
        [*(("real", name) for name in AREA_NUMBERS), ("const real *", "ndf_area_terms")] if area_terms else []
    )
    lines = [
        f"#define DIRECTION {'real' if isotropic else 'real3'}",
        f"#define COS_OF(d) {'(d)' if isotropic else '((d).z)'}",
        *([] if isotropic else ["#define ANISOTROPIC"]),
        *([f"#define AREA_TERMS {area_terms}"] if area_terms else []),
    ]
    for slot, entry in slots.items():
        lines += _list_lines(slot, entry, own, table)
        kinks = [f"{slot.upper()}_KINK{end}" for end in ("", "_2")[: entry.kinks.on_ring if entry.kinks else 0]]
        for function in (*entry.provides, *kinks):
            lines += _function_lines(slot, entry, function, isotropic)
    lines += _default_lines(slots, isotropic, bool(area_terms))
    lines += _cell_lines(cells, [name for slot in slots for name in own[slot]], table)
    return "\n".join(lines) + "\n"


def _list_lines(slot: str, entry: Model, own: Mapping[str, list[Declared]], table: list[Declared]) -> list[str]:
    """Define the three lists of numbers of a slot: as parameters, as arguments, and as scalar kernel arguments."""
    needed = {name.split("_")[0].lower() for name in entry.needs} - {slot}
    listed = [n for other in sorted(needed) for n in own[other]] + own[slot]
    if slot == "ndf" or "ndf" in needed:
        listed = listed + table
    plain = [n for n in listed if n not in table]
    upper = slot.upper()
    return [
        f"#define {upper}_PARAMETERS " + "".join(f", {kind} {name}" for kind, name in listed),
        f"#define {upper}_VALUES " + "".join(f", {name}" for _, name in listed),
        f"#define {upper}_SCALARS " + "".join(f", const scalar {name}" for _, name in plain),
    ]


def _function_lines(slot: str, entry: Model, function: str, isotropic: bool) -> list[str]:
    """Define the macro of one function of a model."""
    known = FUNCTIONS[function]
    dummies = [f"a{k}" for k in range(len(known.kinds(isotropic)))]
    passed = dummies[:1] if function == "NDF_D" and not entry.takes_sin2 else dummies
    target = f"lanes_{slot}" if entry.function else f"{slot}_{entry.name}_{known.ending}"
    if slot in SELF_CONTAINED:
        call = f"{target}({', '.join([*passed, *(f'{slot}_{n}' for n in entry.passed(function))])})"
    else:
        call = f"{target}({', '.join(passed)} {slot.upper()}_VALUES)"
    head = f"({', '.join(dummies)})" if dummies else ""
    if function != "NDF_D":
        return [f"#define {function}{head} {call}"]
    # For every model D is 0 for backfacing m, and a user's D is divided by its norm; both are written only here.
    front = (
        "#define NDF_D(a0, a1) ((a0) > 0 ? NDF_D_FRONT(a0, a1) : (real)0)"
        if isotropic
        else "#define NDF_D(a0) ((a0).z > 0 ? NDF_D_FRONT(a0) : (real)0)"
    )
    return [front, f"#define NDF_D_FRONT{head} ({'' if entry.text is None else 'ndf_per_norm * '}{call})"]


def lanes(entry: Model) -> str:
    """Return the function `lanes_SLOT` that calls the function of a user's file for each lane by itself.

    The compiler makes vectors of the loop where it can: a function without branches takes the time of explicit lanes. A
    D is called where n·m is in (0, 1] alone, since a square root or an index of the user's may fail elsewhere.
    """
    kinds = list(FUNCTIONS[entry.provides[0]].parameters.values())
    if entry.slot == "ndf" and not entry.takes_sin2:
        kinds.pop()
    kinds += [NUMBER for _ in entry.parameters]
    rows: list[str] = []  # the numbers that a lane takes
    values: list[str] = []  # the arguments of the user's function, made of them
    for place, kind in enumerate(kinds):
        parts = [f"a{place}.{axis}" for axis in "xyz"] if kind is VECTOR else [f"a{place}"]
        taken = [f"in[{len(rows) + k}][k]" for k in range(len(parts))]
        rows += parts
        values.append(f"(scalar3)({', '.join(taken)})" if kind is VECTOR else taken[0])
    call = f"own_{entry.function}({', '.join(values)})"
    declared = ", ".join(f"real{'3' if kind is VECTOR else ''} a{place}" for place, kind in enumerate(kinds))
    loads = " ".join(f"USER_LANES({row}, in[{k}]);" for k, row in enumerate(rows))
    if entry.slot == "ndf":
        outputs, result = 1, "real"
        body = f"in[0][k] = fmin(in[0][k], (scalar)1); out[0][k] = in[0][k] > 0 ? {call} : (scalar)0;"
        returned = "USER_REAL(out[0])"
    else:
        outputs, result = 3, "real3"
        body = f"const scalar3 f = {call}; out[0][k] = f.x; out[1][k] = f.y; out[2][k] = f.z;"
        returned = "vec3(USER_REAL(out[0]), USER_REAL(out[1]), USER_REAL(out[2]))"
    return (
        f"static inline {result} lanes_{entry.slot}({declared}) {{\n"
        f"  scalar in[{len(rows)}][W], out[{outputs}][W];\n  {loads}\n"
        f"  for (int k = 0; k < W; k++) {{ {body} }}\n  return {returned};\n}}\n"
    )


def _default_lines(slots: Mapping[str, Model], isotropic: bool, tabled: bool) -> list[str]:
    """Define the functions that the models of a program do not provide."""
    lines = []
    if tabled:
        lines.append(f"#define NDF_AREA(d) area_of_table(d, {', '.join(AREA_NUMBERS)}, ndf_area_terms)")
    if "ndf" in slots:
        if slots["ndf"].text is not None:
            lines.append("#define NDF_WIDTH ndf_lobe_width")
        if not any("NDF_REACH" in entry.provides for entry in slots.values()):
            # Polar angle; stretched slope for anisotropic ones, where A has α/r beyond r for the longest tail.
            lines.append(f"#define NDF_REACH ((real){'HALF_PI' if isotropic else '(PRECISION == 64 ? 1e14f : 1e7f)'})")
    if "masking" not in slots:
        lines.append("#define MASKING_AT(d) ((real)0)")
    return lines


def _cell_lines(cells: Iterable[str], numbers: list[Declared], table: list[Declared]) -> list[str]:
    """Define how a work item loads its cell: one row for each number, first those named in `cells`."""
    rows = [*(f"cell_{name}" for name in cells), *(name for _, name in numbers)]
    loads = [f"const real {name} = LOAD(g, cell_values + (size_t){k} * cells);" for k, name in enumerate(rows)]
    if table:
        first = len(rows)
        loads += [
            f"const real {name} = LOAD(g, cell_values + (size_t){first + k} * cells);"
            for k, name in enumerate(AREA_NUMBERS)
        ]
        loads.append(
            f"real ndf_area_terms[AREA_TERMS]; for (int k = 0; k < AREA_TERMS; k++) "
            f"ndf_area_terms[k] = LOAD(g, cell_values + (size_t)({first + len(AREA_NUMBERS)} + k) * cells);"
        )
    return [
        "#define CELL_PARAMETERS " + "".join(f", {kind} {name}" for kind, name in [*numbers, *table]),
        "#define CELL_VALUES " + "".join(f", {name}" for _, name in [*numbers, *table]),
        "#define CELL_ARRAYS , __global const scalar *restrict cell_values",
        "#define CELL_LOAD " + " ".join(loads),
    ]
