"""Model files as newcomers write them: OpenCL C, GLSL and HLSL mean what they say, and what does not work is reported
in one sentence with the file and the line."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate as scipy_integrate

from whitefurnace import integrate
from whitefurnace.catalogue.user import user_files, user_model
from whitefurnace.errors import FileError, InputError
from whitefurnace.opencl.complaints import vocabulary
from whitefurnace.opencl.derived import evaluate
from whitefurnace.opencl.device import Device

WriteFile = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> WriteFile:
    def made(text: str | bytes, name: str = "mine.clh") -> Path:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return made


def norm(path: Path, device: Device, precision: int = 32, **options: float) -> float:
    return float(integrate("normalization", ndf=str(path), precision=precision, device=device, **options).values)


def norm_of(d: Callable[[float], float]) -> float:
    """2π ∫ D(c) c dc over [0, 1], with the joints of the tables below given to scipy's quadrature."""
    return 2 * math.pi * scipy_integrate.quad(lambda c: d(c) * c, 0, 1, points=[0.25, 0.5, 0.75], limit=200)[0]


HEAD = "real ndf_mine_D(real cos_m) "
TABLE = [4.0, 1.0, 3.0, 2.0, 2.5]


def from_table(c: float) -> float:
    return float(np.interp(4 * c, np.arange(5), TABLE))


@pytest.mark.parametrize(
    ("text", "d"),
    [
        ("\ufeff" + HEAD + "{ return 1 + cos_m; }", lambda c: 1 + c),
        (HEAD.replace(" ", "\r\n") + "{\r\nreturn 1 + cos_m;\r\n}\r\n", lambda c: 1 + c),
        (HEAD + "{ return 1.0 + 0.5 * cos_m; }", lambda c: 1 + 0.5 * c),
        (
            HEAD + "{ if (cos_m <= 0.5f) return 0.5f * cos_m; else return cos_m - 0.25f; }",
            lambda c: max(c / 2, c - 0.25),
        ),
        (HEAD.replace("real", "float") + "{ float a = max(cos_m, 0.0f); return pow(a, 2.0); }", lambda c: c * c),
        (
            HEAD.replace("real", "double") + "{ const double two = 2; return max(0, min(cos_m, 1)) * two; }",
            lambda c: 2 * c,
        ),
        (
            "constant float T[5] = {4.0f, 1.f, 3, 2., 2.5};\n"
            + HEAD
            + "{ float x = 4 * cos_m; int W = min((int)x, 3); return mix(T[W], T[W + 1], x - W); }",
            from_table,
        ),
        (
            "static const float LOAD[] = {4, 1, 3, 2, 2.5}, SCALE = 1.0;\n"
            + HEAD
            + "{ int k = clamp(int(4.0 * cos_m), 0, 3); float T = fract(min(4.0 * cos_m, 3.9999999)); "
            "if (k == 3) T = 4.0 * cos_m - 3.0; return lerp(LOAD[k], LOAD[k + 1], T) * SCALE; }",
            from_table,
        ),
        (
            "#version 450\nprecision highp float;\n#define PI 3.0\n#define saturate(x) clamp(x, 0.0, 1.0)\n"
            "float D_GGX(in float x, const in float W) { return W * saturate(x) / PI; }\n"
            "float ndf_mine_D(in highp float cos_m) { return D_GGX(cos_m, 6.0); }",
            lambda c: 2 * c,
        ),
        (
            HEAD + "{ real sum = 0; for (int n = 1; n <= 3; ++n) { sum += n * pow(cos_m, n); } return sum; }",
            lambda c: c + 2 * c**2 + 3 * c**3,
        ),
        (
            HEAD + "{ float mix = mix(1.0, 3.0, cos_m), step = 1, PRECISION2 = 0; return mix + step; }",
            lambda c: 2 + 2 * c,
        ),
        (
            "struct Lobe { float width, x, a; };\ntypedef struct { float scale; } Peak;\n"
            + HEAD
            + "{ struct Lobe one = {1, 1, 1}; Peak p; p.scale = one.width + one.x + one.a; return p.scale * cos_m; }",
            lambda c: 3 * c,
        ),
        (
            "const float[5] LOAD = float[5](4.0, 1.0, 3.0, 2.0, 2.5);\n"
            + HEAD
            + "{ float x = min(4.0 * cos_m, 3.999999), t[] = float[](0.0, 0x1p0); int k = int(x);\n"
            "[unroll] for (int i = 0; i < 1; ++i) { t[1] *= 1.0; }\n"
            "return mix(LOAD[k], LOAD[k + 1], (x - k) * t[1] + t[0]); }",
            from_table,
        ),
        (
            HEAD + "{ vec3 a = vec3(cos_m), b = float3(1, 2, 3); real3 c = (real3)(0, 0, 1); "
            "return dot(a.rgb, b) + c.b + cross(a, a).y + length(vec2(3, 4)); }",
            lambda c: 6 * c + 6,
        ),
        (
            HEAD
            + "{ real T = 1, W = 2, ORDER = 3, SCALAR = 4, add = 5, sqr = 6; return T + W + ORDER + SCALAR + add; }",
            lambda c: 15,
        ),
    ],
    ids=[
        "byte-order mark",
        "line ends of Windows",
        "double literals",
        "if",
        "float and max",
        "double and integers",
        "table",
        "static table",
        "GLSL",
        "loop",
        "names of functions",
        "structures",
        "arrays of GLSL",
        "vectors",
        "names of ours",
    ],
)
def test_what_newcomers_write_works(device: Device, write: WriteFile, text: str, d: Callable[[float], float]) -> None:
    path = write(text)
    for precision, tolerance in ((32, 1e-5), (64, 1e-5 if d is from_table or "if (" in text else 1e-9)):
        # Tables and branches have kinks, where rules converge as their squared step: 1e-5 at the end of the ladder.
        want = norm_of(d)
        assert abs(norm(path, device, precision) - want) <= tolerance * want * (3 if tolerance == 1e-5 else 1)


