"""The renderer reads an engine's own files and shades as the engine does: closed forms for constant light, directions
that say where they are, levels that say which they are."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from whitefurnace.cli import cli
from whitefurnace.engines.presets import ENGINES, PRESETS, Dfg, Engine, File
from whitefurnace.errors import FileError, InputError, UnsupportedError, UsageError
from whitefurnace.files import (
    EnvMap,
    GltfLight,
    digest_file,
    encode,
    pack,
    read_stored,
    write_env,
    write_exr,
    write_gltf_lights,
    write_manifest,
    write_npz,
    write_png,
    write_texture,
)
from whitefurnace.rendering import shading
from whitefurnace.rendering.shading import Lights
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere import octahedral_map as octamap
from whitefurnace.sphere.grids import cube_centres

OWN = Engine(
    name="own",
    lod="max_lod * r",
    axes="+z -x +y",
    sh="radiance",
    dfg=Dfg(64, x="alpha", y="NoV", NoV="sqrt"),
    file=(File("specular", "{stem}.dds", "rgba16f"), File("sh", "{stem}.json"), File("dfg", "{stem}_dfg.exr")),
)
MAPS, ATLAS = (
    Engine(
        name=name,
        lod="max_lod * r",
        dfg=Dfg(64),
        file=(
            File("specular", f"{{stem}}{suffix}", layout="octahedral", border=border),
            File("irradiance", "{stem}_i.ktx2", "rgba16f"),
            File("dfg", "{stem}_dfg.ktx2", "rg16f"),
        ),
    )
    for name, suffix, border in (("maps", ".ktx2", 0), ("atlas", ".exr", 2))
)
ALL = [engine for engine in ENGINES.values() if engine.holding("specular") or engine.container != "files"]
ALL += [OWN, MAPS, ATLAS]
AXES = {name: preset.published.direction for name, preset in PRESETS.items() if preset.published} | {"own": (3, -1, 2)}
"""Of the world's axes those that the stored direction has; (1, 2, 3) where nothing is said."""
LEVELS = {"filament": 5, "three": 4} | {name: 7 for name, engine in ENGINES.items() if engine.whole or engine.levels}
"""Of chains from 64², 3 where nothing is said: down to 16², or 8², or 1², as the presets want."""
IMPORTED = tuple(engine.name for engine in ALL if engine.container == "files" and not engine.holding("dfg"))
"""No table of ours: their weights of white metal are those of Karis's fit."""


def world(engine: Engine, d: np.ndarray) -> np.ndarray:
    """(3, m) world directions of stored ones."""
    back = np.empty_like(d)
    for k, a in enumerate(AXES.get(engine.name, (1, 2, 3))):
        back[abs(a) - 1] = math.copysign(1, a) * d[k]
    return back


