"""Sheen as engines shade it: Charlie under the masking models of sheen, by quadratures that share no rule with ours."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.special import gammaln

import reference
from whitefurnace import bake, integrate, lut
from whitefurnace.catalogue import model
from whitefurnace.engines.presets import ENGINES, user_engine
from whitefurnace.errors import InputError, UsageError
from whitefurnace.files import decode, read_image, read_texture
from whitefurnace.files.packing import unpack
from whitefurnace.files.png import decode_png
from whitefurnace.opencl.device import Device

NOV = np.array([0.01, 0.1, 0.5, 0.9])
WITH_SHEEN = [name for name, engine in ENGINES.items() if engine.dfg.charlie]


def charlie_by_tanh_sinh(masking: str, NoV: float, alpha: float, own: dict[str, float]) -> float:
    """E(v) of Charlie over light directions, in float64."""
    D, V = model("ndf", "charlie").reference["D"], model("masking", masking).reference["V"]
    return reference.albedo_by_tanh_sinh(
        lambda theta: D(theta, alpha=alpha),
        lambda *arguments: V(*arguments, **own),
        lambda c: 1.0,
        lambda up: np.zeros_like(up),
        NoV,
    )


def test_the_sheen_of_engines_has_its_published_values(device: Device) -> None:
    """Charlie × Neubelt's V at n·v = .1, as a BRDF written out whole gives it: four digits are known."""
    r = np.array([0.1, 0.3, 0.7, 1.0])
    made = integrate("albedo", ndf="charlie", masking="ashikhmin", NoV=0.1, alpha=r**2, device=device)
    assert made.values == pytest.approx([0.8988, 0.7981, 0.5558, 0.4940], abs=6e-5)


@pytest.mark.parametrize("masking", ["ashikhmin", "estevez_kulla", "estevez_kulla:softening=1"])
def test_albedo_of_sheen_by_another_quadrature(device: Device, masking: str) -> None:
    r = np.array([0.1, 0.3, 0.7, 1.0])
    name, _, softened = masking.partition(":")
    got = integrate("albedo", ndf="charlie", masking=masking, NoV=NOV, alpha=r[:, None] ** 2, device=device)
    for i, rough in enumerate(r):
        own = {"alpha": rough**2, "softening": float(bool(softened))} if name == "estevez_kulla" else {}
        for j, NoV in enumerate(NOV):
            want = charlie_by_tanh_sinh(name, float(NoV), float(rough**2), own)
            # The reference has 1e-10, and 5e-7 at the turn of the fitted Λ at ½, where its panels do not meet.
            assert abs(got.values[i, j] - want) <= got.error + 1e-6 and got.error <= 1e-5, (rough, NoV, want)


def test_albedo_at_grazing_is_the_projected_area(device: Device) -> None:
    """At n·v = 0 Neubelt's V is 1/(n·l), so E = ∫ D (v·h)₊ dω = (2 + 1/α)/(2√π) Γ(3/2 + 1/2α)/Γ(2 + 1/2α)."""
    alpha = np.array([1e-3, 0.01, 0.1, 0.5, 1.0])
    want = (2 + 1 / alpha) / (2 * np.sqrt(np.pi)) * np.exp(gammaln(1.5 + 0.5 / alpha) - gammaln(2 + 0.5 / alpha))
    single = integrate("albedo", ndf="charlie", masking="ashikhmin", NoV=0.0, alpha=alpha, device=device)
    # α = 1e-3 is a rim of 3°, whose ulp is 5e-6 of D: two roundings of values up to 12.6.
    assert single.values == pytest.approx(want, rel=1e-5)
    if device.fp64:
        double = integrate(
            "albedo", ndf="charlie", masking="ashikhmin", NoV=0.0, alpha=alpha, precision=64, device=device
        )
        assert double.values == pytest.approx(want, rel=1e-9)


def test_where_sheen_makes_energy_is_as_the_entries_say(device: Device) -> None:
    """The notes' figures: albedos at most, and the roughness from which no more than 1 is reflected."""
    NoV = np.concatenate([[0.0], np.geomspace(1e-5, 1, 60)])
    known = {
        "ashikhmin": ([4.02, 2.05, 1.42, 0.94, 0.64], [0.1, 0.2, 0.3, 0.5, 1.0], 0.46),
        "estevez_kulla": ([2.13, 1.20, 0.92, 0.81, 0.87, 0.94], [0.1, 0.2, 0.3, 0.5, 0.7, 1.0], 0.26),
    }
    for masking, (largest, at, even) in known.items():
        r = np.array([*at, even - 0.02, even + 0.02])[:, None]
        E = integrate("albedo", ndf="charlie", masking=masking, NoV=NoV, alpha=r**2, tolerance=1e-4, device=device)
        most = E.values.max(1)
        assert most[: len(at)] == pytest.approx(largest, abs=6e-3), masking
        assert most[-2] > 1 > most[-1], masking


