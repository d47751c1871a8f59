"""Minnaert's law of limb darkening."""
import numpy as np

from whitefurnace.catalogue.model import Model, Parameter


def _f(light, view, albedo, exponent):
    return (albedo * (exponent + 1) / (2 * np.pi) * np.power(light[..., 2], exponent - 1.0) *
            np.power(view[..., 2], exponent - 1.0))


def _albedo(NoV, albedo, exponent):
    """∫μ^k dμ = 1/(k + 1) leaves albedo (n·v)^(k-1)."""
    with np.errstate(divide="ignore"):
        return np.asarray(albedo, np.float64) * np.power(np.asarray(NoV, np.float64), exponent - 1.0)


ENTRY = Model(
    slot="diffuse",
    name="minnaert",
    title="Minnaert",
    citation="Minnaert1941",
    parameters=(
        Parameter("albedo", "ρ", "1", 0.0, 1.0, (0.18, 0.8, 1.0), "directional albedo at normal view"),
        Parameter("exponent", "k", "1", 0.0, 10.0, (0.0, 0.5, 1.0, 1.5, 3.0),
                  "1 is Lambert, more darkens the limb, less brightens it"),
    ),
    provides=("DIFFUSE_F",),
    reference={"f": _f, "albedo": _albedo},
    facts={"reciprocal": True,
           "energy": "conserving for exponents of 1 and more; below at most albedo · NoV^(exponent - 1), without bound "
                     "at NoV = 0 (exponent .5: 10 at NoV = .01; exponent 0: 100)",
           "largest albedo": np.inf,
           "float32": "relative error ≤ 3e-7 (1 + |(k - 1) log(NoL NoV)|): 1e-6 at k = 0, cosines 1e-6",
           # float32's as above; rules meet μ^k at the horizon, and NoV^(k - 1) at grazing.
           "tolerance": {"kernel f": (6e-6, 1e-13), "albedo": (1e-4, 5e-8)}},
)
