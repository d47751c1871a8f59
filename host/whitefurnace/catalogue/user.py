"""Models from a user's `.clh` file: an NDF with only D in it, or a whole BRDF."""

from __future__ import annotations

import re
from pathlib import Path

from whitefurnace.catalogue.model import Model, Paper, Parameter
from whitefurnace.errors import FileError, InputError, UsageError

FORMS = {
    "ndf": ("D", "real", "real cos_m[, real sin2_m][, real p1, …]"),
    "brdf": ("f", "real3", "real3 l, real3 v[, real p1, …]"),
}


CONSTANTS = ("per_norm", "lobe_width")
"""What the engine finds out about a user's D; its own parameters cannot have these names."""


def user_model(slot: str, path: str | Path) -> Model:
    """Return the model in the file `path` for the slot `ndf` or `brdf`; its signature names its parameters.

    An NDF is `real ndf_STEM_D(real cos_m, real p1, …)`, where STEM is the file's stem. It may have any scale, since the
    engine normalizes it. A second parameter `sin2_m` gets sin²θ. A BRDF is `real3 brdf_STEM_f(real3 l, real3 v, …)` in
    1/sr, in the local frame with n = +z. Raises UsageError for another slot, FileError where the file cannot be read,
    and InputError where it does not define such a function.
    """
    path = Path(path)
    if slot not in FORMS:
        raise UsageError(f"{slot} {str(path)!r}: only an ndf or a brdf can come from a file")
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not a text file") from None
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from None
    ending, result, form = FORMS[slot]
    name = f"{slot}_{path.stem}_{ending}"
    wanted = f"a file that defines {result} {name}({form})"
    if not path.stem.isidentifier() or not path.stem.isascii():
        raise InputError(f"{path}: the file's name must be a C identifier, since its function is named after it")
    bare = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.DOTALL)
    found = re.search(rf"\b{result}\s+{re.escape(name)}\s*\(([^)]*)\)\s*\{{", bare)
    if found is None:
        raise InputError(f"{path}: is not {wanted}")
    signature = []
    for item in found[1].split(","):
        words = item.split()
        if len(words) < 2 or words[-2] not in ("real", "real3"):
            raise InputError(f"{path}: parameter {item.strip()!r} of {name} is not `real NAME`; needed is {wanted}")
        signature.append((words[-2], words[-1]))
    own = [("real", "cos_m")] if slot == "ndf" else [("real3", "l"), ("real3", "v")]
    takes_sin2 = slot == "ndf" and len(signature) > 1 and signature[1] == ("real", "sin2_m")
    count = len(own) + takes_sin2
    rest = signature[count:]
    if [kind for kind, _ in signature[: len(own)]] != [kind for kind, _ in own] or any(k != "real" for k, _ in rest):
        raise InputError(f"{path}: {name} takes ({found[1].strip()}); needed is {wanted}")
    names = [name for _, name in rest]
    for name in names:
        if (
            name in CONSTANTS
            or names.count(name) > 1
            or name in ("area_scale", "area_per_range", "area_grazing", "area_terms")
        ):
            raise InputError(f"{path}: parameter {name!r} of the function is taken; give it another name")
    return Model(
        slot=slot,
        name=path.stem,
        title=f"from {path.name}",
        citation=Paper("", ""),
        parameters=tuple(Parameter(p, p, "", -1e30, 1e30, (), f"of {path.name}") for _, p in rest),
        provides=("NDF_D",) if slot == "ndf" else ("BRDF_F",),
        reference={},
        from_roughness=(lambda r: {"alpha": r * r}) if any(p == "alpha" for _, p in rest) else None,
        constant_names=CONSTANTS if slot == "ndf" else (),
        text=text,
        path=str(path),
        takes_sin2=takes_sin2,
    )
