"""Engines as data: mappings, axes and files of every preset and of a user's own, baked, read back and held against
what the project's own arrays say."""

from __future__ import annotations

import ast
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

from reference import cube_directions
from whitefurnace import bake, dfg
from whitefurnace.baking.outputs import targets
from whitefurnace.cli import main
from whitefurnace.cli.bake import baked_text
from whitefurnace.engines.engine import check
from whitefurnace.engines.presets import (
    ENGINES,
    FORMATS,
    PRESETS,
    Dfg,
    Engine,
    File,
    as_text,
    axes_matrix,
    engines,
    user_engine,
)
from whitefurnace.errors import FileError, InputError, UnsupportedError, UsageError
from whitefurnace.expression import LANGUAGES, Expression, table_text
from whitefurnace.files import decode, encode, read_env, read_gltf_lights, read_image, read_texture
from whitefurnace.files.packing import step
from whitefurnace.prefiltering.recipe import LOD_NAMES, Lods, chain
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere import octahedral_map as octamap
from whitefurnace.sphere.grids import turned_cube
from whitefurnace.tables.split_sum import split_sum

LOADED = tuple(name for name, engine in ENGINES.items() if engine.container == "files")
TOGETHER = tuple(name for name in LOADED if not ENGINES[name].holding("sheen"))
"""Presets that one bake makes for all tests; sheen takes long and has a test of its own."""


# ------------------------------------------------------------------------------------------------- formulas


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("max_lod * r * (2 - r)", 4 * 0.75),
        ("r**2 if r < .25 else .5*r + .375", 0.625),
        ("-r + 2**3", 7.5),
        ("clamp(8 * r, 0, 3)", 3.0),
        ("mix(1, 3, r)", 2.0),
        ("max(log2(r), -0.25)", -0.25),
        ("1e-3 / .5", 2e-3),
        ("exp2(log2(alpha) / 2)", 0.5),
        ("abs(min(r, 2) - 1) + sqrt(alpha) + pow(r, 2)", 1.25),
    ],
)
def test_a_formula_is_what_it_says(text, value):
    formula = Expression(text, LOD_NAMES)
    assert formula(r=0.5, alpha=0.25, max_lod=4, width=128) == pytest.approx(value, abs=1e-12)
    assert formula(r=np.full(3, 0.5), alpha=0.25, max_lod=4, width=128) == pytest.approx(np.full(3, value), abs=1e-12)
    for language in LANGUAGES:
        written = formula.shader(language, r="roughness")
        # No integer stands alone: WGSL knows no mixed arithmetic.
        assert "**" not in written and not any(
            word.isdigit() for word in written.replace("(", " ").replace(")", " ").replace(",", " ").split()
        )


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('x')",
        "r.real",
        "r[0]",
        "lambda: r",
        "rr",
        "2 **",
        "True",
        "r if r else 1",
        "sqrt(1, 2)",
        "'a'",
        "1e999",
        "(" * 300 + "r" + ")" * 300,
        "",
        "r" * 2000,
        "+".join(["r"] * 300),
        "[r]",
        "r < 1",
        "f(r)",
        "1j",
        "r; r",
        "r\nr",
        "x := r",
        "max(*r, 1)",
        "max(r, b=1)",
        "1" + "0" * 400,
    ],
)
def test_what_is_no_formula_is_one_sentence(text):
    with pytest.raises(UsageError) as told:
        Expression(text, ("r",), "here: lod")
    assert str(told.value).startswith("here: lod: ") and "\n" not in str(told.value)


def test_a_table_is_piecewise_linear():
    curve = Expression(table_text([[0, 0], [0.5, 3], [1, 6.5]], "r", "lod"), ("r",))
    assert curve(r=[-1, 0, 0.25, 0.5, 0.75, 1, 2]) == pytest.approx([0, 0, 1.5, 3, 4.75, 6.5, 6.5], abs=1e-12)
    for bad in ([[0, 0]], [[0, 0], [0, 1]], [[1, 0], [0, 1]], [[0, 0], [1, math.nan]], [[0, 0, 0], [1, 1, 1]]):
        with pytest.raises(UsageError):
            table_text(bad, "r", "lod")


