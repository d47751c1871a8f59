"""`compare`: errors by the project's definition, worked out here once more; across containers, layouts and axes."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

from reference import cube_directions
from whitefurnace.cli import main
from whitefurnace.engines.presets import ENGINES
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.files import digest_file, write_exr, write_manifest, write_npz, write_texture
from whitefurnace.files.codec import encode
from whitefurnace.files.env import EnvMap, write_env
from whitefurnace.files.gltf_lights import GltfLight, write_gltf_lights
from whitefurnace.files.packing import step
from whitefurnace.inspection.comparison import axes_of, compare, percentile
from whitefurnace.inspection.contents import contents
from whitefurnace.sphere import harmonics as harmonic

SIZES = (16, 8, 4, 2, 1)


def radiance(d: np.ndarray) -> np.ndarray:
    """Of directions (..., 3): smooth, positive, without a symmetry, and another function in every channel."""
    x, y, z = np.moveaxis(d, -1, 0)
    return np.stack([1.5 + 0.8 * x + 0.3 * y * z, 1.2 - 0.5 * y + 0.4 * x * z, 1 + 0.6 * z + 0.3 * x * y - 0.2 * x], -1)


def chain(axes=((1, 0, 0), (0, 1, 0), (0, 0, 1)), sizes=SIZES) -> list[np.ndarray]:
    """Cubes that hold in direction P·d what is seen in d, P the axes."""
    return [radiance(cube_directions(s) @ np.array(axes, np.float64)).astype(np.float32) for s in sizes]


def raw(path: Path, levels, **more) -> Path:
    write_npz(path, {f"specular_{k}": level for k, level in enumerate(levels)} | more)
    return path


def code(*argv) -> int:
    with pytest.raises(SystemExit) as done:
        main(["compare", *map(str, argv)])
    return done.value.code


# --- the definition -------------------------------------------------------------------------------------


def solid_angle(n: int, i: int, j: int) -> float:
    """Of a texel, by four corners: Ω(x, y) = atan(xy / √(1 + x² + y²))."""

    def corner(x, y):
        return math.atan2(x * y, math.sqrt(x * x + y * y + 1))

    x0, x1, y0, y1 = (2 * k / n - 1 for k in (j, j + 1, i, i + 1))
    return corner(x1, y1) - corner(x0, y1) - corner(x1, y0) + corner(x0, y0)


def test_errors_are_those_of_the_definition(tmp_path):
    """Texel by texel, in a loop: max over channels of |x - ref| / max(ref, 1e-3 mean), p99, worst and rmse."""
    n = 8
    rng = np.random.default_rng(4)
    ref = (10 ** rng.uniform(-6, 1, (6, n, n, 3))).astype(np.float32)  # some below a thousandth of the mean
    got = (ref * (1 + 0.01 * rng.standard_normal(ref.shape))).astype(np.float32)
    got[3, 1, 6, 2] = ref[3, 1, 6, 2] * 1.5
    omega = {(i, j): solid_angle(n, i, j) for i in range(n) for j in range(n)}
    texels = list(itertools.product(range(6), range(n), range(n)))
    mean = sum(omega[i, j] * float(ref[f, i, j].astype(float).mean()) for f, i, j in texels) / (4 * math.pi)
    errors = sorted(
        max(
            abs(float(got[f, i, j, c]) - float(ref[f, i, j, c])) / max(float(ref[f, i, j, c]), 1e-3 * mean)
            for c in range(3)
        )
        for f, i, j in texels
    )
    lost = sum(
        omega[i, j] * (float(got[f, i, j, c]) - float(ref[f, i, j, c])) ** 2 for f, i, j in texels for c in range(3)
    )
    power = sum(omega[i, j] * float(ref[f, i, j, c]) ** 2 for f, i, j in texels for c in range(3))
    raw(tmp_path / "a.npz", [got])
    raw(tmp_path / "b.npz", [ref])
    (row,) = compare(contents(tmp_path / "a.npz"), contents(tmp_path / "b.npz")).rows
    # float64 sums in another order
    assert row.worst == pytest.approx(errors[-1], rel=1e-12)
    assert row.rmse == pytest.approx(math.sqrt(lost / power), rel=1e-9)
    assert row.error == pytest.approx(errors[math.ceil(0.99 * len(errors)) - 1], rel=1e-12)
    assert row.at.startswith("face -Y, texel (6, 1)")
    # Not the same the other way round: B is the reference.
    (other,) = compare(contents(tmp_path / "b.npz"), contents(tmp_path / "a.npz")).rows
    assert other.worst != row.worst


def test_the_percentile_is_exceeded_by_a_hundredth_at_most():
    for n in (1, 99, 100, 101, 1536):
        errors = np.random.default_rng(n).permutation(np.arange(n, dtype=float))
        p = percentile(errors)
        assert (errors > p).sum() <= n / 100 < (errors >= p).sum()


def test_what_is_not_finite_is_an_infinite_error_unless_both_have_it(tmp_path):
    cube = chain(sizes=(4,))[0]
    cube[0, 0, 0, 0], cube[1, 1, 1, 1] = np.nan, np.inf
    raw(tmp_path / "a.npz", [cube])
    found = compare(contents(tmp_path / "a.npz"), contents(tmp_path / "a.npz"))
    assert found.rows[0].worst == 0 and "2 texels are not finite" in found.notices[0]
    fine = np.where(np.isfinite(cube), cube, np.float32(1))
    raw(tmp_path / "b.npz", [fine])
    for one, other in (("a", "b"), ("b", "a")):
        found = compare(contents(tmp_path / f"{one}.npz"), contents(tmp_path / f"{other}.npz"))
        assert found.rows[0].worst == math.inf == found.rows[0].rmse and found.beyond(1e9) is not None


# --- containers -----------------------------------------------------------------------------------------

EVERY = [
    (suffix, form)
    for suffix, forms in {
        ".ktx": ("rgba16f", "rgba32f", "rgb9e5", "b10g11r11"),
        ".ktx2": ("rgba16f", "rgb9e5", "b10g11r11"),
        ".dds": ("rgba16f", "rgb9e5"),
        ".env": ("rgbd",),
        ".gltf": ("rgbd",),
    }.items()
    for form in forms
]


@pytest.mark.parametrize("suffix, form", EVERY)
def test_a_chain_is_itself_in_every_container(tmp_path, suffix, form):
    """Within the step of its format over the least value there is, and no further; harmonics in each one's scale."""
    levels = chain()
    sh = np.random.default_rng(1).standard_normal((9, 3)) + 2 * (np.arange(9) == 0)[:, None]
    path = tmp_path / f"a{suffix}"
    if suffix == ".env":
        write_env(path, EnvMap(tuple(levels), harmonic.babylon(sh)))
    elif suffix == ".gltf":
        write_gltf_lights(path, GltfLight(tuple(levels), harmonic.irradiance(sh)))
    else:
        text = " ".join(f"{x:.17g}" for x in harmonic.filament(sh).ravel())
        write_texture(
            path,
            encode(
                form, levels, cube=True, key_values={} if suffix == ".dds" else {"sh": text.encode() + b"\0"}
            ).texture,
        )
    found = compare(contents(path), contents(raw(tmp_path / "b.npz", levels, sh=sh)))
    rows = {row.part: row for row in found.rows}
    assert set(rows) == {f"level {k}" for k in range(5)} | (set() if suffix == ".dds" else {"SH"})
    for k, level in enumerate(levels):
        bound = float((step(form, level) / level).max())
        assert 0 <= rows[f"level {k}"].worst <= bound * (1 + 1e-6), f"level {k}"
        assert form == "rgba32f" or rows[f"level {k}"].worst > bound / 50  # it is looked at
    if "SH" in rows:
        assert rows["SH"].worst < 1e-12  # float64 and texts of 17 digits
    assert code(path, tmp_path / "b.npz", "--max-error", "0.02") == 0