def written(engine: Engine, folder, light, diffuse, split=(1.0, 0.0)) -> None:
    """The files of a bake for `engine` in `folder`: light(k, d) and diffuse(d) give (m, 3) in world directions (3, m),
    diffuse constant or linear; the table is (A, B) everywhere."""
    folder.mkdir(parents=True, exist_ok=True)
    count = LEVELS.get(engine.name, 3)

    def cube(size: int, of) -> np.ndarray:
        d = cube_centres(size, np.arange(6 * size * size))
        return of(world(engine, d)).reshape(6, size, size, 3).astype(np.float32)

    levels = [cube(64 >> k, lambda d, k=k: light(k, d)) for k in range(count)]
    # E/π = c + a·n has radiance c + 3/2 a·d behind it.
    ends = np.array([diffuse(s * np.eye(3)) for s in (1, -1)])  # (2, axis, channel)
    c, a = ends.mean((0, 1)), 1.5 * (ends[0] - ends[1]).T / 2
    radiance = harmonic.coefficients_of(c, a, np.zeros((3, 3, 3))).T
    sh = None if engine.sh is None else harmonic.SCALINGS[engine.sh](harmonic.turned(radiance, engine.matrix))
    A, B = split
    pair = (B, A + B) if engine.dfg.form == "multiscatter" else (A, B)
    table = np.broadcast_to(np.array([*pair, 0.0], np.float32), (engine.dfg.size, engine.dfg.size, 3))
    if engine.container == "npz":
        write_npz(
            folder / "x.npz",
            {
                **{f"specular_{k}": level for k, level in enumerate(levels)},
                "irradiance": cube(32, diffuse),
                "dfg": table[..., :2],
            },
        )
    if engine.container == "exr":
        for k, level in enumerate(levels):
            write_exr(folder / f"x_specular_{k}.exr", level.reshape(-1, level.shape[2], 3))
        write_exr(folder / "x_irradiance.exr", cube(32, diffuse).reshape(-1, 32, 3))
        write_exr(folder / "x_dfg.exr", np.ascontiguousarray(table[..., :2]), channel_names=("R", "G"))
    for file in engine.file:
        path = folder / file.name.replace("{stem}", "x")
        if file.suffix == ".env":
            write_env(path, EnvMap(tuple(levels), sh))
        elif file.suffix == ".gltf":
            write_gltf_lights(path, GltfLight(tuple(levels), sh))
        elif file.suffix == ".json":
            path.write_text(json.dumps({str(k): row for k, row in enumerate(sh.tolist())}))
        elif file.holds == "sh":
            path.write_text("".join(f"({r}, {g}, {b}); // L\n" for r, g, b in sh))
        elif file.suffix == ".png":
            write_png(path, pack("rgbd", table).data)
        elif path.suffix == ".exr" and file.holds == "dfg":
            write_exr(path, np.ascontiguousarray(table[..., :2]), channel_names=("R", "G"))
        elif file.holds == "dfg":
            write_texture(path, encode(file.stored, [table[..., :2] if file.stored == "rg16f" else table]).texture)
        elif file.layout == "octahedral":
            maps = [
                light(k, octamap.texel_directions(64 >> k)).reshape(64 >> k, 64 >> k, 3).astype(np.float32)
                for k in range(count)
            ]
            if file.suffix == ".exr":
                write_exr(path, octamap.to_atlas(maps, file.border)[0])
                write_manifest(
                    folder.parent / "x.json",
                    {"whitefurnace": "0", "files": {f"{folder.name}/{path.name}": {"levels": [{}] * count}}},
                )
            else:
                write_texture(path, encode(file.stored, maps).texture)
        elif file.holds in ("specular", "irradiance"):
            held = levels if file.holds == "specular" else [cube(32, diffuse)]
            write_texture(path, encode(file.stored, held, cube=True).texture, zstd=file.zstd)


OCTAHEDRAL = {"atlas": 6e-3, "maps": 0.5 * 1.5 * 2 / 64}


def constant(value: float):
    return lambda *d: np.full((d[-1].shape[1], 3), value)


def spheres(engine: Engine, lights: Lights, **options) -> np.ndarray:
    """(rows, columns, m, 3): the pixels that are wholly of a sphere."""
    size = options.setdefault("size", 32)
    picture = shading.grid(engine, lights, background="plain", **options)
    index, cover, _ = shading.sphere(size)
    rows, columns = picture.shape[0] // size, picture.shape[1] // size
    cells = picture.reshape(rows, size, columns, size, 3).swapaxes(1, 2).reshape(rows, columns, -1, 3)
    return cells[:, :, index[cover == 1]]


