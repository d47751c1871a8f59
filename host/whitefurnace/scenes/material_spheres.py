"""Lays out the spheres of a picture: roughness across and metalness down, or the materials of a scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from whitefurnace.errors import InputError, UsageError
from whitefurnace.scenes.materials import Material, Scene, Spread, read_scene

DIELECTRIC = 0.04
"""F0 of the insulating part for an index of refraction of 1.5, in every engine here."""

COUNT_RANGE = (1, 64)
"""Range of the number of columns, and of rows."""

MOST = 64
"""Largest number of a scene's materials in one picture."""

EVEN = 1 / 128
"""Two steps of 8 bits. A texture that varies by no more counts as one value."""

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class MaterialSphere:
    """The material of one sphere: base colour, metalness and perceptual roughness in [0, 1], and F0 of the insulating
    part, a number or RGB."""

    base_color: Triple
    metalness: float
    roughness: float
    insulator: float | Triple = DIELECTRIC
    name: str = ""


@dataclass(frozen=True)
class SphereLayout:
    """Spheres row by row, `columns` to a row; the last row may have fewer.

    roughness  perceptual roughness of the columns of a grid; `metalness` of its rows; both empty for a scene
    notices    sentences about parts of the materials that the spheres leave out
    scene      path of the scene, "" for a grid
    """

    spheres: tuple[MaterialSphere, ...]
    columns: int
    roughness: tuple[float, ...] = ()
    metalness: tuple[float, ...] = ()
    notices: tuple[str, ...] = ()
    scene: str = ""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return -(-len(self.spheres) // self.columns)

    def placed(self) -> tuple[dict[str, object], ...]:
        """Each material of a scene with its name, its row and column from 1, and the values of its sphere."""
        return (
            tuple(
                {
                    "name": s.name,
                    "row": k // self.columns + 1,
                    "column": k % self.columns + 1,
                    "base_color": s.base_color,
                    "metalness": s.metalness,
                    "roughness": s.roughness,
                    "f0": s.insulator,
                }
                for k, s in enumerate(self.spheres)
            )
            if self.scene
            else ()
        )


def steps(count: int, alone: float) -> tuple[float, ...]:
    """Return `count` values from 0 to 1 in equal steps, or `alone` where `count` is 1."""
    return tuple(float(x) for x in np.linspace(0, 1, count)) if count > 1 else (alone,)


def in_range(what: str, value: int, limits: tuple[int, int] = COUNT_RANGE) -> None:
    """Check that a number is within its limits. Raises UsageError."""
    if not limits[0] <= value <= limits[1]:
        raise UsageError(f"{what} {value} is outside [{limits[0]}, {limits[1]}]")


def of_grid(columns: int = 7, rows: int = 3, base_color: Sequence[float] = (1.0, 1.0, 1.0)) -> SphereLayout:
    """Return a grid of spheres: roughness 0 to 1 from left to right, metalness 0 to 1 from the top down.

    columns, rows: numbers of spheres. With one column the roughness is 0; with one row the metalness is 1. Raises
    UsageError for values out of range.
    """
    in_range("columns", columns)
    in_range("rows", rows)
    color = np.asarray(base_color, np.float64)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise UsageError(f"base color {' '.join(f'{c:g}' for c in color.ravel())} is not three numbers in [0, 1]")
    across, down = steps(columns, 0.0), steps(rows, 1.0)
    spheres = tuple(MaterialSphere(_triple(color), m, r) for m in down for r in across)
    return SphereLayout(spheres, columns, across, down)


def of_scene(scene: Scene, columns: int = 7) -> SphereLayout:
    """Return a sphere for each lit material of a scene, in the order of the file, at most MOST of them.

    Raises UsageError for columns out of range, and InputError for a scene in which every material is unlit.
    """
    in_range("columns", columns)
    lit = [m for m in scene.materials if not m.unlit]
    if not lit:
        raise InputError(f"{scene.path} has no materials that light falls on: there is nothing to draw")
    notices = []
    if len(lit) > MOST:
        # Areas are not known, so materials with the most primitives are kept, earlier ones of the file first.
        kept = sorted(sorted(range(len(lit)), key=lambda k: (-lit[k].uses, k))[:MOST])
        notices.append(
            f"{scene.path} has {len(lit)} materials that light falls on: drawn are the {MOST} that most of "
            "its primitives have, their surface is not known"
        )
        lit = [lit[k] for k in kept]
    unlit = [m.name for m in scene.materials if m.unlit]
    if unlit:
        notices.append(f"{_some(unlit)}: unlit, no sphere is drawn of it")
    made = tuple(
        MaterialSphere(
            _triple(np.clip(middle(m["base_color"]) * m.diffuse_share(insulator(m)), 0, 1)),
            float(middle(m["metalness"])[0]),
            float(middle(m["roughness"])[0]),
            insulator(m),
            m.name,
        )
        for m in lit
    )
    return SphereLayout(made, min(columns, len(made)), notices=(*notices, *_left_out(lit)), scene=str(scene.path))


def layout_of(
    scene: str | os.PathLike[str] | None, columns: int, rows: int | None, base_color: Sequence[float] | None
) -> SphereLayout:
    """Return the spheres of a scene's materials, or of a grid where no scene is given.

    Raises UsageError for rows or a base colour together with a scene, and the errors of `of_grid`, `of_scene` and
    `read_scene`.
    """
    if scene is None:
        return of_grid(columns, 3 if rows is None else rows, (1.0, 1.0, 1.0) if base_color is None else base_color)
    if rows is not None:
        raise UsageError("rows are of the grid: a scene has as many as its materials take")
    if base_color is not None:
        raise UsageError("base color is of the grid: the materials of a scene have their own")
    in_range("columns", columns)
    return of_scene(read_scene(scene), columns)


def middle(spread: Spread) -> np.ndarray:
    """Return the mean of a property over the texels in use, (channels,); the middle of its range where no mean is
    known.
    """
    return np.array(spread.mean) if spread.mean else (np.array(spread.low) + np.array(spread.high)) / 2


def insulator(m: Material) -> Triple:
    """Return F0 of the insulating part by KHR_materials_ior and KHR_materials_specular: min(((n - 1)/(n + 1))² c, 1) w.

    An ior of 0 stands for infinity. Without either extension it is the engines' .04.
    """
    ior, weight, tint = middle(m["ior"])[0], middle(m["specular"])[0], middle(m["specular_color"])
    f0 = DIELECTRIC if ior == 1.5 else 1.0 if ior == 0 else ((ior - 1) / (ior + 1)) ** 2
    return _triple(np.minimum(f0 * tint, 1) * weight)


# Properties of a material that a sphere does not show: name, test for it, and what is drawn instead.
_KINDS: tuple[tuple[str, Callable[[Material], bool], str], ...] = (
    ("clear coat", lambda m: m["clearcoat"].most > 0, "the surface under it is drawn"),
    ("sheen", lambda m: m["sheen_color"].most > 0, "the layer under it is drawn, unscaled"),
    ("transmission", lambda m: m["transmission"].most > 0, "the sphere is opaque, its base colour diffuse"),
    ("diffuse transmission", lambda m: m["diffuse_transmission"].most > 0, "all diffuse light is reflected"),
    ("volume", lambda m: m["transmission"].most > 0 and m["thickness"].most > 0, "nothing is refracted or absorbed"),
    ("anisotropy", lambda m: m["anisotropy"].most > 0, "the highlight is round"),
    ("iridescence", lambda m: m["iridescence"].most > 0, "Fresnel's term is that without the film"),
    (
        "light of its own",
        lambda m: m["emission"].most * m["emissive_strength"].most > 0,
        "only what is reflected is drawn",
    ),
    ("a specular factor below 1", lambda m: m["specular"].least < 1, "F0 is scaled, F90 stays 1"),
)

_TEXTURED = ("base_color", "metalness", "roughness", "ior", "specular", "specular_color")


def _left_out(lit: Sequence[Material]) -> list[str]:
    found = []

    def add(who: Sequence[Material], what: str) -> None:
        if who:
            found.append(f"{_some([m.name for m in who])}: {what}")

    read = [m for m in lit if all(m[name].mean for name in _TEXTURED)]
    add(
        [
            m
            for m in read
            if any(b - a > EVEN for name in _TEXTURED for a, b in zip(m[name].low, m[name].high, strict=True))
        ],
        "textures vary, the sphere has the mean of the parts in use",
    )
    add([m for m in lit if m not in read], "textures that are not read, the sphere has the middle of their range")
    for what, has, instead in _KINDS:
        add([m for m in lit if has(m)], f"{what} is left out, {instead}")
    for name in sorted({name for m in lit for name in m.unread}):
        add([m for m in lit if name in m.unread], f"{name[:60]} is not read, what it falls back to is drawn")
    return found


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


def _triple(values: np.ndarray) -> Triple:
    x, y, z = map(float, values)
    return x, y, z
