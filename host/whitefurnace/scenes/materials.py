"""Reads a glTF scene: its size, its cameras, and its materials with the range of each value.

The ranges go through factors and textures. `advice.needs` decides what follows from them.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from whitefurnace.errors import InputError, UnsupportedError, nearest
from whitefurnace.files import Gltf, srgb_table
from whitefurnace.text import printable

MAX_NODES, MAX_MATERIALS, MAX_MESHES = 1 << 18, 1 << 14, 1 << 18
"""Largest numbers that a scene may have. A real scene has fewer; a node is read in 65 µs, a material in 1.5 ms."""

MAX_PRIMITIVES = 1 << 20
MAX_INDICES = 1 << 26
"""Largest total number of triangle indices whose texture coordinates are examined; beyond it whole images count."""

BINS = 64
"""Number of bins of a histogram, equal parts of [0, 1]."""

TILES = 512
"""Largest edge of the grid of tiles in which triangles mark the parts of an image that they use."""

ROUNDING = 1e-4
"""How far a factor may lie outside its range, as exporters round. It is clamped to the range."""


@dataclass(frozen=True)
class Property:
    """A value that a material has.

    extension  name of the extension that defines it, "" for glTF's core
    factor     name of its factor; `default`: the factor's default
    texture    name of its texture; `channels`: those that multiply the factor; `srgb`: True if they are coded in sRGB
    low, high  range of the factor
    """

    name: str
    extension: str
    factor: str
    default: tuple[float, ...]
    texture: str = ""
    channels: str = ""
    srgb: bool = False
    low: float = 0.0
    high: float = 1.0


_PBR = "pbrMetallicRoughness"
_KHR = "KHR_materials_"

PROPERTIES = (
    # glTF 2.0, 3.9.2: baseColorTexture in sRGB; of metallicRoughnessTexture G is roughness, B metalness, both linear.
    Property("base_color", _PBR, "baseColorFactor", (1.0, 1.0, 1.0), "baseColorTexture", "RGB", srgb=True),
    Property("metalness", _PBR, "metallicFactor", (1.0,), "metallicRoughnessTexture", "B"),
    Property("roughness", _PBR, "roughnessFactor", (1.0,), "metallicRoughnessTexture", "G"),
    Property("emission", "", "emissiveFactor", (0.0, 0.0, 0.0), "emissiveTexture", "RGB", srgb=True),
    Property("emissive_strength", _KHR + "emissive_strength", "emissiveStrength", (1.0,), high=math.inf),
    Property("ior", _KHR + "ior", "ior", (1.5,), high=math.inf),
    Property("specular", _KHR + "specular", "specularFactor", (1.0,), "specularTexture", "A"),
    Property(
        "specular_color",
        _KHR + "specular",
        "specularColorFactor",
        (1.0, 1.0, 1.0),
        "specularColorTexture",
        "RGB",
        srgb=True,
        high=math.inf,
    ),
    Property("sheen_color", _KHR + "sheen", "sheenColorFactor", (0.0, 0.0, 0.0), "sheenColorTexture", "RGB", srgb=True),
    Property("sheen_roughness", _KHR + "sheen", "sheenRoughnessFactor", (0.0,), "sheenRoughnessTexture", "A"),
    Property("clearcoat", _KHR + "clearcoat", "clearcoatFactor", (0.0,), "clearcoatTexture", "R"),
    Property(
        "clearcoat_roughness", _KHR + "clearcoat", "clearcoatRoughnessFactor", (0.0,), "clearcoatRoughnessTexture", "G"
    ),
    Property("anisotropy", _KHR + "anisotropy", "anisotropyStrength", (0.0,), "anisotropyTexture", "B"),
    Property("transmission", _KHR + "transmission", "transmissionFactor", (0.0,), "transmissionTexture", "R"),
    Property("thickness", _KHR + "volume", "thicknessFactor", (0.0,), "thicknessTexture", "G", high=math.inf),
    Property("attenuation_distance", _KHR + "volume", "attenuationDistance", (math.inf,), high=math.inf),
    Property("attenuation_color", _KHR + "volume", "attenuationColor", (1.0, 1.0, 1.0)),
    Property("iridescence", _KHR + "iridescence", "iridescenceFactor", (0.0,), "iridescenceTexture", "R"),
    Property("iridescence_ior", _KHR + "iridescence", "iridescenceIor", (1.3,), low=1.0, high=math.inf),
    Property(
        "diffuse_transmission",
        _KHR + "diffuse_transmission",
        "diffuseTransmissionFactor",
        (0.0,),
        "diffuseTransmissionTexture",
        "A",
    ),
    Property(
        "diffuse_transmission_color",
        _KHR + "diffuse_transmission",
        "diffuseTransmissionColorFactor",
        (1.0, 1.0, 1.0),
        "diffuseTransmissionColorTexture",
        "RGB",
        srgb=True,
    ),
    Property("dispersion", _KHR + "dispersion", "dispersion", (0.0,), high=math.inf),
)
"""Every value that is read, in the order of the extensions' specifications."""

