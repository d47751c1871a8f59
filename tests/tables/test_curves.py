"""Curves in place of Smith's term and of norms: the headers themselves, evaluated, against quadrature of the NDF."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reference
from whitefurnace import lut
from whitefurnace.catalogue import model
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.opencl.device import Device
from whitefurnace.tables.curves import least_largest


def macros(path: Path) -> dict[str, Callable[..., Any]]:
    """The macros of a header as functions of numpy, in float64."""
    text = path.read_text("utf-8")
    found: dict[str, Any] = {"log": np.log, "exp": np.exp}
    for name, arguments, body in re.findall(r"#define (\w+)\(([^)]*)\) (.*)", text):
        exec(f"def {name}({arguments}): return {re.sub(r'(?<=[0-9])f', '', body)}", found)
    return {name: found[name] for name in found if name.isupper()}


def test_least_largest_is_chebyshevs() -> None:
    """The best line to eˣ on [0, 1] has the chord's slope and errs alike at both ends and where its tangent is."""
    x = np.linspace(0, 1, 2001)
    slope = np.e - 1
    want = (1 - (slope - slope * np.log(slope))) / 2  # half the distance of the chord from the parallel tangent
    found = least_largest(lambda p: p[0] + p[1] * x - np.exp(x), np.zeros(2))
    # Sums of 64th powers come within 3 % of the largest.
    assert abs(want) <= np.abs(found[0] + found[1] * x - np.exp(x)).max() <= 1.03 * abs(want)


@pytest.mark.parametrize(
    "ndf, scheme, most",
    [("ggx", "rational", 7e-3), ("ggx", "linear", 0.08), ("beckmann", "rational", 0.04), ("abc", "rational", 0.015)],
)
def test_smith_of_the_header(device: Device, tmp_path: Path, ndf: str, scheme: str, most: float) -> None:
    path = tmp_path / "my_smith.h"
    made = lut("smith", path, ndf=ndf, scheme=scheme, device=device)
    told, own = made.manifest, macros(path)
    assert told["error"] <= most and f"{told['error']:.2g}" in path.read_text("utf-8")
    entry = model("ndf", ndf)
    assert entry.from_roughness is not None
    worst = pair = 0.0
    for r in (0.045, 0.1, 0.31, 0.55, 0.8, 1.0):
        given = entry.from_roughness(r)

        def D(theta: np.ndarray, given: dict[str, float] = given) -> np.ndarray:
            return entry.reference["D"](theta, **given)  # type: ignore[no-any-return]

        c = np.array([3e-3, 0.02, 0.07, 0.2, 0.41, 0.77, 0.99])
        # GGX's closed form; else tanh-sinh, which shares nothing with the kernel.
        A = (
            entry.reference["area"](np.arccos(c), **given)
            if ndf == "ggx"
            else np.array(reference.smith_area(D, np.arcsin(c)))
        )
        worst = max(worst, float(np.abs(own["MY_SMITH_G1"](c, r) - c / A).max()))
        V = 1 / (c[:, None] * A + c * (A[:, None] - c[:, None]))
        pair = max(pair, float(np.abs((own["MY_SMITH_V"](c[:, None], c, r) - V) * c * c[:, None]).max()))
    # Bounds that are not far off either: the points are few. 1e-6 is of the coefficients' digits.
    assert worst <= told["error"] + 1e-6 and pair <= 1.02 * told["error_pairs"] + 1e-6
    assert worst >= 0.2 * told["error"]


def test_smith_of_one_roughness_and_of_another_parameter(device: Device, tmp_path: Path) -> None:
    made = lut("smith", tmp_path / "one.npy", ndf="ggx", roughness=0.5, device=device)
    assert np.load(tmp_path / "one.npy").shape == (2, 1) and made.manifest["error"] < 7e-3
    # Hammon's k is α/2; the best of one line over all n·v at one α is near it.
    lut("smith", tmp_path / "line.npy", ndf="ggx", alpha=0.25, scheme="linear", device=device)
    assert np.load(tmp_path / "line.npy")[0, 0] == pytest.approx(0.125, rel=0.3)
    made = lut("smith", tmp_path / "other.h", axes={"alpha": (0.05, 1, 32)}, device=device)
    assert made.manifest["variable"] == "alpha" and "OTHER_G1(c, alpha)" in (tmp_path / "other.h").read_text("utf-8")