# ------------------------------------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("engine", ALL, ids=lambda e: e.name)
def test_white_spheres_under_a_constant_sky(engine, tmp_path):
    """From the engine's own files. What single scattering loses, three.js, Bevy and the Khronos viewer give back, so
    that white is 1 at any metalness. Filament and Babylon.js keep a white metal at 1, but Filament adds to the
    dielectric what its compensation gives, and Babylon.js leaves its diffuse at 1 - F0 whatever the specular takes; the
    split sum alone leaves a metal at A + B."""
    A, B = 0.625, 0.125  # exact in half floats
    written(engine, tmp_path, constant(1.0), constant(1.0), (A, B))
    lights = shading.read_lights(engine, tmp_path, "x")
    got = spheres(engine, lights, columns=3, rows=2)
    metal = dielectric = np.ones(())
    if engine.shading == "scaled":
        dielectric = 1 + (0.04 * A + B) * 0.04 * (1 / (A + B) - 1)
    if engine.shading == "babylon":
        dielectric = 0.96 + (0.04 * A + B) * (1 + 0.04 * (1 / (A + B) - 1))
    if engine.shading == "split_sum" and engine.name not in IMPORTED:
        metal = np.asarray(A + B)
    # All is exact in its format but Babylon's table in RGBD: 2.2/255 of .75 and .125, and SH of nine digits.
    close = 0.01 if engine.shading == "babylon" else 2e-6
    np.testing.assert_allclose(got[0], np.broadcast_to(dielectric, got[0].shape), atol=close)
    if engine.name in IMPORTED:  # [Karis2014] is within 2e-2 of 1 for a mirror, and darker where it is rough
        assert np.abs(got[1, 0] - 1).max() <= 0.02 and got[1].max() <= 1.02
    else:
        np.testing.assert_allclose(got[1], np.broadcast_to(metal, got[1].shape), atol=2e-6)


X, Y = 0.15, 0.8
"""(∫Fc, ∫1) of a pixel, which is (A, B) = (Y - X, X)."""


def as_written(formula: str, c: float, m: float, r: float, NoV: float) -> tuple[float, float]:
    """Weights of radiance and E/π as the engine's shader has them, of one channel: Filament's light_indirect.fs,
    Babylon's pbrBlockFinalLitComponents, three.js's RE_IndirectSpecular_Physical, the viewer's pbr.frag."""
    mix = lambda a, b, t: a * (1 - t) + b * t  # noqa: E731
    f0 = 0.16 * 0.5**2 * (1 - m) + c * m
    if formula == "split_sum":
        E = f0 * (Y - X) + X
        return E, c * (1 - m) * (1 - E)
    if formula == "scaled":
        E = mix(X, Y, f0)
        return E * (1 + f0 * (1 / Y - 1)), c * (1 - m) * (1 - E)
    if formula == "babylon":
        return ((1 - f0) * X + f0 * Y) * (1 + f0 * (1 / Y - 1)), c * (1 - 0.04) * (1 - m)
    fab = (Y - X, X)
    if formula == "fdez_aguera":
        single, multi = [], []
        for F in (0.04, c):
            FssEss = F * fab[0] + 1.0 * fab[1]
            Ems = 1 - (fab[0] + fab[1])
            Favg = F + (1 - F) * 0.047619047619
            single.append(FssEss)
            multi.append(FssEss * Favg / (1 - Ems * Favg) * Ems)
        return mix(*single, m), mix(*multi, m) + c * (1 - m) * (1 - single[0] - multi[0])
    found = []
    for F in (0.04, c):
        Fr = max(1 - r, F) - F
        k_S = F + Fr * (1 - NoV) ** 5
        FssEss = k_S * fab[0] + fab[1]
        Ems = 1 - (fab[0] + fab[1])
        F_avg = F + (1 - F) / 21
        found.append(FssEss + Ems * FssEss * F_avg / (1 - F_avg * Ems))
    return mix(*found, m), mix(c * (1 - found[0]), 0, m)