GLOSSINESS = _KHR + "pbrSpecularGlossiness"

GLOSSY_PROPERTIES = (
    # Its specularGlossinessTexture holds F0 in sRGB and glossiness, which is linear, in alpha.
    Property("base_color", GLOSSINESS, "diffuseFactor", (1.0, 1.0, 1.0), "diffuseTexture", "RGB", srgb=True),
    Property(
        "specular_color", GLOSSINESS, "specularFactor", (1.0, 1.0, 1.0), "specularGlossinessTexture", "RGB", srgb=True
    ),
    Property("roughness", GLOSSINESS, "glossinessFactor", (1.0,), "specularGlossinessTexture", "A"),
)
"""The values of a specular-glossiness material, by the names of PROPERTIES that they stand for: roughness is 1 −
glossiness, and an insulator of infinite ior (written as 0) has the specular colour as its F0 [KHR_materials_ior]."""

UNLIT = _KHR + "unlit"

KNOWN = {p.extension for p in PROPERTIES} | {UNLIT, GLOSSINESS}

Given = Literal["default", "factor", "texture"]


@dataclass(frozen=True)
class Spread:
    """The values of one property over a surface.

    low, high  range of each channel
    mean       over the texels in use, empty where it is not known
    given      where the value comes from
    histogram  shares of BINS equal parts of [0, 1], for one channel; empty for a single value
    seen       True if the texels were read; if not, the whole range of the factor is assumed
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    mean: tuple[float, ...]
    given: Given = "default"
    histogram: tuple[float, ...] = ()
    seen: bool = True

    @property
    def least(self) -> float:
        """The smallest value of all channels."""
        return min(self.low)

    @property
    def most(self) -> float:
        """The largest value of all channels."""
        return max(self.high)

    @property
    def shares(self) -> tuple[tuple[float, float, float], ...]:
        """Return (low, high, share) of each part of the range in use, cut to its ends; for a property of one
        channel.
        """
        if not self.histogram:
            return ((self.least, self.most, 1.0),)
        return tuple(
            (max(k / BINS, self.least), min((k + 1) / BINS, self.most), share)
            for k, share in enumerate(self.histogram)
            if share > 0
        )


@dataclass(frozen=True)
class Material:
    """A material that the scene uses.

    values  spreads by the names of PROPERTIES
    given   extensions that it has; `unread`: those that are not known here
    uses    number of primitives that have it
    """

    name: str
    values: Mapping[str, Spread]
    given: tuple[str, ...]
    uses: int
    unlit: bool = False
    unread: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Spread:
        return self.values[name]

    def diffuse_share(self, specular: Iterable[float]) -> float:
        """Return the factor of the base colour in diffuse light, in [0, 1], where F0 is `specular` (3,).

        It is 1 − max(F0) in specular-glossiness [KHR_materials_pbrSpecularGlossiness, c_diff], and 1 otherwise.
        """
        return max(1 - max(specular), 0.0) if GLOSSINESS in self.given else 1.0

    def has(self, extension: str) -> bool:
        """Return whether the material has KHR_materials_`extension`."""
        return _KHR + extension in self.given


@dataclass(frozen=True)
class Camera:
    """A camera of the scene.

    position, direction  in world axes, metres
    yfov                 vertical angle in radians of a perspective camera, else None
    height               metres that an orthographic camera shows, else None
    """

    name: str
    position: tuple[float, float, float]
    direction: tuple[float, float, float]
    yfov: float | None
    height: float | None


@dataclass(frozen=True)
class Scene:
    """The content of a glTF scene.

    low, high  corners of the box around it in metres, None for a scene without positions
    lights     number of punctual lights
    """

    path: Path
    materials: tuple[Material, ...]
    low: tuple[float, float, float] | None
    high: tuple[float, float, float] | None
    cameras: tuple[Camera, ...]
    lights: int
    notices: tuple[str, ...]

    @property
    def extent(self) -> tuple[float, float, float] | None:
        """Size along x, y and z in metres."""
        if self.low is None or self.high is None:
            return None
        x, y, z = (b - a for a, b in zip(self.low, self.high, strict=True))
        return x, y, z


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """Read the scene of a .glb or .gltf file, with its buffers and images from it or from its folder.

    Raises FileError for a file that cannot be read; InputError for one that is not valid glTF 2 (missing buffers,
    cyclic nodes, wrong accessors, values out of range, files outside its folder); UnsupportedError without pygltflib,
    and for required extensions that are not known.
    """
    library()
    return _Reading(Gltf(path)).scene()


def library() -> Any:
    """Return the module pygltflib. Raises UnsupportedError where it is not installed."""
    try:
        import pygltflib
    except ImportError:
        raise UnsupportedError('scenes need pygltflib: pip install "whitefurnace[scene]"') from None
    return pygltflib


# Extensions that a file may require: they are read, or they change neither materials nor extent.
_ALLOWED = (KNOWN - {"", _PBR}) | {
    "KHR_texture_transform",
    "KHR_lights_punctual",
    "KHR_mesh_quantization",
    "KHR_materials_variants",
    "EXT_mesh_gpu_instancing",
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_texture_basisu",
    "EXT_texture_webp",
    "KHR_animation_pointer",
    "KHR_node_visibility",
    "EXT_lights_image_based",
    "KHR_xmp_json_ld",
}


@dataclass
class _Use:
    """The part of an image that a material uses.

    boxes   rectangles (n, 4) of texture coordinates as low u, low v, high u, high v in [0, 1]; None for all of it
    counts  receives the counts of the image's codes there
    """

    boxes: np.ndarray | None
    counts: np.ndarray | None = None


class _Reading:
    """Reads one file into a `Scene`."""

    def __init__(self, gltf: Gltf) -> None:
        self.gltf, self.take = gltf, gltf.take
        self.notices: dict[str, None] = {}
        self.indices = 0
        required = self.take.array(gltf.document.get("extensionsRequired", []), "extensionsRequired", 0, 256)
        unknown = [n for n in required if self.take.text(n, "an entry of extensionsRequired") not in _ALLOWED]
        if unknown:
            names = ", ".join(printable(name[:60]) for name in unknown[:5])
            hint = nearest(unknown[0][:60], _ALLOWED)
            raise UnsupportedError(
                f"{gltf.path} requires {names}, which {'is' if len(unknown) == 1 else 'are'} not read"
                f"{hint if 'did you mean' in hint and len(unknown) == 1 else ''}"
            )

    def wrong(self, what: str) -> InputError:
        return self.gltf.source.wrong(what)

    # ------------------------------------------------------------------------------------------- nodes

    def scene(self) -> Scene:
        nodes = self.gltf.objects("nodes", MAX_NODES)
        meshes = self.gltf.objects("meshes", MAX_MESHES)
        cameras = self.gltf.objects("cameras", MAX_NODES)
        self.raw = self.gltf.objects("materials", MAX_MATERIALS)
        order = self._order(nodes)
        used: dict[int, list[dict[str, Any]]] = {}  # by material, -1 for glTF's default: primitives
        boxes: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        seen: list[Camera] = []
        lights = 0
        for k, world in order:
            node, what = nodes[k], f"node {k}"
            if "mesh" in node:
                m = self.gltf.index(node["mesh"], len(meshes), f"the mesh of {what}")
                if m not in boxes:
                    boxes[m] = self._mesh(meshes[m], m, used)
                if (box := boxes[m]) is not None:
                    corners = np.array([[box[(c >> a) & 1][a] for a in range(3)] for c in range(8)])
                    placed = corners @ world[:3, :3].T + world[:3, 3]
                    low, high = np.minimum(low, placed.min(0)), np.maximum(high, placed.max(0))
            if "camera" in node:
                c = self.gltf.index(node["camera"], len(cameras), f"the camera of {what}")
                seen.append(self._camera(cameras[c], c, world))
            lights += "KHR_lights_punctual" in self.take.object(node.get("extensions", {}), f"extensions of {what}")
        if not meshes and self.raw:
            self.notices["it has no meshes: all of its materials count"] = None
            used = {k: [] for k in range(len(self.raw))}
        if not np.all(np.isfinite(np.where(low <= high, high - low, 0.0))):
            raise self.wrong("its extent is not finite")
        there = bool(np.all(low <= high))
        materials = self._materials(used)
        return Scene(
            self.gltf.path,
            materials,
            _three(low) if there else None,
            _three(high) if there else None,
            tuple(seen),
            lights,
            tuple(self.notices),
        )

    def _order(self, nodes: Sequence[dict[str, Any]]) -> list[tuple[int, np.ndarray]]:
        """The nodes of the scene with their transforms to the world, (4, 4)."""
        parent = [-1] * len(nodes)
        children: list[list[int]] = []
        for k, node in enumerate(nodes):
            found = self.take.array(node.get("children", []), f"children of node {k}", 0, len(nodes))
            children.append([self.gltf.index(c, len(nodes), f"a child of node {k}") for c in found])
            for c in children[-1]:
                if parent[c] >= 0:
                    raise self.wrong(
                        f"node {c} is a child of both node {parent[c]} and node {k}"
                        if parent[c] != k
                        else f"node {c} is twice a child of node {k}"
                    )
                parent[c] = k
        mark = [0] * len(nodes)  # 1 + the node from which it was first passed on the way up
        for k in range(len(nodes)):
            at = k
            while at >= 0 and not mark[at]:
                mark[at] = k + 1
                at = parent[at]
            if at >= 0 and mark[at] == k + 1:
                raise self.wrong(f"node {at} is its own ancestor: nodes must not be cyclic")
        scenes = self.gltf.objects("scenes", MAX_NODES)
        roots = [k for k in range(len(nodes)) if parent[k] < 0]
        if scenes or "scene" in self.gltf.document:
            which = self.gltf.index(self.gltf.document.get("scene", 0), len(scenes), "scene")
            listed = self.take.array(scenes[which].get("nodes", []), f"nodes of scenes[{which}]", 0, len(nodes))
            roots = list(dict.fromkeys(self.gltf.index(r, len(nodes), f"a node of scenes[{which}]") for r in listed))
            for r in roots:
                if parent[r] >= 0:
                    raise self.wrong(f"scenes[{which}] begins at node {r}, which is a child of node {parent[r]}")
        order: list[tuple[int, np.ndarray]] = []
        stack = [(r, np.eye(4)) for r in reversed(roots)]
        while stack:
            k, above = stack.pop()
            local = self._transform(nodes[k], k)
            with np.errstate(over="ignore", invalid="ignore"):
                world = above if local is None else above @ local
            if not np.all(np.isfinite(world)):
                raise self.wrong(f"the transform of node {k} is not finite")
            order.append((k, world))
            stack += [(c, world) for c in reversed(children[k])]
        return order

    def _numbers(self, value: Any, what: str, count: int) -> list[float]:
        return [self.take.number(x, f"a number of {what}") for x in self.take.array(value, what, count, count)]

    def _transform(self, node: dict[str, Any], k: int) -> np.ndarray | None:
        if "matrix" in node:
            return np.array(self._numbers(node["matrix"], f"matrix of node {k}", 16)).reshape(4, 4).T
        if not {"translation", "rotation", "scale"} & node.keys():
            return None
        x, y, z, w = self._numbers(node.get("rotation", [0, 0, 0, 1]), f"rotation of node {k}", 4)
        n = 2 / max(x * x + y * y + z * z + w * w, 1e-30)  # of a unit quaternion 2: exporters round
        turn = np.array(
            [
                [1 - n * (y * y + z * z), n * (x * y - z * w), n * (x * z + y * w)],
                [n * (x * y + z * w), 1 - n * (x * x + z * z), n * (y * z - x * w)],
                [n * (x * z - y * w), n * (y * z + x * w), 1 - n * (x * x + y * y)],
            ]
        )
        made = np.eye(4)
        with np.errstate(over="ignore", invalid="ignore"):
            made[:3, :3] = turn * self._numbers(node.get("scale", [1, 1, 1]), f"scale of node {k}", 3)
        made[:3, 3] = self._numbers(node.get("translation", [0, 0, 0]), f"translation of node {k}", 3)
        return made

    def _camera(self, one: dict[str, Any], k: int, world: np.ndarray) -> Camera:
        kind = one.get("type")
        if kind not in ("perspective", "orthographic"):
            raise self.wrong(f"camera {k} is neither perspective nor orthographic")
        lens = self.take.object(one.get(kind), f"{kind} of camera {k}")
        value = self.take.number(lens.get("yfov" if kind == "perspective" else "ymag"), f"the angle of camera {k}")
        if kind == "perspective" and not 0 < value < math.pi:
            raise self.wrong(f"yfov of camera {k} is {value:g}, it must be in (0, π)")
        ahead = -world[:3, 2]
        length = float(np.sqrt((ahead * ahead).sum()))
        return Camera(
            self._name(one, f"camera {k}"),
            _three(world[:3, 3]),
            _three(ahead / length if length else ahead),
            value if kind == "perspective" else None,
            None if kind == "perspective" else 2 * abs(value),
        )

    def _name(self, one: dict[str, Any], what: str) -> str:
        text = self.take.text(one.get("name", ""), f"the name of {what}")
        return "".join(c if c.isprintable() else " " for c in text[:60]) or what

    # ------------------------------------------------------------------------------------------- meshes

    def _mesh(
        self, mesh: dict[str, Any], m: int, used: dict[int, list[dict[str, Any]]]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the box of a mesh, None where it has no positions, and note its primitives under their materials."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for p, primitive in enumerate(
            self.take.array(mesh.get("primitives"), f"primitives of mesh {m}", 1, MAX_PRIMITIVES)
        ):
            what = f"primitive {p} of mesh {m}"
            one = self.take.object(primitive, what)
            attributes = self.take.object(one.get("attributes"), f"attributes of {what}")
            extensions = self.take.object(one.get("extensions", {}), f"extensions of {what}")
            numbers = [one["material"]] if "material" in one else []
            variants = self.take.object(extensions.get(_KHR + "variants", {}), f"variants of {what}")
            numbers += [
                self.take.object(v, f"a variant of {what}").get("material")
                for v in self.take.array(variants.get("mappings", []), f"mappings of {what}", 0, 1 << 12)
            ]
            of = [self.gltf.index(k, len(self.raw), f"the material of {what}") for k in numbers]
            for k in dict.fromkeys(of or [-1]):
                used.setdefault(k, []).append({**one, "what": what})
            if "POSITION" in attributes:
                packed = "KHR_draco_mesh_compression" in extensions
                box = self._box(attributes["POSITION"], f"POSITION of {what}", packed)
                if box is not None:
                    low, high = np.minimum(low, box[0]), np.maximum(high, box[1])
        return (low, high) if np.all(low <= high) else None

    def _box(self, value: Any, what: str, packed: bool) -> tuple[np.ndarray, np.ndarray] | None:
        accessors = self.take.array(self.gltf.document.get("accessors", []), "accessors", 0, 1 << 20)
        k = self.gltf.index(value, len(accessors), what)
        one = self.take.object(accessors[k], f"accessor {k}")
        positions = None if packed else self.gltf.accessor(k, ("VEC3",), what)
        if "min" in one and "max" in one:
            low, high = (np.array(self._numbers(one[end], f"{end} of accessor {k}", 3)) for end in ("min", "max"))
            if one.get("normalized") is True:
                component = self.take.whole(one.get("componentType"), f"componentType of accessor {k}", 0, 1 << 16)
                scale = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}.get(component, 1)
                low, high = low / scale, high / scale
            if not np.all(low <= high):
                raise self.wrong(f"accessor {k}, {what}, has a min above its max")
            return low, high
        if positions is None:
            return None
        if not np.all(np.isfinite(positions)):
            raise self.wrong(f"accessor {k}, {what}, has values that are not finite")
        return positions.min(0).astype(np.float64), positions.max(0).astype(np.float64)

    # ------------------------------------------------------------------------------------------- materials

    def _materials(self, used: Mapping[int, list[dict[str, Any]]]) -> tuple[Material, ...]:
        self.typed = self._typed()
        wanted: list[tuple[int, dict[str, Callable[[], Spread]]]] = []
        self.uses: dict[int, dict[Any, _Use]] = {}  # of each image
        for k, primitives in sorted(used.items()):
            values = {p.name: self._property(k, p, primitives) for p in PROPERTIES}
            if k >= 0 and GLOSSINESS in (self.raw[k].get("extensions") or {}):
                values |= self._glossy(k, primitives)
            values["iridescence_thickness"] = self._thickness(k, primitives)
            wanted.append((k, values))
        for image, uses in self.uses.items():
            _count(self.gltf.bands(image, "of a material"), list(uses.values()))
        return tuple(self._material(k, values, len(used[k])) for k, values in wanted)

    def _typed(self) -> Any:
        """Materials, textures, images and samplers as pygltflib's objects."""
        document = {
            name: self.gltf.objects(name, MAX_MATERIALS) for name in ("materials", "textures", "images", "samplers")
        }
        document["images"] = [{} for _ in document["images"]]  # their data stay where they are
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of null where a number should be
                return library().GLTF2.from_dict({"asset": {"version": "2.0"}, **document}, infer_missing=True)
        except (TypeError, ValueError, ArithmeticError, AttributeError, LookupError, RecursionError) as error:
            raise self.wrong(f"its materials or textures are not as glTF has them ({str(error)[:100]})") from None

    def _holder(self, k: int, extension: str) -> tuple[Any, str]:
        """Return the object that holds values of a material: a dictionary or an object of pygltflib, None where it
        has none.
        """
        if k < 0:
            return None, "the default material"
        material, what = self.typed.materials[k], f"material {k}"
        if extension == "":
            return material, what
        if extension == _PBR:
            # pygltflib passes on values that are not objects.
            self.take.object(self.raw[k].get(_PBR, {}), f"{_PBR} of {what}")
            return material.pbrMetallicRoughness, f"{_PBR} of {what}"
        extensions = self.take.object(material.extensions or {}, f"extensions of {what}")
        if extension not in extensions:
            return None, what
        return self.take.object(extensions[extension], f"{extension} of {what}"), f"{extension} of {what}"

    def _factor(self, holder: Any, p: Property, what: str) -> tuple[np.ndarray, Given]:
        value = holder.get(p.factor) if isinstance(holder, dict) else getattr(holder, p.factor, None)
        if value is None:
            return np.array(p.default), "default"
        n = len(p.default)
        numbers = value if n > 1 else [value]
        most = 4 if p.name == "base_color" else n  # its fourth is coverage
        numbers = self.take.array(numbers, f"{p.factor} of {what}", n, most)
        found = np.array([self.take.number(x, f"{p.factor} of {what}") for x in numbers[:n]])
        if p.name == "ior" and 0 < found[0] < 1:
            raise self.wrong(f"ior of {what} is {found[0]:g}; 0 and 1 or more are allowed")
        if np.any(found < p.low - ROUNDING) or np.any(found > p.high + ROUNDING):
            raise self.wrong(
                f"{p.factor} of {what} is {', '.join(f'{x:g}' for x in found)}, outside [{p.low:g}, {p.high:g}]"
            )
        if p.name == "attenuation_distance" and found[0] <= 0:
            raise self.wrong(f"attenuationDistance of {what} is {found[0]:g}, it must be over 0")
        return np.clip(found, p.low, p.high), "default" if np.array_equal(found, p.default) else "factor"

    def _property(self, k: int, p: Property, primitives: Sequence[dict[str, Any]]) -> Callable[[], Spread]:
        """Return a function that gives the spread of a property, once the images were counted."""
        holder, what = self._holder(k, p.extension)
        factor, given = self._factor(holder, p, what)
        texture = self._texture(holder, p.texture, what, primitives) if p.texture and factor.any() else None
        if texture is None:
            value = tuple(map(float, factor))
            return lambda: Spread(value, value, value, given)
        return lambda: _spread(texture, p, np.zeros_like(factor), factor)

    def _glossy(self, k: int, primitives: Sequence[dict[str, Any]]) -> dict[str, Callable[[], Spread]]:
        """Return functions that give the spreads of a specular-glossiness material, in place of others of their names.

        They hold where the material has metallic-roughness values too, which are its fallback.
        """
        colour, specular, glossiness = GLOSSY_PROPERTIES
        holder, what = self._holder(k, GLOSSINESS)
        factor, given = self._factor(holder, glossiness, what)
        texture = self._texture(holder, glossiness.texture, what, primitives) if factor.any() else None
        rough = (float(1 - factor[0]),)
        return {
            "base_color": self._property(k, colour, primitives),
            "specular_color": self._property(k, specular, primitives),
            "roughness": lambda: (
                Spread(rough, rough, rough, given)
                if texture is None
                else _spread(texture, glossiness, np.ones_like(factor), -factor)
            ),
            "metalness": lambda: Spread((0.0,), (0.0,), (0.0,), "factor"),
            "ior": lambda: Spread((0.0,), (0.0,), (0.0,), "factor"),
        }

    def _thickness(self, k: int, primitives: Sequence[dict[str, Any]]) -> Callable[[], Spread]:
        """Return the spread of the iridescent film's thickness in nm.

        It runs from minimum to maximum by the texture's G; without a texture it is the maximum.
        """
        name = _KHR + "iridescence"
        holder, what = self._holder(k, name)
        ends = [
            self._factor(holder, Property("", name, f"iridescenceThickness{end}", (usual,), high=math.inf), what)
            for end, usual in (("Minimum", 100.0), ("Maximum", 400.0))
        ]
        texture = self._texture(holder, "iridescenceThicknessTexture", what, primitives)
        if texture is None:
            value = (float(ends[1][0][0]),)
            return lambda: Spread(value, value, value, ends[1][1])
        return lambda: _spread(
            texture, Property("", name, "", (0.0,), "", "G", high=math.inf), ends[0][0], ends[1][0] - ends[0][0]
        )

    def _texture(self, holder: Any, name: str, what: str, primitives: Sequence[dict[str, Any]]) -> _Use | None:
        """Return the image and channels that multiply a property; None for no texture."""
        info = None if holder is None else holder.get(name) if isinstance(holder, dict) else getattr(holder, name, None)
        if info is None:
            return None
        if not isinstance(info, dict | library().TextureInfo):
            raise self.wrong(f"{name} of {what} is {printable(str(info)[:40])}, an object was expected")
        if isinstance(info, dict):
            number, coordinates, extensions = info.get("index"), info.get("texCoord", 0), info.get("extensions", {})
        else:
            number, coordinates, extensions = info.index, info.texCoord, info.extensions
        textures = self.typed.textures
        where = f"{name} of {what}"
        texture = textures[self.gltf.index(number, len(textures), f"the index of {where}")]
        source = texture.source
        own = self.take.object(texture.extensions or {}, f"extensions of the texture of {where}")
        if "EXT_texture_webp" in own:
            source = self.take.object(own["EXT_texture_webp"], f"EXT_texture_webp of {where}").get("source", source)
        if source is None:
            self.notices[
                f"{where} is of a kind that is not decoded ({printable(', '.join(own)[:60]) or 'it has no source'}): "
                "all from 0 to its factor is assumed"
            ] = None
            return _Use(None)
        image = self.gltf.index(source, len(self.typed.images), f"the image of {where}")
        coordinates = self.take.whole(0 if coordinates is None else coordinates, f"texCoord of {where}", 0, 64)
        transform = self.take.object((extensions or {}).get("KHR_texture_transform", {}), f"the transform of {where}")
        moved = self._moved(transform, where)
        if "texCoord" in transform:
            coordinates = self.take.whole(transform["texCoord"], f"texCoord of {where}", 0, 64)
        wraps = (10497, 10497)
        if texture.sampler is not None:
            sampler = self.typed.samplers[
                self.gltf.index(texture.sampler, len(self.typed.samplers), f"the sampler of {where}")
            ]
            wraps = (self._wrap(sampler.wrapS, where), self._wrap(sampler.wrapT, where))
        key = (coordinates, moved.tobytes(), wraps, id(primitives))
        uses = self.uses.setdefault(image, {})
        if key not in uses:
            uses[key] = _Use(self._boxes(primitives, coordinates, moved, wraps) if len(uses) < 16 else None)
        return uses[key]

    def _wrap(self, value: Any, where: str) -> int:
        """Return the wrap mode of a sampler, REPEAT where there is none."""
        return 10497 if value is None else self.take.whole(value, f"a wrap mode of the sampler of {where}", 0, 65535)

    def _moved(self, transform: dict[str, Any], where: str) -> np.ndarray:
        """Return the matrix (2, 3) of KHR_texture_transform: translation · rotation · scale."""
        x, y = self._numbers(transform.get("offset", [0, 0]), f"offset of {where}", 2)
        a, b = self._numbers(transform.get("scale", [1, 1]), f"scale of {where}", 2)
        turn = self.take.number(transform.get("rotation", 0), f"rotation of {where}")
        c, s = math.cos(turn), math.sin(turn)
        return np.array([[a * c, b * s, x], [-a * s, b * c, y]])

    def _boxes(
        self, primitives: Sequence[dict[str, Any]], coordinates: int, moved: np.ndarray, wraps: tuple[int, int]
    ) -> np.ndarray | None:
        """Return boxes (n, 4) around the triangles of primitives on an image, None where they cover all of it or are
        unknown.
        """
        found = []
        for one in primitives:
            number = one["attributes"].get(f"TEXCOORD_{coordinates}")
            packed = "KHR_draco_mesh_compression" in (one.get("extensions") or {})
            if number is None or packed or one.get("mode", 4) != 4:
                return None
            what = f"TEXCOORD_{coordinates} of {one['what']}"
            uv = self.gltf.accessor(number, ("VEC2",), what)
            if uv is None:
                return None
            count = len(uv)
            corners: np.ndarray | None = None
            if "indices" in one:
                corners = self.gltf.accessor(one["indices"], ("SCALAR",), f"indices of {one['what']}")
                if corners is None:
                    return None
                if corners.dtype.kind != "u":
                    raise self.wrong(f"indices of {one['what']} are not unsigned integers")
                if (most := int(corners.max())) >= count:
                    raise self.wrong(
                        f"indices of {one['what']} go up to {most}, its {count} texture coordinates to {count - 1}"
                    )
            number_of = count if corners is None else len(corners)
            self.indices += number_of
            if self.indices > MAX_INDICES:
                return None
            placed = uv.astype(np.float64) @ moved[:, :2].T + moved[:, 2]
            placed = placed if corners is None else placed[corners[:, 0]]
            found.append(_around(placed[: number_of // 3 * 3].reshape(-1, 3, 2), wraps))
        boxes = np.concatenate(found) if found else np.empty((0, 4))
        if not len(boxes) or np.any(np.all(boxes == [0, 0, 1, 1], axis=1)):
            return None
        return boxes

    def _material(self, k: int, values: Mapping[str, Callable[[], Spread]], uses: int) -> Material:
        if k < 0:
            return Material("(glTF's default)", {name: value() for name, value in values.items()}, (), uses)
        name = self._name(self.raw[k], f"material {k}")
        given = tuple(self.take.object(self.raw[k].get("extensions", {}), f"extensions of material {k}"))
        return Material(
            name,
            {p: value() for p, value in values.items()},
            given,
            uses,
            UNLIT in given,
            tuple(printable(e[:60]) for e in given if e not in KNOWN),
        )


def _three(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _around(triangles: np.ndarray, wraps: tuple[int, int]) -> np.ndarray:
    """Return boxes (n, 4) in [0, 1]² around triangles (n, 3, 2) of texture coordinates as a sampler wraps them.

    A range that is not finite or that reaches over an edge becomes the whole axis.
    """
    low, high = triangles.min(1), triangles.max(1)
    out = np.empty((len(triangles), 4))
    for axis, wrap in enumerate(wraps):
        a, b = low[:, axis], high[:, axis]
        if wrap == 33071:  # CLAMP_TO_EDGE
            a, b = np.clip(a, 0, 1), np.clip(b, 0, 1)
        elif wrap == 10497:  # REPEAT
            tile = np.floor(a)
            a, b = a - tile, b - tile
        with np.errstate(invalid="ignore"):
            inside = (a >= 0) & (b <= 1)  # of MIRRORED_REPEAT the first tile alone
        out[:, axis], out[:, axis + 2] = np.where(inside, a, 0.0), np.where(inside, b, 1.0)
    return out


def _tiles(boxes: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return the tiles of the image that boxes touch, (rows, columns) bool, and their neighbours, which a filter
    reads too.
    """
    x0, y0 = (np.clip(np.floor(boxes[:, k] * n).astype(int) - 1, 0, n) for k, n in ((0, columns), (1, rows)))
    x1, y1 = (np.clip(np.floor(boxes[:, k] * n).astype(int) + 2, 0, n) for k, n in ((2, columns), (3, rows)))
    # The running sums of the boxes' corners along both axes count the boxes over a tile.
    edge = np.zeros((rows + 1, columns + 1), np.int64)
    for y, x, sign in ((y0, x0, 1), (y1, x1, 1), (y0, x1, -1), (y1, x0, -1)):
        np.add.at(edge, (y, x), sign)
    return np.asarray(edge.cumsum(0).cumsum(1)[:rows, :columns] > 0)


def _count(bands: Iterable[tuple[int, int, int, np.ndarray]], uses: Sequence[_Use]) -> None:
    """Count the codes (4, 256 or 65536) in the part of an image that each use reads."""
    masks: list[np.ndarray | None] = []
    for height, width, y, codes in bands:
        rows, columns = min(height, TILES), min(width, TILES)
        if y == 0:
            masks = [None if use.boxes is None else _tiles(use.boxes, rows, columns) for use in uses]
            for use in uses:
                use.counts = np.zeros((4, np.iinfo(codes.dtype).max + 1), np.int64)
        across = ((np.arange(width) + 0.5) * columns / width).astype(int)
        down = ((np.arange(y, y + len(codes)) + 0.5) * rows / height).astype(int)
        for use, mask in zip(uses, masks, strict=True):
            some = codes.reshape(-1, 4) if mask is None else codes[mask[down][:, across]]
            assert use.counts is not None
            for channel in range(4):
                use.counts[channel] += np.bincount(some[:, channel], minlength=use.counts.shape[1])


def _spread(use: _Use, p: Property, base: np.ndarray, factor: np.ndarray) -> Spread:
    """Return the spread of base + factor × texture."""
    if use.counts is None:
        ends = np.sort(np.stack([base, base + factor]), axis=0)
        return Spread(tuple(ends[0].tolist()), tuple(ends[1].tolist()), (), "texture", seen=False)
    codes = use.counts.shape[1]
    decoded = (
        srgb_table(f"uint{8 if codes == 256 else 16}").astype(np.float64) if p.srgb else np.arange(codes) / (codes - 1)
    )
    low, high, mean = [], [], []
    for channel, b, f in zip(p.channels, base, factor, strict=True):
        counts = use.counts["RGBA".index(channel)]
        values = b + f * decoded
        there = values[counts > 0]
        low.append(float(there.min()))
        high.append(float(there.max()))
        mean.append(float((values * counts).sum() / counts.sum()))
    histogram: tuple[float, ...] = ()
    if len(p.channels) == 1 and high[0] > low[0] and high[0] <= 1:
        place = np.minimum((values * BINS).astype(int), BINS - 1)
        histogram = tuple((np.bincount(place, counts, BINS) / counts.sum()).tolist())
    return Spread(tuple(low), tuple(high), tuple(mean), "texture", histogram)
