"""Finds the sun of an environment, and extracts it as a directional light or clamps it.

A sun holds most of the light in a few texels. Engines cast its shadows from a separate light, and a prefiltered copy of
it would light everything twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from whitefurnace.errors import UsageError, nearest
from whitefurnace.sphere.environments import Environment, statistics_of
from whitefurnace.sphere.grids import source_directions, source_solid_angles

MODES = ("keep", "extract", "clamp=X")

CAP, RING = math.radians(10.0), math.radians(15.0)
"""Angles around the brightest texel: the sun is searched within CAP of it, and its sky between CAP and RING. A glare is
narrower than CAP, and a sky hardly changes up to RING."""

STANDS_OUT = 10.0
"""Smallest ratio of the brightest texel to the sky around it for a sun."""

WIDER = 0.1
"""Largest share of the extracted energy that may lie between CAP and RING: enough for glints, not for a light panel."""

LEAST = 0.005
"""Smallest share of the source's energy for a sun: a highlight on the rim of a lamp has less."""

BESIDE = 2.5
"""Number of texels around the sun whose mean fills its hole."""


@dataclass(frozen=True)
class Sun:
    """A sun as a directional light, in linear RGB.

    direction: unit vector towards it, in the world.
    angular_radius: radians of a disc of constant `radiance` with the sun's energy and ∫ L² dω.
    irradiance: irradiance of a surface that faces it.
    c: irradiance/π, the radiance of a white Lambertian surface that faces it, which is the light colour of
    [Hoffman2012] and of most engines.
    share: its share of the energy of the source, in [0, 1].
    texels: number of texels that held it.
    """

    direction: tuple[float, float, float]
    angular_radius: float
    radiance: tuple[float, float, float]
    irradiance: tuple[float, float, float]
    c: tuple[float, float, float]
    share: float
    texels: int

    def data(self) -> dict[str, Any]:
        """Return the sun as plain data, for manifests."""
        return {
            "direction": list(self.direction),
            "angular_radius": self.angular_radius,
            "radiance": list(self.radiance),
            "irradiance": list(self.irradiance),
            "c": list(self.c),
            "share": self.share,
            "texels": self.texels,
        }


def sun_mode(mode: str) -> tuple[str, float]:
    """Return the mode `keep`, `extract` or `clamp=X` as (name, X). Raises UsageError."""
    name, equals, value = str(mode).partition("=")
    if name in ("keep", "extract") and not equals:
        return name, math.inf
    if name != "clamp":
        raise UsageError(f"unknown sun {mode!r}{nearest(name, MODES)}")
    try:
        bound = float(value)
    except ValueError:
        bound = math.nan
    if not 1 <= bound < math.inf:
        raise UsageError(f"sun {mode!r}: clamp=X takes X in [1, ∞), multiples of the mean radiance")
    return name, bound


def without_sun(env: Environment, mode: str) -> tuple[Environment, Sun | None]:
    """Return the environment with its sun treated as `mode` says, and the sun where it was extracted.

    "extract": the texels that stand out around the brightest one are filled with the mean of the sky next to them. The
    rest of their radiance is the sun, so sun and sky add up to the source.
    "clamp=X": no texel keeps more than X times the mean, measured by the mean of its channels. Colours stay.
    "keep": nothing changes.

    Notices of the environment say what was removed. Raises UsageError for another mode.
    """
    name, bound = sun_mode(mode)
    if name == "keep":
        return env, None
    flat = env.texels.reshape(-1, 3)
    weights = source_solid_angles(env).ravel()
    level = flat.mean(1, dtype=np.float64)
    energy = float(level @ weights)
    if energy <= 0:
        return _with(env, env.texels, f"{env.name} is black: there is no sun in it"), None
    if name == "clamp":
        return _clamped(env, flat, level, weights, energy, bound), None
    return _extracted(env, flat, level, weights, energy)