def test_every_lane_takes_its_own_branch(write: WriteFile, monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    path = write(HEAD + "{ if (cos_m > 0.5f) { return 3; } for (int k = 0; k < 2; k++) cos_m *= 2; return cos_m; }")
    cos_m = np.linspace(-0.2, 1, 97)
    want = np.where(cos_m > 0.5, 3, np.where(cos_m > 0, 4 * cos_m, 0))
    for precision in (32, 64):
        ones = np.ones_like(cos_m)  # the norm and the width, which the engine finds
        cells = np.stack([cos_m, 1 - cos_m**2, ones, ones])
        got = evaluate(device, "NDF_D", {"ndf": user_model("ndf", path)}, cells, precision)[0]
        assert np.abs(got - want).max() <= (1e-6 if precision == 32 else 1e-15)  # roundings of the input


# Functions of the vocabulary by what they are, with arguments x in (0, 1] and y = 0.7.
ONE = {
    "sqrt": math.sqrt,
    "rsqrt": lambda x: x**-0.5,
    "inversesqrt": lambda x: x**-0.5,
    "cbrt": math.cbrt,
    "exp": math.exp,
    "exp2": lambda x: 2**x,
    "exp10": lambda x: 10**x,
    "expm1": math.expm1,
    "log": math.log,
    "log2": math.log2,
    "log10": math.log10,
    "log1p": math.log1p,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "asin": math.asin,
    "acos": math.acos,
    "atan": math.atan,
    "sinh": math.sinh,
    "cosh": math.cosh,
    "tanh": math.tanh,
    "asinh": math.asinh,
    "atanh": lambda x: math.atanh(x),
    "sinpi": lambda x: math.sin(math.pi * x),
    "cospi": lambda x: math.cos(math.pi * x),
    "erf": math.erf,
    "erfc": math.erfc,
    "tgamma": math.gamma,
    "lgamma": math.lgamma,
    "fabs": abs,
    "abs": abs,
    "floor": math.floor,
    "ceil": math.ceil,
    "round": lambda x: float(x >= 0.5),
    "trunc": math.trunc,
    "sign": lambda x: 1,
    "rint": lambda x: float(x > 0.5),
    "radians": math.radians,
    "degrees": math.degrees,
    "saturate": lambda x: x,
    "fract": lambda x: x % 1,
    "frac": lambda x: x % 1,
    "sqr": lambda x: x * x,
    "square": lambda x: x * x,
    "pow2": lambda x: x * x,
    "native_sqrt": math.sqrt,
    "native_exp": math.exp,
    "native_log": math.log,
    "half_sqrt": math.sqrt,
    "half_exp": math.exp,
    "half_log": math.log,
    "exp_": math.exp,
    "log_": math.log,
    "log1p_": math.log1p,
    "expm1_": math.expm1,
    "erfc_": math.erfc,
    "recip": lambda x: 1 / x,
    "native_recip": lambda x: 1 / x,
    "one_minus_sqr": lambda x: 1 - x * x,
    "acosh": None,
}
TWO = {
    "max": max,
    "min": min,
    "fmax": max,
    "fmin": min,
    "pow": math.pow,
    "powr": math.pow,
    "native_powr": math.pow,
    "pow_": math.pow,
    "fmod": math.fmod,
    "mod": math.fmod,
    "atan2": math.atan2,
    "atan": math.atan2,
    "hypot": math.hypot,
    "copysign": math.copysign,
    "fdim": lambda x, y: max(x - y, 0),
    "step": lambda x, y: float(y >= x),
    "divide": lambda x, y: x / y,
    "native_divide": lambda x, y: x / y,
}


def evaluated(device: Device, write: WriteFile, expressions: list[str], x: np.ndarray, precision: int) -> np.ndarray:
    """Expressions of x, a number in (0, 1], each computed by a function of its own: (expressions, x)."""
    lines = [f"real f{k}(real x) {{ real y = 0.7; return {text}; }}" for k, text in enumerate(expressions)]
    cases = " ".join(f"if (k == {k}) return f{k}(cos_m);" for k in range(len(expressions)))
    path = write(
        "\n".join([*lines, f"real ndf_mine_D(real cos_m, real which) {{ int k = (int)which; {cases} return 0; }}"])
    )
    which = np.repeat(np.arange(len(expressions)), x.size)
    xs = np.tile(x, len(expressions))
    ones = np.ones_like(xs)
    got = evaluate(
        device, "NDF_D", {"ndf": user_model("ndf", path)}, np.stack([xs, ones, which, ones, ones]), precision
    )
    return got[0].reshape(len(expressions), x.size).astype(np.float64)


@pytest.mark.parametrize("precision", [32, 64])
def test_the_vocabulary_computes_what_its_names_say(device: Device, write: WriteFile, precision: int) -> None:
    x = np.float32([0.05, 0.25, 0.6, 0.95]).astype(np.float64)
    rows = [(f"{name}(x)", [f(v) for v in x]) for name, f in ONE.items() if f]
    rows += [("acosh(1 + x)", [math.acosh(1 + v) for v in x])]
    rows += [(f"{name}(x, y)", [f(v, 0.7) for v in x]) for name, f in TWO.items()]
    rows += [(f"{name}(x, 1)", [f(v, 1) for v in x]) for name, f in TWO.items()]
    rows += [(f"{name}(2, y)", [f(2, 0.7)] * 4) for name, f in TWO.items() if name not in ("fmod", "mod")]
    rows += [(f"{name}(4)", [ONE[name](4)] * 4) for name in ("sqrt", "exp", "log", "sin", "floor", "sqr")]
    rows += [(f"{name}(vec3(x, y, 1)).y", [ONE[name](0.7)] * 4) for name in ("sqrt", "exp", "abs", "fract", "saturate")]
    rows += [(f"{name}(vec3(1, x, y), 0.5).y", [TWO[name](v, 0.5) for v in x]) for name in ("max", "min", "pow", "mod")]
    rows += [
        ("pown(x, 3)", x**3),
        ("ldexp(x, 3)", 8 * x),
        ("clamp(x, 0.1, y)", np.clip(x, 0.1, 0.7)),
        ("clamp(x, 0, 1)", x),
        ("clamp(2, 3, 5)", [3] * 4),
        ("mix(x, y, 0.25)", x + (0.7 - x) / 4),
        ("lerp(x, y, 0.25)", x + (0.7 - x) / 4),
        ("mix(vec3(x), vec3(y), 0.25).z", x + (0.7 - x) / 4),
        ("smoothstep(0.0, 1.0, x)", x * x * (3 - 2 * x)),
        ("fma(x, y, 1)", x * 0.7 + 1),
        ("mad(x, y, 1)", x * 0.7 + 1),
        ("select(x, y, x > 0.5)", np.where(x > 0.5, 0.7, x)),
        ("dot(vec3(x, y, 1), vec3(1, 2, 3))", x + 4.4),
        ("dot3(vec3(x), vec3(1))", 3 * x),
        ("distance(vec3(x), vec3(0))", 3**0.5 * x),
        ("length(normalize(vec3(x, y, 1)))", [1] * 4),
        ("cross(vec3(1, 0, 0), vec3(0, x, 0)).z", x),
        ("reflect(vec3(x, 0, -x), vec3(0, 0, 1)).z", x),
        ("refract(vec3(0, 0, -1), vec3(0, 0, 1), x).z", [-1] * 4),
        ("int(4 * x)", np.floor(4 * x)),
        ("float(3) + real(x)", 3 + x),
        ("bool(x) ? 1.0 : 2.0", [1] * 4),
        ("uint(3 * y)", [2] * 4),
        ("isnan(x) || isinf(x) || !isfinite(x) ? 1.0 : 2.0", [2] * 4),
        ("M_PI_F + M_1_PI + HALF_PI + INV_PI", [1.5 * math.pi + 2 / math.pi] * 4),
        ("float4(vec3(x), 2).w + vec2(x, y).y", [2.7] * 4),
        ("convert_int(4 * x)", np.floor(4 * x)),
    ]
    got = evaluated(device, write, [text for text, _ in rows], x, precision)
    for (text, want), values in zip(rows, got, strict=True):
        # Built-ins of OpenCL are within 16 ulp in float32, and 0.7 is a rounding off, at most tripled by pow and exp10.
        scale = np.maximum(np.abs(want), 1)
        assert np.abs(values - want).max() <= np.max(scale) * (2e-6 if precision == 32 else 1e-13), (text, values, want)
    tested = " ".join(text for text, _ in rows)
    assert [name for name in ONE | TWO if name not in vocabulary()] == []
    assert [
        name
        for name in vocabulary()
        if not name.isupper()
        and f"{name}(" not in tested
        and name[-1] not in "234_"
        and name not in ("double", "half", "scalar", "vec", "name", "convert_float")
    ] == []


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (HEAD + "{\n  return cosm; }", 2, "'cosm' is not known"),
        (HEAD + "{\n\n  return normalise(cos_m); }", 3, "'normalise' is not known; did you mean 'normalize'?"),
        (HEAD + "{\n  return cos_m\n}", 2, "semicolon"),
        (HEAD + "{\n  return 1;", 1, "'{' of this line is not closed"),
        (HEAD + "{\n  return (1; }", 2, "does not close the '\\(' of line 2"),
        ("/* no end\n" + HEAD + "{ return 1; }", 1, "comment"),
        ("#define TWICE(a) ((a) + \\\n  (a))\n" + HEAD + "{\n  return TWICE(nothing); }", 4, "'nothing'"),
        (HEAD + "{\n  return cos_m × 2; }", 2, "not ASCII"),
        (HEAD + '{\n  printf("x"); return 1; }', 2, "string"),
        ("float T[2] = {1, 2};\n" + HEAD + "{\n  return T[cos_m]; }", 3, "index must be an integer"),
        ("uniform float k;\n" + HEAD + "{ return k; }", 1, "parameter"),
        ("void f(out float x) { x = 1; }\n" + HEAD + "{ return 1; }", 1, "return the value"),
        ("kernel void go() {}\n" + HEAD + "{ return 1; }", 1, "functions only"),
        (HEAD + "{\n  mat3 m; return 1; }", 2, "matrices"),
        ("#import <x>\n" + HEAD + "{ return 1; }", 1, "#import"),
        ("#include <math.h>\n" + HEAD + "{ return 1; }", 1, "#include"),
        ('#include "../mine.clh"\n' + HEAD + "{ return 1; }", 1, "folder"),
        ('#include "mine.clh"\n' + HEAD + "{ return 1; }", 1, "includes itself"),
        ("real ndf_mine_D(int cos_m) { return 1; }", 1, "needed is real ndf_mine_D"),
        ("real3 ndf_mine_D(real cos_m) { return 1; }", 1, "needed is real ndf_mine_D"),
    ],
)
def test_what_does_not_work_is_reported_with_its_line(
    device: Device, write: WriteFile, text: str, line: int, words: str
) -> None:
    path = write(text)
    with pytest.raises(InputError, match=words) as caught:
        norm(path, device)
    assert str(caught.value).startswith(f"{path}:{line}: ") and "\n" not in str(caught.value)
    assert "own_" not in str(caught.value) and "user_" not in str(caught.value)