# ------------------------------------------------------------------------------------------------- mappings


def test_what_is_called_seen_is_what_an_engine_test_renders():
    tree = ast.parse(Path(__file__).with_name("test_engines.py").read_text("utf-8"))
    (names,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "NAMES"
    )
    assert {name for name, engine in ENGINES.items() if engine.proven} == set(names)


@pytest.mark.parametrize("name", LOADED)
def test_mappings_are_those_of_the_engines(name):
    published, engine = PRESETS[name].published, ENGINES[name]
    assert published is not None, f"engines/presets/{name}.py states no Published to hold its formulas against"
    assert engine.lods.at(0.5, published.levels, published.width) == pytest.approx(published.lod, abs=1e-12)
    assert engine.bend_formula(r=0.5, alpha=0.25) == pytest.approx(published.bend, abs=1e-12)
    assert engine.blend_formula(r=0.5, alpha=0.25) == pytest.approx(published.blend, abs=1e-12)
    assert [tuple(row) for row in engine.matrix] == [
        tuple(math.copysign(1, a) if k == abs(a) - 1 else 0 for k in range(3)) for a in published.direction
    ]


@pytest.mark.parametrize("name", LOADED)
def test_levels_hold_what_is_read_there(name):
    engine = ENGINES[name]
    recipe = chain(
        size=engine.size,
        lods=engine.lods,
        usual_min=engine.min_size,
        **({"levels": engine.levels} if engine.levels else {}),
    )
    assert recipe.levels[0] == (engine.size, 0.0) and recipe.levels[-1][1] >= 1
    for k, (_, r) in enumerate(recipe.levels[1:], 1):
        if r != 1 or recipe.lod(1) >= k:
            # 12 digits of r, where lod(r) is as flat as Filament's at 1, are 6 of lod.
            assert engine.lods.lod is None or float(
                engine.lods.lod(r=r, alpha=r * r, max_lod=len(recipe.levels) - 1, width=engine.size)
            ) == pytest.approx(k, abs=1e-5)
            assert recipe.lod(min(r, 1.0)) <= k + 1e-5
    assert [r for _, r in recipe.levels] == sorted(r for _, r in recipe.levels)


def test_levels_past_one():
    followed = chain(size=128, usual_min=1, lods=ENGINES["babylon"].lods)
    # lod = .8 log2(width (α + 5e-4)) [Babylon.js pbrBlockReflection, MINIMUMVARIANCE].
    assert [r * r for _, r in followed.levels[1:]] == pytest.approx(
        [2 ** (k / 0.8) / 128 - 5e-4 for k in range(1, 8)], rel=1e-9
    )
    assert followed.parameters(1.5) == {"alpha": 2.25}
    stopped = chain(size=128, usual_min=1, lods=ENGINES["unreal"].lods)
    assert [r for _, r in stopped.levels][-3:] == [1, 1, 1]
    beckmann = chain(ndf="beckmann", size=128, usual_min=1, lods=ENGINES["babylon"].lods)
    assert beckmann.parameters(1.5) == beckmann.parameters(1.0)


@pytest.mark.parametrize("text", ["max_lod * (1 - r)", "log2(r) - 9", "r / 0", "max_lod * r * (1.2 - r)"])
def test_a_mapping_that_does_not_grow_is_refused(text):
    with pytest.raises(UsageError, match="lod"):
        chain(lods=Lods(Expression(text, LOD_NAMES, "mine: lod"))).levels  # noqa: B018