def _clamped(
    env: Environment, flat: np.ndarray, level: np.ndarray, weights: np.ndarray, energy: float, bound: float
) -> Environment:
    most = bound * energy / (4 * math.pi)
    over = level > most
    if not over.any():
        return _with(env, env.texels, f"no texel is over {bound:g} times the mean: nothing was clamped")
    texels = flat.copy()
    texels[over] *= (most / level[over])[:, None].astype(np.float32)
    taken = float(((level - most) * weights)[over].sum()) / energy
    return _with(
        env,
        texels.reshape(env.texels.shape),
        f"{int(over.sum())} texels over {bound:g} times the mean were clamped, which took {100 * taken:.3g} % "
        "of the energy",
    )


def _extracted(
    env: Environment, flat: np.ndarray, level: np.ndarray, weights: np.ndarray, energy: float
) -> tuple[Environment, Sun | None]:
    index = np.arange(level.size)
    top = int(level.argmax())
    cosine = source_directions(env, np.array([top]))[:, 0] @ source_directions(env, index)
    ring = index[(cosine < math.cos(CAP)) & (cosine >= math.cos(RING))]
    around = index[cosine >= math.cos(CAP)]
    sky = float(np.median(level[ring])) if ring.size else 0.0
    if ring.size == 0 or level[top] <= STANDS_OUT * sky:
        return _with(
            env,
            env.texels,
            f"no sun was found: the brightest texel is {level[top] / max(sky, 1e-30):.3g} "
            f"times the sky around it, and {STANDS_OUT:g} times is what is looked for",
        ), None
    # The geometric mean of peak and sky parts a disc from its glare; a black sky leaves a thousandth of the peak.
    bound = max(math.sqrt(level[top] * max(sky, 1e-6 * level[top])), STANDS_OUT * sky)
    held = around[level[around] > bound]
    beyond = ring[level[ring] > bound]
    if float(level[beyond] @ weights[beyond]) > WIDER * float(level[held] @ weights[held]):
        return _with(
            env,
            env.texels,
            "no sun was found: what stands out about the brightest texel reaches further "
            f"than {math.degrees(CAP):g}°, a panel rather than a sun",
        ), None
    towards = source_directions(env, held)
    centre = towards @ (level[held] * weights[held])
    centre /= np.linalg.norm(centre)
    # The sky next to it: texels that are not the sun, near its edge.
    texel = math.pi / env.texels.shape[-3] / (1 if env.kind == "latlong" else 2)
    edge = math.acos(min(1.0, float((centre @ towards).min()))) + BESIDE * texel
    beside = np.setdiff1d(around[centre @ source_directions(env, around) >= math.cos(edge)], held)
    beside = beside if beside.size else ring
    fill = np.average(flat[beside].astype(np.float64), 0, weights[beside])
    texels = flat.copy()
    texels[held] = np.minimum(flat[held], fill.astype(np.float32))
    excess = flat[held].astype(np.float64) - texels[held]
    power = weights[held] @ excess
    grey = excess.mean(1)
    solid = float((weights[held] @ grey) ** 2 / (weights[held] @ grey**2))  # of the disc with its energy and ∫ L² dω
    irradiance = (weights[held] * (centre @ towards)) @ excess
    share = float(power.mean()) / energy
    if share < LEAST:
        return _with(
            env,
            env.texels,
            f"no sun was found: what stands out most holds {100 * share:.2g} % of the energy "
            f"and {100 * LEAST:g} % is what is looked for",
        ), None
    sun = Sun(
        tuple(centre.tolist()),
        math.acos(max(-1.0, 1 - solid / (2 * math.pi))),
        tuple((power / solid).tolist()),
        tuple(irradiance.tolist()),
        tuple((irradiance / math.pi).tolist()),
        share,
        int(held.size),
    )
    text = (
        f"the sun was taken out of {held.size} texel{'s' if held.size > 1 else ''}, {100 * share:.3g} % of the "
        "energy: light it as a directional light of irradiance "
        f"({', '.join(f'{x:.4g}' for x in sun.irradiance)}) from ({', '.join(f'{x:.4f}' for x in sun.direction)})"
    )
    return _with(env, texels.reshape(env.texels.shape), text), sun


def _with(env: Environment, texels: np.ndarray, notice: str) -> Environment:
    found = replace(env, texels=texels, notices=(*env.notices, notice))
    return found if texels is env.texels else replace(found, statistics=statistics_of(found))
