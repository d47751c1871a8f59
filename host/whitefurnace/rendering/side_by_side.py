"""Draws an engine's picture of spheres, the full reflectance integral of the same pixels, and their difference."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from whitefurnace.catalogue.choice import Chosen, Spec, chosen
from whitefurnace.engines.presets import Engine
from whitefurnace.errors import FileError, InputError, UsageError
from whitefurnace.files import read_manifest, write_exr
from whitefurnace.integrals.radiance import radiance
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering.certificate import texel_errors
from whitefurnace.prefiltering.lighting import irradiance
from whitefurnace.prefiltering.reading import bilinear
from whitefurnace.rendering import shading
from whitefurnace.rendering.shading import Lights
from whitefurnace.rendering.truth import Points, Term, Truth, albedo, term
from whitefurnace.scenes.material_spheres import DIELECTRIC, MaterialSphere, SphereLayout, layout_of
from whitefurnace.sphere.environments import Environment, Reading, read_environment
from whitefurnace.sphere.grids import radiance_at
from whitefurnace.sphere.suns import without_sun

TOLERANCE = 1e-2
TOLERANCE_RANGE = (1e-4, 0.5)

IRRADIANCE = 128
"""Texels of a face edge of the cube of E/π from which a Lambertian surface is read. Bilinear reads err by 2e-5 of its
range."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear Rec.709 in luminance."""

DARK = 1e-3
"""Smallest luminance of the truth by which differences are divided, relative to the mean radiance."""

MOST = 0.95
"""Share of the spheres' pixels that the scale of differences covers."""

SUFFIXES = (".png", ".exr")

MIRROR = 1 / 64
"""Roughness below which the truth is a mirror: its lobe, α = 2.4e-4, is narrower than a texel of an image of 16K."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """The reflection model of all spheres, the metallic-roughness model of glTF 2.0.

    The specular part has the NDF, Smith's masking and F = (1 - metalness) F_d + metalness F_m. Without `dielectric` and
    `metal` these are Schlick's, of the sphere's insulator and of F0 = base colour. The diffuse part is (1 - metalness)
    times the reflection by a `diffuse` model of the base colour, Lambert's by default, times 1 - E_d(v), where E_d is
    the directional albedo of the specular part under F_d. So it gets the light that the specular part leaves, as in the
    engines.

    Facets scatter once. `multiscatter` gives back the lost energy as most engines do: the specular part is multiplied
    by 1 + F0 (1/E₁ - 1), where E₁ is the albedo of F = 1 and F0 the Fresnel term at n = v [Turquin2019].
    """

    ndf: Spec = "ggx"
    masking: Spec = "smith"
    dielectric: Spec | None = None
    metal: Spec | None = None
    diffuse: Spec | None = None
    multiscatter: bool = False

    def terms(self, roughness: float) -> dict[str, Term]:
        """Return the terms of the specular part at a perceptual roughness.

        Schlick's is "both", which is linear in F0; `dielectric` and `metal` are terms of their own.
        """
        base: dict[str, Any] = {"ndf": self.ndf, "masking": self.masking, "roughness": roughness}
        found = {}
        if self.dielectric is None or self.metal is None:
            found["both"] = term(**base, fresnel="schlick", fresnel_f0=np.array([DIELECTRIC, 1.0]), fresnel_f90=1.0)
        for name, spec in (("dielectric", self.dielectric), ("metal", self.metal)):
            if spec is not None:
                found[name] = term(**base, fresnel=spec)
        return found


@dataclass(frozen=True)
class Certified:
    """One pixel compared with the quadrature: its roughness, n·v, the variant, both values and the relative error."""

    roughness: float
    NoV: float
    of: str
    value: tuple[float, ...]
    exact: tuple[float, ...]
    error: float


@dataclass(frozen=True)
class Shown:
    """The pictures of an engine, of the truth and of their difference.

    engine, truth, difference  (h, w, 3), linear; the difference is (engine - truth) over the luminance of the truth,
                               and 0 outside the spheres
    samples, estimates         samples for each pixel and the estimated error of the truth, for each value of
                               `roughness`
    certificate                pixels that were compared with the quadrature
    seconds                    wall time by activity
    covered                    (h, w) bool, pixels that a sphere covers
    roughness                  of each column of a grid, or the distinct ones of a scene
    """

    engine: np.ndarray
    truth: np.ndarray
    difference: np.ndarray
    samples: tuple[int, ...]
    estimates: tuple[float, ...]
    certificate: tuple[Certified, ...]
    seconds: Mapping[str, float]
    covered: np.ndarray
    roughness: tuple[float, ...]

    @property
    def luminance(self) -> np.ndarray:
        """Difference of luminances, (h, w)."""
        return np.asarray(self.difference @ LUMINANCE)

    def within(self, share: float) -> float:
        """Return the relative difference that the share `share` of the spheres' pixels does not exceed."""
        return float(np.quantile(np.abs(self.luminance[self.covered]), share))

    @property
    def error(self) -> float:
        """The largest error of the certificate, NaN without one."""
        return max((c.error for c in self.certificate), default=math.nan)