def test_a_function_of_another_name_is_named(write: WriteFile) -> None:
    with pytest.raises(InputError, match=r"ndf_mine_D\(.*did you mean 'ndf_Mine_D'"):
        user_model("ndf", write("real ndf_Mine_D(real cos_m) { return 1; }"))


def test_bytes_that_are_no_text(write: WriteFile) -> None:
    for raw in (b"\xff\x00\x80", b"real \x00", b"\x80\x81"):
        with pytest.raises(InputError, match="not a text file"):
            user_model("ndf", write(raw))
    user_model("ndf", write((HEAD + "{ return 1; }").encode("utf-16")))


def test_included_files_are_found_beside_the_file_and_named_in_messages(device: Device, write: WriteFile) -> None:
    write('#ifndef A\n#define A\n#include "parts/b.clh"\n#endif\n', "a.clh")
    inner = write("float helper(float x) {\n  return 2.0 * x;\n}\n", "parts/b.clh")
    path = write(
        '#include "a.clh"\n#include "a.clh" // twice is once, by its guard\n' + HEAD + "{ return helper(cos_m); }"
    )
    assert [one.name for one in user_files(path)] == ["mine.clh", "a.clh", "b.clh", "a.clh", "b.clh"]
    assert abs(norm(path, device) - norm_of(lambda c: 2 * c)) <= 1e-5
    before = user_model("ndf", path).text
    inner.write_text("float helper(float x) {\n  return 3.0 * x;\n}\n")
    assert user_model("ndf", path).text != before
    inner.write_text("float helper(float x) {\n  return 3.0 * nothing;\n}\n")
    with pytest.raises(InputError, match=r"b\.clh:2: 'nothing' is not known"):
        norm(path, device)
    path.write_text('#include "a.clh"\n' + HEAD + "{ return helper(cosm); }")
    inner.write_text("float helper(float x) {\n  return 3.0 * x;\n}\n")
    with pytest.raises(InputError, match=r"mine\.clh:2: 'cosm' is not known"):
        norm(path, device)
    inner.unlink()
    with pytest.raises(FileError, match=r"a\.clh:3: 'parts/b\.clh' is not found"):
        norm(path, device)