def test_fit_follows_the_mapping_of_the_engine(device):
    from whitefurnace.prefiltering.level_fit import read_mixtures

    linear = chain(fit="read", lods=ENGINES["bevy"].lods)
    mixtures = read_mixtures(device, linear)
    assert mixtures[0] is None and all(sum(w for w, _ in m) == pytest.approx(1) for m in mixtures[1:])
    # The nodes of level k lie around its own r = k/4.
    for k in (1, 2, 3):
        assert any(r == pytest.approx(k / 4, abs=1e-9) for _, r in mixtures[k])
    with pytest.raises(UnsupportedError, match="fit"):
        chain(fit="read", size=128, usual_min=1, lods=ENGINES["babylon"].lods)


# ------------------------------------------------------------------------------------------------- axes


@pytest.mark.parametrize(
    "words",
    [
        " ".join(a + b for a, b in zip(signs, axes, strict=True))
        for axes in itertools.permutations("xyz")
        for signs in itertools.product("+-", repeat=3)
    ],
)
def test_a_turned_cube_is_read_in_the_engines_direction(words):
    d = cube_directions(5)
    matrix = np.array(axes_matrix(words))
    stored = turned_cube(d, matrix)  # radiance that is the world's direction
    np.testing.assert_allclose(np.einsum("ij,...j->...i", matrix, stored), d, atol=1e-12)
    np.testing.assert_array_equal(turned_cube(stored, matrix.T), d)


@pytest.mark.parametrize("words", ["+x +y", "+x +y +y", "x y w", "", "+x +y +z +x", "--x y z"])
def test_what_are_no_axes(words):
    with pytest.raises(UsageError, match="axes"):
        axes_matrix(words)


# ------------------------------------------------------------------------------------------------- files


def coded(h: int = 64) -> np.ndarray:
    """½ + d/2 over a lat-long: every direction has its own colour."""
    v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(2 * h) + 0.5) / (2 * h), indexing="ij")
    azimuth, ring = 2 * np.pi * (u - 0.5), np.sin(np.pi * v)
    d = np.stack([ring * np.cos(azimuth), np.cos(np.pi * v), ring * np.sin(azimuth)], -1)
    return ((1 + d) / 2).astype(np.float32)


@pytest.fixture(scope="module")
def baked(tmp_path_factory, device):
    """Every preset in one bake of 32², beside each mapping's own arrays: (folder, manifest)."""
    folder = tmp_path_factory.mktemp("presets")
    (made,) = bake(coded(256), folder, for_=",".join(["raw", *TOGETHER]), size=64, device=device)
    return folder, made


def specular(name: str, folder: Path) -> tuple[list[np.ndarray], str]:
    """Levels of an engine's file as its reader sees them, and the pixel format."""
    (file,) = ENGINES[name].holding("specular")
    path = folder / name / file.name.replace("{stem}", "array")
    if file.suffix == ".env":
        return list(read_env(path).levels), file.stored
    if file.suffix == ".gltf":
        return list(read_gltf_lights(path)[0].levels), file.stored
    texture = read_texture(path)
    return [decode(texture, k)[..., :3] for k in range(len(texture.levels))], texture.format


@pytest.mark.parametrize("name", [n for n in TOGETHER if ENGINES[n].holding("specular")])
def test_files_hold_the_right_colour_in_every_direction(baked, name):
    """What is read at P·d is what the lobe makes of ½ + d/2, which is ½ + c d/2: within the format and 1e-3."""
    folder, made = baked
    levels, form = specular(name, folder)
    matrix = np.array(ENGINES[name].matrix)
    rows = [row for row in made.levels if name in row["for"]]
    assert len(levels) == len(rows)
    for level, row in zip(levels, rows, strict=True):
        size = row["size"]
        assert level.shape == (6, size, size, 3)
        world = np.einsum("ji,...j->...i", matrix, cube_directions(size))  # d = Pᵀ stored
        c = float(((2 * level - 1) * world).sum(-1).mean())
        assert (0.97 if row["roughness"] < 0.2 else 0.45 if size > 1 else 0.1) < c < 1.01
        ideal = (1 + c * world) / 2
        # The source's texels are π/256 wide: half of that, times the gradient of ½; texel means of level 0 lose
        # (2/size)²/24 of the curvature.
        allowed = step(form, ideal) + math.pi / 256 / 4 + 1e-3 + 1 / size**2
        assert (np.abs(level - ideal) <= allowed).all(), (name, size, (np.abs(level - ideal) - allowed).max())


