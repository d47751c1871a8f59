"""Values that radiance cannot have: not finite or negative. They are refused, or set to values that it can have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from whitefurnace.errors import InputError, UsageError
from whitefurnace.sphere.layouts import FACES, Layout, solid_angles_in

MODES = ("refuse", "zero", "clamp")
NEGLIGIBLE = 2e-5
"""Share of the energy that negative values may have and still become 0 by default.

Setting them to 0 changes the mean radiance by this share at most. It is the tolerance of `--quality reference`, so that
no bake of a named quality can tell. Lossy compression (DWA) and resampling leave 1e-11 to 1e-6 in published HDRIs.
"""

_CHANNELS = "RGBA"
_BLOCK = 1 << 20
_FLOAT_MAX = float(np.finfo(np.float32).max)


def check_bad_pixels(bad_pixels: object, nonfinite: object = None) -> str:
    """Return the mode of two options, of which `nonfinite` is the older name. Raises `UsageError`."""
    name, value = ("bad_pixels", bad_pixels) if nonfinite is None else ("nonfinite", nonfinite)
    if not isinstance(value, str) or value not in MODES:
        raise UsageError(f"{name} is {value!r}, 'refuse', 'zero' or 'clamp' was expected")
    if nonfinite is not None and bad_pixels not in ("refuse", nonfinite):
        raise UsageError(
            f"bad_pixels is {bad_pixels!r} and nonfinite, its older name, is {nonfinite!r}; give bad_pixels alone"
        )
    return value


def clean(
    faces: npt.NDArray[np.float32],
    layout: Layout | None,
    where: str,
    mode: str,
    notices: list[str],
    *,
    largest: float = _FLOAT_MAX,
    each: Sequence[str] = (),
) -> None:
    """Refuse values that radiance cannot have in `faces` (1 or 6, h, w, c), or set them in place.

    What no face of the layout covers does not count. layout: None for six faces. where: name of the source; each: names
    of six images. mode: "refuse", "zero" (all become 0) or "clamp" (+inf becomes `largest`, others become 0). Negative
    values of negligible energy become 0 in every mode. Raises `InputError`.
    """
    if faces.min() >= 0 and faces.max() <= _FLOAT_MAX:  # false where there is a NaN
        return
    _, height, width, _ = faces.shape
    angles = solid_angles_in(layout, height, width)
    bad = ~np.isfinite(faces) & (angles > 0)
    if bad.any():
        if mode == "refuse":
            raise InputError(
                f"{_first(faces, bad, where, each, 'not finite')}; radiance must be finite: --bad-pixels clamp "
                f"sets +inf to {largest:.6g}, the largest value of these pixels, and others to 0, --bad-pixels zero "
                "sets all to 0"
            )
        infinite = bad & (faces == np.inf) if mode == "clamp" else np.zeros_like(bad)
        faces[infinite] = largest
        faces[bad & ~infinite] = 0
        count = int(np.count_nonzero(infinite))
        if count:
            # Sums of such floats leave float32, so that no level can meet a tolerance.
            hint = "; give --exposure -20 too, or --sun clamp=N" if largest > 1e30 else ""
            notices.append(f"{where}: {_many(count, '+inf')} set to {largest:.6g}, the largest of its pixels{hint}")
        if rest := int(np.count_nonzero(bad)) - count:
            notices.append(f"{where}: {_many(rest, 'not finite')} set to 0")
    bad = (faces < 0) & (angles > 0)
    if bad.any():
        share = _share(faces, bad, angles)
        if mode == "refuse" and share > NEGLIGIBLE:
            raise InputError(
                f"{_first(faces, bad, where, each, 'negative')}, with {share:.2g} of the energy; radiance must be "
                f"at least 0: --bad-pixels zero or clamp has them set to 0 (by default up to {NEGLIGIBLE:g} of the "
                "energy)"
            )
        count, least = int(np.count_nonzero(bad)), float(faces[bad].min())
        faces[bad] = 0
        notices.append(
            f"{where}: {_many(count, 'negative')} clamped to 0 (least {least:.3g}, {share:.2g} of the energy)"
        )


def _share(faces: npt.NDArray[np.float32], bad: npt.NDArray[np.bool_], angles: npt.NDArray[np.float64]) -> float:
    """The energy of negative values over that of the others, of radiance or of coverage, where it is larger."""
    taken, kept = np.zeros(2), np.zeros(2)
    step = max(1, _BLOCK // faces.shape[2])
    for y in range(0, faces.shape[1], step):  # a block of rows at a time: all of an image in float64 is large
        rows = slice(y, y + step)
        some = angles if angles.shape[1] == 1 else angles[:, rows]
        for k, part in enumerate((slice(0, 3), slice(3, 4))):
            values, wrong = faces[:, rows, :, part], bad[:, rows, :, part]
            with np.errstate(invalid="ignore"):  # values that no face covers may be infinite, and their angle is 0
                energy = values * some
            taken[k] -= float(energy[wrong].sum())
            kept[k] += float(energy[(values > 0) & (some > 0)].sum())
    return max(float(t / k) if k > 0 else np.inf for t, k in zip(taken, kept, strict=True) if t > 0)


def _many(count: int, what: str) -> str:
    return f"{count} {what} value{' was' if count == 1 else 's were'}"


def _first(
    faces: npt.NDArray[np.float32], bad: npt.NDArray[np.bool_], where: str, each: Sequence[str], what: str
) -> str:
    """The start of a sentence about the first bad value."""
    count = int(np.count_nonzero(bad))
    face, y, x, channel = (int(i) for i in np.unravel_index(int(bad.argmax()), bad.shape))
    place = f"pixel ({x}, {y})" + (f" of face {FACES[face]}" if len(faces) == 6 and not each else "")
    colour = "grey" if faces.shape[-1] == 1 else _CHANNELS[channel]
    many = "the only value that is" if count == 1 else f"the first of {count} values that are"
    value = faces[face, y, x, channel]
    return f"{each[face] if each else where} holds {value} in channel {colour} of {place}, {many} {what}"
