"""Computes exact values of the texels that certify a level, as finely as the tolerance needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from whitefurnace.prefiltering import plan as planning
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.convolution import Convolver
from whitefurnace.prefiltering.jobs import Job

PROBES = 16
"""Number of texels on which a reference is compared with one of twice the nodes. They are the darkest, where a bright
panel at the horizon shows most."""

COARSE = {"sharp": 2.0, "rough": 2.2}
"""Factor by which a grid that replaces all texels in a level's reference is finer than the level's own grid. Its error
is 2^6.5 = 90 times smaller where the lobe's width limits it, 2.2² = 5 times smaller where its kink does."""

COARSE_GRID = 512
"""Largest number of nodes per edge of such a grid. For sharper lobes texels are summed, if necessary only those near
their direction."""


@dataclass
class Reference:
    """The reference of one level while it is made.

    job     the level; its plan gets the cuts that the texels turn out to need
    sample  texel indices: a uniform draw and the near-source sample
    cuts    nodes per edge into which a source texel is cut for the reference
    grid    nodes per edge of the grid that replaces the texels, 0 for none
    values  (m, 3) exact values of the sample's texels
    doubt   estimated error of the values, as a texel error
    """

    job: Job
    sample: tuple[np.ndarray, np.ndarray]
    cuts: int
    grid: int = 0
    values: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    doubt: float = 0.0

    @property
    def index(self) -> np.ndarray:
        """Flat indices of all texels of the sample."""
        return np.concatenate(self.sample)


def references_of(convolver: Convolver, jobs: Sequence[Job], tolerance: float, certify: int) -> list[Reference]:
    """Compute the references of levels, in the order of `jobs`.

    A lobe is integrated over every texel, or over a much finer grid than its level's if that has at most half as many
    nodes. The grid is compared with every texel on the PROBES darkest texels of the sample, cut twice as finely where
    the lobe has a kink that would otherwise not show; the difference is the doubt. While the doubt is more than a tenth
    of the tolerance, texels replace the grid, and then the number of nodes is doubled. Lobes with the same cuts share
    one pass over the source.

    certify: number of uniform texels of each sample.
    """
    found = [Reference(job, convolver.sample(job.shape, certify), job.plan.cuts) for job in jobs]
    for one in found:
        if one.job.lobe is None:
            one.values = convolver.exact_means(one.job.shape, one.index)
        elif one.job.plan.grid:
            n = planning.nodes_for(COARSE["rough" if one.job.kinked else "sharp"] * one.job.plan.grid)
            one.grid = n if n <= COARSE_GRID and 2 * 6 * n * n <= convolver.texels.nodes(one.cuts) else 0
    if any(one.grid for one in found):
        convolver.prepare(
            max(max(one.grid, one.job.plan.grid) for one in found), max(one.cuts for one in found if one.job.lobe)
        )
    todo = [one for one in found if one.job.lobe]
    while todo:
        _integrate(convolver, todo, tolerance)
        todo = [one for one in todo if (one.job.kinked or one.grid) and not convolver.constant]
        todo = _doubted(convolver, todo, tolerance)
    return found


def _integrate(convolver: Convolver, todo: Sequence[Reference], tolerance: float) -> None:
    """Compute the values of references, on their grids or over every texel."""
    for one in todo:
        if one.grid:
            one.values = convolver.on_grid(one.job.own_lobe, one.job.shape.directions(one.index), one.grid, tolerance)
    for cuts in sorted({one.cuts for one in todo if not one.grid}):
        group = [one for one in todo if not one.grid and one.cuts == cuts]
        for one, values in zip(
            group, _exact(convolver, group, [one.index for one in group], cuts, tolerance), strict=True
        ):
            one.values = values
            one.doubt = planning.cuts_error(convolver.texel, one.job.own_lobe.alpha, cuts, convolver.texels.centred)


def _doubted(convolver: Convolver, todo: Sequence[Reference], tolerance: float) -> list[Reference]:
    """Measure the doubt of references, refine the plans of those whose doubt is too large, and return these."""
    by_cuts: dict[int, list[tuple[Reference, float]]] = {}
    for one in todo:
        detected = _detected(convolver, one)
        by_cuts.setdefault(one.cuts * (1 if detected else 2), []).append((one, detected))
    again = []
    for cuts, group in sorted(by_cuts.items()):
        dark = [np.argsort(one.values.min(1), kind="stable")[:PROBES] for one, _ in group]
        finer = _exact(
            convolver,
            [one for one, _ in group],
            [one.index[probes] for (one, _), probes in zip(group, dark, strict=True)],
            cuts,
            tolerance,
        )
        # On small images more nodes cost nothing: there the reference is made exact, not just good enough.
        cheap = convolver.texels.nodes(cuts) <= planning.NODES_A_BAND
        for (one, detected), probes, values in zip(group, dark, finer, strict=True):
            mean = convolver.mean * convolver.scale
            one.doubt = float(texel_errors(one.values[probes], values, mean).max()) / (detected or 1.0)
            if one.doubt <= tolerance / (100 if cheap else 10):
                continue
            if one.grid:
                one.grid = 0
                again.append(one)
            elif cuts <= planning.MOST_CUTS:
                one.cuts = cuts
                again.append(one)
                if one.doubt > tolerance / 10:  # the level needs them too
                    one.job = replace(one.job, plan=replace(one.job.plan, cuts=cuts))
    return again


def _detected(convolver: Convolver, one: Reference) -> float:
    """Return the fraction of the reference grid's error that a check with the texels' cuts detects.

    It is 0 where the fraction is too small. Where a lobe has a kink, nodes at a spacing h have an error of h², for
    texels as well as for the grid.
    """
    if not one.job.kinked:
        return 1.0
    ratio = convolver.texel / one.cuts / planning.spacing(one.grid) if one.grid else 1.0
    return 1 - ratio**2 if ratio**2 <= 0.55 else 0.0


def _exact(
    convolver: Convolver, group: Sequence[Reference], indices: Sequence[np.ndarray], cuts: int, tolerance: float
) -> list[np.ndarray]:
    """Return exact values of each level's texels `indices`, in one pass over the source."""
    return convolver.exact(
        [(one.job.own_lobe, one.job.shape.directions(index)) for one, index in zip(group, indices, strict=True)],
        cuts,
        tolerance,
    )