def test_a_manifest_states_what_each_format_costs(baked):
    folder, _ = baked
    manifest = json.loads((folder / "array.json").read_text())
    for name, entry in manifest["files"].items():
        engine = name.split("/")[0]
        if engine in LOADED and "levels" in entry:
            for level in entry["levels"]:
                assert 0 <= level["error"] <= 1e-3
                assert "format_p99" in level or entry["format"] == "float32", name
                assert level.get("format_p99", 0) <= level.get("format_worst", 0)
    # 5 bits of mantissa, to the nearest.
    assert manifest["files"]["filament/array_ibl.ktx"]["levels"][0]["format_worst"] <= 1 / 64
    assert manifest["files"]["bevy/array_specular.ktx2"]["levels"][0]["format_worst"] > 0
    assert set(manifest["engines"]) == set(TOGETHER)


def test_presets_share_the_levels_they_have_in_common(baked):
    _, made = baked
    rows = {(row["size"], row["roughness"]): row["for"] for row in made.levels}
    assert len(rows) == len(made.levels), "a level was made twice"
    assert {"raw", "filament", "bevy", "gltf", "unity"} <= set(rows[64, 0.0])
    assert {"three", "filament"} <= set(rows[32, chain(size=64, min_size=8).levels[1][1]])
    assert {"gltf", "raw"} <= set(rows[16, 1.0])


def test_harmonics_of_engines_are_theirs(baked):
    folder, _ = baked
    with np.load(folder / "raw" / "array.npz") as archive:
        sh = archive["sh"]
    lines = (folder / "filament" / "array_sh.txt").read_text().splitlines()
    rows = np.array([[float(x) for x in line[line.index("(") + 1 : line.index(")")].split(",")] for line in lines])
    assert np.abs(rows - harmonic.filament(sh)).max() < 1e-14
    assert lines[0].endswith("// L00, irradiance, pre-scaled base")
    words = read_texture(folder / "filament" / "array_ibl.ktx").key_values["sh"].rstrip(b"\0").split()
    assert np.array(words, np.float64).reshape(9, 3) == pytest.approx(harmonic.filament(sh), abs=1e-8)
    turned = harmonic.turned(sh, ENGINES["babylon"].matrix)
    assert read_env(folder / "babylon" / "array.env").polynomials == pytest.approx(harmonic.babylon(turned), abs=1e-12)
    (light,) = read_gltf_lights(folder / "gltf" / "array.gltf")
    assert light.coefficients == pytest.approx(harmonic.irradiance(sh), abs=1e-12)


def test_lat_longs_for_engines_that_filter_themselves(baked):
    folder, _ = baked
    for path in (folder / "unreal" / "array.hdr", folder / "godot" / "array.hdr", folder / "unity" / "array.exr"):
        pixels = read_image(path).pixels
        assert pixels.shape == (128, 256, 3)
        # RGBE: 1/256 of the largest channel; texel means of a gradient over .05 rad.
        assert np.abs(pixels - coded(128)).max() < 1 / 256 + 0.01


