"""Snippets are the contract of a preset: compilers take them, and what their text computes is what the engine does.

The texts themselves are executed: with a small header GLSL, HLSL and WGSL are OpenCL C, textures give back where they
were read, and the results are held against numbers written here by hand from what is known of each engine.
"""

from __future__ import annotations

import re
import shutil
import subprocess

import numpy as np
import pytest

from whitefurnace.engines.presets import ENGINES, PRESETS, Dfg, Engine, File, Published
from whitefurnace.engines.snippets import snippet
from whitefurnace.errors import UnsupportedError, UsageError
from whitefurnace.expression import LANGUAGES
from whitefurnace.sphere import harmonics as harmonic
from whitefurnace.sphere import octahedral_map as octamap

OWN = Engine(
    name="own",
    lod=((0, 0), (0.25, 2), (1, 3)),
    axes="+z -x +y",
    bend="r / 4",
    blend="0.25 * alpha",
    least=0.1,
    sh="radiance",
    dfg=Dfg(32, x="alpha", y="NoV", NoV="sqrt"),
    file=(
        File("specular", "{stem}.ktx2", "rgba16f"),
        File("sh", "{stem}.json"),
        File("dfg", "{stem}_dfg.ktx2", "rg16f"),
    ),
)
MAPS = Engine(
    name="maps",
    lod="max_lod * r",
    file=(
        File("specular", "{stem}.ktx2", "rgba16f", layout="octahedral", border=0),
        File("irradiance", "{stem}_i.ktx2", "rgba16f"),
    ),
)
ATLAS = Engine(name="atlas", lod="max_lod * r", file=(File("specular", "{stem}.exr", layout="octahedral", border=2),))
EDGES = Engine(name="edges", lod="max_lod * r", file=(File("specular", "{stem}.exr", layout="octahedral", border=0),))
BAKED = [*(engine for engine in ENGINES.values() if engine.holding("specular")), OWN, MAPS, ATLAS, EDGES]

PUBLISHED = {name: preset.published for name, preset in PRESETS.items() if preset.published is not None} | {
    "own": Published(4, 64, 2 + 1 / 3, 1 / 8, 0.25 * 0.25, (3, -1, 2), (0.25, (0.3**0.5 * 31 + 0.5) / 32)),
    "maps": Published(4, 64, 1.5),
    "atlas": Published(4, 64, 1.5),
    "edges": Published(4, 64, 1.5),
}
"""What each engine computes at r = 1/2, from what is published of it."""


def text_of(engine: Engine, language: str) -> str:
    published = PUBLISHED[engine.name]
    return snippet(engine, language, published.levels, published.width, "studio")


# ------------------------------------------------------------------------------------------------- compilers

CALLS = {
    "glsl": (
        "#version 300 es\nprecision highp float;\nprecision highp samplerCube;\nprecision highp sampler2D;\n",
        "\nin vec3 a;\nout vec4 color;\nvoid main() {{\nvec3 x = specular_radiance(a, a, .5) + irradiance(a);\n"
        "{albedo}color = vec4(x, 1.0); }}\n",
        "x += specular_albedo(a, .5, .5);\n",
    ),
    "hlsl": (
        "",
        "\nfloat4 main(float3 a : TEXCOORD0) : SV_Target {{\n"
        "float3 x = specular_radiance(a, a, .5) + irradiance(a);\n{albedo}return float4(x, 1.0); }}\n",
        "x += specular_albedo(a, .5, .5);\n",
    ),
    "wgsl": (
        "",
        "\n@fragment fn main(@location(0) a: vec3f) -> @location(0) vec4f {{\n"
        "var x = specular_radiance(a, a, .5) + irradiance(a);\n{albedo}return vec4f(x, 1.0); }}\n",
        "x += specular_albedo(a, .5, .5);\n",
    ),
}
COMPILERS = {
    "glslangValidator": ("glsl", ".frag", ["-S", "frag"]),
    "glslangValidator -D": ("hlsl", ".hlsl", ["-D", "-S", "frag", "-e", "main", "-V", "-o", "out.spv"]),
    "dxc": ("hlsl", ".hlsl", ["-T", "ps_6_0", "-E", "main", "-Fo", "out.dxil"]),
    "naga": ("wgsl", ".wgsl", []),
    "tint": ("wgsl", ".wgsl", ["--format", "wgsl"]),
}