def test_charlie_with_neubelts_visibility_as_glsl(device: Device, write: WriteFile) -> None:
    """Directional albedos at n·v = .1 by an independent quadrature over l, for the sheen that engines integrate."""
    path = write(
        "const float TAU = 6.28318530718;\n"
        "float D_Charlie(float NoH, float alpha) {\n"
        "  float sin2 = max(1.0 - NoH * NoH, 1e-9);\n"
        "  return (2.0 + 1.0 / alpha) * pow(sin2, 0.5 / alpha) / TAU;\n}\n"
        "float V_Neubelt(float NoV, float NoL) { return 1.0 / (4.0 * (NoL + NoV - NoL * NoV)); }\n"
        "vec3 brdf_cloth_f(vec3 l, vec3 v, float alpha) {\n"
        "  vec3 h = normalize(l + v);\n  if (l.z <= 0.0) return vec3(0.0);\n"
        "  return vec3(D_Charlie(h.z, alpha) * V_Neubelt(v.z, l.z));\n}\n",
        "cloth.clh",
    )
    x, w = np.polynomial.legendre.leggauss(400)
    z, wz = (x + 1) / 2, w / 2
    z, wz = z * z, 2 * z * wz  # nodes are dense at grazing
    phi = (np.arange(800) + 0.5) / 800 * math.pi
    v = np.array([math.sqrt(1 - 0.01), 0, 0.1])
    s = np.sqrt(1 - z * z)[:, None]
    half = np.stack([s * np.cos(phi) + v[0], s * np.sin(phi) + v[1], np.broadcast_to(z[:, None] + v[2], (400, 800))])
    sin2 = 1 - half[2] ** 2 / (half**2).sum(0)
    for r in (0.3, 0.7, 1.0):
        alpha = r * r
        d = (2 + 1 / alpha) * np.maximum(sin2, 1e-9) ** (0.5 / alpha) / (2 * math.pi)
        f = d / (4 * (z + 0.1 - z * 0.1))[:, None]
        want = 2 * math.pi / 800 * (f * (z * wz)[:, None]).sum()
        got = integrate("albedo", brdf=str(path), NoV=0.1, phi=0.0, alpha=alpha, device=device).values[0]
        assert abs(got - want) <= 1e-4  # of the quadrature here