# ---------------------------------------------------------------------------------------------- tables of engines


def corners(size: int) -> list[tuple[int, int]]:
    """Texels (row, column) of a table: r from the least that engines shade a sheen with, n·v from grazing to normal."""
    rows, columns = (0.06, 0.1, 0.3, 0.7, 0.999), (0.0, 0.1, 0.5, 0.999)
    return [(int(r * size), int(c * size)) for r in rows for c in columns]


def third_channel(size: int) -> dict[tuple[int, int], float]:
    """Charlie × Neubelt's V at the centres of some texels, in float64."""
    return {
        (row, column): charlie_by_tanh_sinh("ashikhmin", (column + 0.5) / size, ((row + 0.5) / size) ** 2, {})
        for row, column in corners(size)
    }


def test_the_engines_with_a_channel_of_sheen_are_known() -> None:
    assert WITH_SHEEN == ["filament", "babylon", "khronos"]
    for name in WITH_SHEEN:
        table = ENGINES[name].dfg
        assert (table.x, table.y, table.charlie_masking) == ("NoV", "roughness", "ashikhmin")


@pytest.mark.parametrize("name", WITH_SHEEN)
def test_the_third_channel_is_what_the_engine_integrates(name: str, device: Device, tmp_path: Path) -> None:
    made = lut("dfg", tmp_path / "t.npy", for_=name, device=device)
    table, size = np.load(tmp_path / "t.npy"), ENGINES[name].dfg.size
    assert table.shape == (size, size, 3) and made.manifest["channels"][2] == "charlie"
    assert made.manifest["charlie_masking"] == "ashikhmin" and made.manifest["charlie_error"] <= 1e-4
    for (row, column), want in third_channel(size).items():
        assert abs(table[row, column, 2] - want) <= made.manifest["charlie_error"], (row, column, want)
    # The masking of the first two channels is no matter of the third.
    lut("dfg", tmp_path / "s.npy", for_=name, masking="smith_separable", device=device)
    other = np.load(tmp_path / "s.npy")
    assert np.array_equal(other[..., 2], table[..., 2]) and np.abs(other - table)[..., :2].max() > 1e-3


def test_bakes_write_the_third_channel_too(device: Device, tmp_path: Path) -> None:
    """As half floats for Filament, as 8 bits with a divisor for Babylon.js, whose blue is otherwise 0."""
    (made,) = bake(np.ones((16, 32, 3), np.float32), tmp_path, for_="filament,babylon", size=32, device=device)
    halves = decode(read_texture(tmp_path / "filament" / "array_dfg.ktx2"), 0)
    code = decode_png((tmp_path / "babylon" / "array_dfg.png").read_bytes())
    rgbd = unpack("rgbd", code, code.shape[:-1])
    for name, table in (("filament", halves), ("babylon", rgbd)):
        entry = next(e for file, e in made.manifest["files"].items() if f"{name}/array_dfg" in file)
        assert entry["charlie_masking"] == "ashikhmin"
        for (row, column), want in third_channel(len(table)).items():
            # Half an ulp of half; half a step of a code of 8 bits to the power of 2.2, which the bake states.
            allowed = 2.0**-11 * max(want, 2.0**-14) if name == "filament" else 0.02 * want + 1e-4
            assert abs(table[row, column, 2] - want) <= entry["charlie_error"] + allowed, (name, row, column, want)


def test_an_engine_of_the_users_has_the_masking_that_it_names(device: Device, tmp_path: Path) -> None:
    text = '[dfg]\nsize = 8\ncharlie = true\ncharlie_masking = "{}"\n[[file]]\nholds = "dfg"\nname = "{{stem}}.exr"\n'
    engine = tmp_path / "mine.toml"
    engine.write_text(text.format("estevez_kulla"), "utf-8")
    lut("dfg", tmp_path / "t.npy", for_=str(engine), device=device)
    want = charlie_by_tanh_sinh("estevez_kulla", 2.5 / 8, (4.5 / 8) ** 2, {"alpha": (4.5 / 8) ** 2, "softening": 0.0})
    assert abs(np.load(tmp_path / "t.npy")[4, 2, 2] - want) <= 1e-4
    engine.write_text(text.format("ashikmin"), "utf-8")
    with pytest.raises(InputError, match=r"charlie_masking: unknown masking 'ashikmin'.*ashikhmin"):
        user_engine(engine)