def test_charlie_and_coverage(tmp_path, device):
    image = np.concatenate([coded(16), np.full((16, 32, 1), 0.25, np.float32)], -1)
    (made,) = bake(image, tmp_path, for_="khronos", size=16, min_size=4, tolerance=1e-2, device=device)
    assert {row.get("ndf", "ggx") for row in made.levels} == {"ggx", "charlie"}
    folder = tmp_path / "khronos"
    for ending in ("ggx", "charlie"):
        texture = read_texture(folder / f"array_{ending}.ktx2")
        for k in range(3):
            assert decode(texture, k)[..., 3] == pytest.approx(0.25, abs=0.25 * (1e-2 + 2**-11)), "coverage is kept"
    assert decode(read_texture(folder / "array_lambertian.ktx2"), 0).shape == (6, 32, 32, 4)
    sheen = decode(read_texture(folder / "array_charlie.ktx2"), 2)[..., :3]
    ggx = decode(read_texture(folder / "array_ggx.ktx2"), 2)[..., :3]
    assert np.abs(sheen - ggx).max() > 0.02


def test_sheen_on_a_hard_panel_is_baked_and_says_what_it_reached(tmp_path, device):
    """Charlie's smooth lobes are a rim at the horizon: with a panel there they do not reach 1e-3 on any grid."""
    image = np.full((128, 256, 3), 0.1, np.float32)
    image[48:80, 60:100] = 20
    (made,) = bake(image, tmp_path, for_="khronos", size=32, device=device)
    rows = {name: [row for row in made.levels if row.get("ndf", "ggx") == name] for name in ("ggx", "charlie")}
    assert [row["roughness"] for row in rows["ggx"]] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [row["roughness"] for row in rows["charlie"]] == pytest.approx([1 / 3, 2 / 3, 1])  # level 0 is the same
    assert max(row["error"] for row in rows["ggx"]) <= 1e-3 and max(row["error"] for row in rows["charlie"]) <= 1e-2
    text = baked_text(made, tmp_path)
    assert "specular 3" in text and "specular 4" not in text and "sheen 3" in text


@pytest.mark.parametrize(("name", "size"), [("unity", 16), ("godot", 8), ("bevy", 2), ("filament", 4), ("three", 1)])
def test_small_probes_have_the_levels_they_can_have(tmp_path, device, name, size):
    (made,) = bake(coded(16), tmp_path, for_=name, size=size, device=device)
    assert made.state == "done"
    with pytest.raises(UsageError, match=f"{name}: min-size"):
        bake(coded(16), tmp_path, for_=name, size=size, min_size=2 * size)


def test_files_are_no_larger_than_they_need_be(tmp_path, device):
    bake(coded(256), tmp_path, for_="filament,bevy,babylon,unity,three", size=128, device=device)
    texels = 6 * sum(s * s for s in (128, 64, 32, 16, 8))
    header = 1024  # KTX 1's, its keys and the harmonics
    assert 4 * texels == 523_776
    assert (tmp_path / "filament" / "array_ibl.ktx").stat().st_size <= 4 * texels + header
    assert (tmp_path / "unity" / "array_cube.dds").stat().st_size == 148 + 8 * 6 * sum(4**k for k in range(1, 8))
    # Zstandard and PNG find something even in a gradient, in which no two texels are alike.
    assert (tmp_path / "bevy" / "array_specular.ktx2").stat().st_size < 0.9 * 4 * texels
    assert (tmp_path / "babylon" / "array.env").stat().st_size < 0.9 * 4 * 6 * 128**2 * 4 / 3


# ------------------------------------------------------------------------------------------------- tables


@pytest.mark.parametrize(
    "name",
    [
        n
        for n in LOADED
        if ENGINES[n].holding("dfg")
        and ENGINES[n].dfg.x != "alpha"
        and ENGINES[n].dfg.y != "alpha"
        and ENGINES[n].dfg.NoV == "centres"
    ],
)
def test_tables_of_engines(name, device):
    engine = ENGINES[name]
    made = split_sum(engine.dfg, device=device)
    n = engine.dfg.size
    plain = dfg(n, device=device).values.astype(np.float64)
    pair = plain if engine.dfg.form == "scale_bias" else np.stack([plain[..., 1], plain.sum(-1)], -1)
    if engine.dfg.x != "NoV":
        pair = pair.swapaxes(0, 1)
    assert np.abs(made.values[..., :2] - pair).max() <= made.error + 2e-6
    # The mirror seen along n reflects all for F0 = 1, and F0 alone else: scale + bias = ∫1 → 1.
    corner = made.values[n - 1, 0] if engine.dfg.x != "NoV" else made.values[0, n - 1]
    whole = corner[0] + corner[1] if engine.dfg.form == "scale_bias" else corner[1]
    assert whole == pytest.approx(1, abs=1e-3)


