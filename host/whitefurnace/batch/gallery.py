"""Writes the results of a batch as an HTML page: a row for each environment, with thumbnails and the stated errors.

The page opens from disk, loads nothing from a network, and has the same bytes for the same results.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import html
import importlib.resources
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

from whitefurnace.baking.bake import format_notices
from whitefurnace.batch.jobs import Result
from whitefurnace.errors import FileError, WhitefurnaceError
from whitefurnace.files import head_of, open_input, read_manifest, write_atomic
from whitefurnace.rendering.thumbnails import CELL, LOOK, read_thumbnail, write_thumbnail
from whitefurnace.text import size as bytes_text

INDEX, THUMBNAILS = "index.html", "strips"
OURS = b'<meta name="generator" content="whitefurnace">'
MANY = 500
"""Number of rows above which a browser lays out only the visible ones."""

NO_TEXT = re.compile("[\0-\x1f\x7f-\x9f\ufdd0-\ufdef\ufffe\uffff]")
"""Controls and noncharacters, which an HTML page must not contain [HTML, 13.2.3.5]."""

FEW = 8
"""Number of environments above which a page has a search field."""

MOST_LISTED = 20
"""Largest number of notices of an item on a page."""

MOST_TEXT = 600
"""Largest number of characters of a name or a notice on a page."""

BAKES = (
    ("Environment", "text"),
    ("Largest error", ""),
    ("As stored", ""),
    ("Time", ""),
    ("Size", ""),
    ("Sun share", ""),
    ("Energy kept", ""),
    ("Notices", ""),
)
ABOUT = {
    "Environment": "name, source and levels",
    "Largest error": "the largest error that a level or the irradiance states; below it the worst texel seen",
    "As stored": "error of the worst level and what its pixel format adds (99th percentile), by engine",
    "Time": "seconds of reading, computing and writing in this run",
    "Size": "bytes of all files",
    "Sun share": "what the brightest texels hold of all energy",
    "Energy kept": "of the level that is furthest from 100 %",
    "Notices": "what was said of it",
}
TABLES = (("Table", "text"), ("Error", ""), ("Time", ""), ("Size", ""), ("Notices", ""))
FAILED = (("Item", "text"), ("Reason", "text"), ("Exit code", ""))


def write_gallery(
    folder: str | os.PathLike[str], results: Iterable[Result], *, title: str = "Bakes", force: bool = False
) -> Path:
    """Write the page of `results`, FOLDER/index.html, with pictures in FOLDER/strips; return its path.

    Raises FileError for a file that cannot be read or written, and, without `force`, for an index.html that this tool
    did not write.
    """
    with Gallery(folder, title=title, force=force) as gallery:
        for result in results:
            gallery.add(result)
        return gallery.close()


def found_in(output: str | os.PathLike[str]) -> Iterator[Result]:
    """Yield a result for each manifest in a folder of outputs and in the folders below it, in the order of paths."""
    output = Path(output)
    for path in sorted(output.rglob("*.json")):
        stated = None if path.name.startswith(".") else read_manifest(path)
        if stated is None or not isinstance(stated.get("key"), str):
            continue
        name, place = path.name.removesuffix(".json"), path.relative_to(output).as_posix()
        if stated.get("name") == name:
            kind = "bake" if isinstance(stated.get("levels"), list) else "lut"
            yield Result(
                0,
                kind,
                place,
                name,
                "skipped",
                str(path.parent if kind == "bake" else path.with_name(name)),
                str(path),
                nbytes=_size_of(stated),
            )


class Gallery:
    """A page that is written while a batch runs.

    Rows are added as items end, in any order. They are kept on disk, so that memory does not grow.
    """

    def __init__(self, folder: str | os.PathLike[str], *, title: str, force: bool = False) -> None:
        self.folder = Path(folder)
        self.title = title
        self._rows: dict[str, list[tuple[int, int, int, int]]] = {"failed": [], "bake": [], "lut": []}
        self._thumbnails: set[str] = set()
        self._states = dict.fromkeys(("done", "skipped", "failed"), 0)
        self._nbytes, self._seconds, self._made = 0, 0.0, 0.0
        self._error: tuple[float, str] | None = None
        self._devices: set[str] = set()
        self._versions: set[str] = set()
        self._wrong: WhitefurnaceError | None = None
        self._spool: IO[bytes] = _checked(self.folder, force)

    def __enter__(self) -> Gallery:
        return self

    def __exit__(self, *_: object) -> None:
        self._spool.close()

    def add(self, result: Result) -> None:
        """Add the row of an item; planned items have none.

        An error is kept for `close` to raise, so that the batch goes on.
        """
        if result.state not in self._states:
            return
        self._states[result.state] += 1
        kind = "failed" if result.state == "failed" else result.kind
        try:
            row = self._failed(result) if kind == "failed" else self._row(result)
            data = row.encode()
            at = self._spool.tell()
            self._spool.write(data)
        except (WhitefurnaceError, OSError) as error:
            self._wrong = self._wrong or _file_error(error, self.folder)
            return
        self._rows[kind].append((result.index, len(self._rows[kind]), at, len(data)))

    def close(self, *, total: int | None = None) -> Path:
        """Write the page, and remove pictures that it does not show; return its path.

        total: number of items of the batch. If not all of them have ended, no picture is removed. Raises FileError.
        """
        count = sum(self._states.values())
        path = self.folder / INDEX
        begin, end = self._page(count if total is None else total)

        def write(temporary: Path) -> None:
            with open(temporary, "wb") as file:
                file.write(begin.encode())
                for kind, head in (("failed", FAILED), ("bake", BAKES), ("lut", TABLES)):
                    if self._rows[kind] or (kind == "bake" and not count):
                        file.write(_table_head(kind, head, len(self._rows[kind])).encode())
                        for _, _, at, length in sorted(self._rows[kind]):
                            self._spool.seek(at)
                            file.write(self._spool.read(length))
                        file.write(b"</tbody>\n</table>\n</section>\n")
                file.write(end.encode())

        write_atomic(path, write)
        if self._wrong is not None:
            raise self._wrong
        if total is None or total == count:
            self._sweep()
        return path

    def _sweep(self) -> None:
        with contextlib.suppress(OSError):  # the folder does not exist
            for entry in os.scandir(self.folder / THUMBNAILS):
                if re.fullmatch(r"\.?[0-9a-f]{32}-\d+\.png(\.tmp)?", entry.name) and entry.name not in self._thumbnails:
                    os.unlink(entry.path)

    # --------------------------------------------------------------------------------------------- rows

    def _failed(self, result: Result) -> str:
        return (
            f'<tr><th scope="row"><bdi>{_text(result.place)}</bdi></th><td><bdi>{_text(result.message)}</bdi></td>'
            f'<td data-v="{result.exit_code}">{result.exit_code}</td></tr>\n'
        )

    def _row(self, result: Result) -> str:
        stated = read_manifest(result.manifest) or {}
        self._nbytes += result.nbytes
        self._count(stated)
        notices = list(dict.fromkeys([*result.notices, *_notices(stated)]))
        seconds = sum(result.seconds.values()) if result.state == "done" else None
        if seconds is not None:
            self._seconds += seconds
        ends = (
            _cell(seconds, "up to date" if seconds is None else f"{seconds:.2f} s"),
            _cell(result.nbytes, bytes_text(result.nbytes)),
        )
        link = _link(result.manifest, self.folder)
        name = f'<a href="{link}"><bdi>{_text(result.name)}</bdi></a>' if link else f"<bdi>{_text(result.name)}</bdi>"
        if result.kind == "lut":
            error = _finite_number(stated.get("error"))
            self._larger(error, result.name)
            about = f'<span class="small">{_text(_table_about(stated))}</span>'
            cells = "".join((_cell(error, _figure(error)), *ends, _listed(notices)))
            return f'<tr><th scope="row"><span class="name">{name}</span>{about}</th>{cells}</tr>\n'
        rows = _levels(stated)
        error = max((e for row in rows if (e := _finite_number(row.get("error"))) is not None), default=None)
        worst = max((e for row in rows if (e := _finite_number(row.get("worst"))) is not None), default=None)
        self._larger(error, result.name)
        stored = _stored(stated)
        first = (
            f'<span class="name">{name}</span><span class="small cut"><bdi>{_text(result.place)}</bdi></span>'
            f'<span class="small">{_text(_about(stated))}</span>{self._thumbnail(result, stated)}'
        )
        items = "".join(f"<li><b>{_text(engine)}</b> {_figure(e)}</li>" for engine, e in stored.items())
        beside = "" if worst is None else f'<span class="small">worst {_figure(worst)}</span>'
        cells = "".join(
            (
                _cell(error, _figure(error) + beside),
                _cell(max(stored.values(), default=None), f"<ul>{items}</ul>" if items else "–"),
                *ends,
                _share(_finite_number(_dict(_dict(stated.get("source")).get("statistics")).get("brightest_share"))),
                _energy(rows),
                _listed(notices),
            )
        )
        return f'<tr><th scope="row">{first}</th>{cells}</tr>\n'

    def _thumbnail(self, result: Result, stated: Mapping[str, Any]) -> str:
        """Return the HTML of the thumbnail of a bake. The picture is drawn unless one with the bake's key exists."""
        key = stated.get("key")
        if not isinstance(key, str) or not re.fullmatch("[0-9a-f]{64}", key):
            return '<span class="small none">no picture: its manifest has no key</span>'
        name = f"{key[:32]}-{LOOK}.png"
        path = self.folder / THUMBNAILS / name
        if not path.is_file():
            try:
                read = read_thumbnail(Path(result.manifest), stated)
            except WhitefurnaceError as error:
                return f'<span class="small none">no picture: <bdi>{_text(str(error))}</bdi></span>'
            path.parent.mkdir(parents=True, exist_ok=True)
            write_thumbnail(path, read)
        self._thumbnails.add(name)
        width, height = _dimensions(path)
        spheres = width // CELL - 3
        several = f"metal spheres of its {spheres} levels" if spheres > 1 else "a metal sphere of it"
        return (
            f'<img class="strip" src="{THUMBNAILS}/{name}" width="{width}" height="{height}" loading="lazy" '
            f'decoding="async" alt="Level 0 as a panorama, {several}, a matte sphere">'
        )

    def _count(self, stated: Mapping[str, Any]) -> None:
        device = _dict(stated.get("device"))
        if isinstance(device.get("name"), str) and len(self._devices) < MOST_LISTED:
            self._devices.add(f"{device['name']} ({device.get('platform', '')} {device.get('driver', '')})")
        if isinstance(stated.get("whitefurnace"), str) and len(self._versions) < MOST_LISTED:
            self._versions.add(stated["whitefurnace"])

    def _larger(self, error: float | None, name: str) -> None:
        # Of equal errors keep the first by name, so that the page does not depend on the order of results.
        if error is not None and (self._error is None or (-error, name) < (-self._error[0], self._error[1])):
            self._error = error, name

    def _page(self, total: int) -> tuple[str, str]:
        """Return the HTML before and after the tables."""
        count = sum(self._states.values())
        tiles = [("items", f"{total}", "")]
        tiles += [
            (what, f"{self._states[state]}", "failed" if state == "failed" else "")
            for state, what in (("done", "baked now"), ("skipped", "up to date"), ("failed", "failed"))
            if self._states[state]
        ]
        tiles += [("not begun", f"{total - count}", "failed")] if total > count else []
        tiles += [("size", bytes_text(self._nbytes), "")]
        tiles += [("time of items", _time(self._seconds), "")] if self._states["done"] else []
        if self._error is not None:
            tiles.append(
                (
                    "largest error",
                    f'{_figure(self._error[0])} <span class="small"><bdi>{_text(self._error[1])}</bdi></span>',
                    "",
                )
            )
        parts = [
            f"<div{_attribute('class', kind)}><dt>{what}</dt><dd>{value}</dd></div>" for what, value, kind in tiles
        ]
        parts += [
            f'<div><dt>{what}</dt><dd class="text">{"<br>".join(map(_text, sorted(values)))}</dd></div>'
            for what, values in (("device", self._devices), ("whitefurnace", self._versions))
            if values
        ]
        page = importlib.resources.files("whitefurnace.batch").joinpath("gallery.html").read_text("utf-8")
        title = _text(self.title)
        for mark, text in (
            ("policy", _policy(page)),
            ("title", f"{title} · whitefurnace"),
            ("heading", f"<bdi>{title}</bdi>"),
            ("summary", "\n".join(parts)),
        ):
            page = page.replace(f"{{{{{mark}}}}}", text, 1)
        begin, _, end = page.partition("{{body}}\n")
        return begin, end