def test_a_mirrored_or_turned_cube_is_found_and_named(tmp_path, capsys):
    raw(tmp_path / "b.npz", chain())
    mirrored = [level[:, :, ::-1] for level in chain()]
    shifted = [np.roll(level, 1, axis=2) for level in chain()]
    for name, levels, hint in (
        ("m", mirrored, "each face of A is turned or mirrored by itself: left to right"),
        ("s", shifted, ""),
        ("t", chain(ENGINES["three"].matrix), "--axes-a '-x +y +z'"),
    ):
        path = raw(tmp_path / f"{name}.npz", levels)
        assert code(path, tmp_path / "b.npz", "--max-error", "0.05") == 7
        err = capsys.readouterr().err
        last = err.splitlines()[-1]
        assert last.startswith("error: level ") and f" of {path} has error " in last and last.endswith("is allowed")
        assert hint in err and err.count("error: ") == 1 and (hint or "notice" not in err)
    assert code(tmp_path / "t.npz", tmp_path / "b.npz", "--max-error", "1e-6", "--axes-a", "-x +y +z") == 0
    assert code(tmp_path / "t.npz", tmp_path / "b.npz", "--max-error", "1e-6", "--axes-a", "three") == 0
    assert code(tmp_path / "b.npz", tmp_path / "t.npz", "--max-error", "1e-6", "--axes-b", "three") == 0


