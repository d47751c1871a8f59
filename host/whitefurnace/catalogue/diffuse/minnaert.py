"""Minnaert's law of limb darkening."""

import numpy as np

from whitefurnace.catalogue.model import Checks, Model, Paper, Parameter


def _f(light, view, albedo, exponent):
    return (
        albedo
        * (exponent + 1)
        / (2 * np.pi)
        * np.power(light[..., 2], exponent - 1.0)
        * np.power(view[..., 2], exponent - 1.0)
    )


def _albedo(NoV, albedo, exponent):
    """Integrate ∫μ^k dμ = 1/(k + 1), which gives the albedo (n·v)^(k-1)."""
    with np.errstate(divide="ignore"):
        return np.asarray(albedo, np.float64) * np.power(np.asarray(NoV, np.float64), exponent - 1.0)


ENTRY = Model(
    slot="diffuse",
    name="minnaert",
    title="Minnaert",
    citation=Paper(
        "Minnaert1941", "M. Minnaert, The Reciprocity Principle in Lunar Photometry, Astrophysical Journal 93, 1941"
    ),
    parameters=(
        Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "directional albedo at normal view"),
        Parameter(
            "exponent",
            "k",
            "1",
            0.0,
            10.0,
            (0.0, 0.5, 1.0, 1.5, 3.0),
            "1 is Lambert, more darkens the limb, less brightens it",
        ),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": _albedo},
    # float32's as in the notes; rules meet μ^k at the horizon, and NoV^(k - 1) at grazing.
    checks=Checks(
        reciprocal=True, tolerance={"kernel f": (6e-6, 1e-13), "albedo": (1e-4, 5e-8)}, largest_albedo=np.inf
    ),
    notes={
        "energy": "conserving for exponents of 1 and more; below at most albedo · NoV^(exponent - 1), without bound "
        "at NoV = 0 (exponent .5: 10 at NoV = .01; exponent 0: 100)",
        "float32": "relative error ≤ 3e-7 (1 + |(k - 1) log(NoL NoV)|): 1e-6 at k = 0, cosines 1e-6",
    },
)