def _checked(folder: Path, force: bool) -> IO[bytes]:
    """Make the folder and return a temporary file for rows.

    Raises FileError, also where the folder has an index.html that this tool did not write and `force` is False.
    """
    path = folder / INDEX
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not force and os.path.lexists(path):
            with open_input(path, "a report") as file:
                if OURS not in file.read(4096):
                    raise FileError(f"{path} exists and is not a report of whitefurnace; move it away or give --force")
        return tempfile.TemporaryFile(prefix="whitefurnace-")
    except OSError as error:
        raise _file_error(error, folder) from error


def _file_error(error: Exception, folder: Path) -> WhitefurnaceError:
    if isinstance(error, OSError):
        return FileError(f"cannot write the report in {folder}: {error.strerror or error}")
    assert isinstance(error, WhitefurnaceError)
    return error


def _policy(page: str) -> str:
    """Return the content security policy of the page [CSP 3].

    It allows the page's own style and script, by their digests, and images in its folder.
    """

    def digest(tag: str) -> str:
        body = page.partition(f"<{tag}>")[2].partition(f"</{tag}>")[0]
        return f"'sha256-{base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()}'"

    return (
        f"default-src 'none'; img-src 'self' file:; style-src {digest('style')}; script-src {digest('script')}; "
        "base-uri 'none'; form-action 'none'"
    )