def test_every_signed_permutation_of_the_axes_is_undone(tmp_path):
    """What lies in direction d is stored at P·d: made by the directions, undone by the option."""
    sh = np.random.default_rng(2).standard_normal((9, 3))
    reference = contents(raw(tmp_path / "b.npz", chain(sizes=(5,)), sh=sh))
    d = np.random.default_rng(3).standard_normal((3, 40))
    d /= np.linalg.norm(d, axis=0)
    for order in itertools.permutations("xyz"):
        for signs in itertools.product("+-", repeat=3):
            text = " ".join(sign + letter for sign, letter in zip(signs, order, strict=True))
            axes = axes_of(text)
            # L_stored(P d) = L(d): coefficients fitted to values in 40 directions
            stored = np.linalg.lstsq(harmonic.basis(axes @ d).T, harmonic.basis(d).T @ sh, rcond=None)[0]
            found = contents(raw(tmp_path / "a.npz", chain(axes, (5,)), sh=stored))
            rows = compare(found, reference, axes_a=text).rows
            # float32 of directions whose sums were rounded in another order
            assert rows[0].worst < 3e-7 and rows[1].worst < 1e-12, text


def test_a_file_of_a_preset_is_turned_back_by_itself(tmp_path):
    raw(tmp_path / "b.npz", chain())
    path = tmp_path / "three" / "a.dds"
    path.parent.mkdir()
    write_texture(path, encode("rgba32f", chain(ENGINES["three"].matrix), cube=True).texture)
    write_manifest(
        tmp_path / "a.json", {"whitefurnace": "1", "name": "a", "files": {"three/a.dds": {"sha256": digest_file(path)}}}
    )
    found = compare(contents(path), contents(tmp_path / "b.npz"))
    assert max(row.worst for row in found.rows) < 3e-7 and "written for three" in found.notices[0]
    assert compare(contents(path), contents(tmp_path / "b.npz"), axes_a="+x +y +z").rows[0].worst > 0.1


def test_a_file_of_a_users_engine_is_turned_back_as_its_manifest_says(tmp_path):
    raw(tmp_path / "b.npz", chain())
    path = tmp_path / "mine" / "a.ktx"
    path.parent.mkdir()
    turned = chain(axes_of("+x +z -y").astype(int).tolist())
    # The key says whose it is, the manifest in which axes that has them.
    write_texture(path, encode("rgba32f", turned, cube=True, key_values={"whitefurnace:engine": b"mine\0"}).texture)
    for axes, fits in (("+x +z -y", True), ("+x +y +z", False), ("sideways", False), (3, False)):
        write_manifest(
            tmp_path / "a.json",
            {
                "whitefurnace": "1",
                "name": "a",
                "recipe": {"engines": {"mine": {"engine": {"axes": axes}}}},
                "files": {"mine/a.ktx": {"sha256": digest_file(path)}},
            },
        )
        found = compare(contents(path), contents(tmp_path / "b.npz"))
        assert (max(row.worst for row in found.rows) < 3e-7) == fits, axes
        assert any("written for mine" in notice for notice in found.notices) == fits


# --- what goes with what --------------------------------------------------------------------------------