@dataclass(frozen=True)
class Rendered(shading.Rendered):
    """A picture of three panels, with the errors and samples that are stated with it."""

    source: str = ""
    tolerance: float = TOLERANCE
    samples: tuple[int, ...] = ()
    estimates: tuple[float, ...] = ()
    certificate: tuple[Certified, ...] = ()
    error: float = math.nan
    median: float = math.nan
    most: float = math.nan
    multiscatter: bool = False
    scale: float = 0.0
    seconds: Mapping[str, float] = field(default_factory=dict)


# ---------------------------------------------------------------------------------------------- the truth of spheres


class Spheres:
    """The true radiance of points on spheres in one environment and under further lights."""

    def __init__(self, truth: Truth, material: Material, points: Points, lights: Sequence[Spec] = ()) -> None:
        self.truth, self.material, self.points = truth, material, points
        self.lights = tuple(chosen("light", spec) for spec in lights)
        self._diffuse: dict[Triple, np.ndarray] = {}
        self._diffuse_lit: dict[Triple, np.ndarray] = {}

    def alike(
        self,
        roughness: float,
        spheres: Sequence[MaterialSphere],
        tolerance: float,
    ) -> tuple[list[np.ndarray], list[np.ndarray], int, float, dict[str, Term]]:
        """Compute the true radiance of spheres of one roughness.

        Returns the radiance (m, 3) by the environment for each sphere, the radiance by the further lights for each, the
        samples per point, their estimated error, and the terms. tolerance: largest 99th percentile of the specular
        part's errors.
        """
        truth, points = self.truth, self.points
        found = self.material.terms(roughness)
        lost = self._lost(roughness)
        made, lit, counts, estimates = {}, {}, [0], [0.0]
        for name, one in found.items():
            count = 0
            if not one.smooth:
                count, estimate = truth.samples(one, points, tolerance)
                counts.append(count)
                estimates.append(estimate)
            made[name] = truth.reflected(one, points, count)
            lit[name] = self.lit(one) if self.lights else 0 * made[name][0]

        def of(what: str, F0: Any, values: Mapping[str, Any], albedo: bool = False) -> np.ndarray:
            """Return the values (m, 3) of the dielectric or the metal."""
            held = values[what if what in values else "both"]
            S = held[1] if albedo else held[0] if isinstance(held, tuple) else held
            S = np.broadcast_to(S[..., None], (*S.shape, 3)) if albedo else S
            if what in values:
                channel = np.arange(3) if S.shape[1] == 3 else np.zeros(3, int)
                F0 = truth.mirror(found[what], _facing())[1][0, channel]
                once = S[:, channel, np.arange(3)]
            else:
                once = S[:, 0] + (F0 - DIELECTRIC) / (1 - DIELECTRIC) * (S[:, 1] - S[:, 0])
            return np.asarray(once * (1 + F0 * lost[:, None]))

        pictures, extras = [], []
        for sphere in spheres:
            m, base = sphere.metalness, sphere.base_color
            color, F0 = np.asarray(base, np.float64), np.asarray(sphere.insulator, np.float64)
            rest = 1 - of("dielectric", F0, made, albedo=True)
            mixed = [(1 - m) * of("dielectric", F0, values) + m * of("metal", color, values) for values in (made, lit)]
            pictures.append(mixed[0] + (1 - m) * rest * self.diffuse(base))
            extras.append(mixed[1] + (1 - m) * rest * self.diffuse_lit(base))
        return pictures, extras, max(counts), max(estimates), found

    def _lost(self, roughness: float) -> np.ndarray:
        """Return 1/E₁ - 1, (m,); 0 where multiple scattering is not restored."""
        if not self.material.multiscatter or roughness == 0:
            return np.zeros(self.points.n.shape[1])
        one = term(ndf=self.material.ndf, masking=self.material.masking, roughness=roughness)
        return np.asarray(1 / albedo(one, self.points.NoV, self.truth.device)[:, 0] - 1)

    @cached_property
    def _lambert(self) -> np.ndarray:
        """E/π (m, 3) of the environment."""
        cube = irradiance(self.truth.env, size=IRRADIANCE, device=self.truth.device).values
        return bilinear(cube, self.points.n)

    def diffuse(self, base_color: Triple) -> np.ndarray:
        """Return the reflection (m, 3) of the environment by the diffuse model, with the base colour."""
        truth, points = self.truth, self.points
        if self.material.diffuse is None:
            return np.asarray(self._lambert * np.asarray(base_color, np.float64))
        if base_color not in self._diffuse:
            found = self._diffuse_term(base_color)
            count, _ = truth.samples(found, points, TOLERANCE / 4)
            self._diffuse[base_color] = truth.reflected(found, points, count)[0][:, np.arange(3), np.arange(3)]
        return self._diffuse[base_color]

    def _diffuse_term(self, base_color: Triple) -> Term:
        choice = chosen("diffuse", "lambert" if self.material.diffuse is None else self.material.diffuse)
        given: dict[str, Any] = {}
        if "albedo" not in choice.given:
            given["diffuse_albedo"] = np.asarray(base_color, np.float64)
        found = term(diffuse=choice, **given)
        return Term(found.models, {name: np.broadcast_to(v, (3,)) for name, v in found.parameters.items()})

    def diffuse_lit(self, base_color: Triple) -> np.ndarray:
        """Return the reflection (m, 3) of the further lights by the diffuse model, with the base colour."""
        if not self.lights:
            return np.zeros((self.points.n.shape[1], 3))
        if base_color not in self._diffuse_lit:
            values = self.lit(self._diffuse_term(base_color))
            self._diffuse_lit[base_color] = values[:, np.arange(3), np.arange(3)]
        return self._diffuse_lit[base_color]

    def lit(self, found: Term) -> np.ndarray:
        """Return the reflection (m, S, 3) of the further lights under a term, in closed form or along their
        outlines.
        """
        points, total = self.points, np.zeros((self.points.n.shape[1], found.sets, 3))
        own = {name: np.broadcast_to(v, (found.sets,)) for name, v in found.parameters.items()}
        models: dict[str, Any] = dict(found.models)
        if found.smooth:
            models, own = {"fresnel": models["fresnel"]}, {n: v for n, v in own.items() if n.startswith("fresnel_")}
        for light in self.lights:
            if found.smooth and "LIGHT_L" not in light.model.provides:
                continue  # a mirror shows nothing of a light that has no size
            for c in range(3):
                given = {name: v[c] if isinstance(v, tuple) else v for name, v in light.given.items()}
                placed = in_frame(light, given, points)
                numbers: dict[str, Any] = {**own, **{f"light_{name}": v[:, None] for name, v in placed.items()}}
                values = radiance(
                    light=Chosen(light.model, {}),
                    NoV=points.NoV[:, None],
                    phi=0.0,
                    tolerance=1e-4,
                    device=self.truth.device,
                    **models,
                    **numbers,
                ).values
                if not any(isinstance(v, tuple) for v in light.given.values()):
                    total += np.asarray(values, np.float64).reshape(total.shape[:2])[..., None]
                    break
                total[..., c] += np.asarray(values, np.float64).reshape(total.shape[:2])
        return total


