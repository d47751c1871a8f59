"""Computes the light that an engine reads from its files at the points of a scene, and the picture that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from whitefurnace.advice.reference import PointIntegrals
from whitefurnace.engines.presets import FORMATS, Dfg, Engine, File
from whitefurnace.errors import UnsupportedError
from whitefurnace.files import decode, encode, pack, unpack
from whitefurnace.prefiltering.level_fit import read_mixtures
from whitefurnace.prefiltering.lighting import Filtered, Lighting, Want, light
from whitefurnace.prefiltering.reading import Exact, bilinear, single, stored
from whitefurnace.prefiltering.recipe import Chain
from whitefurnace.rendering import shading
from whitefurnace.rendering.shading import Lights, looked_up
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.tables.split_sum import split_sum


@dataclass(frozen=True)
class Storage:
    """How an engine's files store the light; a pixel format of "float32" means unchanged numbers.

    chain    pixel format of the specular levels
    table    pixel format of the split-sum table, None where there is no table
    diffuse  how diffuse light is stored ("sh", "cube", or "level" for the level of r = 1), and its pixel format
    """

    chain: str
    table: str | None
    diffuse: tuple[str, str]

    @classmethod
    def of(cls, engine: Engine) -> Storage:
        """Return the storage of an engine's files."""
        if engine.container != "files":
            return cls("float32", "float32", ("sh" if "irradiance" in engine.without else "cube", "float32"))
        files = {holds: engine.holding(holds) for holds in ("specular", "skybox", "dfg", "irradiance")}
        levels = (files["specular"] or files["skybox"])[0].stored
        diffuse = (
            ("sh", "float32")
            if engine.sh
            else ("cube", files["irradiance"][0].stored)
            if files["irradiance"]
            else ("level", levels)
        )
        return cls(levels, files["dfg"][0].stored if files["dfg"] else None, diffuse)