def test_levels_go_by_size_and_by_roughness_where_both_know_it(tmp_path):
    levels = chain(sizes=(8, 4, 4, 4))
    a = raw(tmp_path / "a.npz", [levels[0], levels[1], 2 * levels[2], 3 * levels[3]], roughness=[0, 0.25, 0.5, 1])
    b = raw(tmp_path / "b.npz", [levels[0], 3 * levels[3], 2 * levels[2]], roughness=[0, 1, 0.5])
    found = compare(contents(a), contents(b))
    assert [(row.part, row.roughness, row.worst) for row in found.rows] == [
        ("level 0", 0, 0),
        ("level 1", 1, 0),
        ("level 2", 0.5, 0),
    ]
    assert found.notices == ("level 1 (4²) of a.npz: no counterpart",)
    c = raw(tmp_path / "c.npz", [levels[1]], roughness=[0.3])
    with pytest.raises(UnsupportedError, match=r"no level of the same roughness"):
        compare(contents(c), contents(raw(tmp_path / "d.npz", [levels[0]], roughness=[0.7])))
    assert [row.part for row in compare(contents(c), contents(raw(tmp_path / "e.npz", chain()))).rows] == ["level 2"]


def test_a_base_cube_of_another_size_goes_with_level_0_by_exact_means(tmp_path):
    """The mean of a texel's four by their solid angles, in either direction."""
    fine = np.random.default_rng(8).random((6, 8, 8, 3), np.float32)
    coarse = np.empty((6, 4, 4, 3))
    for i, j in itertools.product(range(4), range(4)):
        parts = [(solid_angle(8, k, m), k, m) for k in (2 * i, 2 * i + 1) for m in (2 * j, 2 * j + 1)]
        coarse[:, i, j] = sum(w * fine[:, k, m].astype(float) for w, k, m in parts) / sum(w for w, _, _ in parts)
    a = raw(tmp_path / "a.npz", [fine])
    b = raw(tmp_path / "b.npz", [coarse.astype(np.float32)])
    for one, other in ((a, b), (b, a)):
        found = compare(contents(one), contents(other))
        assert found.rows[0].worst < 2e-7 and found.rows[0].method == "overlap"  # float32 of the coarse one
        assert f"the means of {'A' if one is a else 'B'} over" in found.notices[0]


def test_a_lat_long_and_a_cube_are_held_against_each_other(tmp_path):
    """Level 0 of a bake of it is its exact mean; a rough level is read bilinearly and that is said."""
    rows, columns = 32, 64
    theta, phi = (np.arange(rows) + 0.5) * math.pi / rows, (np.arange(columns) + 0.5) * 2 * math.pi / columns - math.pi
    d = np.stack(
        np.broadcast_arrays(
            np.sin(theta)[:, None] * np.cos(phi), np.cos(theta)[:, None], np.sin(theta)[:, None] * np.sin(phi)
        ),
        -1,
    )
    wide = radiance(d).astype(np.float32)
    write_exr(tmp_path / "wide.exr", wide)
    raw(tmp_path / "cube.npz", chain(sizes=(8,)))
    found = compare(contents(tmp_path / "wide.exr"), contents(tmp_path / "cube.npz"))
    # A mean over a texel of 1/4 rad differs from its centre by up to (h²/24)·∆L: 6 h²/24 = .016 of what is .3 or more.
    assert 0 < found.rows[0].worst < 0.05 and found.rows[0].method == "overlap"
    # Mirrored, or turned by a right angle, it is not.
    for turned in (wide[:, ::-1], np.roll(wide, 16, 1), wide[::-1]):
        write_exr(tmp_path / "turned.exr", turned)
        assert compare(contents(tmp_path / "turned.exr"), contents(tmp_path / "cube.npz")).rows[0].error > 0.3
    write_exr(tmp_path / "mirrored.exr", wide[:, ::-1])  # φ to -φ: z to -z
    assert (
        compare(contents(tmp_path / "mirrored.exr"), contents(tmp_path / "cube.npz"), axes_a="+x +y -z").rows[0].worst
        < 0.05
    )
    with pytest.raises(UnsupportedError, match="resampled"):
        compare(contents(tmp_path / "wide.exr"), contents(tmp_path / "cube.npz"), axes_a="+y +x +z")
    write_exr(tmp_path / "rough.exr", wide, attributes={"whitefurnace:roughness": 0.5})
    fine = raw(tmp_path / "fine.npz", chain(sizes=(32,)), roughness=[0.5])
    for one, other in ((tmp_path / "rough.exr", fine), (fine, tmp_path / "rough.exr")):
        found = compare(contents(one), contents(other))
        # A bilinear read of texels of .1 rad: h²/8 of second derivatives up to 4, of .3 or more, is .017.
        assert found.rows[0].method == "bilinear" and 0 < found.rows[0].worst < 0.02
        assert "is read bilinearly" in found.notices[0]


