"""Pages of three.js, Babylon.js and Filament in headless Chromium, served from loopback: their pixels as floats."""

from __future__ import annotations

import contextlib
import http.server
import json
import mimetypes
import os
import shutil
import signal
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

PAGES = Path(__file__).with_name("engines")
CHROMIUM = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--disable-default-apps",
    "--mute-audio",
)


def chromium() -> str | None:
    """The browser that WHITEFURNACE_CHROMIUM names, else the first on the path."""
    return os.environ.get("WHITEFURNACE_CHROMIUM") or next(filter(None, map(shutil.which, CHROMIUM)), None)


class Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_: object) -> None:
        """A browser that ends leaves connections behind."""


class PageError(Exception):
    """A page that failed, or said nothing in time."""


@dataclass
class Answer:
    """`about` is what the engine says of itself, `images` the linear RGB of each job: (size, size, 3), rows from the
    top."""

    about: dict[str, Any] = field(default_factory=dict)
    images: dict[str, np.ndarray] = field(default_factory=dict)


def started(url: str, profile: str, out: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start a browser with its own folder `profile`, whose messages go to `out`. Raises OSError."""
    return subprocess.Popen(
        [chromium() or CHROMIUM[0], *FLAGS, f"--user-data-dir={profile}", "--enable-logging=stderr", url],
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=out,
        start_new_session=True,
    )


def rendered(
    page: str, jobs: Sequence[Mapping[str, Any]], node_modules: Path, files: Path, timeout: float = 120
) -> Answer:
    """What the page PAGES/`page`.html renders of `jobs`, whose files lie in `files`. Raises PageError."""
    answer, over = Answer(), threading.Event()
    failure: list[str] = []
    roots = {"node_modules": node_modules, "files": files, "pages": PAGES}

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None:
            pass

        def say(self, data: bytes = b"", kind: str = "text/plain", status: int = 200) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def do_GET(self) -> None:
            root, _, rest = self.path.split("?")[0].lstrip("/").partition("/")
            if root == "jobs":
                return self.say(json.dumps(list(jobs)).encode(), "application/json")
            path = roots[root] / rest if root in roots else None
            if path is None or ".." in Path(rest).parts or not path.is_file():
                return self.say(status=404)
            own = {".mjs": "text/javascript", ".js": "text/javascript", ".wasm": "application/wasm"}
            return self.say(
                path.read_bytes(), own.get(path.suffix) or mimetypes.guess_type(path)[0] or "application/octet-stream"
            )

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            _, what, *name = self.path.split("/")
            if what == "pixels":
                pixels = np.frombuffer(body, "<f4")
                size = round((len(pixels) / 4) ** 0.5)
                answer.images[name[0]] = pixels.reshape(size, size, 4)[..., :3].copy()
            elif what == "about":
                answer.about.update(json.loads(body))
            elif what == "failed":
                failure.append(json.loads(body)["error"])
            self.say()
            if what in ("done", "failed"):
                over.set()

    server = Server(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        log = Path(profile, "log")
        with log.open("wb") as out:
            url = f"http://127.0.0.1:{server.server_port}/pages/{page}.html"
            try:
                browser = started(url, profile, out)
            except OSError as error:
                server.shutdown()
                server.server_close()
                raise PageError(f"{page}: no browser: {error}") from error
        try:
            end = time.monotonic() + timeout
            while not over.wait(0.25) and time.monotonic() < end and browser.poll() is None:
                pass
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(browser.pid, signal.SIGKILL)
            browser.wait()
            server.shutdown()
            server.server_close()
        if failure or not over.is_set():
            said = [line for line in log.read_text(errors="replace").splitlines() if "CONSOLE" in line][-5:]
            what = failure[0] if failure else f"the browser ended or did not answer in {timeout:.0f} s"
            raise PageError(f"{page}: {what} {said}")
    return answer


def glb(meshes: Sequence[Mapping[str, Any]]) -> bytes:
    """The meshes of a job as binary glTF 2.0, which Filament loads."""
    blob, views, accessors, made, materials = b"", [], [], [], []
    for k, mesh in enumerate(meshes):
        for name, kind, target in (("positions", "<f4", 34962), ("normals", "<f4", 34962), ("indices", "<u4", 34963)):
            array = np.asarray(mesh[name], kind).reshape(-1, 1 if name == "indices" else 3)
            views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes, "target": target})
            accessors.append(
                {
                    "bufferView": len(views) - 1,
                    "count": len(array),
                    "componentType": 5125 if name == "indices" else 5126,
                    "type": "SCALAR" if name == "indices" else "VEC3",
                }
                | ({"min": array.min(0).tolist(), "max": array.max(0).tolist()} if name == "positions" else {})
            )
            blob += array.tobytes()
        materials.append(
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*mesh["color"], 1],
                    "metallicFactor": mesh["metallic"],
                    "roughnessFactor": mesh["roughness"],
                },
            }
        )
        if "sheen" in mesh:
            own = {"sheenColorFactor": mesh["sheen"]["color"], "sheenRoughnessFactor": mesh["sheen"]["roughness"]}
            materials[-1]["extensions"] = {"KHR_materials_sheen": own}
        made.append(
            {
                "primitives": [
                    {"attributes": {"POSITION": 3 * k, "NORMAL": 3 * k + 1}, "indices": 3 * k + 2, "material": k}
                ]
            }
        )
    text = json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(made)))}],
            "nodes": [{"mesh": k} for k in range(len(made))],
            "meshes": made,
            "materials": materials,
            **({"extensionsUsed": ["KHR_materials_sheen"]} if any("sheen" in mesh for mesh in meshes) else {}),
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": len(blob)}],
        }
    ).encode()
    text += b" " * (-len(text) % 4)
    return b"".join(
        (
            struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(blob)),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(blob), b"BIN\0"),
            blob,
        )
    )