# ------------------------------------------------------------------------------------------------- users' engines

BLOCKS = """
lod = "max_lod * r"
min_size = 8
[[file]]
holds = "specular"
name = "{stem}.dds"
format = "bc6hu"
"""


def test_blocks(tmp_path, device):
    """BC6H is an optional extra; its files have 8 bits a texel, and its loss is stated and told."""
    pytest.importorskip("ispc_texcomp")
    (tmp_path / "blocks.toml").write_text(BLOCKS)
    (made,) = bake(coded(256), tmp_path, for_=f"raw,{tmp_path / 'blocks.toml'}", size=128, device=device)
    path = tmp_path / "blocks" / "array.dds"
    assert path.stat().st_size == 148 + sum(6 * s * s for s in (128, 64, 32, 16, 8))
    texture, entry = read_texture(path), made.manifest["files"]["blocks/array.dds"]
    # [docs/accuracy.md]
    with np.load(tmp_path / "raw" / "array.npz") as archive:
        true = archive["specular_0"].astype(np.float64)
    off = np.abs(decode(texture, 0) - true) / np.maximum(true, 1e-3 * true.mean())
    assert entry["levels"][0]["format_worst"] == pytest.approx(off.max(), rel=1e-3)
    # A block holds colours on two lines, which a gradient of all three channels leaves by up to 12 % where one is dark.
    assert 0.01 < entry["levels"][0]["format_worst"] < 0.5
    assert any("bc6hu costs" in notice for notice in made.notices)


MINE = """
title = "Mine"
lod = [[0, 0], [0.5, 1], [1, 2]]
axes = "+x +z -y"
bend = "alpha"
size = 32
min_size = 8
sh = "irradiance"
[dfg]
size = 16
NoV = "sqrt"
form = "multiscatter"
[[file]]
holds = "specular"
name = "{stem}_spec.ktx2"
format = "rgba32f"
zstd = 3
[[file]]
holds = "sh"
name = "{stem}.json"
[[file]]
holds = "dfg"
name = "{stem}_dfg.exr"
"""


