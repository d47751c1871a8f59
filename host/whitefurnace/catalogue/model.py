"""The form of catalogue entries: models with their parameters, checks and papers, and integrals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from whitefurnace.catalogue.numerics import held
from whitefurnace.errors import UsageError


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model.

    name, symbol, unit  as command lines, formulas and tables write it
    low, high           its domain, inclusive; input outside it is refused
    typical             values that tests and help show
    about               its meaning in one line
    default             its value where none is given; None where one must be given or follows from roughness
    """

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    typical: tuple[float, ...]
    about: str
    default: float | None = None

    def check(self, values: Any, where: str) -> np.ndarray:
        """Return `values` as float64.

        where: begins the error message. A value outside [low, high] by a rounding is taken as the end (`held`). Raises
        UsageError for a value that is not a number, is not finite or lies further outside.
        """
        try:
            array = np.asarray(held(values, self.low, self.high))
        except (TypeError, ValueError):
            raise UsageError(f"{where}: {self.name} must be a number, not {values!r}") from None
        bad = ~((array >= self.low) & (array <= self.high))  # also catches NaN
        if bad.any():
            raise UsageError(
                f"{where}: {self.name} = {array[bad].flat[0]:g} is outside [{self.low:g}, {self.high:g}] ({self.about})"
            )
        return array


@dataclass(frozen=True)
class Paper:
    """A publication: the key that comments cite (`Walter2007`) and its full citation."""

    key: str
    text: str


@dataclass(frozen=True)
class Checks:
    """Facts of an entry that the engine and the tests act on. None means that nothing is stated.

    normalized: True if ∫ D(m)(n·m) dω is 1.
    reciprocal: True if the model stays the same when l and v are exchanged.
    slow_rules: largest ratio of a quadrature rule's error to its change from the rule before; over 1 where the
    integrand has kinks or roots that rules resolve slowly.
    weak_furnace: value of the weak furnace test with every NDF, for a masking.
    tolerance: tolerances (float32, float64) of single checks of `whitefurnace verify`, by the name of the check.
    largest_albedo: largest directional albedo for parameters in their domain, infinity for no bound.
    float32_error: largest relative error of D in float32 where D is over 1e-7 of its peak.
    negative: True if the BRDF has negative values somewhere.
    leaves_unit_range: True if the Fresnel term leaves [0, 1] somewhere.
    """

    normalized: bool | None = None
    reciprocal: bool | None = None
    reciprocal_at: Mapping[str, float] = field(default_factory=dict)
    slow_rules: float | None = None
    weak_furnace: float | None = None
    tolerance: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    largest_albedo: float | None = None
    float32_error: float | None = None
    negative: bool = False
    leaves_unit_range: bool = False


_LISTED = {
    "normalized": (),
    "reciprocal": (),
    "reciprocal at": (),
    "slow rules": ("float32", "follows roughness"),
    "weak furnace": ("follows roughness",),
    "tolerance": ("float32", "energy"),
    "largest albedo": ("energy",),
}
"""The checks that a listing of a model shows, each after the first of these notes that the model has, or at the top."""


@dataclass(frozen=True)
class Kinks:
    """The kinks of a masking or a Fresnel term, at which quadrature panels meet.

    on_ring: number of values of v·m, at most, at which the model has a kink while n·m stays the same. Kernel functions
    `…_kink`, and `…_kink_2` for a second one, return them for n·v and n·m; 2 stands for none.
    angles: function from n·v (n,) and the parameters to the polar angles of m, (k, n) in radians, at which such a value
    enters or leaves the directions m of a view, or at which two of them cross. NaN stands for none; where all are NaN
    the cell has no kink.
    """

    on_ring: int
    angles: Callable[..., np.ndarray]