def _facing() -> Points:
    """Return one point whose normal is the view direction."""
    up = np.array([[0.0], [0.0], [1.0]])
    return Points(up, up)


def in_frame(light: Chosen, given: Mapping[str, float], points: Points) -> dict[str, np.ndarray]:
    """Return a light's parameters, (m,) each, in the frame of every point, where n is +z and v has the azimuth 0.

    given: parameters in the frame of the sphere's middle, a surface that faces the viewer: +z towards the viewer, +x to
    the right, lengths in radii. NAME_x, NAME_y, NAME_z are a vector, and `center` is a place; NoL and phi_l are a
    direction. Raises UsageError for a parameter that is missing.
    """
    model, m = light.model, points.n.shape[1]
    values = {**{p.name: p.default for p in model.parameters if p.default is not None}, **given}
    for p in model.parameters:
        if p.name not in values:
            raise UsageError(f"light {model.name} needs {p.name}, {p.about}")
    surface = points.surface()
    x, z = surface[3:6], points.n
    frame = np.stack([x, np.cross(z, x, axis=0), z])  # (3, 3, m)
    placed = {name: np.full(m, float(value)) for name, value in values.items()}
    for name in [n[:-2] for n in values if n.endswith("_x")]:
        vector = np.array([values[f"{name}_{axis}"] for axis in "xyz"], np.float64)[:, None]
        vector = vector - points.n if name == "center" else np.broadcast_to(vector, (3, m))
        placed |= {f"{name}_{axis}": (row * vector).sum(0) for axis, row in zip("xyz", frame, strict=True)}
    if "NoL" in values and "phi_l" in values:
        c, phi = float(values["NoL"]), float(values["phi_l"])
        s = math.sqrt((1 - c) * (1 + c))
        to = (frame * np.array([s * math.cos(phi), s * math.sin(phi), c])[:, None]).sum(1)
        placed |= {"NoL": np.clip(to[2], -1.0, 1.0), "phi_l": np.arctan2(to[1], to[0])}
    return placed