class EngineReads:
    """Values that an engine reads at the points of a scene, and the radiance that it shows.

    Arrays are linear radiance (m, 3), one row for each point, unless stated otherwise. Baked chains, reads and tables
    are kept, so that sets of files which share a part compute it once.
    """

    def __init__(self, integrals: PointIntegrals, engine: Engine) -> None:
        self.integrals, self.engine = integrals, engine
        self.points, self.sampled = integrals.points, integrals.sampled
        self.device, self.env = integrals.device, integrals.env
        self._lights: dict[str, tuple[Lighting, Filtered]] = {}
        self._reads: dict[tuple[str, ...], np.ndarray] = {}
        self._tables: dict[tuple[Dfg, str | None], np.ndarray] = {}

    # ------------------------------------------------------------------------------------------- without files

    @cached_property
    def looked_up(self) -> np.ndarray:
        """World directions in which the engine reads the chain, (3, m)."""
        return looked_up(self.engine, self.points.n, self.points.v, self.sampled.roughness)

    @cached_property
    def prefiltered(self) -> np.ndarray:
        """Exact prefiltered radiance (n = v = r) in the directions in which the engine reads it, (m, 3)."""
        return self.integrals.each(
            lambda g: self.integrals.lobe(single(g.roughness), self.looked_up[:, g.index], g.count)
        )

    @cached_property
    def blend(self) -> np.ndarray:
        """Share of E/π that the engine blends into the prefiltered radiance, (m, 1) in [0, 1]."""
        r = self.sampled.roughness
        return np.broadcast_to(self.engine.blend_formula(r=r, alpha=r * r), r.shape)[:, None]

    def weights(self, table: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the engine's weights of the specular radiance and of E/π, (m, 3) each.

        table: the split-sum terms (A, B), (m,) each.
        """
        s = self.sampled
        made = shading.SHADINGS[self.engine.shading](
            table[0][:, None],
            table[1][:, None],
            s.color,
            s.metal[:, None],
            s.roughness[:, None],
            self.points.NoV[:, None],
            s.f0,
        )
        return np.broadcast_to(made[0], s.color.shape), np.broadcast_to(made[1], s.color.shape)

    def shown(self, radiance: np.ndarray, diffuse: np.ndarray, table: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return the radiance that the engine shows, (m, 3), combined as in `shading.shade`.

        radiance: prefiltered radiance (m, 3). diffuse: E/π (m, 3). table: the split-sum terms (A, B), (m,) each.
        """
        specular, rest = self.weights(table)
        return specular * (radiance + (diffuse - radiance) * self.blend) + rest * diffuse

    @cached_property
    def perfect(self) -> np.ndarray:
        """X₀: the radiance that the engine would show from files without any error, (m, 3)."""
        return self.shown(self.prefiltered, self.integrals.diffuse, self.integrals.exact_table)

    # ------------------------------------------------------------------------------------------- from files

    def bake(self, recipes: Sequence[Chain]) -> None:
        """Bake the chains that are not baked yet; chains of one tolerance share their work.

        Raises CheckError where a level cannot reach its tolerance.
        """
        wanted = [recipe for key, recipe in {key_of(r): r for r in recipes}.items() if key not in self._lights]
        for tolerance in dict.fromkeys(recipe.tolerance for recipe in wanted):
            some = [recipe for recipe in wanted if recipe.tolerance == tolerance]
            made = light(self.device, self.env, [Want(recipe) for recipe in some], seed="budget")
            for recipe, filtered in zip(some, made.chains, strict=True):
                self._lights[key_of(recipe)] = made, filtered

    def is_baked(self, recipe: Chain) -> bool:
        """Return whether the chain has been baked."""
        return key_of(recipe) in self._lights

    def read(self, recipe: Chain, form: str) -> np.ndarray:
        """Return prefiltered radiance (m, 3) as the engine reads it from the levels of a chain.

        form: the pixel format of the levels.
        """
        key = (key_of(recipe), form)
        if key not in self._reads:
            self.bake([recipe])
            levels = as_stored([level.texels for level in self._lights[key[0]][1].levels], form)
            self._reads[key] = shading.specular(
                self.engine, Lights(tuple(levels)), self.points.n, self.points.v, self.sampled.roughness
            )
        return self._reads[key]

    def between(self, recipe: Chain) -> np.ndarray:
        """Return prefiltered radiance (m, 3) as it is read between two levels whose texels are exact in every
        direction.
        """
        own = [single(r) for _, r in recipe.levels]
        mixtures = [
            mixture or lobe
            for mixture, lobe in zip(
                read_mixtures(self.device, recipe) if recipe.fit else [None] * len(own), own, strict=True
            )
        ]
        lod = shading.lods(self.engine, self.sampled.roughness, len(own), recipe.size)
        value = np.zeros_like(self.sampled.color)
        for k, mixture in enumerate(mixtures):
            weight = np.maximum(1 - np.abs(lod - k), 0)
            some = np.flatnonzero(weight)
            if len(some):
                d = self.looked_up[:, some]
                # The last mips of an engine that follows its lod are rougher than 1; only the prefilter integrates
                # such lobes.
                level = (
                    self.integrals.lobe(mixture, d, 0)
                    if max(r for _, r in mixture) <= 1
                    else Exact(self.device, self.env, recipe).lobes([(tuple(mixture), d)])[0]
                )
                value[some] += weight[some, None] * level
        return value

    def stated(self, recipe: Chain) -> np.ndarray:
        """Return the stated error (99th percentile) at each point, (m,): that of its two levels, weighted as they
        are read.
        """
        self.bake([recipe])
        errors = np.array([level.error for level in self._lights[key_of(recipe)][1].levels])
        lod = shading.lods(self.engine, self.sampled.roughness, len(errors), recipe.size)
        return np.asarray(np.maximum(1 - np.abs(lod[:, None] - np.arange(len(errors))), 0) @ errors)

    def diffuse_read(self, recipe: Chain, how: str, form: str) -> np.ndarray:
        """Return E/π (m, 3) as the engine reads it from stored diffuse light.

        how: "sh" for harmonics, "cube" for an irradiance cube, "level" for the level of r = 1. form: the pixel format.
        """
        key = (key_of(recipe), how, form)
        if key not in self._reads:
            self.bake([recipe])
            made, filtered = self._lights[key[0]]
            if how == "level":
                levels = tuple(as_stored([level.texels for level in filtered.levels], form))
                engine = msgspec.structs.replace(self.engine, sh=None)
                self._reads[key] = shading.irradiance(engine, Lights(levels), self.points.n)
            elif how == "cube":
                self._reads[key] = bilinear(as_stored([made.irradiance.texels], form)[0], self.points.n)
            else:
                sh = harmonic.windowed(made.sh).values
                self._reads[key] = np.maximum(harmonic.irradiance_at(sh, self.points.n), 0)
        return self._reads[key]

    def table(self, dfg: Dfg | None, form: str | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the split-sum terms (A, B), (m,) each, as the engine reads them from a table.

        dfg: size and axes of the table; None for an engine without one, which gets Karis's fit. form: the pixel format;
        None for float32.
        """
        NoV, r = self.points.NoV, self.sampled.roughness
        if dfg is None:
            return shading.karis(NoV, r)
        dfg = msgspec.structs.replace(dfg, charlie=False)
        if (dfg, None) not in self._tables:
            self._tables[dfg, None] = split_sum(dfg, device=self.device).values
        if (dfg, form) not in self._tables:
            values = self._tables[dfg, None]
            wide = values if form == "rg16f" else np.concatenate([values, np.zeros_like(values[..., :1])], -1)
            self._tables[dfg, form] = as_stored([wide], form or "", cube=False)[0][..., :2]
        engine = msgspec.structs.replace(self.engine, dfg=dfg)
        return shading.split_sum(engine, self._tables[dfg, form], NoV, r)

    def picture(self, recipe: Chain, engine: Engine, but: Sequence[str] = ()) -> np.ndarray:
        """Return the radiance that the engine shows from its files, (m, 3).

        engine: describes the files; the shading is always that of this object's engine. but: parts of the files that
        are exact here, any of "format", "diffuse" and "table".
        """
        storage = Storage.of(engine)
        return self.shown(
            self.read(recipe, "float32" if "format" in but else storage.chain),
            self.integrals.diffuse if "diffuse" in but else self.diffuse_read(recipe, *storage.diffuse),
            self.integrals.exact_table
            if "table" in but
            else self.table(None if storage.table is None else engine.dfg, storage.table),
        )


def key_of(recipe: Chain) -> str:
    """Return a text that is equal for equal chains and differs otherwise."""
    return repr(recipe.canonical())


def as_stored(levels: Sequence[np.ndarray], form: str, *, cube: bool = True) -> list[np.ndarray]:
    """Return levels after a round trip through a pixel format; "" and "float32" leave them unchanged.

    levels: cubes (6, s, s, 3), or with cube=False images (h, w, 3). Raises UnsupportedError for BC6H and ASTC where
    their packages are not installed.
    """
    if form in ("", "float32"):
        return list(levels)
    if form in ("bc6hu", "astc4x4hdr"):
        made = encode(form, levels, cube=cube).texture
        return [decode(made, k)[..., :3] for k in range(len(levels))]
    if form == "rgba16f":
        return [stored(level, "float16") for level in levels]
    return [unpack(form, pack(form, level).data, level.shape[:-1])[..., : level.shape[-1]] for level in levels]


def writable_formats(file: File) -> list[str]:
    """List the pixel formats of a file's container that have three channels and that this installation can write."""
    found = []
    for form in FORMATS[file.suffix]:
        if form == "rg16f":
            continue
        try:
            as_stored([np.ones((6, 4, 4, 3), np.float32)], form)
        except UnsupportedError:
            continue
        found.append(form)
    return found
