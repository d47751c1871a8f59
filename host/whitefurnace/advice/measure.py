"""Measures the error of each approximation between a scene's materials and an engine's picture of them.

The points of the materials are shaded as the engine does it, and compared with the full reflectance integral with
multiple scattering. Each approximation is measured alone:

- X₀ is the picture that the engine would show from files without any error. The error of a part of the files is the
  change of X₀ when that part alone is not exact.
- The error of the split sum compares the engine's prefiltered radiance with the mean that the whole integrand takes.
- The error of the model compares the integral of the engine's own weights with the reference.

All errors are relative to the same reference, so they can be compared. They do not add up, because parts may cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import msgspec
import numpy as np

from whitefurnace.advice.points import POINTS, sample_points
from whitefurnace.advice.reads import EngineReads, Storage
from whitefurnace.advice.reference import PointIntegrals, mirrored
from whitefurnace.catalogue import models
from whitefurnace.engines.presets import Engine, reduced
from whitefurnace.errors import UnsupportedError
from whitefurnace.opencl.device import Device
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.reading import single
from whitefurnace.prefiltering.recipe import Chain
from whitefurnace.scenes.materials import Scene
from whitefurnace.sphere.environments import Environment

Kind = Literal["files", "split", "model", "other"]

_DIFFUSE = {
    "sh": "nine harmonics, windowed",
    "cube": "a cube of 32², read bilinearly",
    "level": "the level of r = 1, whose lobe is the cosine's for GGX",
}


@dataclass(frozen=True)
class Entry:
    """The error of one approximation.

    rms, p95  root mean square and 95th percentile, over the points, of the texel error of reflected radiance
    what      a phrase that describes the approximation
    used      True if the engine makes this approximation, False if it is the cost of another choice
    bound     True if the error is the one that files state, and not measured
    """

    name: str
    kind: Kind
    rms: float
    p95: float
    what: str
    used: bool = True
    bound: bool = False


@dataclass(frozen=True)
class Budget:
    """The errors of a scene in an environment under one engine, one entry for each approximation.

    levels    (texels of a face edge, perceptual roughness) of each level
    points    number of points that were shaded
    entries   entries in the order in which the engine makes the approximations
    files     error that all of the files together add to the picture from exact files
    floor     error of the picture from exact files against the reference
    whole     error of the engine's picture against the reference
    accuracy  error (99th percentile) of the reference itself
    """

    engine: str
    environment: str
    levels: tuple[tuple[int, float], ...]
    points: int
    entries: tuple[Entry, ...]
    files: Entry
    floor: Entry
    whole: Entry
    accuracy: float
    notices: tuple[str, ...]

    def __getitem__(self, name: str) -> Entry:
        return next(e for e in self.entries if e.name == name)

    @property
    def largest(self) -> Entry:
        """The largest measured error among the approximations that the engine makes."""
        return max((e for e in self.entries if e.used and not e.bound), key=lambda e: e.rms)


class ErrorMeter:
    """Measures error budgets of one scene and engine in one environment.

    without: parts of the engine's files that are left out (`engines.engine.reduced`). count: number of points. seed:
    seed of the random points. Integrals that several chains need are computed once.

    Raises UnsupportedError for an engine that gets no prefiltered chain, and the errors of `sample_points`.
    """

    def __init__(
        self,
        scene: Scene,
        env: Environment,
        engine: Engine,
        device: Device,
        *,
        without: Sequence[str] = (),
        count: int = POINTS,
        seed: int = 0,
    ) -> None:
        if not engine.needs("specular"):
            raise UnsupportedError(f"{engine.name} filters the image itself: what it shows is not ours to measure")
        self.scene, self.env, self.device = scene, env, device
        self.preset, self.without = _upright(engine), tuple(without)
        self.engine = reduced(self.preset, self.without) if without else self.preset
        self.sampled = sample_points(scene, least=engine.least, count=count, seed=seed)
        self.points = self.sampled.points
        self.integrals = PointIntegrals(scene, self.sampled, env, device)
        self.reads = EngineReads(self.integrals, self.engine)

    @property
    def right(self) -> np.ndarray:
        """Reference radiance of the points, (m, 3), against which errors are measured."""
        return self.integrals.right

    def entry(
        self, name: str, kind: Kind, difference: np.ndarray, what: str, *, used: bool = True, bound: bool = False
    ) -> Entry:
        """Return the entry of an approximation that changes the radiance of the points by `difference` (m, 3).

        what, used, bound: fields of the `Entry`.
        """
        off = texel_errors(self.right + difference, self.right, float(self.right.mean()))
        return Entry(name, kind, float(np.sqrt((off * off).mean())), float(np.quantile(off, 0.95)), what, used, bound)

    def budget(self, recipe: Chain, engine: Engine | None = None) -> Budget:
        """Measure the budget of a chain.

        engine: an engine with other files and the same shading; by default the engine of this meter. Raises CheckError
        where a level cannot reach its tolerance.
        """
        engine = _upright(engine) if engine else self.engine
        files, X0, whole = self.files(recipe, engine), self.reads.perfect, self.reads.picture(recipe, engine)
        return Budget(
            engine.name,
            self.env.name,
            recipe.levels,
            len(X0),
            (*files, *self.split, *self.model, *self._diffuse_otherwise(recipe, engine), *self._others),
            self.entry("files", "files", whole - X0, "all of them, against exact ones"),
            self.floor,
            self.entry("whole", "other", whole - self.right, "the engine's picture against the integral"),
            self.integrals.accuracy,
            self.sampled.notices,
        )

    @cached_property
    def floor(self) -> Entry:
        """Return the error of the picture from exact files."""
        return self.entry(
            "exact files", "split", self.reads.perfect - self.right, "the engine with these, against the integral"
        )

    @cached_property
    def filter_share(self) -> float:
        """Return the RMS error that a filter of tolerance t may add to the picture, divided by t."""
        specular, _ = self.reads.weights(self.integrals.exact_table)
        return self.entry("filter", "files", specular * self.reads.prefiltered, "").rms

    # ------------------------------------------------------------------------------------------- the engine's way

    def files(self, recipe: Chain, engine: Engine) -> list[Entry]:
        """Measure the error of each part of the files, as the change of X₀ when only that part is not exact."""
        reads, storage = self.reads, Storage.of(engine)
        P, D, AB, X0 = reads.prefiltered, self.integrals.diffuse, self.integrals.exact_table, reads.perfect
        specular, _ = reads.weights(AB)
        exact, read = reads.between(recipe), reads.read(recipe, "float32")
        found = [
            self.entry(
                "filter",
                "files",
                specular * P * reads.stated(recipe)[:, None],
                "p99 of texels that its levels state",
                bound=True,
            ),
            self.entry(
                "texels",
                "files",
                reads.shown(P + read - exact, D, AB) - X0,
                f"bilinear reads within levels of {recipe.size}² to {recipe.levels[-1][0]}²",
            ),
            self.entry(
                "roughness",
                "files",
                reads.shown(exact, D, AB) - X0,
                f"linear reads between {len(recipe.levels)} levels" + (", fitted" if recipe.fit else ""),
            ),
            self.entry(
                "format", "files", reads.shown(P + reads.read(recipe, storage.chain) - read, D, AB) - X0, storage.chain
            ),
        ]
        if storage.table is None:
            found.append(
                self.entry(
                    "table", "files", reads.shown(P, D, reads.table(None, None)) - X0, "Karis's fit in place of one"
                )
            )
        else:
            plain = reads.table(engine.dfg, None)
            found.append(
                self.entry("table", "files", reads.shown(P, D, plain) - X0, f"{engine.dfg.size}², read bilinearly")
            )
            rounded = reads.table(engine.dfg, storage.table)
            changed = (AB[0] + rounded[0] - plain[0], AB[1] + rounded[1] - plain[1])
            found.append(self.entry("table format", "files", reads.shown(P, D, changed) - X0, storage.table))
        found.append(
            self.entry(
                "diffuse",
                "files",
                reads.shown(P, reads.diffuse_read(recipe, *storage.diffuse), AB) - X0,
                _DIFFUSE[storage.diffuse[0]],
            )
        )
        return found

    @cached_property
    def split(self) -> tuple[Entry, ...]:
        """Measure the errors of the split sum: first its two parts, then the whole."""
        engine, reads, integrals = self.engine, self.reads, self.integrals
        specular = reads.weights(integrals.exact_table)[0]
        read = reads.prefiltered + (integrals.diffuse - reads.prefiltered) * reads.blend
        how = f"mix(mirror direction, n, {engine.bend})" if engine.bend != "0" else "the mirror direction"
        return (
            self.entry(
                "n = v = r",
                "split",
                specular * (read - integrals.own_view),
                f"a lobe seen from n, read in {how}"
                + (f", blended with E/π by {engine.blend}" if engine.blend != "0" else ""),
            ),
            self.entry(
                "F·G from L",
                "split",
                specular * (integrals.own_view - integrals.seen),
                "Fresnel and masking weigh no light",
            ),
            self.entry(
                "split sum", "split", specular * (read - integrals.seen), "both of these, against the full integral"
            ),
        )

    @cached_property
    def model(self) -> tuple[Entry, ...]:
        """Measure the errors of the engine's reflection model: of its multiple scattering and of its Fresnel term."""
        specular, rest = self.reads.weights(self.integrals.exact_table)
        schlick = self.integrals.reference(exact=False)
        return (
            self.entry(
                "energy",
                "model",
                specular * self.integrals.seen + rest * self.integrals.diffuse - schlick,
                "energy restored for multiple scattering, and left for diffuse light",
            ),
            self.entry("Fresnel", "model", schlick - self.right, "Schlick's term for the materials' indices"),
        )

    # ------------------------------------------------------------------------------------------- other choices

    def _diffuse_otherwise(self, recipe: Chain, engine: Engine) -> list[Entry]:
        """Errors of diffuse light that is stored in other ways than the engine's."""
        own = Storage.of(engine).diffuse[0]
        return [
            self.entry(
                f"diffuse by {'harmonics' if how == 'sh' else 'cube'}",
                "other",
                self.reads.shown(
                    self.reads.prefiltered, self.reads.diffuse_read(recipe, how, "float32"), self.integrals.exact_table
                )
                - self.reads.perfect,
                _DIFFUSE[how],
                used=False,
            )
            for how in ("sh", "cube")
            if how != own
        ]

    @cached_property
    def _others(self) -> tuple[Entry, ...]:
        """Measure the effects of choices that another renderer could make, each against the reference."""
        integrals = self.integrals
        found = []
        if self.engine.bend != "0" or self.engine.blend != "0":
            plain = integrals.each(
                lambda g: integrals.lobe(single(g.roughness), mirrored(self.points.some(g.index)), g.count)
            )
            found.append(
                self.entry(
                    "mirror direction",
                    "other",
                    self.reads.weights(integrals.exact_table)[0] * (plain - integrals.own_view),
                    "n = v = r read there, and nothing blended",
                    used=False,
                )
            )
        found.append(
            self.entry(
                "single scattering",
                "other",
                integrals.reference(again=False) - self.right,
                "nothing given back, in the reference",
                used=False,
            )
        )
        if (grooved := integrals.grooved()).any():
            found.append(
                self.entry(
                    "Lambert",
                    "other",
                    grooved,
                    "Oren and Nayar's grooves of the same roughness (tan σ = α/√2) in its place",
                    used=False,
                )
            )
        found += [
            self.entry(
                f"masking {name}",
                "other",
                integrals.masked(name),
                f"{models('masking')[name].title}, in place of height-correlated Smith",
                used=False,
            )
            for name in models("masking")
            if name != "smith" and models("masking")[name].made_for in ("", "ggx")  # which these lobes are
        ]
        masking = self.reads.engine.dfg.charlie_masking
        if (sheen := integrals.sheen(masking)) is not None:
            title = models("masking")[masking].title
            found.append(
                self.entry(
                    "split sum of sheen",
                    "other",
                    sheen,
                    f"Charlie's lobe from n = v = r, masked by {title}",
                    used=False,
                )
            )
        return tuple(found)


def _upright(engine: Engine) -> Engine:
    """The engine with its files in the world's axes. Turning the axes moves whole texels and changes no error."""
    return msgspec.structs.replace(engine, axes="+x +y +z")