def test_arrays_of_cubes_are_compared_layer_by_layer(tmp_path):
    levels = [np.stack([level, 2 * level]) for level in chain(sizes=(4, 2))]
    write_texture(tmp_path / "a.ktx2", encode("rgba32f", levels, cube=True).texture)
    other = [np.stack([x[0], 4 * x[0]]) for x in levels]
    write_texture(tmp_path / "b.dds", encode("rgba32f", other, cube=True).texture)
    found = compare(contents(tmp_path / "a.ktx2"), contents(tmp_path / "b.dds"))
    assert [(row.part, row.worst) for row in found.rows] == [
        ("level 0 of layer 0", 0),
        ("level 0 of layer 1", 0.5),
        ("level 1 of layer 0", 0),
        ("level 1 of layer 1", 0.5),
    ]
    with pytest.raises(UnsupportedError, match="arrays"):
        compare(contents(tmp_path / "a.ktx2"), contents(raw(tmp_path / "c.npz", chain())))


def test_tables_are_compared_cell_by_cell_and_absolutely(tmp_path, capsys):
    table = np.random.default_rng(9).random((8, 8, 2), np.float32)
    other = table.copy()
    other[2, 5, 1] += np.float32(0.25)
    for name, values in (("a", table), ("b", other)):
        np.save(tmp_path / f"{name}.npy", values)
    write_texture(tmp_path / "a.ktx2", encode("rg16f", [table]).texture)
    assert code(tmp_path / "a.ktx2", tmp_path / "a.npy", "--max-error", 2.0**-12) == 0  # half an ulp of a half
    capsys.readouterr()
    assert code(tmp_path / "b.npy", tmp_path / "a.npy", "--max-error", "0.2", "--json") == 7
    out, err = capsys.readouterr()
    rows = [json.loads(line) for line in out.splitlines()]
    assert [row["worst"] for row in rows[:2]] == [0, pytest.approx(0.25)] and rows[1]["worst_at"] == "cell (5, 2)"
    assert rows[1]["error"] == pytest.approx(0.25)  # one of 64 is more than a hundredth
    assert rows[2]["exit_code"] == 7 and "the table, channel 2" in rows[2]["message"] and "worst 0.25" in err
    np.save(tmp_path / "c.npy", table[:4])
    assert code(tmp_path / "a.npy", tmp_path / "c.npy") == 5
    assert code(tmp_path / "a.npy", raw(tmp_path / "d.npz", chain())) == 5


def test_exit_codes_of_compare(tmp_path, capsys):
    path = raw(tmp_path / "a.npz", chain(sizes=(4,)))
    assert code(path, tmp_path / "missing.ktx") == 2
    (tmp_path / "b.ktx2").write_bytes(path.read_bytes()[:50])
    assert code(path, tmp_path / "b.ktx2") == 3
    for bad in (("--max-error", "-1"), ("--max-error", "nan"), ("--axes-a", "-x +x +z"), ("--axes-b", "thre")):
        assert code(path, path, *bad) == 1
    with pytest.raises(UsageError):
        axes_of("x y")
    assert code(path, path, "--max-error", "0") == 0
    assert "Traceback" not in capsys.readouterr().err


def test_error_maps_are_drawn(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    import OpenImageIO as oiio

    a, b = (
        raw(tmp_path / "a.npz", chain(sizes=(8, 4)), dfg=np.ones((4, 4, 2))),
        raw(tmp_path / "b.npz", [1.01 * level for level in chain(sizes=(8, 4))], dfg=np.zeros((4, 4, 2))),
    )
    for folder in ("p", "q"):
        assert code(a, b, "--plot", tmp_path / folder) == 0
    assert (tmp_path / "p/compare.png").read_bytes() == (tmp_path / "q/compare.png").read_bytes()
    picture = oiio.ImageInput.open(str(tmp_path / "p/compare.png"))
    assert picture.spec().width > 800 and picture.spec().height > 800  # two rows of maps: two levels, two channels
    picture.close()
    assert "wrote" in capsys.readouterr().out