@pytest.mark.parametrize("compiler", COMPILERS)
def test_compilers_take_every_snippet(compiler, tmp_path):
    program = compiler.split()[0]
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed (Debian: glslang-tools; cargo: naga-cli)")
    language, suffix, options = COMPILERS[compiler]
    head, tail, albedo = CALLS[language]
    wrong = []
    for engine in BAKED:
        path = tmp_path / f"{engine.name}{suffix}"
        path.write_text(head + text_of(engine, language) + tail.format(albedo=albedo if engine.holding("dfg") else ""))
        done = subprocess.run([program, *options, str(path)], cwd=tmp_path, capture_output=True, text=True)
        if done.returncode:
            wrong.append(f"{engine.name}: {(done.stdout + done.stderr).strip()[:400]}")
    assert not wrong, "\n".join(wrong)


# ------------------------------------------------------------------------------------------------- execution

HEADER = """
#define SELECT(no, yes, test) ((test) ? (yes) : (no))
typedef float2 vec2; typedef float3 vec3; typedef float4 vec4;
typedef float f32; typedef float2 vec2f; typedef float3 vec3f; typedef float4 vec4f;
#define vec2(...) ((float2)(__VA_ARGS__))
#define vec3(...) ((float3)(__VA_ARGS__))
#define vec2f(...) ((float2)(__VA_ARGS__))
#define vec3f(...) ((float3)(__VA_ARGS__))
#define float2(...) ((float2)(__VA_ARGS__))
#define float3(...) ((float3)(__VA_ARGS__))
float3 reflect(float3 i, float3 n) { return i - 2.0f * dot(n, i) * n; }
#define lerp mix
#define abs fabs
// A texture gives back where it was read: a cube d (1 + lod) times its number, an image (u + lod, v, number).
float4 __attribute__((overloadable)) textureLod(int texture, float3 d, float lod)
{ return (float4)(d * (1.0f + lod) * (float)texture, 1.0f); }
float4 __attribute__((overloadable)) textureLod(int texture, float2 at, float lod)
{ return (float4)(at.x + lod, at.y, (float)texture, 1.0f); }
enum { specular_map = 1, irradiance_map = 2, sheen_map = 3, dfg_map = 4 };
"""


def as_opencl(text: str, language: str, sh: np.ndarray | None, ending: str) -> str:
    """The snippet as OpenCL C: the spelling of declarations and of reads, and the names; nothing that computes."""
    text = re.sub(r"//[^\n]*", "", text)
    rows = "" if sh is None else ", ".join(f"(float3)({x!r}, {y!r}, {z!r})" for x, y, z in sh.astype(float).tolist())
    text = re.sub(
        r"^(uniform \w+ sh\[9\]|(@group\(0\) @binding\(\d+\) )?var<uniform> sh: array<vec3f, 9>);",
        "__constant float3 sh[9] = {" + rows + "};",
        text,
        flags=re.M,
    )
    text = re.sub(r"^(uniform sampler\w+ \w+|Texture\w+ \w+|SamplerState \w+|@group[^;]*);", "", text, flags=re.M)
    text = re.sub(r"(\w+)\.SampleLevel\(linear_clamp, ", r"textureLod(\1, ", text)
    text = re.sub(r"textureSampleLevel\((\w+), linear_clamp, ", r"textureLod(\1, ", text)
    if language == "wgsl":
        text = re.sub(
            r"fn (\w+)\(([^)]*)\) -> (\w+) \{",
            lambda m: (
                f"{m[3]} {m[1]}("
                + ", ".join("{1} {0}".format(*(word.strip() for word in one.split(":"))) for one in m[2].split(","))
                + ") {"
            ),
            text,
        )
        kinds = {"alpha": "float", "k": "float", "side": "float", "d": "float3", "a": "float3", "e": "float2"}
        table = re.search(r"^(\w+) dfg\(", text, re.M)
        kinds["t"] = table[1] if table else "float2"
        text = re.sub(r"let (\w+) =", lambda m: f"{kinds[m[1]]} {m[1]} =", text)
        text = text.replace("select(", "SELECT(")
    text = re.sub(r"\.rgb\b", ".xyz", re.sub(r"\.rg\b", ".xy", text)).replace("code.a", "code.w")
    for name in {*re.findall(r"^\w+ (\w+)\(", text, re.M), "sh"}:
        text = re.sub(rf"(?<!\.)\b{name}\b", name + ending, text)
    # All numbers of a shader are of single precision.
    return re.sub(r"(?<![\w.])(\d+\.\d*(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)", r"\1f", text)


def unit(*x: float) -> np.ndarray:
    return np.array(x) / np.linalg.norm(x)