def _table_head(kind: str, columns: Sequence[tuple[str, str]], count: int) -> str:
    title = {"failed": f"{count} failed", "bake": "Environments", "lut": "Tables"}[kind]
    wrong = _attribute("class", "failed" if kind == "failed" else "")
    heads = "".join(
        f'<th scope="col"{_attribute("data-by", by)}><button type="button"'
        f"{_attribute('title', ABOUT[name] if kind == 'bake' else '')}>{name}</button></th>"
        for name, by in columns
    )
    widths = "".join(f'<col class="w{k}">' for k in range(1, 1 + len(columns)))
    find = (
        '<p class="find" hidden><input type="search" aria-label="Show environments whose name, source or engine '
        'holds this" placeholder="Find…"></p>\n'
        if kind == "bake" and count > FEW
        else ""
    )
    names = f"{kind} many" if kind == "bake" and count > MANY else kind
    return (
        f'<section>\n<h2 id="of-{kind}"{wrong}>{title}</h2>\n{find}'
        f'<table class="{names}" aria-labelledby="of-{kind}">\n<colgroup>{widths}</colgroup>\n'
        f"<thead><tr>{heads}</tr></thead>\n<tbody>\n"
    )


def _attribute(name: str, value: str) -> str:
    return f' {name}="{html.escape(value)}"' if value else ""