PIECES = (
    "{ } ( ) [ ] ; , . \n # \\ \" ' /* */ // 1.0 1f .5e3 0x1 1e 9z real real3 float vec3 int T W in out const "
    "static constant struct typedef return if for ? : = == + - * / \u03b1 \0 #define #include #if #endif #line "
    "precision l.z x.rgb"
).split(" ")


def broken(rng: np.random.Generator, text: str) -> str:
    """The text with a few places cut, doubled, exchanged or replaced by a piece of the language."""
    for _ in range(int(rng.integers(1, 4))):
        a, b = sorted(int(v) for v in rng.integers(0, len(text) + 1, 2))
        b = min(b, a + 30)
        piece = PIECES[int(rng.integers(len(PIECES)))]
        text = (
            text[:a] + text[b:],
            text[:b] + text[a:],
            text[:a] + piece + text[a:],
            text[:a] + piece + text[b:],
            text[:a],
        )[int(rng.integers(5))]
    return text


def translated(write: WriteFile, count: int, seed: int) -> int:
    """Translate broken texts; each is translated, or refused in one sentence. Returns how many are translated."""
    rng, done = np.random.default_rng(seed), 0
    base = [
        "// a lobe\n#define SQ(x) ((x) * (x))\nconst float T[3] = {1.0, .5f, 2};\nstruct P { float a; };\n"
        "real ndf_mine_D(real cos_m, real sin2_m, in float alpha) {\n  struct P p = {1}; int i = int(cos_m * 2.0);\n"
        "  if (i > 1) { return SQ(T[i]); }\n  for (int k = 0; k < 3; k++) p.a += T[k] * vec3(1, 2, 3).b;\n"
        "  return mix(p.a, 1, alpha); /* end */\n}\n",
        "#version 330\n#if 1\nvec3 helper(vec3 h) { return h.rgb * 2.0; }\n#endif\n"
        "vec3 brdf_mine_f(vec3 l, vec3 v, float k) { vec3 h = normalize(l + v); "
        "return helper(h) * max(h.z, 0.0) * k; }\n",
    ]
    for n in range(count):
        text = broken(rng, base[n % 2])
        try:
            made = user_model(("ndf", "brdf")[n % 2], write(text)).text
        except (InputError, FileError) as error:
            assert "\n" not in str(error) and "mine.clh" in str(error), (seed, n, text)
        else:
            assert made is not None and made.count("\n") >= text.count("\n") - text.count("\\\n"), (seed, n, text)
            done += 1
    return done


def test_a_thousand_broken_texts_are_one_sentence_each(write: WriteFile) -> None:
    assert 50 < translated(write, 1000, 21) < 950  # both ends are seen


@pytest.mark.long
def test_ten_thousand_broken_texts(write: WriteFile) -> None:
    assert 500 < translated(write, 10_000, 22) < 9_500


def test_long_texts_are_translated_in_proportion_to_their_length(write: WriteFile) -> None:
    """Texts of some hundred kilobytes, for which any quadratic step would take minutes."""
    many = "\n".join(
        f"float f{k}(float x) {{ float a = 1, b = 2, c = max(x, a), d; return x * {k}.0; }}" for k in range(4000)
    )
    assert (
        len(user_model("ndf", write(many + "\nfloat ndf_mine_D(float cos_m) { return f1(cos_m); }")).text or "") > 3e5
    )
    deep = "{" * 3000 + "}" * 3000 + ", a" * 20000
    with pytest.raises(InputError):
        user_model("ndf", write("float x = 1" + deep + ";\n"))
