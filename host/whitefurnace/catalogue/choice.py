"""A model as a user chooses it: an entry of the catalogue or a file, and the parameters given with it."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from whitefurnace.catalogue import Model, model
from whitefurnace.catalogue.user import user_model
from whitefurnace.errors import UsageError, nearest


@dataclass(frozen=True)
class Chosen:
    """A model and the parameters given with it. Its other parameters follow from roughness or have defaults."""

    model: Model
    given: Mapping[str, float | tuple[float, ...]]

    def canonical(self) -> dict[str, Any]:
        """Return the choice as plain data, for keys and manifests: name, digest of a file, sorted parameters."""
        text = self.model.text
        source = {} if text is None else {"sha256": hashlib.sha256(text.encode()).hexdigest()}
        return {"name": self.model.name, **source, **dict(sorted(self.given.items()))}


Spec = str | os.PathLike[str] | Model | Chosen


def file_of(spec: str) -> str | None:
    """Return the path in `FILE.clh[:p=v,…]`, whose folders may have any name; None where `spec` names no file."""
    found = re.match(r"(.*\.clh)(?::|$)", spec, re.DOTALL)
    return found[1] if found else None


def chosen(slot: str, spec: Spec) -> Chosen:
    """Return the choice that `spec` stands for, with its parameters checked.

    slot: "ndf", "masking", "fresnel", "diffuse", "light" or "brdf". spec: `NAME`, `NAME:PRESET`, `NAME:p=v,…`,
    `FILE.clh[:p=v,…]`, a catalogue entry or a choice. A value is a number, or three for RGB (`f0=1/.71/.29`). Raises
    UsageError with the nearest name or for a model of another slot, and what `user_model` raises for a file.
    """
    if isinstance(spec, Model):
        spec = Chosen(spec, {})
    if isinstance(spec, Chosen):
        if spec.model.slot != slot:
            raise UsageError(f"{slot} is {spec.model.name}, which is a model of the slot {spec.model.slot}")
        return spec
    if not isinstance(spec, str | os.PathLike):
        raise UsageError(f"{slot} is {spec!r}; a name, a path or a catalogue entry was expected")
    spec = os.fspath(spec)
    file = file_of(spec)
    if file is not None:
        entry, rest = user_model(slot, file), spec[len(file) + 1 :]
    else:
        name, _, rest = spec.partition(":")
        entry = model(slot, name)
    where = f"{slot} {entry.name}"
    known = {p.name: p for p in entry.parameters}
    given: dict[str, float | tuple[float, ...]] = {}
    for item in filter(None, rest.split(",")):
        key, equals, value = item.partition("=")
        if not equals and entry.presets and key not in known:
            if key not in entry.presets:
                raise UsageError(f"{where} has no preset {key!r}{nearest(key, entry.presets)}")
            given |= entry.presets[key]
            continue
        if key not in known:
            raise UsageError(f"{where} has no parameter {key!r}{nearest(key, known)}")
        try:
            numbers = tuple(float(part) for part in value.split("/"))
        except ValueError:
            raise UsageError(f"{where}: {key}={value!r} is not a number") from None
        if not equals or key in given:
            raise UsageError(f"{where}: {key} must be given once, as {key}=VALUE")
        if len(numbers) not in (1, 3):
            raise UsageError(f"{where}: {key}={value!r} is neither one number nor three (R/G/B)")
        known[key].check(numbers, where)
        given[key] = numbers[0] if len(numbers) == 1 else numbers
    return Chosen(entry, given)


def is_number(value: object) -> bool:
    """Return whether `value` is one real number, of Python or numpy."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