@pytest.mark.parametrize(
    "ndf, lobe, points",
    [
        ("abc", lambda t, b, c: (1 + b * (1 - np.cos(t))) ** -c, [(1, 1), (7, 2), (300, 1.5), (2e4, 3), (1e6, 1.2)]),
        (
            "shifted_gamma",
            lambda t, a, p: np.exp(-(np.tan(t) ** 2) / a) * (1 + np.tan(t) ** 2 / a**2) ** -p / np.cos(t) ** 4,
            [(1e-3, 0), (0.01, 1), (0.1, 2), (0.4, 0.3), (1, 1.7)],
        ),
    ],
)
def test_norm_of_the_header(device: Device, tmp_path: Path, ndf: str, lobe: Any, points: list[Any]) -> None:
    """1/∫ lobe cos θ dω by Gauss panels in log θ, the lobe as the header's comment has it."""
    path = tmp_path / "n.h"
    made = lut("norm", path, ndf=ndf, device=device)
    own = macros(path)["N_NORM"]
    x, w = reference.gauss(20)
    edges = np.concatenate([[0], np.geomspace(1e-6, np.pi / 2 - 1e-9, 120)])
    theta = (edges[:-1, None] + np.diff(edges)[:, None] * x).ravel()
    weight = (np.diff(edges)[:, None] * w).ravel() * 2 * np.pi * np.sin(theta) * np.cos(theta)
    worst = 0.0
    for point in points:
        with np.errstate(under="ignore"):
            want = 1 / float(lobe(theta, *point) @ weight)
        worst = max(worst, abs(own(*point) / want - 1))
    assert worst <= made.manifest["error"] + 1e-5 <= 1e-2 + 1e-5 and worst >= 0.1 * made.manifest["error"]


def test_norm_of_a_range_and_a_file(device: Device, tmp_path: Path) -> None:
    """A finer tolerance takes a higher degree; one parameter; a lobe of one's own, cos^k, whose norm is (k + 2)/2π."""
    made = lut(
        "norm", tmp_path / "n.npy", axes={"b": (10, 1e3, 24, "log")}, ndf="abc:c=2", tolerance=1e-4, device=device
    )
    coarse = lut("norm", tmp_path / "c.npy", axes={"b": (10, 1e3, 24, "log")}, ndf="abc:c=2", device=device)
    assert made.manifest["degree"] > coarse.manifest["degree"] and made.manifest["error"] <= 1e-4
    (tmp_path / "lobe.clh").write_text("real ndf_lobe_D(real cos_m, real k) { return pow(cos_m, k); }\n")
    made = lut(
        "norm", tmp_path / "l.h", ndf=str(tmp_path / "lobe.clh"), axes={"k": (1, 16, 16)}, tolerance=1e-3, device=device
    )
    k, own = np.linspace(1, 16, 7), macros(tmp_path / "l.h")["L_NORM"]
    assert np.abs(own(k) / ((k + 2) / (2 * np.pi)) - 1).max() <= made.manifest["error"] + 1e-5
    # D = 1 + α c has the norm 1/(π + 2π α/3); its α follows the roughness of the axis.
    (tmp_path / "bowl.clh").write_text("real ndf_bowl_D(real cos_m, real alpha) { return 1 + alpha * cos_m; }\n")
    made = lut(
        "norm",
        tmp_path / "b.h",
        ndf=str(tmp_path / "bowl.clh"),
        axes={"roughness": (0.1, 1, 16)},
        tolerance=1e-4,
        device=device,
    )
    r, own = np.linspace(0.1, 1, 7), macros(tmp_path / "b.h")["B_NORM"]
    assert np.abs(own(r) * (np.pi + 2 * np.pi * r**2 / 3) - 1).max() <= made.manifest["error"] + 1e-5


def test_refusals(device: Device, tmp_path: Path) -> None:
    ask: Any = lambda kind, name="t.h", **more: lut(kind, tmp_path / name, device=device, **more)  # noqa: E731
    for error, words, kind, more in (
        (UsageError, "as coefficients, to .h or .npy", "smith", {"name": "t.exr"}),
        (UnsupportedError, "another", "smith", {"masking": "kelemen"}),
        (UnsupportedError, "isotropic", "smith", {"ndf": "ggx_anisotropic"}),
        (UnsupportedError, "one parameter more", "smith", {"ndf": "abc", "axes": {"b": (1, 9, 4), "c": (1, 2, 4)}}),
        (UnsupportedError, "has a plain one", "norm", {"ndf": "ggx"}),
        (UsageError, "leave out --fit", "smith", {"fit": "bilinear"}),
    ):
        with pytest.raises(error, match=words):
            ask(kind, **more)
    assert list(tmp_path.iterdir()) == []
