"""Filtered importance sampling: exact where it must be, right on average where it samples, and nowhere shifted."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import reference
from whitefurnace import irradiance, prefilter
from whitefurnace.catalogue import Model, models
from whitefurnace.catalogue.choice import chosen
from whitefurnace.cli import main
from whitefurnace.errors import UsageError
from whitefurnace.files import write_exr
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering.importance import Sampler, light_samples
from whitefurnace.prefiltering.lobes import COSINE, Lobe, mixture_lobe, ndf_lobe
from whitefurnace.prefiltering.means import Means
from whitefurnace.prefiltering.recipe import chain
from whitefurnace.sphere.environments import cube_solid_angles, environment
from whitefurnace.sphere.grids import Shape

HAT = """real ndf_hat_D(real cos_m, real sin2_m, real alpha) {
  real t = alpha * alpha + sin2_m;
  return 1 / (t * sqrt(t));
}
"""
ISOTROPIC = [name for name, entry in models("ndf").items() if entry.isotropic and entry.from_roughness]
WHERE = Shape(False, 4)


class Points(Shape):
    """Any directions (3, m) in the place of a level's texels."""

    def __init__(self, directions: np.ndarray) -> None:
        super().__init__(False, 1)
        object.__setattr__(self, "points", directions / np.linalg.norm(directions, axis=0))

    @property
    def dims(self) -> tuple[int, ...]:
        return (self.points.shape[1],)  # type: ignore[attr-defined]

    def directions(self, index: np.ndarray | None = None) -> np.ndarray:
        return self.points if index is None else self.points[:, index]  # type: ignore[attr-defined]

    def tiled(self) -> np.ndarray:
        return np.arange(self.count)


def sampler(device: Device, texels: np.ndarray, rotate: float = 0.0, precision: int = 32) -> Sampler:
    return Sampler(Means(device, environment(texels).texels, math.radians(rotate)), precision)


def ggx(device: Device, alpha: float) -> Lobe:
    return ndf_lobe(device, chosen("ndf", "ggx"), math.sqrt(alpha), {"alpha": alpha})


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(list(shape)).random((*shape, 3), np.float32) + np.float32(0.1)


def linear(size: int) -> np.ndarray:
    """(6, size, size, 3): 1 + d/2 at texel centres, a colour that tells its direction."""
    return (1 + reference.cube_directions(size).reshape(6, size, size, 3) / 2).astype(np.float32)


def mean_cosine(lobe: Callable[[np.ndarray], np.ndarray], width: float) -> float:
    """∫ K (l·r) dω / ∫ K dω by Gauss panels graded from `width`², K a function of s = 1 - l·r."""
    edges = np.concatenate([[0.0], np.geomspace(min(width**2, 0.1) * 1e-3, 1.0, 80)])
    x, w = np.polynomial.legendre.leggauss(12)
    s = edges[:-1, None] + np.diff(edges)[:, None] * (x + 1) / 2
    K = lobe(s.ravel()).reshape(s.shape) * np.diff(edges)[:, None] * w
    return float((K * (1 - s)).sum() / K.sum())


