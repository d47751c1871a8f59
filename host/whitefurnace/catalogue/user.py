"""Models from a user's `.clh` file: an NDF with only D in it, or a whole BRDF."""

from __future__ import annotations

import os
import re
from pathlib import Path

from whitefurnace.catalogue.model import Model, Paper, Parameter
from whitefurnace.catalogue.user_text import MARK, NUMBERS, VECTORS, Signature, UserText, decoded
from whitefurnace.errors import FileError, InputError, UsageError, nearest
from whitefurnace.files import inside, read_input

FORMS = {
    "ndf": ("D", "real", "real cos_m[, real sin2_m][, real p1, …]"),
    "brdf": ("f", "real3", "real3 l, real3 v[, real p1, …]"),
}

CONSTANTS = ("per_norm", "lobe_width")
"""Names of the numbers that the engine computes from a user's D; its own parameters cannot have these names."""

_TAKEN = (*CONSTANTS, "area_scale", "area_per_range", "area_grazing", "area_terms")

_INCLUDE = re.compile(r"^[ \t]*#[ \t]*include\b([^\n]*)", re.MULTILINE)

MOST_BYTES = 1 << 20
"""Largest size of a .clh file in bytes; the longest model of the catalogue has six thousand."""

MOST_INCLUDES = 32
"""Largest number of files that one model may include, and depth of their nesting."""


def user_model(slot: str, path: str | Path) -> Model:
    """Return the model in the file `path` for the slot `ndf` or `brdf`; its signature names its parameters.

    An NDF is `real ndf_STEM_D(real cos_m, real p1, …)`, where STEM is the file's stem. It may have any scale, since the
    engine normalizes it. A second parameter `sin2_m` gets sin²θ. A BRDF is `real3 brdf_STEM_f(real3 l, real3 v, …)` in
    1/sr, in the local frame with n = +z. Both compute with plain numbers, in OpenCL C or with the habits of GLSL
    (`user_text`). Raises UsageError for another slot, FileError where the file or one that it includes cannot be read,
    and InputError where it does not define such a function.
    """
    path = Path(path)
    if slot not in FORMS:
        raise UsageError(f"{slot} {str(path)!r}: only an ndf or a brdf can come from a file")
    files: list[Path] = []
    text = UserText(_with_includes(path, path.parent, files), str(path))
    ending = FORMS[slot][0]
    name = f"{slot}_{re.sub(r'[^A-Za-z0-9_]', '_', path.stem)}_{ending}"
    signature = _wanted(slot, path, name, text.signatures())
    own = [("real", "cos_m")] if slot == "ndf" else [("real3", "l"), ("real3", "v")]
    kinds = [(_kind(type_), parameter) for type_, parameter in signature.parameters]
    takes_sin2 = slot == "ndf" and kinds[1:2] == [("real", "sin2_m")]
    names = [parameter for _, parameter in kinds[len(own) + takes_sin2 :]]
    for parameter in names:
        if parameter in _TAKEN or names.count(parameter) > 1:
            raise InputError(
                f"{path}:{signature.line}: parameter {parameter!r} of {name} is taken; give it another name"
            )
    return Model(
        slot=slot,
        name=path.stem,
        title=f"from {path.name}",
        citation=Paper("", ""),
        parameters=tuple(Parameter(p, p, "", -1e30, 1e30, (), f"of {path.name}") for p in names),
        provides=("NDF_D",) if slot == "ndf" else ("BRDF_F",),
        reference={},
        from_roughness=(lambda r: {"alpha": r * r}) if "alpha" in names else None,
        constant_names=CONSTANTS if slot == "ndf" else (),
        text=text.translation(),
        path=str(path),
        function=name,
        takes_sin2=takes_sin2,
    )


def user_files(path: str | Path) -> list[Path]:
    """Return the files that a model's file consists of: itself, then those that it includes, in order.

    Raises FileError and InputError as `user_model` does.
    """
    files: list[Path] = []
    _with_includes(Path(path), Path(path).parent, files)
    return files


def _read(path: Path) -> str:
    return decoded(read_input(path, "a .clh file", most=MOST_BYTES), str(path))


def _with_includes(path: Path, folder: Path, files: list[Path], within: tuple[Path, ...] = ()) -> str:
    """Return the text of a file with each `#include "NAME"` replaced by the text of that file beside it.

    Lines are numbered by `#line`, so that messages name the file that they stand in. `files` gets every file read.
    folder: the folder of the model's file, which included files may not leave.
    """
    text = _read(path)
    files.append(path)
    bare = re.sub(
        r"//[^\n]*|/\*(?:.*?\*/|.*)|\"(?:\\.|[^\"\\\n])*\"",
        lambda m: m[0] if m[0][0] == '"' else re.sub(r"[^\n]", " ", m[0]),
        text,
        flags=re.DOTALL,
    )
    pieces, end = [], 0
    for found in _INCLUDE.finditer(bare):
        line = bare.count("\n", 0, found.start()) + 1
        quoted = re.fullmatch(r'"([^"]+)"', found[1].strip())
        if quoted is None:
            raise InputError(f'{path}:{line}: #include takes a file in the same folder, such as #include "NAME.clh"')
        try:
            there = inside(folder, os.path.join(os.path.relpath(path.parent, folder), quoted[1]))
        except ValueError:
            raise InputError(
                f"{path}:{line}: {quoted[1]!r} is not in the folder of the model's file, {folder}"
            ) from None
        if there.resolve() in [one.resolve() for one in (*within, path)]:
            raise InputError(f"{path}:{line}: {quoted[1]!r} includes itself")
        if len(files) > MOST_INCLUDES:
            raise InputError(f"{path}:{line}: more than {MOST_INCLUDES} files are included")
        if not os.path.exists(there):
            raise FileError(f"{path}:{line}: {quoted[1]!r} is not found in the folder of this file")
        body = _with_includes(there, folder, files, (*within, path))
        pieces.append(
            f'{text[end : found.start()]}#line 1 "{MARK}{there.name}"\n{body}\n#line {line} "{MARK}{path.name}"\n'
        )
        end = found.end()
    return "".join(pieces) + text[end:]


def _kind(type_: str) -> str:
    """The kind of a parameter's type: real, real3, or the type itself."""
    if type_ in NUMBERS:
        return "real"
    return "real3" if VECTORS.get(type_) == "scalar3" else type_


def _wanted(slot: str, path: Path, name: str, there: dict[str, Signature]) -> Signature:
    """Return the signature of the function `name`, checked; InputError where the file has none of this form."""
    _, result, form = FORMS[slot]
    wanted = f"{result} {name}({form})"
    if name not in there:
        others = f"; it defines {', '.join(there)}" if there else ""
        hint = nearest(name, there) if there and "did you mean" in nearest(name, there) else others
        raise InputError(f"{path}: does not define {wanted}, which is named after the file{hint}")
    found = there[name]
    kinds = [_kind(type_) for type_, _ in found.parameters]
    own = ["real"] if slot == "ndf" else ["real3", "real3"]
    if _kind(found.result) != result or kinds[: len(own)] != own or any(kind != "real" for kind in kinds[len(own) :]):
        given = f"{found.result} {name}({', '.join(f'{type_} {parameter}' for type_, parameter in found.parameters)})"
        raise InputError(f"{path}:{found.line}: this is {given}; needed is {wanted}")
    return found
