"""Text for terminals and pages: aligned tables and sizes in bytes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Set `rows` below `head` in aligned columns, indented by two spaces.

    The first `left` columns are aligned to the left, the others to the right. Every row has as many cells as `head`.
    """
    cells = [list(head), *[list(row) for row in rows]]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    lines = []
    for row in cells:
        parts = [c.ljust(w) if k < left else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append("  " + "  ".join(parts).rstrip())
    return "\n".join(lines)


def printable(text: str) -> str:
    """Return a text on one line of valid Unicode: line breaks, controls and bytes that are not UTF-8 are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shortened(text: str, most: int = 400) -> str:
    """Return a text on one line with its middle left out where it has more than `most` characters."""
    text = printable(text)
    return text if len(text) <= most else f"{text[: most // 2]} … {text[-most // 3 :]}"


def size(nbytes: float) -> str:
    """A number of bytes as text with three digits and a decimal unit: 12 B, 3.4 KB, 56.7 MB, 8.9 GB."""
    for unit in ("B", "KB", "MB"):
        if nbytes < 1000:
            return f"{nbytes:.0f} {unit}" if unit == "B" else f"{nbytes:.3g} {unit}"
        nbytes /= 1000
    return f"{nbytes:.3g} GB"
