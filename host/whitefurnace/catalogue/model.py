"""What a catalogue entry says of a model, a parameter, an integral."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from whitefurnace.errors import UsageError


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model: its domain validates input, its typical values feed tests and help."""

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    typical: tuple[float, ...]
    about: str
    default: float | None = None

    def check(self, values: Any, where: str) -> np.ndarray:
        """`values` as float64, or UsageError when one lies outside [low, high] or is not finite."""
        try:
            array = np.asarray(values, np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"{where}: {self.name} must be a number, not {values!r}") from None
        bad = ~((array >= self.low) & (array <= self.high))  # also catches NaN
        if bad.any():
            raise UsageError(f"{where}: {self.name} = {array[bad].flat[0]:g} is outside "
                             f"[{self.low:g}, {self.high:g}] ({self.about})")
        return array


@dataclass(frozen=True)
class Model:
    """One model of a slot. `provides` and `needs` name kernel functions as SLOT_FUNCTION (`NDF_D`).

    `constants` gives float64 numbers that follow from the parameters alone, such as a norm; kernel functions take
    them, in the order of `constant_names`, after the parameters. `presets` are named parameter sets, RGB as three.
    `limits` are exact values by name: each takes the parameters and gives the argument of the reference and its value,
    NaN where there is none.
    `text` is the kernel text of a model from a user's file, `path` where it lies and `takes_sin2` whether its D wants
    sin²θ; a model of ours has a kernel file.
    """

    slot: str
    name: str
    title: str
    citation: str
    parameters: tuple[Parameter, ...]
    provides: tuple[str, ...]
    reference: Mapping[str, Callable[..., Any]]
    """Float64 references by function name, written in another form than the kernel."""
    needs: tuple[str, ...] = ()
    isotropic: bool = True
    from_roughness: Callable[[float], dict[str, float]] | None = None
    past_one: Callable[[float], dict[str, float]] | None = None
    """The same for roughnesses over 1, which some engines' last mips have; None where r = 1 is the end."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    constants: Callable[..., dict[str, np.ndarray]] | None = None
    constant_names: tuple[str, ...] = ()
    presets: Mapping[str, Mapping[str, float | tuple[float, float, float]]] = field(default_factory=dict)
    limits: Mapping[str, Callable[..., tuple[Any, Any]]] = field(default_factory=dict)
    text: str | None = None
    path: str | None = None
    takes_sin2: bool = True

    @property
    def kernel_file(self) -> str:
        return f"{self.slot}/{self.name}.clh"

    @property
    def arguments(self) -> tuple[str, ...]:
        """Names of the numbers a kernel function takes after its own: parameters, then constants."""
        return (*(p.name for p in self.parameters), *self.constant_names)

    def passed(self, function: str) -> tuple[str, ...]:
        """Those of `arguments` that a kernel function of a self-contained model takes: constants go to D and its
        sampler alone, and a user's file knows none."""
        wanted = self.text is None and function in ("NDF_D", "NDF_SAMPLE", "DIFFUSE_F")
        return self.arguments if wanted else tuple(p.name for p in self.parameters)


@dataclass(frozen=True)
class Integral:
    """An integral of the catalogue: `integrand/NAME.clh` under the rule that fits its `support` (`ring.clh`)."""

    name: str
    title: str
    components: int
    needs: tuple[str, ...]
    support: str
    view: bool
    about: str