def reading(own: Sampler, directions: np.ndarray, lod: float, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """(m, 3): one sample along each direction, for a solid angle `lod` levels above the first's middle texels."""
    one = np.array([[0.0, 0.0, 1.0]]), np.ones(1), np.array([4 / own.size**2 * 4.0**lod])
    monkeypatch.setattr("whitefurnace.prefiltering.importance.light_samples", lambda lobe, count: one)
    monkeypatch.setattr("whitefurnace.prefiltering.importance.CROWDED", math.inf)  # the first level as it is
    return own.level(COSINE, Points(directions), 1)


# ---------------------------------------------------------------------------------------------- exact


@pytest.mark.parametrize("count", [1, 7, 1500])
@pytest.mark.parametrize("source", [(1, 1), (17, 34), (6, 9, 9)], ids=str)
def test_a_constant_environment_comes_out_exactly(device: Device, source: tuple[int, ...], count: int) -> None:
    own = sampler(device, np.full((*source, 3), 0.7, np.float32))
    for lobe in (ggx(device, 0.02), ggx(device, 1.0), COSINE):
        assert (own.level(lobe, Shape(True, 5), count) == np.float32(0.7)).all()


def test_shares_add_up_where_nothing_is_taken_off_first(device: Device) -> None:
    """One black texel straight down keeps the base at 0; what looks up sees 1 alone."""
    texels = np.ones((6, 32, 32, 3), np.float32)
    texels[3, 16, 16] = 0
    up = Points(np.array([[0.0, 0.1, -0.2], [1.0, 1.0, 1.0], [0.0, 0.2, 0.1]]))
    for count in (1, 100, 20000):
        # Rounding of up to 1024 shares of a sum of 1 in float32, half an ulp each: 1024 · 6e-8/2 at worst.
        assert np.abs(sampler(device, texels).level(ggx(device, 0.05), up, count) - 1).max() <= 3e-5


@pytest.mark.parametrize("source", [(6, 16, 16), (31, 62)], ids=str)
def test_the_pyramid_keeps_the_energy_of_every_level(device: Device, source: tuple[int, ...]) -> None:
    texels = noise(*source) ** 8 * 100
    own = sampler(device, texels, 25.0)
    size = own.size
    read = own.pyramid(size).read()
    _, weight, index = reference.texel_nodes(texels, 0.0, 6)
    want = weight @ texels.reshape(-1, 3).astype(np.float64)[index] / (4 * math.pi)
    first = 0
    for k in range(size.bit_length()):
        n = size >> k
        faces = read[first : first + 6 * (n + 2) ** 2].reshape(6, n + 2, n + 2, 4)[:, 1:-1, 1:-1, :3]
        mean = np.einsum("fijc,ij->c", faces.astype(np.float64), cube_solid_angles(n)) / (4 * math.pi) + own.base
        # Means in float32 through at most six levels; the reference's nodes of a lat-long texel leave 1e-7.
        assert np.abs(mean / want - 1).max() <= 1e-6, (k, mean, want)
        first += 6 * (n + 2) ** 2
    assert first == len(read)


def test_samples_stand_for_the_hemisphere(device: Device) -> None:
    """∑ 1/(N pdf) is ∫ dω = 2π: at once for GGX of α = 1, whose D is constant; else as the tail is met."""
    assert light_samples(ggx(device, 1.0), 64)[2].sum() == pytest.approx(2 * math.pi, rel=1e-9)
    # 1/√(1-u) at its singular end: the midpoint rule leaves .6/√N of 2.
    assert light_samples(COSINE, 4096)[2].sum() == pytest.approx(2 * math.pi, rel=0.01)
    for lobe in (ggx(device, 0.3), COSINE):
        light, share, _ = light_samples(lobe, 1024)
        assert np.abs(np.linalg.norm(light, axis=1) - 1).max() <= 1e-12 and share.sum() == pytest.approx(1, rel=1e-12)
        # As many on each side: the lattice's discrepancy is O(log N/N) of directions.
        assert np.abs(share @ light[:, :2]).max() <= 2e-3


# ---------------------------------------------------------------------------------------------- where texels are


@pytest.mark.parametrize("lod", [-3.0, 0.4, 1.7, 2.9])
def test_texels_are_where_their_centres_are(device: Device, lod: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A read tells the direction it was made in: half a texel's shift would show as half a texel."""
    own = sampler(device, linear(64))
    d = np.random.default_rng(5).normal(size=(3, 500))
    d /= np.linalg.norm(d, axis=0)
    told = 2 * (reading(own, d, lod, monkeypatch).T - 1)
    told /= np.linalg.norm(told, axis=0)
    # Texels near a corner are read a level higher, at most 2^(lod + 1.2) of 2/64 wide; bilinear reads of means of a
    # direction bend by a tenth of that at the coarsest, beside an edge where centres crowd; a shift is half or more.
    texel = 2 / 64 * 2 ** max(lod + 1.2, 0)
    off = np.arccos(np.clip((told * d).sum(0), -1, 1))
    assert np.median(off) <= 0.05 * texel and off.max() <= 0.3 * texel, (np.median(off) / texel, off.max() / texel)


def test_a_texel_read_at_its_centre_is_itself(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    texels = noise(6, 16, 16)
    got = reading(sampler(device, texels), Shape(False, 16).directions(), -2.0, monkeypatch)
    # A direction is rounded to 6e-8 of 1, that is 5e-7 of a texel, and neighbours differ by up to 1.
    assert np.abs(got - texels.reshape(-1, 3)).max() <= 4e-6


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_a_sample_is_read_where_texels_are_as_large_as_it(
    device: Device, level: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the middle of a face, between four texels, and at a corner, between three that are 3^(-3/2) as large."""
    texels, n = noise(6, 16, 16), 16 >> level
    weight = np.repeat(cube_solid_angles(16)[None, ..., None], 6, 0)

    def blocks(a: np.ndarray) -> np.ndarray:
        return a.reshape(6, n, 16 // n, n, 16 // n, -1).sum((2, 4)).reshape(6 * n * n, -1)

    means, centres = blocks(texels * weight) / blocks(weight), reference.cube_directions(n).reshape(-1, 3)
    middles = np.repeat(np.eye(3), 2, 1) * np.tile([1, -1], 3)
    corners = np.stack(np.meshgrid([1.0, -1], [1, -1], [1, -1])).reshape(3, 8)
    for directions, count, lod in ((middles, 4, float(level)), (corners, 3, level - 0.75 * math.log2(3))):
        nearest = np.argsort(-(centres @ directions), 0)[:count]
        got = reading(sampler(device, texels), directions, lod, monkeypatch)
        # The level is right to 1e-3 of one (samples.cl), and levels differ by up to 1 from each other.
        assert np.abs(got - means[nearest].mean(0)).max() <= 1.1e-3, (level, count)


@pytest.mark.parametrize("lod", [-1.0, 0.3, 1.0, 2.6, 3.5])
def test_reads_go_on_over_edges_and_corners(device: Device, lod: float, monkeypatch: pytest.MonkeyPatch) -> None:
    own = sampler(device, noise(6, 16, 16))
    near = 1e-4
    t = np.linspace(-1, 1, 41)
    pairs = []
    for a in range(3):
        for b in range(3):
            if a == b:
                continue
            for signs in range(4):
                p = np.empty((3, t.size))
                p[a], p[b], p[3 - a - b] = 1 - 2 * (signs & 1), 1 - (signs & 2), t
                out, inside = p.copy(), p.copy()
                out[a] *= 1 - near
                inside[b] *= 1 - near
                pairs.append((out, inside))
    one, other = (np.concatenate(side, 1) for side in zip(*pairs, strict=True))
    step = np.abs(reading(own, one, lod, monkeypatch) - reading(own, other, lod, monkeypatch)).max()
    # 1e-4 of a half face is 8e-4 of its 16 texels; between texels radiance changes by 1 at most, in two directions and
    # from level to level. A wrong neighbour steps by a third in the mean.
    assert step <= 5e-3, step


# ---------------------------------------------------------------------------------------------- what they converge to


@pytest.mark.parametrize("r", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("name", ISOTROPIC)
def test_any_ndf_on_a_linear_environment(device: Device, name: str, r: float) -> None:
    """1 + d/2 becomes 1 + c d/2 with c = ∫ K (l·r) / ∫ K, from the entry's reference."""
    entry: Model = models("ndf")[name]
    assert entry.from_roughness is not None
    parameters = {**{p.name: p.typical[0] for p in entry.parameters}, **entry.from_roughness(r)}

    def lobe(s: np.ndarray) -> np.ndarray:
        return np.asarray(entry.reference["D"](np.arcsin(np.sqrt(s / 2)), **parameters)) * (1 - s)

    assert_linear(device, ndf_lobe(device, chosen("ndf", name), r, parameters), mean_cosine(lobe, r * r))


def test_a_users_ndf_irradiance_and_a_mixture(device: Device, tmp_path: Path) -> None:
    (tmp_path / "hat.clh").write_text(HAT)
    hat = chosen("ndf", tmp_path / "hat.clh")

    def lobe(alpha: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda s: (alpha**2 + s / 2) ** -1.5 * (1 - s)

    assert_linear(device, ndf_lobe(device, hat, 0.5, {"alpha": 0.25}), mean_cosine(lobe(0.25), 0.25))
    assert_linear(device, COSINE, 2 / 3)
    mixed = mixture_lobe(device, hat, [(1.4, 0.5), (-0.4, 0.8)], lambda r: {"alpha": r * r})
    want = 1.4 * mean_cosine(lobe(0.25), 0.25) - 0.4 * mean_cosine(lobe(0.64), 0.64)
    assert_linear(device, mixed, want)


def assert_linear(device: Device, lobe: Lobe, c: float) -> None:
    got = sampler(device, linear(64)).level(lobe, WHERE, 8192)
    want = 1 + c * WHERE.directions().T.reshape(6, 4, 4, 3) / 2
    # Samples in equal steps of energy leave 1e-3 at a lobe's long tail, a texel of 64 a part of (2/64)² and its means
    # up to twice that on the coarse levels that the tail is read from; both of 1/2.
    assert np.abs(got - want).max() <= 2e-3, (lobe.name, c, np.abs(got - want).max())


@pytest.mark.parametrize("alpha", [0.05, 0.1, 0.3, 1.0])
def test_more_samples_are_nearer_the_exact_integral(device: Device, alpha: float) -> None:
    texels = noise(32, 64) ** 6  # spots, some forty times the mean
    want = reference.exact_lobe(texels, math.radians(40), WHERE.directions().T, reference.ggx_lobe(alpha), 8)
    errors = []
    for count in (64, 1024, 16384):
        got = sampler(device, texels, 40.0).level(ggx(device, alpha), WHERE, count).reshape(-1, 3)
        errors.append(float(np.sqrt(np.mean((got - want) ** 2) / np.mean(want**2))))
    # Between random samples' N^(-1/2), 4 a step, and a lattice's 1/N: at least 3 a step, down to what the pyramid's 64²
    # blur. Bilinear reads widen a lobe by a quarter of a texel squared, so by half of that times ∇²K ≈ K/α² of noise.
    floor = (math.pi / 128 / alpha) ** 2 / 6
    assert errors[1] <= max(errors[0] / 3, floor) and errors[2] <= max(errors[1] / 3, floor), errors


def test_suns_are_not_clamped(device: Device) -> None:
    """A sun of 1e5 keeps its energy in the mean of a level, whatever single texels miss."""
    texels = noise(64, 128)
    texels[20, 31] = 1e5
    shape = Shape(False, 32)
    mean = shape.mean(sampler(device, texels).level(ggx(device, 0.5), shape, 4096))
    _, weight, index = reference.texel_nodes(texels, 0.0, 2)
    # Zonal convolution keeps the mean; over texels of 32² as over all samples that leaves a percent.
    assert mean == pytest.approx(float((weight @ texels.reshape(-1, 3)[index]).mean()) / (4 * math.pi), rel=0.01)


# ---------------------------------------------------------------------------------------------- lanes and precision


@pytest.mark.few(2)
@pytest.mark.parametrize("lanes", [1, 4, 16])
def test_every_width_gives_the_same(device: Device, monkeypatch: pytest.MonkeyPatch, lanes: int) -> None:
    texels = noise(16, 32)
    usual = {alpha: sampler(device, texels).level(ggx(device, alpha), Shape(True, 7), 300) for alpha in (0.03, 0.6)}
    monkeypatch.setenv("WHITEFURNACE_LANES", str(lanes))
    other = choose_device(f"{device.platform}: {device.name}")
    assert other.lanes(32) == lanes
    for alpha, level in usual.items():
        got = sampler(other, texels).level(ggx(other, alpha), Shape(True, 7), 300)
        # One text: only what is contracted to fused operations may differ, a digit of a direction or of a sum.
        assert np.abs(got / level - 1).max() <= 1e-5


def test_float64_agrees(device: Device) -> None:
    if not device.fp64:
        pytest.skip("the device has no float64")
    texels = noise(16, 32)
    for alpha in (0.03, 0.6):
        one, two = (sampler(device, texels, precision=p).level(ggx(device, alpha), WHERE, 3000) for p in (32, 64))
        assert np.abs(one / two - 1).max() <= 1e-5  # texels of contrast 10, read at places rounded to 1e-6 of one


# ---------------------------------------------------------------------------------------------- as it is asked for


def test_levels_are_certified_as_any_other(device: Device) -> None:
    texels = noise(32, 64)
    texels[9, 20] = 1e4
    few, many = (prefilter(texels, size=32, min_size=8, samples=n, device=device) for n in (16, 1024))
    assert few.rule == ("texel-mean", "samples-16", "samples-16")
    assert few.error[0] <= 1e-6  # level 0 is the exact mean
    assert (many.rmse[1:] < few.rmse[1:]).all() and few.error[1] > 1e-2
    assert few.evaluations == 6 * (16**2 + 8**2) * 16
    e = irradiance(texels, size=8, samples=256, device=device)
    exact = irradiance(texels, size=8, device=device)
    assert e.rule == "samples-256"
    # `error` bounds 99 % of texels, `worst` was the largest of all 384, which are fewer than a certificate looks at.
    off = np.abs(e.values - exact.values) / np.maximum(exact.values, 1e-3 * exact.values.mean())
    assert off.max() == pytest.approx(e.worst, rel=0.02, abs=2e-3)  # the other's own error is 1e-3


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--samples", "0"), ("samples 0", "[1, 65536]")),
        (("--samples", "65537"), ("65537", "65536")),
        (("--samples", "many"), ("many",)),
        (("--samples", "64", "--tolerance", "1e-3"), ("samples", "tolerance", "not both")),
        (("--samples", "64", "--quality", "draft"), ("samples", "quality", "not both")),
    ],
)
def test_the_command_line_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    write_exr(tmp_path / "a.exr", noise(2, 4))
    with pytest.raises(SystemExit) as done:
        main(["bake", str(tmp_path / "a.exr"), "-o", str(tmp_path / "out"), *arguments])
    said = capsys.readouterr().err
    assert done.value.code == 1 and all(word in said for word in words), said


@pytest.mark.parametrize("samples", [0, -1, 2.5, math.nan, math.inf, "64", True])
def test_python_refuses(samples: object) -> None:
    with pytest.raises(UsageError, match="whole number"):
        chain(samples=samples)  # type: ignore[arg-type]


def test_a_bake_by_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_exr(tmp_path / "a.exr", noise(16, 32))
    keys = []
    for count in ("32", "33"):
        with pytest.raises(SystemExit) as done:
            main(
                [
                    "bake",
                    str(tmp_path / "a.exr"),
                    "-o",
                    str(tmp_path / "out"),
                    "--size",
                    "16",
                    "--min-size",
                    "4",
                    "--samples",
                    count,
                    "--quiet",
                ]
            )
        assert done.value.code == 0, capsys.readouterr().err
        manifest = json.loads((tmp_path / "out" / "a.json").read_text())
        keys.append(manifest["key"])
        assert [row["method"] for row in manifest["levels"]] == ["texel-mean", *[f"samples-{count}"] * 2]
        assert manifest["irradiance"]["method"] == f"samples-{count}" and manifest["recipe"]["samples"] == int(count)
        assert "tolerance" not in manifest["recipe"]
        assert all(row["error"] > 1e-3 for row in manifest["levels"][1:])  # more than the default tolerance, and stated
    assert keys[0] != keys[1]