@pytest.mark.parametrize("formula", shading.SHADINGS)
def test_weights_are_those_of_the_engines_shader(formula):
    got = np.array(
        [
            [
                np.array(
                    shading.SHADINGS[formula](
                        np.array([[Y - X]]),
                        np.array([[X]]),
                        np.array([[c]]),
                        np.array([[m]]),
                        np.array([[r]]),
                        np.array([[0.4]]),
                    )
                ).ravel()
                for c in (0.0, 0.3, 1.0)
            ]
            for m in (0.0, 0.25, 1.0)
            for r in (0.2, 0.9)
        ]
    )
    wanted = np.array(
        [[as_written(formula, c, m, r, 0.4) for c in (0.0, 0.3, 1.0)] for m in (0.0, 0.25, 1.0) for r in (0.2, 0.9)]
    )
    np.testing.assert_allclose(got, wanted, atol=1e-10)


def test_every_shading_of_a_preset_is_there():
    assert {engine.shading for engine in ALL} == set(shading.SHADINGS)


@pytest.mark.parametrize(
    ("x", "y", "NoV"),
    [
        ("NoV", "roughness", "centres"),
        ("roughness", "NoV", "centres"),
        ("NoV", "alpha", "sqrt"),
        ("alpha", "NoV", "sqrt"),
    ],
)
def test_a_table_is_read_on_its_axes(x, y, NoV):
    """A table that holds its own axes, which a bilinear read gives back exactly between the first and last texel."""
    n = 16
    values = {
        "roughness": (np.arange(n) + 0.5) / n,
        "alpha": (np.arange(n) + 0.5) / n,
        "NoV": np.arange(n) / (n - 1) if NoV == "sqrt" else (np.arange(n) + 0.5) / n,
    }
    across, down = np.meshgrid(values[x], values[y])
    held = np.stack([across, down] if x == "NoV" else [down, across], -1)
    rng = np.random.default_rng(3)
    mu, r = rng.uniform(0.04, 0.96, (2, 50))
    r = np.maximum(r, 0.2)  # α = .04 is beyond the first centre
    for form in ("scale_bias", "multiscatter"):
        A, B = shading.split_sum(Engine(dfg=Dfg(n, x=x, y=y, NoV=NoV, form=form)), held, mu, r)
        if form == "multiscatter":
            A, B = B, A + B
        np.testing.assert_allclose(A, np.sqrt(mu) if NoV == "sqrt" else mu, atol=1e-12)
        np.testing.assert_allclose(B, r * r if "alpha" in (x, y) else r, atol=1e-12)


# ------------------------------------------------------------------------------------------------- where and which


def encoded(d: np.ndarray) -> np.ndarray:
    """(m, 3) light that says its direction."""
    return 1 + 0.5 * d.T


@pytest.mark.parametrize("engine", ALL, ids=lambda e: e.name)
def test_a_mirror_shows_the_mirror_directions_and_a_dielectric_the_normals(engine, tmp_path):
    written(engine, tmp_path, lambda k, d: encoded(d), lambda d: 1 + d.T / 3)
    lights = shading.read_lights(engine, tmp_path, "x")
    _, cover, n = shading.sphere(32)
    n = n[:, cover == 1]
    assert n[2].min() > 0 and n[1, 0] > 0  # the first row is the upper one
    v = np.array([0.0, 0.0, 1.0])
    r = max(0.0, engine.least)
    mirror = 2 * n[2] * n - v[:, None]
    d = mirror + (n - mirror) * float(engine.bend_formula(r=r, alpha=r * r))
    shown = encoded(d / np.linalg.norm(d, axis=0))
    blend = float(engine.blend_formula(r=r, alpha=r * r))
    diffuse = encoded(n) if lights.sh is None and lights.irradiance is None else 1 + n.T / 3
    shown = shown + (diffuse - shown) * blend
    got = spheres(engine, lights, columns=1, rows=2)[:, 0]
    if engine.name in IMPORTED:
        A, B = shading.karis(n[2], np.full(n.shape[1], r))
        shown = shown * (A + B)[:, None]
    # A bilinear read between centres 2/64 apart errs by (2/64)²/8 · |f''| ≤ 1e-4, at a cube's corners, where the fourth
    # texel is the mean of three, by ¼ · 2/64 · |f'| = 4e-3; so at an octahedron's creases, its texels 3/2 as wide, and
    # by half of one of them at the edges of a map without a border.
    # Formats add half an ulp of values below 2: 2^-6 of blue in 10 bits, 2^-9 of a shared exponent, 2.2/255 of RGBD
    # with D = 1/2; BC6H a little more.
    half = {"b10g11r11": 2**-6, "rgbd": 2.2 / 255, "bc6hu": 1e-2, "rgb9e5": 2**-9}
    step = OCTAHEDRAL.get(engine.name, 4e-3) + half.get(engine.file[0].stored if engine.file else "", 2**-11)
    np.testing.assert_allclose(got[1], shown, atol=step)
    if lights.sh is not None or lights.irradiance is not None:
        np.testing.assert_allclose(shading.irradiance(engine, lights, n), 1 + n.T / 3, atol=step)
    elif engine.name == "three":  # from 8² texels
        np.testing.assert_allclose(shading.irradiance(engine, lights, n), encoded(n), atol=8 * step)


