"""Derives from a recipe the levels to make: their plans, lobes and shapes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.level_fit import read_mixtures
from whitefurnace.prefiltering.lobes import COSINE, Lobe, mixture_lobe, ndf_lobe
from whitefurnace.prefiltering.plan import LevelPlan
from whitefurnace.prefiltering.recipe import Chain
from whitefurnace.sphere.grids import Shape


@dataclass(frozen=True)
class Job:
    """One level to make.

    plan   grid, cuts or samples of the level
    lobe   the lobe that filters the environment; None for the mean over each texel
    shape  the texels at which the level is evaluated
    """

    plan: LevelPlan
    lobe: Lobe | None
    shape: Shape

    @property
    def own_lobe(self) -> Lobe:
        """The lobe of a level. Only valid for a level that has a lobe."""
        assert self.lobe is not None
        return self.lobe

    @property
    def kinked(self) -> bool:
        """True if the lobe has a kink at the horizon that limits a quadrature's order."""
        return self.own_lobe.horizon > planning.SHARP_ENOUGH


def chain_jobs(convolver: Convolver, recipe: Chain, *, latlong: bool = False, octahedral: bool = False) -> list[Job]:
    """Return the jobs of a specular chain, one for each level.

    latlong: make lat-long images with as many rows as two faces, instead of cubes. octahedral: make octahedral maps.
    """
    jobs = []
    planned = planning.plan_chain(recipe, convolver.texel, convolver.share, convolver.texels.centred)
    mixtures = read_mixtures(convolver.device, recipe) if recipe.fit else [None] * len(planned)
    for level, mixture in zip(planned, mixtures, strict=True):
        lobe = None
        if mixture:
            lobe = mixture_lobe(convolver.device, recipe.ndf, mixture, recipe.parameters)
        elif level.roughness > 0:
            lobe = ndf_lobe(convolver.device, recipe.ndf, level.roughness, level.parameters)
        if lobe and (mixture or lobe.horizon > lobe.alpha):  # the plan is made for GGX's own lobe
            grid = planning.grid_size(lobe.alpha, recipe.tolerance, max(lobe.horizon, lobe.alpha))
            level = replace(
                level,
                grid=level.grid and max(level.grid, grid),
                cuts=max(
                    level.cuts,
                    planning.cuts_for(
                        convolver.texel, lobe.alpha, recipe.tolerance, convolver.share, convolver.texels.centred
                    ),
                ),
            )
        jobs.append(Job(level, lobe, Shape(latlong, 2 * level.size if latlong else level.size, octahedral=octahedral)))
    return jobs


def irradiance_job(convolver: Convolver, size: int, tolerance: float, samples: int | None = None) -> Job:
    """Return the job of an irradiance cube with faces of size² texels.

    tolerance: bound on its `error`. samples: importance samples for each texel; None for convolution on a grid.
    """
    cuts = planning.cuts_for(convolver.texel, 1.0, tolerance, convolver.share, convolver.texels.centred)
    grid = 0 if samples else planning.grid_size(1.0, tolerance)
    return Job(LevelPlan(size, 1.0, {}, grid, cuts, samples or 0), COSINE, Shape(False, size))
