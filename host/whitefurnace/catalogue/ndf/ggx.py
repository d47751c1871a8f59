"""GGX (Trowbridge-Reitz)."""
import numpy as np

from whitefurnace.catalogue.model import Model, Parameter


def _d(cos_m, alpha):
    """In slopes: D = P22(tan θ) / cos⁴θ, the GGX slope density 1/(πα²(1 + tan²θ/α²)²). [Heitz2014, eq. 64]"""
    cos_m = np.asarray(cos_m, np.float64)
    tan2 = (1 - cos_m) * (1 + cos_m) / cos_m**2
    density = 1 / (np.pi * alpha**2 * (1 + tan2 / alpha**2) ** 2)
    return np.where(cos_m > 0, density / cos_m**4, 0.0)


def _lambda(cos_v, alpha):
    """Λ = (√(1 + 1/a²) - 1)/2, a = 1/(α tan θ). [Heitz2014, eq. 72]"""
    cos_v = np.asarray(cos_v, np.float64)
    a = cos_v / (alpha * np.sqrt((1 - cos_v) * (1 + cos_v)))
    return (np.sqrt(1 + 1 / a**2) - 1) / 2


ENTRY = Model(
    slot="ndf",
    name="ggx",
    title="GGX (Trowbridge-Reitz)",
    citation="Walter2007",
    parameters=(
        Parameter("alpha", "α", "1", 1e-5, 1.0, (1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 1.0),
                  "roughness, the square of the perceptual one"),
    ),
    provides=("NDF_D", "NDF_LAMBDA", "NDF_WIDTH"),
    reference={"D": _d, "lambda": _lambda},
    from_roughness=lambda r: {"alpha": r * r},
    facts={"normalized": True, "projected area": "n·v (1 + Λ)", "tail": "D falls like 1/sin⁴θ"},
)