N, V, NOV = unit(0.3, 0.5, 0.81), unit(-0.2, 0.1, 0.9), 0.3
C, B = np.array([1.5, 1.0, 2.0]), np.array([[0.3, -0.2, 0.1], [0.2, 0.4, -0.3], [-0.1, 0.25, 0.2]])
Q = np.array([[[0.2, 0.1, -0.05], [0.1, -0.3, 0.15], [-0.05, 0.15, 0.1]]] * 3) * np.array([1, -0.5, 2])[:, None, None]
"""An environment c + b·d + dᵀQd by channel, Q without trace: the clamped cosine leaves E/π = c + ⅔ b·n + ¼ nᵀQn."""


def irradiance(n: np.ndarray) -> np.ndarray:
    return C + 2 / 3 * B @ n + np.einsum("i,cij,j->c", n, Q, n) / 4


def stored(engine: Engine, d: np.ndarray) -> np.ndarray:
    return np.array([np.sign(a) * d[abs(a) - 1] for a in PUBLISHED[engine.name].direction])


@pytest.fixture(scope="module")
def executed(device) -> dict[tuple[str, str, float], np.ndarray]:
    """What each text computes at r = .5 and .01, all of them in one program."""
    texts, calls, keys = [], [], []
    for engine in BAKED:
        for language in LANGUAGES:
            ending, k = f"_{len(keys)}", len(keys)
            keys.append((engine.name, language))
            sh = None
            if engine.sh is not None:
                coefficients = harmonic.coefficients_of(C, B, Q).T
                sh = harmonic.SCALINGS[engine.sh](harmonic.turned(coefficients, engine.matrix))
            texts.append(as_opencl(text_of(engine, language), language, sh, ending))
            table = (
                f"vstore2(dfg{ending}(NoV, r).xy, 0, out + 13); "
                f"vstore3(specular_albedo{ending}((float3)(.1f, .5f, 1.0f), NoV, r), 0, out + 15);"
            )
            sheen = f"vstore3(sheen_radiance{ending}(n, v, r), 0, out + 18);"
            calls.append(
                f"case {k}: out[0] = specular_lod{ending}(r); vstore3(irradiance{ending}(n), 0, out + 7); "
                f"vstore3(specular_direction{ending}(n, v, r), 0, out + 1); "
                f"vstore3(stored_direction{ending}(n), 0, out + 4); "
                f"vstore3(specular_radiance{ending}(n, v, r), 0, out + 10); "
                f"{table if engine.holding('dfg') else ''}{sheen if engine.holding('sheen') else ''} break;"
            )
    kernel = (
        "kernel void run(global const float *in, float r, global float *out)\n{\n"
        "float3 n = vload3(0, in), v = vload3(1, in); float NoV = in[6];\n"
        "out += 24 * get_global_id(0);\nswitch (get_global_id(0)) {\n" + "\n".join(calls) + "\n}\n}\n"
    )
    program = device.build(HEADER + "\n".join(texts) + kernel)
    given, found = device.array(np.array([*N, *V, NOV], np.float32)), {}
    for r in (0.5, 0.01):
        out = device.array(np.zeros((len(keys), 24), np.float32), writable=True)
        device.launch(program.kernel("run"), (len(keys),), (given, np.float32(r), out), (1,))
        found |= {(*key, r): row for key, row in zip(keys, out.read().astype(np.float64), strict=True)}
    return found


def read_octahedral(engine: Engine, d: np.ndarray, lod: float) -> np.ndarray:
    """Where a map, or both levels of an atlas, are read: a mean weighted by what is left of the lod."""
    e = (octamap.to_square(d[:, None])[:, 0] + 1) / 2
    if engine is MAPS:
        return np.array([e[0] + lod, e[1], 1])
    b, sides = engine.file[0].border, (64, 32, 16, 8)
    image, places = octamap.to_atlas([np.zeros((side, side, 1)) for side in sides], b)
    at = []
    for p in places:
        local = e * p.side if b else np.clip(e * p.side, 0.5, p.side - 0.5)
        at.append((np.array([p.column, p.row]) + local) / image.shape[1::-1])
    k = min(int(lod), 2)
    return np.array([*(at[k] * (k + 1 - lod) + at[k + 1] * (lod - k)), 1])


CLOSE = 4e-6
"""Float32 with a few roundings, log2, sqrt and pow among them, of values up to 8."""