def test_a_users_engine(tmp_path, device):
    path = tmp_path / "mine.toml"
    path.write_text(MINE)
    (made,) = bake(coded(), tmp_path / "out", for_=f"raw,{path}", device=device)
    folder = tmp_path / "out" / "mine"
    assert {p.name for p in folder.iterdir()} == {
        "array_spec.ktx2",
        "array.json",
        "array_dfg.exr",
        "array.glsl",
        "array.hlsl",
        "array.wgsl",
    }
    texture = read_texture(folder / "array_spec.ktx2")
    assert texture.format == "rgba32f" and len(texture.levels) == 3
    assert [row["roughness"] for row in made.levels if "mine" in row["for"]] == pytest.approx([0, 0.5, 1])
    world = np.einsum("ji,...j->...i", np.array(axes_matrix("+x +z -y")), cube_directions(32))
    # Texel means of ½ + d/2 over faces of 32² from texels of .05 rad.
    assert np.abs(decode(texture, 0)[..., :3] - (1 + world) / 2).max() < 0.02
    told = json.loads((folder / "array.json").read_text())
    assert list(told)[:2] == ["L00", "L1-1"]
    again = bake(coded(), tmp_path / "out", for_=f"raw,{path}", device=device)[0]
    assert again.state == "skipped"
    path.write_text(MINE.replace('bend = "alpha"', 'bend = "r"'))
    assert bake(coded(), tmp_path / "out", for_=f"raw,{path}", device=device)[0].state == "done", "another engine"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("title", "titel"), "did you mean 'title'"),
        (('holds = "sh"', 'holds = "sg"'), "holds"),
        (("lod = [[0, 0], [0.5, 1], [1, 2]]", "lod = 'max_lod * q'"), "'q'"),
        (("+x +z -y", "+x +z"), "axes"),
        (("rgba32f", "rgb9e6"), "rgb9e5"),
        (("zstd = 3", "zstd = 99"), "zstd"),
        (("{stem}_spec.ktx2", "../spec.ktx2"), "{stem}"),
        (("{stem}_spec.ktx2", "{stem}/../x.ktx2"), "{stem}"),
        (("size = 16", "size = 0"), "dfg.size"),
        (("{stem}.json", "{stem}_spec.ktx2"), "twice"),
        (("_dfg.exr", "_dfg.ktx"), ".ktx"),
        (('NoV = "sqrt"', 'x = "r"'), "x"),
        (('bend = "alpha"', 'bend = "alpha * "'), "bend"),
        (('sh = "irradiance"', ""), "sh"),
        (("[dfg]", "[dfg"), "TOML"),
        (('title = "Mine"', "proven = true"), "proven"),
        (("size = 32", "size = '32'"), "size"),
        (("size = 32", "size = 33"), "power of two"),
        (("[0.5, 1]", "[1.5, 1]"), "grow"),
    ],
)
def test_a_users_engine_that_is_wrong_is_one_sentence(tmp_path, change, told):
    path = tmp_path / "mine.toml"
    assert change[0] in MINE
    path.write_text(MINE.replace(*change, 1))
    with pytest.raises((InputError, UsageError)) as wrong:
        bake(coded(8), tmp_path / "out", for_=str(path), dry_run=True)
    assert told in str(wrong.value) and "\n" not in str(wrong.value)
    assert not (tmp_path / "out").exists()


SQUARE = """
lod = "max_lod * r"
size = 32
min_size = 8
[[file]]
holds = "specular"
name = "{stem}.exr"
layout = "octahedral"
border = 2
[[file]]
holds = "specular"
name = "{stem}.dds"
format = "rgba32f"
layout = "octahedral"
border = 0
"""


def test_a_border_wider_than_the_last_level_is_refused_before_anything_is_made(tmp_path):
    (tmp_path / "square.toml").write_text(SQUARE)
    with pytest.raises(UsageError, match=r"border of 2 texels does not go around the last level's 1²"):
        bake(coded(), tmp_path, for_=str(tmp_path / "square.toml"), min_size=1, dry_run=True)


@pytest.mark.parametrize(("suffix", "form"), [(s, f) for s in (".ktx2", ".dds") for f in FORMATS[s]])
def test_a_dry_run_knows_the_bytes_of_every_format(suffix, form):
    """Those that the encoder makes, of a table that is no multiple of a block."""
    if form == "bc6hu":
        pytest.importorskip("ispc_texcomp")
    if form == "astc4x4hdr":
        pytest.importorskip("astc_encoder")
    (target,) = targets(Engine("x", file=(File("dfg", "{stem}" + suffix, form),), dfg=Dfg(7)), chain(), Path("."), "a")
    made = encode(form, [np.full((7, 7, 2 if form == "rg16f" else 3), 0.5, np.float32)]).texture
    assert target.nbytes == sum(memoryview(level).nbytes for level in made.levels)


