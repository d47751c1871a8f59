"""Lists which parts of a bake a scene's materials can read, with the reason for each, and derives the smallest bake
that has the needed ones."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from whitefurnace.baking.outputs import targets
from whitefurnace.batch.jobs import MOST_BYTES, SECONDS
from whitefurnace.catalogue.choice import chosen
from whitefurnace.engines.presets import Engine, reduced
from whitefurnace.errors import FileError, InputError, UsageError
from whitefurnace.files import read_input, write_text
from whitefurnace.prefiltering.plan import plan_chain
from whitefurnace.prefiltering.recipe import DFG_SIZE, IRRADIANCE_SIZE, Chain, chain
from whitefurnace.rendering.shading import SHADINGS, karis
from whitefurnace.scenes.materials import Material, Scene, Spread
from whitefurnace.sphere.environments import is_demo

NEGLIGIBLE = 1 / 510
"""Half a step of 8 bits, in units of white. A weight below it changes no pixel."""

TABLE = 128
"""Texels on a side of the smallest split-sum table, a power of two, whose bilinear reads err by at most NEGLIGIBLE (p99
over n·v and r, GGX under Smith's masking: 7e-4, over r > .7 1.4e-3; a table of 64² errs by 3e-3 to 5e-3). The largest
errors are at n·v below half a texel at every roughness, so no scene allows a smaller table."""

TEXEL = math.pi / 512
"""Angle of a texel of a 1K environment. The plan's products do not depend on it."""

GLASS = 32
"""Cells on a side of a table of rough glass for one index of refraction."""

Kind = Literal["level", "lobe", "integral", "table", "file", "effect"]


@dataclass(frozen=True)
class Need:
    """One part that a bake could have.

    needed  True or False; None if no image-based table can provide it
    nbytes  bytes before compression in the engine's full set
    kept    bytes before compression in what the scene needs
    """

    what: str
    kind: Kind
    needed: bool | None
    reason: str
    nbytes: int = 0
    kept: int = 0


@dataclass(frozen=True)
class Needs:
    """The parts of an engine's bake that a scene needs.

    own      the engine with only the needed files, None where nothing is needed
    chain    the chain of `own`
    full     the engine's usual chain
    without  names of the parts that are left out
    table    texels on a side of a smaller split-sum table; None if its size stays
    rows     every part, needed or not
    tables   options of `lut` for further tables, each with a file name as `output`
    cloth    options of a further bake of Charlie's chain, or None
    nbytes   bytes before compression
    seconds  predicted seconds of processor time
    full_nbytes, full_seconds  the same for the engine's usual bake
    """

    engine: Engine
    own: Engine | None
    full: Chain
    chain: Chain | None
    without: tuple[str, ...]
    table: int | None
    rows: tuple[Need, ...]
    tables: tuple[dict[str, Any], ...]
    cloth: dict[str, Any] | None
    nbytes: int
    full_nbytes: int
    seconds: float
    full_seconds: float

    @property
    def options(self) -> dict[str, Any]:
        """Options of `bake` that differ from the engine's usual bake."""
        if self.chain is None:
            return {}
        found: dict[str, Any] = {}
        if self.chain.only:
            found["only_levels"] = only_text(self.chain)
        if self.without:
            found["without"] = list(self.without)
        if self.table is not None:
            found["table"] = self.table
        return found


def only_text(recipe: Chain) -> str:
    """Return the range of the levels that are made, in the form that --only-levels takes ("A-B")."""
    assert recipe.only
    return f"{recipe.only[0]}-{recipe.only[1]}"


@dataclass(frozen=True)
class Lobe:
    """A reflection of a material, with its perceptual roughness in [0, 1] as the engine shades it."""

    material: str
    what: str
    roughness: Spread


def lobes(scene: Scene, least: float = 0.0) -> list[Lobe]:
    """Return the GGX lobes of a scene: each material's own lobe and its clear coat's.

    least: smallest perceptual roughness that the engine shades.
    """
    found = []
    for m in lit(scene):
        if m["specular"].most > 0 or m["metalness"].most > 0:
            found.append(Lobe(m.name, "surface", _at_least(m["roughness"], least)))
        if m["clearcoat"].most > 0:
            found.append(Lobe(m.name, "clear coat", _at_least(m["clearcoat_roughness"], least)))
    return found


def lit(scene: Scene) -> list[Material]:
    """The materials of a scene that are not unlit."""
    return [m for m in scene.materials if not m.unlit]


def _at_least(spread: Spread, least: float) -> Spread:
    return replace(spread, low=(max(spread.least, least),), high=(max(spread.most, least),))


def read_shares(found: Sequence[Lobe], recipe: Chain) -> np.ndarray:
    """Return the share of all reads that each level of a chain gets, (levels,), if all lobes are read equally often.

    A level that is read at all has a share above 0.
    """
    weights = np.zeros(len(recipe.levels))
    for lobe in found:
        for low, high, share in lobe.roughness.shares:
            low, high = max(low, lobe.roughness.least), max(high, lobe.roughness.least)
            first, last = recipe.lod(low), recipe.lod(high)
            # Fine enough that no level between the two is missed, however small the range of r.
            lods = np.linspace(first, last, 2 + math.ceil(4 * (last - first)))
            hats = np.maximum(1 - np.abs(lods[:, None] - np.arange(len(weights))), 0)
            weights += share * hats.mean(0) / len(found)
    return weights


def smallest(engine: Engine, full: Chain, found: Sequence[Lobe]) -> Chain:
    """Return the engine's usual chain `full`, cut to the range from the first to the last level that `found` reads.

    Everything that a surface reads stays the same. If the levels are mips of one texture, all of them stay.
    """
    if engine.container == "files":
        return full
    read = np.flatnonzero(read_shares(found, full))
    first, last = int(read[0]), int(read[-1])
    return full if last - first == len(full.levels) - 1 else replace(full, only=(first, last))


def diffuse_weight(engine: Engine, m: Material) -> float:
    """Return the largest factor by which the engine multiplies E/π for a material.

    The maximum is over n·v and the material's roughness. Light through the surface counts too.
    """
    NoV, r = (
        x.ravel()
        for x in np.meshgrid(
            np.linspace(0.05, 1, 12),
            np.linspace(max(m["roughness"].least, engine.least), max(m["roughness"].most, engine.least), 5),
        )
    )
    A, B = karis(NoV, r)
    blend = np.broadcast_to(engine.blend_formula(r=r, alpha=r * r), r.shape)[:, None]
    most = m["diffuse_transmission"].most
    for metal in (m["metalness"].least, m["metalness"].most):
        color = np.array(m["base_color"].high) * (1 - m["transmission"].least * (1 - metal))
        color *= m.diffuse_share(m["specular_color"].low)
        weights = SHADINGS[engine.shading](
            A[:, None], B[:, None], color[None], np.full((len(r), 1), metal), r[:, None], NoV[:, None]
        )
        most = max(most, float((weights[1] + weights[0] * blend).max()))
    return most


def needs(scene: Scene, engine: Engine, *, background: bool = False) -> Needs:
    """Decide which parts of an engine's bake a scene needs.

    background: True if the environment itself is visible behind the scene.
    """
    full = chain(lods=engine.lods, usual_min=engine.min_size, size=engine.size, levels=engine.levels or None)
    return _Deciding(scene, engine, full, background).made()


class _Deciding:
    def __init__(self, scene: Scene, engine: Engine, full: Chain, background: bool) -> None:
        self.scene, self.engine, self.full, self.background = scene, engine, full, background
        self.lit = lit(scene)
        self.lobes = lobes(scene, engine.least)
        self.sheens = [Lobe(m.name, "sheen", m["sheen_roughness"]) for m in self.lit if m["sheen_color"].most > 0]
        self.diffuse = [(m.name, diffuse_weight(engine, m)) for m in self.lit]
        self.needs_diffuse = any(w > NEGLIGIBLE for _, w in self.diffuse)
        self.needs_chain = bool(self.lobes)
        tabled = bool(self.sheens) and engine.dfg.charlie
        self.tabled_sheens = self.sheens if tabled and engine.holding("dfg") else []
        # An engine that has no chain of Charlie's reads its specular chain for a sheen.
        self.readers = [*self.lobes, *(self.sheens if tabled and not engine.holding("sheen") else [])]
        self.rows: list[Need] = []

    def made(self) -> Needs:
        engine, full = self.engine, self.full
        if not (self.needs_chain or self.needs_diffuse or self.sheens or self.background):
            why = "all of its materials are unlit" if self.scene.materials else "it has no materials"
            self.rows.append(Need("any light", "integral", False, why, _bytes(engine, full), 0))
            self._effects()
            return Needs(
                engine,
                None,
                full,
                None,
                (),
                None,
                tuple(self.rows),
                (),
                None,
                0,
                _bytes(engine, full),
                0.0,
                seconds(engine, full),
            )
        own_chain = self._chain()
        without = tuple(self._without())
        table = self._table_size() if "dfg" not in without else None
        own = reduced(engine, without, table)
        self._levels(own, own_chain)
        self._integrals(own, own_chain)
        self._sheen_channel()
        tables = tuple(self._tables())
        cloth = self._cloth()
        self._effects()
        return Needs(
            engine,
            own,
            full,
            own_chain,
            without,
            table,
            tuple(self.rows),
            tables,
            cloth,
            _bytes(own, own_chain),
            _bytes(engine, full),
            seconds(own, own_chain),
            seconds(engine, full),
        )

    # ------------------------------------------------------------------------------------------- the chain

    def _chain(self) -> Chain:
        if self.background or not self.engine.needs("specular"):
            return self.full
        return smallest(self.engine, self.full, self.lobes or [Lobe("", "", Spread((1.0,), (1.0,), (1.0,)))])

    def _without(self) -> Iterator[str]:
        engine = self.engine
        fixed = any(file.suffix == ".gltf" for file in engine.file)  # its specification wants the coefficients
        if not self.needs_diffuse:
            if engine.needs("irradiance"):
                yield "irradiance"
            if engine.needs("sh") and not fixed:
                yield "sh"
        if not self.sheens and (engine.holding("sheen") or (engine.dfg.charlie and engine.holding("dfg"))):
            yield "sheen"
        if not (self.needs_chain or self.tabled_sheens) and engine.needs("dfg"):
            yield "dfg"
        if not self.background and engine.holding("skybox"):
            yield "skybox"

    def _table_size(self) -> int | None:
        """Return the texels on a side of the split-sum table where fewer than the engine's are enough, otherwise None.

        Tables with an axis of √n·v, and with Charlie's albedo, keep their size, since smaller ones were not measured.
        """
        larger = self.engine.holding("dfg") and self.engine.dfg.size > TABLE and self.engine.dfg.NoV == "centres"
        return TABLE if larger and not (self.sheens and self.engine.dfg.charlie) else None

    def _levels(self, own: Engine, made: Chain) -> None:
        engine, full = self.engine, self.full
        if not engine.needs("specular"):
            if engine.holding("environment"):
                self.rows.append(Need("specular chain", "lobe", False, f"{engine.name} filters the image itself"))
            return
        before, after = _parts(engine, full).get("specular", 0), _parts(own, made).get("specular", 0)
        shares = read_shares(self.readers, full) if self.readers else np.zeros(len(full.levels))
        usual, here = (sum(s * s for s, _ in c.levels) for c in (full, made))
        made_of = range(made.first, made.first + len(made.levels))
        for k, (size, r) in enumerate(full.levels):
            last = k == len(full.levels) - 1 and self._last_is_diffuse()
            if shares[k] > 0:
                first = min(
                    (lobe for lobe in self.readers if read_shares([lobe], full)[k] > 0),
                    key=lambda lobe: lobe.roughness.least,
                )
                reason = f"{shares[k]:.2g} of reads: " + _some(
                    sorted({lobe.material for lobe in self.readers if read_shares([lobe], full)[k] > 0})
                )
                reason += f", from r = {first.roughness.least:.2g}" if k == int(np.argmax(shares > 0)) else ""
            elif last:
                reason = f"{engine.name} reads the diffuse light there"
            elif k == 0 and self.background:
                reason = "the environment itself is seen"
            elif k in made_of:
                reason = "no surface reads it" + ("; mips are all there" if engine.container == "files" else "")
            else:
                reason = "no surface reads it"
            self.rows.append(
                Need(
                    f"level {k}, {size}², r = {r:.3g}",
                    "level",
                    bool(shares[k] > 0 or last or (k == 0 and self.background)),
                    reason,
                    round(before * size * size / usual),
                    round(after * size * size / here) if k in made_of else 0,
                )
            )

    def _last_is_diffuse(self) -> bool:
        engine = self.engine
        return self.needs_diffuse and not engine.needs("irradiance") and not engine.needs("sh")

    # ------------------------------------------------------------------------------------------- the rest

    def _integrals(self, own: Engine, made: Chain) -> None:
        engine, before, after = self.engine, _parts(self.engine, self.full), _parts(own, made)

        def row(holds: str, what: str, kind: Kind, needed: bool, reason: str) -> None:
            self.rows.append(Need(what, kind, needed, reason, before.get(holds, 0), after.get(holds, 0)))

        name, weight = max(self.diffuse, key=lambda one: one[1], default=("", 0.0))
        why = (
            f"{name} weighs E/π by up to {weight:.2g}"
            if self.needs_diffuse
            else f"no material weighs E/π by more than {weight:.1g}: metal, black or clear"
        )
        if engine.needs("irradiance"):
            row("irradiance", f"irradiance, {IRRADIANCE_SIZE}²", "integral", self.needs_diffuse, why)
        if engine.needs("sh"):
            stays = " (its container has coefficients all the same)" if own.sh and not self.needs_diffuse else ""
            row("sh", "irradiance harmonics", "integral", self.needs_diffuse, why + stays)
        if engine.holding("environment"):
            row(
                "environment",
                "the image as a lat-long",
                "file",
                True,
                f"{engine.name} filters it itself"
                if not engine.holding("specular")
                else f"where {engine.name} filters it itself",
            )
        if engine.holding("skybox"):
            row(
                "skybox",
                "skybox",
                "file",
                self.background,
                "the background, as --background says"
                if self.background
                else "no material reads it; --background where the environment is seen",
            )
        if engine.holding("sheen"):
            row("sheen", "Charlie's chain", "lobe", bool(self.sheens), _sheen_text(self.sheens))
        if not engine.needs("dfg"):
            return
        if not (self.needs_chain or self.tabled_sheens):
            row("dfg", "split-sum table", "table", False, "no surface reflects")
            return
        least = min(lobe.roughness.least for lobe in self.lobes or self.tabled_sheens)
        size = engine.dfg.size if engine.container == "files" else DFG_SIZE
        reason = f"every reflection reads it, from r = {least:.2g}"
        if own.dfg.size != engine.dfg.size:
            size = own.dfg.size
            reason += (
                f": {size}² are read within {NEGLIGIBLE:.1g} (p99) at any, {engine.name} has "
                f"{engine.dfg.size}²; --table {size}"
            )
        row("dfg", f"split-sum table, {size}²", "table", True, reason)

    def _sheen_channel(self) -> None:
        """Add a row for the albedo of a sheen in the engine's table, where the table or a material has one."""
        engine, text = self.engine, _sheen_text(self.sheens)
        if engine.dfg.charlie and engine.holding("dfg"):
            left = "" if self.sheens else ", so the table's third channel is left out"
            self.rows.append(Need("Charlie's albedo in the table", "table", bool(self.sheens), text + left))
        elif self.sheens and engine.container == "files":
            lacks = f"the table of {engine.name} has no channel for it"
            if not engine.holding("dfg"):
                lacks = f"the files for {engine.name} have no table of it"
            self.rows.append(Need("Charlie's albedo in the table", "table", None, f"{text}, and {lacks}"))

    def _tables(self) -> Iterator[dict[str, Any]]:
        """Return options of `lut` for tables that the engine does not have, for users' own renderers."""
        free = self.engine.container != "files"
        clear = [m for m in self.lit if m["transmission"].most > 0]
        rough = [m for m in clear if m["roughness"].most > 0]
        if rough:
            for ior in sorted({m["ior"].most for m in rough})[:4]:
                who = _some([m.name for m in rough if m["ior"].most == ior])
                if ior <= 1:
                    continue
                self.rows.append(
                    Need(
                        f"glass table, n = {ior:g}, {GLASS}²",
                        "table",
                        True if free else None,
                        f"light that rough {who} reflects and transmits"
                        if free
                        else f"{who} is rough glass; {self.engine.name} reads no such table",
                        kept=GLASS * GLASS * 8 if free else 0,
                    )
                )
                if free:
                    yield {"kind": "glass", "output": f"glass_{ior:g}.npy", "size": GLASS, "set": [f"ior={ior:g}"]}
        else:
            self.rows.append(
                Need(
                    "glass tables",
                    "table",
                    False,
                    "nothing transmits" if not clear else "what transmits is smooth: Fresnel's equations alone",
                )
            )
        if self.sheens and free:
            self.rows.append(
                Need(
                    "sheen table, 64²",
                    "table",
                    True,
                    f"what {_names(self.sheens)} leaves to the layer under it",
                    kept=64 * 64 * 8,
                )
            )
            yield {"kind": "sheen", "output": "sheen.npy", "size": 64}
        self.rows.append(Need("linearly transformed cosines", "table", False, "glTF has no area lights"))
        if self.scene.lights:
            self.rows.append(
                Need(
                    "tables for punctual lights",
                    "table",
                    False,
                    f"its {self.scene.lights} are delta lights: shaders evaluate the BRDF",
                )
            )

    def _cloth(self) -> dict[str, Any] | None:
        if not self.sheens or self.engine.container == "files":
            if self.sheens and not self.engine.holding("sheen"):
                self.rows.append(
                    Need(
                        "Charlie's chain",
                        "lobe",
                        None,
                        f"{_sheen_text(self.sheens)}; {self.engine.name} reads no such chain"
                        + (f": it shades sheen by {self.engine.sheen}" if self.engine.sheen else ""),
                    )
                )
            return None
        usual = replace(self.full, ndf=chosen("ndf", "charlie"))
        made = self.full if self.background else smallest(self.engine, usual, self.sheens)
        without = ["irradiance", "sh", "dfg"]
        self.rows.append(
            Need(
                "Charlie's chain",
                "lobe",
                True,
                _sheen_text(self.sheens),
                kept=_bytes(reduced(self.engine, without), made),
            )
        )
        only = {"only_levels": only_text(made)} if made.only else {}
        return {"ndf": "charlie", **only, "without": without}

    def _effects(self) -> None:
        """Add rows for effects of the materials that no table of an environment can show."""

        def add(what: str, which: Sequence[Material], reason: str) -> None:
            if which:
                self.rows.append(Need(what, "effect", None, f"{_some([m.name for m in which])}: {reason}"))

        add(
            "iridescence",
            [m for m in self.lit if m["iridescence"].most > 0],
            "its Fresnel term turns with the angle and the film, the split sum is of Schlick's with F90 = 1: an "
            "average F0 is all that it can be given",
        )
        thick = [m for m in self.lit if m["transmission"].most > 0 and m["thickness"].most > 0]
        add(
            "refraction with volume",
            thick,
            "where light leaves depends on the shape, no table of an environment "
            "holds that; engines read the chain, or the picture behind, along one refracted ray",
        )
        add(
            "absorption",
            [m for m in thick if math.isfinite(m["attenuation_distance"].least)],
            "Beer's law along that ray, in the shader: no table",
        )
        add("dispersion", [m for m in self.lit if m["dispersion"].most > 0], "one refracted ray a colour: no table")
        add(
            "anisotropy",
            [m for m in self.lit if m["anisotropy"].most > 0],
            "only isotropic lobes can be prefiltered: engines read that of r along a bent direction",
        )
        strong = [m for m in self.scene.materials if m["emission"].most * m["emissive_strength"].most > 1]
        add("light of its own", strong, "it is seen, and lights nothing else: it is not in the environment")
        for m in self.lit:
            for name in m.unread:
                self.rows.append(Need(name, "effect", None, f"{m.name}: this extension is not read, its fallback is"))


def seconds(engine: Engine, recipe: Chain) -> float:
    """Predict the seconds of processor time of a bake without reading the image, as `batch --dry-run` states them."""
    pairs = 0
    if engine.needs("specular"):
        pairs += sum(level.pairs for level in plan_chain(recipe, TEXEL))
    if engine.holding("sheen"):
        pairs += sum(level.pairs for level in plan_chain(replace(recipe, ndf=chosen("ndf", "charlie")), TEXEL))
    return SECONDS["item"] + SECONDS["pair"] * pairs


def _bytes(engine: Engine, recipe: Chain) -> int:
    return sum(target.nbytes for target in targets(engine, recipe, Path("x"), "x"))


def _parts(engine: Engine, recipe: Chain) -> dict[str, int]:
    """Return the bytes of the files by their content."""
    texels = sum(6 * s * s for s, _ in recipe.levels)
    if engine.container == "npz":
        sizes = {"specular": 12 * texels, "irradiance": 72 * IRRADIANCE_SIZE**2, "sh": 108, "dfg": 8 * DFG_SIZE**2}
        return {holds: n for holds, n in sizes.items() if engine.needs(holds)}
    found = targets(engine, recipe, Path("x"), "x")
    sizes = {}
    for k, target in enumerate(found):
        if engine.container == "exr":
            holds = next((h for h in ("irradiance", "dfg") if f"_{h}." in target.path.name), "specular")
        else:
            holds = engine.file[k].holds if k < len(engine.file) else "shader"
        sizes[holds] = sizes.get(holds, 0) + target.nbytes
    return sizes


def _sheen_text(sheens: Sequence[Lobe]) -> str:
    if not sheens:
        return "no material has a sheen"
    low, high = min(s.roughness.least for s in sheens), max(s.roughness.most for s in sheens)
    return f"{_names(sheens)} has a sheen at r = {low:.2g}" + (f" … {high:.2g}" if high > low else "")


def _names(found: Sequence[Lobe]) -> str:
    return _some(list(dict.fromkeys(lobe.material for lobe in found)))


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


def bakes(found: Needs, output: str) -> list[dict[str, Any]]:
    """Return the options of a `BakeRequest` for each bake that an environment needs, with the folder as `output`."""
    if found.own is None:
        return []
    made = [{"output": output, **found.options}]
    if found.cloth:
        made.append({"output": f"{output}/charlie", **found.cloth})
    return made


def write_job(
    path: str | os.PathLike[str],
    found: Needs,
    name: str,
    scene: str,
    environments: Sequence[str],
    *,
    force: bool = False,
) -> None:
    """Write a job for `batch` that bakes what a scene needs.

    path: a .toml file; outputs go into a folder of the same name next to it. name: the engine as --for takes it.
    environments: paths or "demo". force: replace a file with other contents.

    Raises FileError for a file with other contents at `path` or one that cannot be read or written, and UsageError for
    another suffix.
    """
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise UsageError(f"{path}: a job is a .toml file")
    folder = path.absolute().parent
    sources = [one if is_demo(one) else _relative(one, folder) for one in environments]
    engine = _relative(name, folder) if name.lower().endswith(".toml") else name
    tables = [("bake", {"environments": sources, "for": [engine], **one}) for one in bakes(found, path.stem)]
    tables += [("lut", {**one, "output": f"{path.stem}/{one['output']}"}) for one in found.tables]
    text = f"# What {_plain(scene)} needs of {_plain(found.engine.name)}, as `whitefurnace scene` says.\n" + "".join(
        f"\n[[{kind}]]\n" + "".join(f"{key} = {_toml(value)}\n" for key, value in one.items()) for kind, one in tables
    )
    there = read_input(path, "a job", most=MOST_BYTES) if path.exists() else None
    if there is not None and there != text.encode() and not force:
        raise FileError(f"{path} is there and is another job; move it away or give --force")
    write_text(path, text)


def _relative(path: str, folder: Path) -> str:
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # another drive
        return Path(os.path.abspath(path)).as_posix()


def _plain(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if not isinstance(value, str):
        return repr(value)
    try:
        value.encode()
    except UnicodeEncodeError:
        raise InputError(f"{value!r} cannot be written in a TOML file") from None
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def one_engine(found: Sequence[Engine]) -> Engine:
    """Return the engine of a list of one. Raises UsageError for several engines, since each needs its own sizes."""
    if len(found) != 1:
        raise UsageError("scene decides for one engine at a time: give one NAME to --for")
    return found[0]