# ---------------------------------------------------------------------------------------------- pictures


def source_of(manifest: str | os.PathLike[str], given: str | os.PathLike[str], device: Device) -> Environment:
    """Return the environment of a bake: rotated, exposed and without its sun as its manifest says.

    given: the image that the bake was made from. Raises InputError where the image's digest is not the one in the
    manifest, and the errors of `environment`.
    """
    written = shading.dictionary(read_manifest(Path(manifest)))
    recipe, source = shading.dictionary(written.get("recipe")), shading.dictionary(written.get("source"))
    stated: dict[str, float] = {}
    for name in ("rotate", "exposure"):
        value = recipe.get(name)
        if not isinstance(value, (int, float)):
            raise InputError(f"{manifest} does not state {name}: it is not the manifest of a bake")
        stated[name] = float(value)
    how = {name: recipe.get(name) for name in ("layout", "layer", "fill")}
    mode = recipe.get("bad_pixels", recipe.get("nonfinite", "refuse"))  # the name in older manifests
    found = read_environment(given, Reading(stated["rotate"], stated["exposure"], mode, **how), device=device)
    if found.digest != source.get("sha256"):
        raise InputError(
            f"{given} is not the image that {manifest} was baked from: its sha256 is {found.digest[:16]}…"
            f", the bake's is {str(source.get('sha256'))[:16]}…"
        )
    return without_sun(found, str(recipe.get("sun", "keep")))[0]


def ndf_of(manifest: str | os.PathLike[str]) -> Spec:
    """Return the NDF with which a bake was filtered. Raises UsageError for an NDF from a file."""
    ndf = shading.dictionary(shading.dictionary(read_manifest(Path(manifest))).get("recipe")).get("ndf", "ggx")
    if isinstance(ndf, str):
        return ndf
    entry = shading.dictionary(ndf)
    if "sha256" in entry or not isinstance(entry.get("name"), str):
        raise UsageError(f"{manifest} was filtered with an NDF from a file: give it as --ndf FILE.clh")
    given = {k: tuple(v) if isinstance(v, list) else v for k, v in entry.items() if k != "name"}
    return Chosen(chosen("ndf", entry["name"]).model, given)