@dataclass(frozen=True)
class Model:
    """One model of a slot: everything that the engine, the tests and the documents know about it.

    slot, name, title: the slot, the name on command lines, and the name for people.
    citation: the paper that describes it. also_cited: further papers that its kernel file cites.
    parameters: its parameters, in the order in which kernel functions take them.
    provides, needs: kernel functions that it has, and those of other slots that it calls, as SLOT_FUNCTION (`NDF_D`).
    reference: float64 references by function name, written in another form than the kernel.
    isotropic: True if an NDF depends on the polar angle alone.
    made_for: name of the NDF that a masking is made for; "" for any. It can be combined with the others all the same.
    from_roughness: function from a perceptual roughness in [0, 1] to its parameters, for a chain of levels.
    past_one: the same for a roughness over 1, which the last mips of some engines have; None where r = 1 is the end.
    checks: facts that the engine and the tests act on. notes: further facts, in prose, for readers alone.
    constants: function from the parameters to float64 numbers that depend on them alone, such as a norm. Kernel
    functions take them after the parameters, in the order of `constant_names`.
    kinks: where a masking or a Fresnel term has kinks; None for a smooth one.
    presets: named parameter sets, RGB as three numbers.
    limits: exact values by name. Each is a function from the parameters to the argument of the reference and its value
    there, NaN where there is none.
    text, path, function, takes_sin2: for a model from a user's file, its text translated for kernels (`user_text`), the
    path of the file, the name of its function, and whether its D takes sin²θ. Models of the catalogue have a kernel
    file instead; a text without `function` stands for that file.
    """

    slot: str
    name: str
    title: str
    citation: Paper
    parameters: tuple[Parameter, ...]
    provides: tuple[str, ...]
    reference: Mapping[str, Callable[..., Any]]
    needs: tuple[str, ...] = ()
    isotropic: bool = True
    made_for: str = ""
    from_roughness: Callable[[float], dict[str, float]] | None = None
    past_one: Callable[[float], dict[str, float]] | None = None
    checks: Checks = Checks()
    notes: Mapping[str, str | bool] = field(default_factory=dict)
    also_cited: tuple[Paper, ...] = ()
    constants: Callable[..., dict[str, np.ndarray]] | None = None
    constant_names: tuple[str, ...] = ()
    presets: Mapping[str, Mapping[str, float | tuple[float, float, float]]] = field(default_factory=dict)
    limits: Mapping[str, Callable[..., tuple[Any, Any]]] = field(default_factory=dict)
    kinks: Kinks | None = None
    text: str | None = None
    path: str | None = None
    function: str = ""
    takes_sin2: bool = True

    @property
    def kernel_file(self) -> str:
        """Path of the kernel file of a catalogue model, relative to the folder of kernels."""
        return f"{self.slot}/{self.name}.clh"

    @property
    def facts(self) -> dict[str, Any]:
        """Return the facts of the entry for listings: its notes, and the values of its checks that `_LISTED` names."""
        after: dict[str | None, dict[str, Any]] = {}
        for name, places in _LISTED.items():
            value = getattr(self.checks, name.replace(" ", "_"))
            if value is not None and value != {}:
                after.setdefault(next((note for note in places if note in self.notes), None), {})[name] = value
        shown = after.get(None, {})
        for note, value in self.notes.items():
            shown |= {note: value, **after.get(note, {})}
        return shown

    @property
    def arguments(self) -> tuple[str, ...]:
        """Names of the numbers that a kernel function takes after its own parameters: the model's parameters, then
        its constants.
        """
        return (*(p.name for p in self.parameters), *self.constant_names)

    def passed(self, function: str) -> tuple[str, ...]:
        """Return those of `arguments` that a kernel function of a self-contained model takes.

        Only D, its sampler and the diffuse f take the constants; functions of a user's file take none.
        """
        wanted = self.text is None and function in ("NDF_D", "NDF_SAMPLE", "DIFFUSE_F")
        return self.arguments if wanted else tuple(p.name for p in self.parameters)


@dataclass(frozen=True)
class Integral:
    """An integral of the catalogue, whose integrand is the kernel file `integrand/NAME.clh`.

    components  number of components of its value
    needs       model functions that it calls
    support     rule by which it is summed, a macro of `ring.clh`
    view        True if it depends on the view direction
    about       its formula, for help texts
    """

    name: str
    title: str
    components: int
    needs: tuple[str, ...]
    support: str
    view: bool
    about: str