@pytest.mark.parametrize("language", LANGUAGES)
@pytest.mark.parametrize("engine", BAKED, ids=lambda e: e.name)
def test_a_snippet_reads_what_the_engine_reads(executed, engine, language):
    published = PUBLISHED[engine.name]
    lod, bend = published.lod, published.bend
    got = executed[engine.name, language, 0.5]
    assert got[0] == pytest.approx(lod, abs=CLOSE)
    mirror = 2 * (N @ V) * N - V
    direction = mirror + (N - mirror) * bend
    direction /= np.linalg.norm(direction)
    np.testing.assert_allclose(got[1:4], direction, atol=CLOSE)
    np.testing.assert_allclose(got[4:7], stored(engine, N), atol=CLOSE)
    if engine.sh is not None:
        diffuse = irradiance(N)
    elif engine.holding("irradiance"):
        diffuse = 2 * stored(engine, N)
    elif engine in (ATLAS, EDGES):
        diffuse = read_octahedral(engine, N, 3)
    else:
        diffuse = stored(engine, N) * (1 + published.diffuse_lod)
    # Babylon's constants of its polynomials have six digits.
    np.testing.assert_allclose(got[7:10], diffuse, atol=2e-5 if engine.sh == "babylon" else CLOSE)
    if engine in (MAPS, ATLAS, EDGES):
        radiance = read_octahedral(engine, direction, lod)
    else:
        radiance = stored(engine, direction) * (1 + lod)
        if engine.holding("sheen"):
            np.testing.assert_allclose(got[18:21], 3 * radiance, atol=3 * CLOSE)
        radiance = radiance + (diffuse - radiance) * published.blend
    np.testing.assert_allclose(got[10:13], radiance, atol=2e-5)
    if engine.holding("dfg"):
        u, v = published.table
        np.testing.assert_allclose(got[13:15], (u, v), atol=CLOSE)
        F0 = np.array([0.1, 0.5, 1.0])
        albedo = F0 * u + v if published.form == "scale_bias" else u + (v - u) * F0
        np.testing.assert_allclose(got[15:18], albedo, atol=CLOSE)


@pytest.mark.parametrize("language", LANGUAGES)
def test_roughness_is_no_less_than_what_the_engine_shades_with(executed, language):
    # r = .01 of `own` is shaded as .1: a lod of .8, a bend of 1/40, and α² in the table
    mirror = 2 * (N @ V) * N - V
    direction = mirror + (N - mirror) / 40
    radiance = stored(OWN, direction / np.linalg.norm(direction)) * 1.8
    blend = 0.25 * 0.01
    got = executed["own", language, 0.01]
    np.testing.assert_allclose(got[10:13], radiance + (irradiance(N) - radiance) * blend, atol=CLOSE)
    assert got[13] == pytest.approx(0.01, abs=CLOSE)
    assert got[0] == pytest.approx(0.08, abs=CLOSE)


# ------------------------------------------------------------------------------------------------- texts


def test_a_snippet_says_what_it_is_for():
    text = text_of(ENGINES["filament"], "glsl")
    assert "filament" in text and ENGINES["filament"].facts in text and "studio_ibl.ktx" in text
    assert "Proven" in text and "Not proven" in text_of(ENGINES["unity"], "hlsl")
    assert all(step.split("STEM")[0] in text for step in ENGINES["filament"].steps)
    code = [line for line in text.splitlines() if line and not line.startswith("//")]
    assert len(code) <= 40, "about twenty lines, and braces"


def test_no_name_gets_out_of_its_comment():
    # A title may have lines, a file's stem on most systems anything but a slash; a backslash would join two lines.
    engine = Engine(name="own", title="two\nlines \\", steps=("first\r\nsecond",), file=OWN.file, sh="radiance")
    for language in LANGUAGES:
        text = snippet(engine, language, 4, 64, "a\nfloat b;\\")
        assert len(text.splitlines()) == len(snippet(engine, language, 4, 64, "a").splitlines())
        assert not re.search(r"\\$", text, re.M)


def test_what_has_no_snippet_is_refused():
    with pytest.raises(UnsupportedError, match="godot is given no prefiltered chain"):
        snippet(ENGINES["godot"], "glsl", 5, 256)
    with pytest.raises(UsageError, match="did you mean 'glsl'"):
        snippet(ENGINES["three"], "gls", 5, 256)


def test_rgbd_is_decoded_as_babylon_does():
    # (rgb code)^2.2 / alpha, as helperFunctions' fromRGBD; only presets with such files have it
    for language, power in (
        ("glsl", "vec3(2.2, 2.2, 2.2)"),
        ("hlsl", "float3(2.2, 2.2, 2.2)"),
        ("wgsl", "vec3f(2.2, 2.2, 2.2)"),
    ):
        assert f"return pow(code.rgb, {power}) / code.a;" in text_of(ENGINES["babylon"], language)
        assert "decode_rgbd" not in text_of(ENGINES["three"], language)