def test_roughness_bends_blends_and_has_a_least():
    """Half-way between mirror direction and normal, a quarter of E/π, and r = 0 as r = 1/2 at the lod of that."""
    engine = Engine(lod="max_lod * r", bend="2 * alpha", blend="alpha", least=0.5)
    d = cube_centres(128, np.arange(6 * 128**2))
    chain = tuple((encoded(d) + k).reshape(6, 128, 128, 3) for k in range(3))
    lights = Lights(chain, (10 + encoded(d)).reshape(6, 128, 128, 3), None, np.array([[[1.0, 0.0]]]))
    n = np.array([[0.6, 0.0, 0.48], [0.0, -0.28, 0.6], [0.8, 0.96, 0.64]])
    v = np.array([[0.0, 0.6, -0.28], [0.0, 0.0, 0.0], [1.0, 0.8, 0.96]])
    half = 2 * (n * v).sum(0) * n - v + n
    radiance = 1 + encoded(half / np.linalg.norm(half, axis=0))  # of level 1
    radiance = 0.75 * radiance + 0.25 * (10 + encoded(n))
    for r in (0.0, 0.5, [0.0, 0.5, 0.2]):
        for metal, wanted in ((1.0, radiance), (0.0, 0.04 * radiance + 0.96 * (10 + encoded(n)))):
            got = shading.shade(engine, lights, n, v, (1, 1, 1), metal, r)
            # (2/128)²/8 · |f''|, |f''| ≤ 1 of a direction over the face's coordinate
            np.testing.assert_allclose(got, wanted, atol=1e-4)


# lod at r = 0, 1/2 and 1 of those chains, by the published mappings.
LODS = {
    "raw": (0, 0.75 * 2, 2),
    "exr": (0, 0.75 * 2, 2),
    "three": (0, 0.75 * 3, 3),
    "filament": (0, 0.75 * 4, 4),
    "babylon": (0, 0.8 * math.log2(64 * 0.2505), 0.8 * math.log2(64 * 1.0005)),
    "bevy": (0, 1, 2),
    "gltf": (0, 1, 2),
    "khronos": (0, 1, 2),
    "unity": (0, 4.05, 6),
    "unreal": (0, 2.8, 4),
}
UNLISTED = {name: preset.published for name, preset in PRESETS.items() if name not in LODS}
"""Presets that come later: read at their own formulas, which tests/engines/test_presets.py holds against published
numbers."""