def panels(
    engine: Engine,
    lights: Lights,
    env: Environment,
    device: Device,
    material: Material,
    layout: SphereLayout,
    *,
    size: int = 128,
    background: str = "environment",
    tolerance: float = TOLERANCE,
    certify: int = 1,
    further: Sequence[Spec] = (),
    progress: Callable[[str, float], None] | None = None,
) -> Shown:
    """Draw the spheres of `shading.drawn` as the engine shows them, as they truly look, and the difference.

    material: the reflection model of the truth; a roughness below MIRROR is a mirror in it. tolerance: largest 99th
    percentile of the specular part's errors for each roughness, relative to its value or 1e-3 of the mean radiance.
    certify: number of pixels of each roughness that are compared with the quadrature. further: lights that are added to
    both pictures. Raises the errors of `shading.drawn`.
    """
    begin = time.perf_counter()
    shown = shading.drawn(engine, lights, layout, size=size, background=background)
    clock = {"engine": time.perf_counter() - begin}
    index, cover, n = shading.sphere(size)
    points = Points(n, np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), n.shape))
    truth = Truth(device, env)
    spheres = Spheres(truth, material, points, further)
    groups: dict[float, list[int]] = {}
    for k, one in enumerate(layout.spheres):
        groups.setdefault(one.roughness if one.roughness >= MIRROR else 0.0, []).append(k)
    picture = np.full(shown.shape, shading.GREY)
    if background == "environment":
        picture = radiance_at(env, shading.camera(shown.shape)).reshape(shown.shape)
    difference, covered = np.zeros(shown.shape), np.zeros(shown.shape[:2], bool)
    mean, samples, estimates, certificate = float(np.mean(env.statistics["mean"])), [], [], []
    clock |= {"truth": 0.0, "certificate": 0.0}
    for j, (roughness, those) in enumerate(groups.items()):
        begin = time.perf_counter()
        true, extra, count, estimate, terms = spheres.alike(roughness, [layout.spheres[k] for k in those], tolerance)
        samples.append(count)
        estimates.append(estimate)
        for k, by_sky, by_lights in zip(those, true, extra, strict=True):
            one, (i, across) = layout.spheres[k], divmod(k, layout.columns)
            where = np.s_[i * size : (i + 1) * size, across * size : (across + 1) * size]
            lit = shading.shade(
                engine, lights, n, points.v, one.base_color, one.metalness, one.roughness, np.asarray(one.insulator)
            )
            whole = by_sky + by_lights
            apart = (lit - by_sky) / np.maximum(whole @ LUMINANCE, max(DARK * mean, 1e-30))[:, None]
            shown[where] += _over(np.zeros((size, size, 3)), index, cover, by_lights)
            picture[where] = _over(picture[where], index, cover, whole)
            difference[where] = _over(difference[where], index, (cover > 0.5).astype(float), apart)
            covered[where] = (
                _over(np.zeros((size, size, 1)), index, (cover > 0.5).astype(float), np.ones((len(index), 1)))[..., 0]
                > 0
            )
        clock["truth"] += time.perf_counter() - begin
        begin = time.perf_counter()
        certificate += _certificate(truth, terms, points, roughness, j * certify, certify, count, mean)
        clock["certificate"] += time.perf_counter() - begin
        if progress:
            progress("truth", (j + 1) / len(groups))
    return Shown(
        shown, picture, difference, tuple(samples), tuple(estimates), tuple(certificate), clock, covered, tuple(groups)
    )


