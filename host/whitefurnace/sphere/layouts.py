"""Layouts: where an image has the directions of a lat-long or the faces of a cube.

They are known by its size, by what its file states, or by name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError, UsageError, nearest
from whitefurnace.sphere.solid_angles import cube_solid_angles, latlong_solid_angles

FACES = ("+X", "-X", "+Y", "-Y", "+Z", "-Z")


class Cell(NamedTuple):
    """The place of a face in an image.

    turns     quarter turns counter-clockwise that bring the face upright
    mirrored  True if left and right are exchanged first
    """

    column: int
    row: int
    turns: int = 0
    mirrored: bool = False


class Layout(NamedTuple):
    """A placement of faces in an image, known by its aspect ratio `columns` : `rows`.

    cells: those of the faces +X -X +Y -Y +Z -Z; none for a lat-long.
    """

    name: str
    columns: int
    rows: int
    cells: tuple[Cell, ...] = ()

    def size(self, height: int, width: int) -> int:
        """Return the edge of a face in an image, in texels.

        In an image that is a few pixels off, those at its right and lower end are the ones too many or missing.
        """
        across, down = self.steps(height, width)
        return min(across, down, width - (self.columns - 1) * across, height - (self.rows - 1) * down)

    def steps(self, height: int, width: int) -> tuple[int, int]:
        """Return the pixels from one cell to the next across and down."""
        return round(width / self.columns), round(height / self.rows)


# Faces are seen from inside, upright as in GL-direct, and cross faces join at the edges they share on the
# sphere: +Z is in the middle with +Y above it. In a vertical cross -Z hangs below -Y, upside down.
LAYOUTS = (
    Layout("latlong", 2, 1),
    Layout("horizontal cross", 4, 3, (Cell(2, 1), Cell(0, 1), Cell(1, 0), Cell(1, 2), Cell(1, 1), Cell(3, 1))),
    Layout("vertical cross", 3, 4, (Cell(2, 1), Cell(0, 1), Cell(1, 0), Cell(1, 2), Cell(1, 1), Cell(1, 3, 2))),
    Layout("horizontal strip", 6, 1, tuple(Cell(face, 0) for face in range(6))),
    Layout("vertical strip", 1, 6, tuple(Cell(0, face) for face in range(6))),
)
"""The layouts that an aspect ratio tells apart."""

# OpenEXR's environment cubes (ImfEnvmap.h): its faces +X -X +Y -Y +Z -Z from the top. Its +Z is the middle of its
# lat-longs, and +X lies a quarter to the left of it. In ours +X is in the middle, so that OpenEXR's (x, y, z) is our
# (z, y, -x), and a lat-long and the cube that OpenEXR's exrenvmap makes of it are one environment. Its faces are
# mirrored against GL-direct.
OPENEXR_CUBE = Layout(
    "openexr cube",
    1,
    6,
    (
        Cell(0, 4, 0, True),
        Cell(0, 5, 0, True),
        Cell(0, 2, 3, True),
        Cell(0, 3, 1, True),
        Cell(0, 1, 0, True),
        Cell(0, 0, 0, True),
    ),
)

SIX_FACES = "faces"
"""The choice for six images, a face each."""

_KNOWN = {layout.name.replace(" ", "-"): (layout,) for layout in (*LAYOUTS, OPENEXR_CUBE)}
CHOICES: dict[str, tuple[Layout, ...]] = {
    **_KNOWN,
    "cross": (*_KNOWN["horizontal-cross"], *_KNOWN["vertical-cross"]),
    "strip": (*_KNOWN["horizontal-strip"], *_KNOWN["vertical-strip"]),
    "row": _KNOWN["horizontal-strip"],
    "column": _KNOWN["vertical-strip"],
    SIX_FACES: (),
}
"""The names that a caller may give; of several layouts the image's orientation chooses."""


def check_layout(layout: object) -> None:
    """Raise `UsageError` for a layout that is neither None nor a name of `CHOICES`."""
    if layout is not None and (not isinstance(layout, str) or layout.replace(" ", "-") not in CHOICES):
        raise UsageError(f"layout {layout!r} is not known{nearest(str(layout), CHOICES)}")