@pytest.mark.parametrize("engine", ALL, ids=lambda e: e.name)
def test_levels_are_read_at_the_engines_lod(engine, tmp_path):
    written(engine, tmp_path, lambda k, d: constant(k + 1.0)(d), constant(2.0))
    lights = shading.read_lights(engine, tmp_path, "x")
    n = np.array([[0.0, 0.6], [0.0, 0.0], [1.0, 0.8]])
    v = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    for r, lod in zip((0.0, 0.5, 1.0), LODS.get(engine.name, (0, 1, 2)), strict=True):
        if r == 0 and engine.least:  # as .045 or .089 there
            s = engine.least
            lod = {"bevy": 2 * s}.get(engine.name, (LEVELS.get(engine.name, 3) - 1) * s * (2 - s))
            lod = 0 if engine.name == "unreal" else lod
        if engine.name in UNLISTED:
            lod = engine.lods.at(max(r, engine.least), LEVELS.get(engine.name, 3), 64)
        # Small whole numbers are exact in all formats but BC6H and RGBD: half a step of theirs at 7.
        got = shading.specular(engine, lights, n, v, np.full(2, max(r, engine.least)))
        close = 2e-2 if engine.name in UNLISTED else 1e-6
        close = {"three": 4e-3, "babylon": 2e-2, "gltf": 2e-2}.get(engine.name, close)
        np.testing.assert_allclose(got, 1 + lod, rtol=close)
    published = UNLISTED.get(engine.name)
    diffuse = {"three": 4, "unity": 7, "unreal": 5}.get(engine.name, 2)
    diffuse = 1 + lod if published is not None and published.diffuse_lod is not None else diffuse
    assert shading.irradiance(engine, lights, n) == pytest.approx(np.full((2, 3), diffuse), rel=4e-3)


# ------------------------------------------------------------------------------------------------- pictures


@pytest.fixture
def baked(tmp_path):
    """A manifest and what a bake for Filament, and Godot, has written."""
    engine = ENGINES["filament"]
    written(engine, tmp_path / "filament", constant(0.5), constant(0.5))
    (tmp_path / "godot").mkdir()
    (tmp_path / "godot" / "x.hdr").write_bytes(b"anything")
    files = {f"{path.parent.name}/{path.name}": {"sha256": digest_file(path)} for path in sorted(tmp_path.glob("*/*"))}
    write_manifest(
        tmp_path / "x.json",
        {
            "whitefurnace": "0",
            "name": "x",
            "files": files,
            "recipe": {"engines": {"filament": {"engine": engine.data()}}},
        },
    )
    return tmp_path / "x.json"


def test_a_picture_is_srgb_and_reads_back(baked, tmp_path):
    output = tmp_path / "grid.png"
    made = shading.render(baked, output, for_="filament", size=16, columns=2, rows=1)
    assert (made.width, made.height, made.metalness) == (32, 16, (1.0,)) and made.roughness == (0.0, 1.0)
    assert [path.rsplit("/", 1)[1] for path in made.read] == ["x_ibl.ktx", "x_sh.txt", "x_dfg.ktx2"]
    # .5 is 1.055 · .5^(1/2.4) - .055 = .7353569 in sRGB [IEC 61966-2-1], of 255 the nearest is 188; background too
    assert np.unique(np.round(read_stored(output) * 255)).tolist() == [188]
    shading.render(baked, output, for_="filament", size=16, columns=2, rows=1, exposure=1.0, force=True)
    assert np.unique(read_stored(output)).tolist() == [1]
    shading.render(baked, output, for_="filament", size=16, columns=1, exposure=-1, background="plain", force=True)
    grey = 1.055 * 0.09 ** (1 / 2.4) - 0.055
    assert read_stored(output)[0, 0] == pytest.approx(grey, abs=0.5 / 255)