def _dimensions(path: Path) -> tuple[int, int]:
    """Read the width and height of a PNG from its header [PNG 3, 11.2.1]."""
    head = head_of(path, 24)
    if len(head) < 24 or head[12:16] != b"IHDR":
        raise FileError(f"{path} is not a PNG; remove it and run again")
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


# ------------------------------------------------------------------------------------------------- manifests


def _dict(value: Any) -> Mapping[str, Any]:
    """Return the value if it is a mapping, else an empty one."""
    return value if isinstance(value, Mapping) else {}


def _finite_number(value: Any) -> float | None:
    """Return a finite number of a manifest as a float; None for any other value."""
    return float(value) if isinstance(value, int | float) and abs(value) < 1e300 else None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _rows_in(value: Any) -> list[Mapping[str, Any]]:
    return [row for row in _list(value) if isinstance(row, Mapping)]


def _levels(stated: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the rows of all levels of a manifest, the irradiance last."""
    return [
        *(row for what in ("levels", "latlong_levels", "octahedral_levels") for row in _rows_in(stated.get(what))),
        _dict(stated.get("irradiance")),
    ]


def _size_of(stated: Mapping[str, Any]) -> int:
    files = [stated] if isinstance(stated.get("sha256"), str) else map(_dict, _dict(stated.get("files")).values())
    return sum(int(_finite_number(entry.get("bytes")) or 0) for entry in files)


def _stored(stated: Mapping[str, Any]) -> dict[str, float]:
    """Return, by engine, the largest error of a level with that of its pixel format. Float32 adds no error."""
    found: dict[str, float] = {}
    for relative, entry in _dict(stated.get("files")).items():
        for row in _rows_in(_dict(entry).get("levels")):
            if (error := _finite_number(row.get("error"))) is not None:
                name = str(relative).partition("/")[0]
                found[name] = max(found.get(name, 0.0), error + (_finite_number(row.get("format_p99")) or 0.0))
    own = [name for name in ("raw", "exr") if name in _list(_dict(stated.get("recipe")).get("for"))]
    for row in _levels(stated)[:-1]:
        for name in own:
            if name in _list(row.get("for")) and (error := _finite_number(row.get("error"))) is not None:
                found[name] = max(found.get(name, 0.0), error)
    return dict(sorted(found.items()))


def _notices(stated: Mapping[str, Any]) -> list[str]:
    """Return the notices in a manifest about the source and the pixel formats."""
    source = _dict(stated.get("source"))
    found = [*_list(source.get("notices")), *_list(stated.get("notices"))]
    with contextlib.suppress(KeyError, TypeError, ValueError, AttributeError, IndexError):  # a foreign manifest
        found += format_notices(stated)
    return [notice for notice in found if isinstance(notice, str)]


def _about(stated: Mapping[str, Any]) -> str:
    """Return layout, sizes of levels and engines of a bake, in one line."""
    source, recipe = _dict(stated.get("source")), _dict(stated.get("recipe"))
    statistics = _dict(source.get("statistics"))
    parts = [f"{source.get('layout', '')} {statistics.get('width', '')}×{statistics.get('height', '')}".strip(" ×")]
    chain = _rows_in(stated.get("levels")) or _rows_in(stated.get("octahedral_levels"))
    sizes = sorted({int(s) for row in chain if (s := _finite_number(row.get("size"))) is not None}, reverse=True)
    if sizes:
        parts.append(f"{sizes[0]}² to {sizes[-1]}²" if len(sizes) > 1 else f"{sizes[0]}²")
    parts.append(", ".join(map(str, _list(recipe.get("for")))))
    return " · ".join(part for part in parts if part)


def _table_about(stated: Mapping[str, Any]) -> str:
    """Return integral, models, shape and rule of a table, in one line."""
    models = [str(_dict(one).get("name", "")) for one in _dict(stated.get("models")).values()]
    parts = [
        str(stated.get("integral", "")),
        ", ".join(models),
        " × ".join(map(str, _list(stated.get("shape")))),
        str(stated.get("rule", "")),
    ]
    return " · ".join(part for part in parts if part)


# ------------------------------------------------------------------------------------------------- text


def _text(text: Any) -> str:
    """Escape untrusted text for HTML.

    Characters that a page must not contain, such as controls and lone surrogates in file names, are written as escape
    sequences. Long text is cut at MOST_TEXT.
    """
    text = str(text).encode("utf-8", "backslashreplace").decode()
    if len(text) > MOST_TEXT:
        text = text[: MOST_TEXT - 1] + "…"
    return html.escape(NO_TEXT.sub(lambda found: found[0].encode("unicode_escape").decode(), text))


def _link(path: str, folder: Path) -> str | None:
    """Return the address of a file relative to `folder`; None where it is on another drive."""
    try:
        relative = os.path.relpath(os.path.abspath(path), os.path.abspath(folder))
    except ValueError:
        return None
    return quote(os.fsencode(relative.replace(os.sep, "/")))


def _figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.1e}"


def _time(seconds: float) -> str:
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def _cell(value: float | None, shown: str) -> str:
    return f"<td>{shown}</td>" if value is None else f'<td data-v="{value:.6g}">{shown}</td>'


def _share(share: float | None) -> str:
    """Return a cell with a fraction of 1 as a percentage and a bar."""
    if share is None:
        return _cell(None, "–")
    width = 80 * min(max(share, 0.0), 1.0)
    return _cell(
        share,
        f'{100 * share:.3g} %<svg width="80" height="4" aria-hidden="true"><rect class="rail" '
        f'width="80" height="4"/><rect class="bar" width="{width:.1f}" height="4"/></svg>',
    )


def _energy(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a cell with the energy kept by the level furthest from 100 %; it sorts by that distance."""
    kept = [
        (abs(e - 1), e, row.get("size")) for row in rows if (e := _finite_number(row.get("energy_kept"))) is not None
    ]
    if not kept:
        return _cell(None, "–")
    off, e, size = max(kept, key=lambda one: one[0])
    return _cell(off, f'{100 * e:.4g} %<span class="small">at {_text(size)}²</span>')


def _listed(notices: Sequence[str]) -> str:
    if not notices:
        return _cell(0, "–")
    more = len(notices) - MOST_LISTED
    shown = [*notices[:MOST_LISTED], *([f"and {more} more"] if more > 0 else [])]
    items = "".join(f"<li><bdi>{_text(notice)}</bdi></li>" for notice in shown)
    return _cell(len(notices), f"<details><summary>{len(notices)}</summary><ul>{items}</ul></details>")