@pytest.mark.skipif(shutil.which("cmgen") is None, reason="Filament's cmgen is not installed")
def test_filaments_own_tool_writes_the_same_three_channels(device: Device, tmp_path: Path) -> None:
    """Row y of cmgen's table, from below, is of r = (y + 1.5)/128: our row y + 1."""
    lut("dfg", tmp_path / "ours.npy", for_="filament", device=device)
    command = ["cmgen", "--quiet", "--size=128", f"--ibl-dfg={tmp_path / 'cmgen.exr'}"]
    subprocess.run([*command, "--ibl-dfg-multiscatter", "--ibl-dfg-cloth"], check=True, timeout=120)
    own = read_image(tmp_path / "cmgen.exr").pixels[::-1].astype(np.float64)
    off = np.abs(np.load(tmp_path / "ours.npy")[1:] - own[:-1])[8:, 2:]
    # 1024 samples in each of its texels, stored as halves: measured .002, .0099 and .0034. A wrong masking is .2 off.
    for channel, most in enumerate((0.003, 0.015, 0.005)):
        assert off[..., channel].max() <= most, (channel, off[..., channel].max())


# ---------------------------------------------------------------------------------------------- lut sheen


def test_a_table_of_sheen_takes_a_masking_or_an_engine(device: Device, tmp_path: Path) -> None:
    """Any masking, smith by default; an engine decides masking, size and axes."""
    made = {}
    for name, options in {
        "plain": {"size": 8},
        "neubelt": {"size": 8, "masking": "ashikhmin"},
        "fit": {"size": 8, "masking": "estevez_kulla:softening=1"},
        "babylon": {"for_": "babylon"},
    }.items():
        made[name] = lut("sheen", tmp_path / f"{name}.npy", device=device, **options)
    models = {name: one.recipe["models"]["masking"]["name"] for name, one in made.items()}
    assert models == {"plain": "smith", "neubelt": "ashikhmin", "fit": "estevez_kulla", "babylon": "ashikhmin"}
    assert made["babylon"].shape == (256, 256, 2)
    for name, masking, own in (
        ("neubelt", "ashikhmin", {}),
        ("fit", "estevez_kulla", {"alpha": (4.5 / 8) ** 2, "softening": 1.0}),
    ):
        want = charlie_by_tanh_sinh(masking, 1.5 / 8, (4.5 / 8) ** 2, own)
        assert abs(np.load(tmp_path / f"{name}.npy")[4, 1, 0] - want) <= 4e-5, name
    table, size = np.load(tmp_path / "babylon.npy"), 256
    for (row, column), want in third_channel(size).items():
        assert abs(table[row, column, 0] - want) <= made["babylon"].manifest["error"] + 1e-6, (row, column, want)


def test_a_sheen_that_makes_energy_says_so(device: Device, tmp_path: Path) -> None:
    made = lut("sheen", tmp_path / "s.npy", size=16, masking="ashikhmin", device=device)
    E = np.load(tmp_path / "s.npy")[..., 0]
    assert E.max() > 1 and made.manifest["largest"] == pytest.approx(E.max())
    assert made.manifest["over_one"] == pytest.approx((E > 1).mean())
    (told,) = [notice for notice in made.notices if "times what arrives" in notice]
    assert f"{E.max():.3g} times" in told and "under the masking smith no albedo passes 1" in told
    assert lut("sheen", tmp_path / "t.npy", size=16, device=device).notices == ()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"for_": "three"}, "three reads no table of sheen: it shades sheen by a fit of its own .IBLSheenBRDF."),
        ({"for_": "bevy"}, "bevy reads no table of sheen; give --masking"),
        ({"for_": "filament", "masking": "smith"}, "--for filament says the masking"),
        ({"for_": "filament", "size": 16}, "--for filament says the size"),
        ({"for_": "filament,khronos"}, "a table is for one engine"),
        ({"masking": "ashikmin"}, "unknown masking 'ashikmin'.*ashikhmin"),
    ],
)
def test_refusals(tmp_path: Path, options: dict[str, str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        lut("sheen", tmp_path / "t.npy", **options)