def _over(cell: np.ndarray, index: np.ndarray, cover: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A cell (size, size, c) with values (m, c) over it."""
    flat = cell.reshape(-1, cell.shape[-1]).copy()
    flat[index] += (values - flat[index]) * cover[:, None]
    return flat.reshape(cell.shape)


def _certificate(
    truth: Truth,
    terms: Mapping[str, Term],
    points: Points,
    roughness: float,
    first: int,
    many: int,
    count: int,
    mean: float,
) -> list[Certified]:
    """Compare pixels with the quadrature, chosen by the golden ratio over the sphere, one variant after the other."""
    found = []
    variants = [(name, one, k) for name, one in terms.items() for k in range(one.sets)]
    for number in range(first, first + many):
        name, one, variant = variants[number % len(variants)]
        if one.smooth:
            continue  # both are the same texel
        k = int((0.5 + number * (math.sqrt(5) - 1) / 2) % 1 * points.n.shape[1])
        got = truth.reflected(one, points.some([k]), count)[0][0, variant]
        want = truth.exact(one, variant, points, k)
        of = f"{name} {variant + 1} of {one.sets}" if name != "both" else ("dielectric", "white metal")[variant]
        error = float(texel_errors(got[None], want[None], mean)[0])
        found.append(Certified(roughness, float(points.NoV[k]), of, tuple(got.tolist()), tuple(want.tolist()), error))
    return found


def scale_of(shown: Shown) -> float:
    """Return the difference at the ends of the colour scale: 1, 2 or 5 times a power of ten, at most 1.

    95 % of the spheres' pixels are within it.
    """
    most = shown.within(MOST)
    power = 10.0 ** math.floor(math.log10(max(most, 1e-6)))
    return min(next(k * power for k in (1, 2, 5, 10) if k * power >= most * (1 - 1e-9)), 1.0)


def render(
    manifest: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    for_: str,
    truth: str | os.PathLike[str],
    size: int = 128,
    columns: int = 7,
    rows: int | None = None,
    exposure: float = 0.0,
    base_color: Sequence[float] | None = None,
    background: str = "environment",
    scene: str | os.PathLike[str] | None = None,
    tolerance: float | None = None,
    certify: int = 1,
    ndf: Spec | None = None,
    dielectric: Spec | None = None,
    metal: Spec | None = None,
    diffuse: Spec | None = None,
    multiscatter: bool = False,
    light: Sequence[Spec] = (),
    device: Device | str | None = None,
    force: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Rendered:
    """Draw the spheres of a bake for one engine, their true look and the difference side by side.

    A PNG gets three panels with a scale. An EXR gets the layers engine, truth and difference in float32, without
    exposure. truth: the image that the bake was made from. The other parameters are those of `shading.render`, `panels`
    and `Material`; the NDF is the bake's own by default.

    Raises their errors, and UnsupportedError for a PNG without matplotlib.
    """
    output, bound = Path(output), TOLERANCE if tolerance is None else float(tolerance)
    _check(output, bound, certify, exposure, force)
    engine, folder, stem = shading.engine_in(manifest, for_)
    lights = shading.read_lights(engine, folder, stem)
    for name, spec in (("dielectric", dielectric), ("metal", metal)):
        if scene is not None and spec is not None:
            raise UsageError(f"{name} is of the grid: the materials of a scene have their own F0")
    spheres = layout_of(scene, columns, rows, base_color)
    material = Material(ndf_of(manifest) if ndf is None else ndf, "smith", dielectric, metal, diffuse, multiscatter)
    further = [chosen("light", spec) for spec in light]
    on = device if isinstance(device, Device) else choose_device(device)
    env = source_of(manifest, truth, on)
    shown = panels(
        engine,
        lights,
        env,
        on,
        material,
        spheres,
        size=size,
        background=background,
        tolerance=bound,
        certify=certify,
        further=further,
        progress=progress,
    )
    made = _rendered(output, exposure, bound, multiscatter, engine, lights, env, spheres, shown, lit=bool(further))
    _write(made, shown)
    return made


def _check(output: Path, tolerance: float, certify: int, exposure: float, force: bool) -> None:
    """Raise UsageError for numbers outside their ranges, and the errors of a picture that cannot be written."""
    if output.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{output} is not the name of a picture: it must end with {' or '.join(SUFFIXES)}")
    low, high = TOLERANCE_RANGE
    if not low <= tolerance <= high:
        raise UsageError(f"tolerance {tolerance:g} is outside [{low:g}, {high:g}]")
    if not 0 <= certify <= 1000:
        raise UsageError(f"certify {certify} is outside [0, 1000]")
    if not -shading.EXPOSURES <= exposure <= shading.EXPOSURES:
        raise UsageError(f"exposure {exposure:g} is outside [{-shading.EXPOSURES:g}, {shading.EXPOSURES:g}]")
    if output.exists() and not force:
        raise FileError(f"{output} exists; --force replaces it")
    if output.suffix.lower() == ".png":
        from whitefurnace import plot_style

        plot_style.require()


def _notices(shown: Shown, tolerance: float, lit: bool) -> list[str]:
    """Return notices for lights besides the environment (`lit`) and for a missed tolerance."""
    notices = []
    if lit:
        notices.append(
            "what lights besides the environment add is the same in both pictures: what differs is the environment's"
        )
    missed = [f"{r:.3g}" for r, e in zip(shown.roughness, shown.estimates, strict=True) if e > tolerance]
    if missed:
        notices.append(
            f"the tolerance of {tolerance:g} is missed at roughness {', '.join(missed)}: "
            f"{max(shown.estimates):.2g} after {max(shown.samples)} samples a pixel"
        )
    return notices


def _rendered(
    output: Path,
    exposure: float,
    tolerance: float,
    multiscatter: bool,
    engine: Engine,
    lights: Lights,
    env: Environment,
    spheres: SphereLayout,
    shown: Shown,
    *,
    lit: bool,
) -> Rendered:
    """Return the record of the pictures. lit: whether there are lights besides the environment."""
    return Rendered(
        output,
        engine.name,
        shown.engine.shape[1],
        shown.engine.shape[0],
        spheres.roughness,
        spheres.metalness,
        exposure,
        lights.read,
        (*lights.notices, *env.notices, *spheres.notices, *_notices(shown, tolerance, lit)),
        spheres.placed(),
        env.digest,
        tolerance,
        shown.samples,
        shown.estimates,
        shown.certificate,
        shown.error,
        shown.within(0.5),
        shown.within(MOST),
        multiscatter,
        scale_of(shown),
        shown.seconds,
    )


def _write(made: Rendered, shown: Shown) -> None:
    """Write the pictures as the layers of an EXR, or as the panels of a PNG."""
    if made.path.suffix.lower() == ".exr":
        layers = ("difference", "engine", "truth")  # the order in which readers list them
        write_exr(
            made.path,
            np.concatenate([getattr(shown, name) for name in layers], 2).astype(np.float32),
            channel_names=tuple(f"{name}.{c}" for name in layers for c in "RGB"),
            attributes=_stated(made),
        )
    else:
        from whitefurnace.rendering.figures import draw_side_by_side

        draw_side_by_side(
            made.path,
            [shading.srgb(p * 2.0**made.exposure) for p in (shown.engine, shown.truth)],
            np.where(shown.covered, shown.luminance, np.nan),
            made.scale,
            made.engine,
            _caption(made),
            {key: str(value) for key, value in _stated(made).items()},
        )


def _stated(made: Rendered) -> dict[str, str | float | int]:
    """Values that are stored with the picture."""
    return {
        "engine": made.engine,
        "source": made.source,
        "tolerance": made.tolerance,
        "error": made.error,
        "certified": len(made.certificate),
        "samples": " ".join(map(str, made.samples)),
        "difference_median": made.median,
        "difference_95": made.most,
        "difference_scale": made.scale,
        "scattering": "multiple" if made.multiscatter else "single",
        **(
            {"materials": "; ".join(f"{one['name']} ({one['row']}, {one['column']})" for one in made.materials)}
            if made.materials
            else {}
        ),
    }


def _caption(made: Rendered) -> tuple[str, ...]:
    across = f"roughness {made.roughness[0]:g} to {made.roughness[-1]:g} across" if len(made.roughness) > 1 else ""
    down = f"metalness {made.metalness[0]:g} to {made.metalness[-1]:g} down" if len(made.metalness) > 1 else "metal"
    if made.materials:
        across, down = f"{len(made.materials)} materials of a scene, row by row", ""
    scattering = f"truth: facets scatter {'again, by scale' if made.multiscatter else 'once'}"
    held = f", within {made.error:.1e} at {len(made.certificate)} pixels of a quadrature" if made.certificate else ""
    return (
        ", ".join(filter(None, (across, down))),
        f"difference: {100 * made.median:.3g} % or less at half of the pixels, {100 * made.most:.3g} % at 95 of 100",
        scattering + held,
    )