def layout_of(
    shape: tuple[int, ...],
    where: str,
    notices: list[str],
    *,
    asked: str | None = None,
    stated: str | None = None,
    aspect: float = 1.0,
) -> Layout:
    """Return the layout of an image (h, w, …): the one that is asked for, else that its file states, else by its size.

    where: the image's name in messages. notices: sentences are added about a layout that is not by size.
    asked: a name of `CHOICES`. stated: name of the layout in the file. aspect: width of a pixel over its height in the
    file. Raises `InputError` for a size that the layout cannot have, or that no layout has.
    """
    height, width = shape[:2]
    square = abs(aspect - 1) <= 1e-3  # not so for NaN; the rounding of ratios in files is smaller
    if not square and (asked is not None or stated is not None):
        notices.append(f"{where}: states a pixel aspect ratio of {aspect:g}, which a layout does not need")
    if asked is not None:
        layout = _asked(height, width, where, asked.replace(" ", "-"), notices)
        if stated not in (None, layout.name):
            notices.append(f"{where}: its envmap attribute says {stated}, and --layout overrules it")
        return layout
    if stated is not None:
        layout = next(layout for layout in (*LAYOUTS, OPENEXR_CUBE) if layout.name == stated)
        constant = height == width == 1 and not layout.cells
        if width * layout.rows != height * layout.columns and not constant:
            raise InputError(
                f"{where} states the layout {stated} (envmap), whose aspect ratio is {layout.columns}:{layout.rows}, "
                f"but it is {width} x {height}; --layout overrules what it states"
            )
        how = "with OpenEXR's order and axes of its six faces" if layout.cells else "with +X in its middle"
        notices.append(f"{where}: read as {stated}, as its envmap attribute says, {how}")
        return layout
    if not square:
        raise InputError(
            f"{where} states a pixel aspect ratio of {aspect:g}, pixels of environments are square; --layout NAME "
            "reads it all the same"
        )
    return _guessed(height, width, where)


def _guessed(height: int, width: int, where: str) -> Layout:
    if height == width == 1:
        return LAYOUTS[0]
    for layout in LAYOUTS:
        if width * layout.rows == height * layout.columns:
            return layout
    known = ", ".join(f"{layout.name} {layout.columns}:{layout.rows}" for layout in LAYOUTS)
    raise InputError(
        f"{where} is {width} x {height}, an aspect ratio of {width / height:.4g} that no layout has "
        f"({known}, or a single pixel); --layout NAME reads it as one of them"
    )


def _asked(height: int, width: int, where: str, asked: str, notices: list[str]) -> Layout:
    if asked == SIX_FACES:
        raise InputError(f"{where} is one image, --layout faces is of a folder with six or of one of its files")
    of = CHOICES[asked]
    # Of two, the one with the image's orientation, which is the first where it is wider than high.
    layout = of[0] if len(of) == 1 or width > height else of[1]
    across, down = width / layout.columns, height / layout.rows
    if not layout.cells:
        if across != down:
            notices.append(f"{where}: its {width} x {height} pixels were read as latlong, as --layout says")
        return layout
    if layout.size(height, width) < 1 or abs(across - down) > 1:
        raise InputError(
            f"{where} is {width} x {height}: as {layout.name} its faces would have {across:.5g} x {down:.5g} texels, "
            "which may differ by 1 at most"
        )
    if across != down:
        n = layout.size(height, width)
        notices.append(f"{where}: its {width} x {height} pixels were read as {layout.name} with faces of {n} x {n}")
    return layout


def cells_of(layout: Layout, height: int, width: int) -> Iterator[tuple[slice, slice, Cell]]:
    """Yield the rows and columns of each face +X -X +Y -Y +Z -Z in an image, and its cell."""
    n = layout.size(height, width)
    across, down = layout.steps(height, width)
    for cell in layout.cells:
        left, top = cell.column * across, cell.row * down
        yield slice(top, top + n), slice(left, left + n), cell


def placed(pixels: npt.NDArray[np.float32], layout: Layout) -> npt.NDArray[np.float32]:
    """Return the faces (6, n, n, c), GL-direct, of an image (h, w, c); a lat-long as it is."""
    if not layout.cells:
        return pixels
    height, width, _ = pixels.shape
    faces = []
    for rows, columns, cell in cells_of(layout, height, width):
        face = pixels[rows, columns]
        faces.append(np.rot90(face[:, ::-1] if cell.mirrored else face, cell.turns))
    return np.stack(faces)


def faces_of(
    pixels: npt.NDArray[np.float32], *, asked: str | None = None, stated: str | None = None
) -> tuple[str, npt.NDArray[np.float32]] | None:
    """Return the name of the layout that an image (h, w, c) has, and its texels.

    Those of a lat-long are as they are, others become faces (6, n, n, c), GL-direct. asked, stated: as for `layout_of`.
    None where no layout has the size. Raises `InputError` where the size does not fit the layout asked for.
    """
    try:
        layout = layout_of(pixels.shape, "the image", [], asked=asked, stated=stated)
    except InputError:
        if asked is not None:
            raise
        return None
    return layout.name, placed(pixels, layout)


def solid_angles_in(layout: Layout | None, height: int, width: int) -> npt.NDArray[np.float64]:
    """Return the solid angles of an image's pixels, which broadcast to (1 or 6, h, w, c); 0 where no face lies.

    layout: None for six images, a face each.
    """
    if layout is None:
        return cube_solid_angles(height)[None, :, :, None]
    if not layout.cells:
        return latlong_solid_angles(height, width)[None, :, None, None]
    found = np.zeros((1, height, width, 1))
    for rows, columns, _ in cells_of(layout, height, width):
        # The same whichever way the face lies.
        found[0, rows, columns, 0] = cube_solid_angles(layout.size(height, width))
    return found