def test_the_background_is_what_a_camera_sees(tmp_path):
    engine = ENGINES["three"]
    written(engine, tmp_path, lambda k, d: encoded(d), lambda d: 1 + d.T / 3)
    picture = shading.grid(engine, shading.read_lights(engine, tmp_path, "x"), size=32, columns=2, rows=1)
    # 60° high and twice as wide, along -z: right is +x and up is +y, a corner's centre is half a pixel inside
    x, y = 2 * math.tan(math.radians(30)) * (1 - 1 / 64), math.tan(math.radians(30)) * (1 - 1 / 32)
    for row, column, corner in ((0, 0, (-x, y, -1)), (0, -1, (x, y, -1)), (-1, 0, (-x, -y, -1))):
        d = np.array(corner) / np.linalg.norm(corner)
        assert picture[row, column] == pytest.approx(1 + d / 2, abs=0.02)  # BC6H


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"for_": "three"}, UsageError, "was not baked for three; it has filament, godot"),
        ({"for_": "filement"}, UsageError, "did you mean 'filament'"),
        ({"for_": "godot"}, UnsupportedError, "no prefiltered chain"),
        ({"for_": "filament,godot"}, UsageError, "a picture is of one"),
        ({"size": 7}, UsageError, r"size 7 is outside \[8, 2048\]"),
        ({"columns": 0}, UsageError, "columns 0 is outside"),
        ({"size": 2048, "columns": 64, "rows": 64}, UsageError, "are more than"),
        ({"exposure": math.nan}, UsageError, "exposure nan is outside"),
        ({"base_color": (0.5, 2.0, 0.5)}, UsageError, "base color 0.5 2 0.5 is not"),
        ({"background": "sky"}, UsageError, "unknown background"),
    ],
)
def test_what_cannot_be_drawn_is_said(baked, tmp_path, options, error, said):
    with pytest.raises(error, match=said):
        shading.render(baked, tmp_path / "grid.png", **{"for_": "filament", **options})
    assert not (tmp_path / "grid.png").exists()


def test_files_are_those_of_the_manifest(baked, tmp_path):
    output = tmp_path / "grid.png"
    output.write_bytes(b"mine")
    with pytest.raises(FileError, match="--force replaces it"):
        shading.render(baked, output, for_="filament")
    with pytest.raises(UsageError, match=r"must end with \.png"):
        shading.render(baked, tmp_path / "grid.jpg", for_="filament")
    chain = tmp_path / "filament" / "x_ibl.ktx"
    chain.write_bytes(chain.read_bytes()[:-1] + b"\0")
    with pytest.raises(InputError, match="it was changed since the bake"):
        shading.render(baked, tmp_path / "new.png", for_="filament")
    chain.unlink()
    with pytest.raises(FileError, match="lists it and it is not there"):
        shading.render(baked, tmp_path / "new.png", for_="filament")
    with pytest.raises(FileError, match="No such file"):
        shading.render(tmp_path / "y.json", tmp_path / "new.png", for_="filament")
    (tmp_path / "z.json").write_text("{}")
    with pytest.raises(InputError, match="is not the manifest of a bake"):
        shading.render(tmp_path / "z.json", tmp_path / "new.png", for_="filament")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1 2 3",
        "(1, 2, 3)\n" * 8,
        "(1, 2, nan)\n" * 9,
        "(1, 2, 1e999)\n" * 9,
        "{",
        "[1]",
        '{"x": 1}',
        '{"x": [1, 2, "3x"]}',
        "\xff",
        "(1, 2, 3)\n" * 9000,
    ],
)
def test_a_text_that_holds_no_harmonics_is_refused(text, tmp_path):
    path = tmp_path / "x_sh.txt"
    path.write_text(text, "latin-1")
    with pytest.raises(InputError):
        shading.read_sh(path)


def test_the_command_says_what_it_drew(baked, tmp_path):
    asked = ["render", str(baked), "--for", "filament", "--size", "8", "--columns", "2", "--rows", "1"]
    done = CliRunner().invoke(cli, [*asked, "-o", str(tmp_path / "a.png"), "--json"])
    assert done.exit_code == 0, done.output
    row = json.loads(done.stdout)
    assert row["event"] == "rendered" and row["path"].endswith("a.png") and (row["width"], row["height"]) == (16, 8)
    done = CliRunner().invoke(cli, [*asked, "-o", str(tmp_path / "b.png")])
    assert done.exit_code == 0 and "roughness 0 1\n" in done.stdout
