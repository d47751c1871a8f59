"""Recipe -> one kernel text: only the files it needs, each under its own #line, and a digest of the whole."""
from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

from whitefurnace.catalogue import Integral, Model

# Kernel functions by the macro that binds them: the name's ending and the number of its own arguments.
FUNCTIONS = {
    "NDF_D": ("D", 2),
    "NDF_LAMBDA": ("lambda", 1),
    "NDF_WIDTH": ("width", 0),
    "MASKING_G1": ("G1", 1),
    "MASKING_G": ("G", 2),
    "FRESNEL_F": ("F", 1),
}


@dataclass(frozen=True)
class Source:
    """A program's text and its digest (sha256 hex)."""

    text: str
    digest: str


@cache
def _file(name: str) -> str:
    return (resources.files("whitefurnace.kernels") / name).read_text("utf-8")


def _assemble(parts: Sequence[str | tuple[str, str]]) -> Source:
    """Joins files (by name) and generated pieces (name, text), each with a #line that names it."""
    lines = []
    for part in parts:
        name, text = part if isinstance(part, tuple) else (part, _file(part))
        lines.append(f'#line 1 "{name}"\n{text.rstrip()}\n')
    whole = "".join(lines)
    return Source(whole, hashlib.sha256(whole.encode()).hexdigest())


def _bindings(slots: Mapping[str, Model]) -> str:
    """The #defines that bind each slot to its model: parameter lists, values and functions.

    Lists begin with a comma, so that a model without parameters leaves nothing behind. A slot whose model
    needs another slot's function carries that slot's parameters too.
    """
    lines = []
    own = {slot: [f"{slot}_{p.name}" for p in entry.parameters] for slot, entry in slots.items()}
    for slot, entry in slots.items():
        needed = {name.split("_")[0].lower() for name in entry.needs} - {slot}
        names = [n for other in sorted(needed) for n in own[other]] + own[slot]
        upper = slot.upper()
        for kind, prefix in (("PARAMETERS", "real "), ("VALUES", ""), ("SCALARS", "const scalar ")):
            lines.append(f"#define {upper}_{kind} " + "".join(f", {prefix}{n}" for n in names))
        carries = f" {upper}_VALUES" if needed or entry.slot in ("masking", "fresnel") else None
        for function in entry.provides:
            ending, count = FUNCTIONS[function]
            dummies = [f"a{k}" for k in range(count)]
            target = f"{slot}_{entry.name}_{ending}"
            if carries is None:  # a self-contained model names its parameters in its own signature
                values = ", ".join(dummies + names)
                bound = function
                if function == "NDF_D":  # D is 0 for backfacing m, whatever the model: said here, once for all
                    bound = "NDF_D_FRONT"
                    lines.append("#define NDF_D(a0, a1) ((a0) > 0 ? NDF_D_FRONT(a0, a1) : (real)0)")
                lines.append(f"#define {bound}{'(' + ', '.join(dummies) + ')' if count else ''} {target}({values})")
            else:
                lines.append(f"#define {function}({', '.join(dummies)}) {target}({', '.join(dummies)}{carries})")
    names = [n for slot in slots for n in own[slot]]
    lines.append("#define CELL_PARAMETERS " + "".join(f", real {n}" for n in names))
    lines.append("#define CELL_VALUES " + "".join(f", {n}" for n in names))
    lines.append("#define CELL_ARRAYS , __global const scalar *restrict cell_values")
    loads = ["real cell_NoV = LOAD(g, cell_values);"]
    loads += [f"real {n} = LOAD(g, cell_values + (size_t){k + 1} * cells);" for k, n in enumerate(names)]
    lines.append("#define CELL_LOAD " + " ".join(loads))
    return "\n".join(lines) + "\n"


def cell_parameters(slots: Mapping[str, Model]) -> list[tuple[str, str]]:
    """(slot, parameter) in the order in which `integrate` reads them, after n·v."""
    return [(slot, p.name) for slot, entry in slots.items() for p in entry.parameters]


def integration(integral: Integral, slots: Mapping[str, Model]) -> Source:
    """The program of one integral over the models of `slots` (in the order ndf, masking, fresnel)."""
    support = "#define HALF_ANGLE\n" if integral.half_angle else ""
    return _assemble(["real.clh", ("bindings", support + _bindings(slots)), *(m.kernel_file for m in slots.values()),
                      "ring.clh", f"integrand/{integral.name}.clh", "integrate.cl"])


def convolution(ndf: Model | None) -> Source:
    """The zonal convolution with the lobe of an NDF, or with the cosine lobe of irradiance for None."""
    if ndf is None:
        return _assemble(["real.clh", "lobe_cosine.clh", "prefilter.cl"])
    return _assemble(["real.clh", ("bindings", _bindings({"ndf": ndf})), ndf.kernel_file, "lobe.clh", "prefilter.cl"])


def texels(kind: str) -> Source:
    """Nodes and anterpolation of a source of the kind "latlong" or "cube", and spherical harmonics."""
    return _assemble(["real.clh", "sphere.clh", f"texels/{kind}.clh", "anterpolate.cl", "harmonics.cl"])


def overlap() -> Source:
    """Exact areas of overlap, for level 0."""
    return _assemble(["real.clh", "sphere.clh", "overlap.cl"])


def demo() -> Source:
    """The built-in environment."""
    return _assemble(["real.clh", "demo.cl"])