def test_octahedral_maps(tmp_path, device):
    """½ + c d/2 in every direction, read bilinearly over edges and corners."""
    (tmp_path / "square.toml").write_text(SQUARE)
    (made,) = bake(coded(256), tmp_path, for_=str(tmp_path / "square.toml"), device=device)
    rows = made.manifest["octahedral_levels"]
    atlas = read_image(tmp_path / "square" / "array.exr").pixels
    texture = read_texture(tmp_path / "square" / "array.dds")
    places = made.manifest["files"]["square/array.exr"]["levels"]
    d = np.random.default_rng(0).normal(size=(3, 4000))
    d /= np.sqrt((d * d).sum(0))
    for k, (row, place) in enumerate(zip(rows, places, strict=True)):
        s, b = place["size"], 2
        assert row["size"] == s and row["error"] <= (1e-3 if k else 2e-2)  # level 0 is of points
        image = atlas[place["row"] - b : place["row"] + s + b, place["column"] - b : place["column"] + s + b]
        np.testing.assert_array_equal(octamap.strip_border(image, b), decode(texture, k)[..., :3])
        read = octamap.read_bilinear(image, d, b)
        c = float(((2 * read - 1) * d.T).sum(1).mean())
        # Bilinear reads of a map of s² err by (2/s)² of the curvature, by half a texel at the creases' edges.
        assert np.abs(read - (1 + c * d.T) / 2).max() < 0.02 + 1 / s, s
    with pytest.raises(UnsupportedError, match="octahedral"):
        bake(coded(8), tmp_path / "x", for_=str(tmp_path / "square.toml"), samples=16, device=device)


@pytest.mark.parametrize("name", LOADED)
def test_a_preset_as_a_file_is_the_preset(tmp_path, name):
    path = tmp_path / "copy.toml"
    path.write_text(as_text(ENGINES[name]))
    own = {**ENGINES[name].data(), "name": "copy", "proven": False, "facts": "given in copy.toml"}
    assert user_engine(path).data() == own


def test_engines_are_listed(capsys):
    def shell(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as done:
            main(["engines", *arguments])
        out, err = capsys.readouterr()
        return done.value.code, out + err

    code, text = shell()
    assert code == 0 and all(name in text for name in ENGINES)
    code, text = shell("filament")
    assert code == 0 and "STEM_ibl.ktx: specular, b10g11r11" in text and "alpha * alpha" in text
    assert [json.loads(line)["name"] for line in shell("--json")[1].splitlines()] == list(ENGINES)
    assert shell("raw", "--toml")[0] == 1 and shell("--toml")[0] == 1 and "did you mean" in shell("bevi")[1]


def test_engines_that_are_not_there(tmp_path):
    with pytest.raises(UsageError, match="did you mean 'filament'"):
        engines("fillament")
    with pytest.raises(FileError):
        engines(str(tmp_path / "none.toml"))
    (tmp_path / "raw.toml").write_text(MINE)
    with pytest.raises(InputError, match="name of a preset"):
        user_engine(tmp_path / "raw.toml")
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="UTF-8"):
        user_engine(tmp_path / "mine.toml")
    (tmp_path / "a").mkdir()
    for folder in (tmp_path, tmp_path / "a"):
        (folder / "same.toml").write_text(MINE if folder == tmp_path else MINE.replace("Mine", "Other"))
    with pytest.raises(UsageError, match="two engines"):
        engines(f"{tmp_path / 'same.toml'},{tmp_path / 'a' / 'same.toml'}")


def test_whole_chains_are_not_cut(tmp_path):
    with pytest.raises(UsageError, match="babylon needs all levels"):
        bake(coded(8), tmp_path, for_="babylon", min_size=4, dry_run=True)


def test_every_preset_says_what_the_checks_of_a_users_engine_ask():
    for name in LOADED:
        engine = ENGINES[name]
        check(engine)
        assert engine.steps and engine.facts
        assert all(file.stored in FORMATS[file.suffix] for file in engine.file)


def test_presets_are_listed_as_they_state():
    assert [preset.order for preset in PRESETS.values()] == sorted({preset.order for preset in PRESETS.values()})
