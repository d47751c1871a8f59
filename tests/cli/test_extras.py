"""A command that needs a package that is not installed says which, with exit code 5, before it computes anything."""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pytest

from whitefurnace.baking.bake import bake
from whitefurnace.files import encode, require_encoder, write_hdr, write_texture
from whitefurnace.opencl import device as opencl

SENTENCES = {
    "matplotlib": 'figures need matplotlib: pip install "whitefurnace[plot]"',
    "pygltflib": 'scenes need pygltflib: pip install "whitefurnace[scene]"',
    "distributed": 'a scheduler needs Dask: pip install "whitefurnace[dask]"',
    "ispc_texcomp": 'writing BC6H needs ispc-texcomp: pip install "whitefurnace[bc6h]"',
    "astc_encoder": 'ASTC needs astc-encoder-py: pip install "whitefurnace[astc]"',
}

ENGINE = 'title = "an engine of my own"\n\n[[file]]\nholds = "specular"\nname = "{stem}.ktx2"\nformat = "%s"\n'

SCENE = {"asset": {"version": "2.0"}, "materials": [{"name": "chalk"}], "scenes": [{"nodes": []}], "nodes": []}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_hdr("sky.hdr", np.ones((16, 32, 3), np.float32))
    (tmp_path / "blocks.toml").write_text(ENGINE % "bc6hu")
    (tmp_path / "astc.toml").write_text(ENGINE % "astc4x4hdr")
    (tmp_path / "scene.gltf").write_text(json.dumps(SCENE))
    (tmp_path / "job.toml").write_text('[[lut]]\nkind = "dfg"\noutput = "dfg.npy"\nsize = 4\n')
    return tmp_path


@pytest.fixture
def no_kernels(monkeypatch):
    """Any kernel that runs is an error."""

    def launched(*_, **__):
        raise AssertionError("a kernel ran")

    monkeypatch.setattr(opencl.Device, "launch", launched)


@pytest.mark.parametrize(
    "missing, words",
    [
        ("matplotlib", ["verify", "ggx", "--plot", "figures"]),
        ("matplotlib", ["bench", "tradeoff", "demo", "--plot", "figures"]),
        ("matplotlib", ["compare", "a.npy", "b.npy", "--plot", "figures"]),
        ("pygltflib", ["scene", "scene.gltf"]),
        ("pygltflib", ["scene", "scene.gltf", "--environment", "demo", "-o", "baked"]),
        ("distributed", ["batch", "job.toml", "--scheduler", "tcp://127.0.0.1:8786"]),
        ("ispc_texcomp", ["bake", "sky.hdr", "-o", "baked", "--for", "blocks.toml"]),
        ("ispc_texcomp", ["bake", "sky.hdr", "-o", "baked", "--for", "raw,blocks.toml", "--json"]),
        ("astc_encoder", ["bake", "sky.hdr", "-o", "baked", "--for", "astc.toml"]),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_the_sentence_comes_before_the_work(folder, monkeypatch, shell, no_kernels, missing, words):
    for name in ("a.npy", "b.npy"):
        np.save(name, np.ones((4, 4, 2), np.float32))
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    before, start = sorted(folder.iterdir()), time.perf_counter()
    code = shell(*words)
    seconds = time.perf_counter() - start
    assert shell.err.splitlines()[0] == f"error: {SENTENCES[missing]}"
    assert code == 5 and seconds < 10  # the first import of numpy's users counts too; kernels would raise
    assert not (folder / "baked").exists() and set(folder.iterdir()) <= {*before, folder / "figures"}


def test_a_picture_of_the_truth_needs_matplotlib_before_it_is_computed(folder, monkeypatch, shell, no_kernels):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert shell("render", "demo.json", "--for", "filament", "-o", "x.png", "--truth", "demo") == 5
    assert shell.sentence() == f"error: {SENTENCES['matplotlib']}"


def test_a_scene_with_an_engine_of_blocks_is_refused_before_it_is_measured(folder, monkeypatch, shell, no_kernels):
    pytest.importorskip("pygltflib")
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    assert shell("scene", "scene.gltf", "--for", "blocks.toml", "--environment", "demo", "--tolerance", ".1") == 5
    assert shell.err.splitlines()[-1] == f"error: {SENTENCES['ispc_texcomp']}"


def test_a_texture_of_astc_needs_its_decoder(folder, monkeypatch, shell, no_kernels):
    pytest.importorskip("astc_encoder")
    write_texture("sky.ktx2", encode("astc4x4hdr", [np.ones((6, 8, 8, 3), np.float32)], cube=True).texture)
    np.savez("reference.npz", specular_0=np.ones((6, 8, 8, 3), np.float32))
    monkeypatch.setitem(sys.modules, "astc_encoder", None)
    for words in (["bake", "sky.ktx2", "-o", "baked"], ["compare", "sky.ktx2", "sky.ktx2"]):
        assert shell(*words) == 5 and SENTENCES["astc_encoder"] in shell.sentence()
    # What can be known without the decoder is still shown.
    assert shell("inspect", "sky.ktx2") == 0 and SENTENCES["astc_encoder"] in shell.out


def test_a_plan_needs_no_encoder(folder, monkeypatch, shell):
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    assert shell("bake", "sky.hdr", "-o", "baked", "--for", "blocks.toml", "--size", "16", "--dry-run") == 0


@pytest.mark.parametrize("source", ["sky.hdr", "demo"])
def test_what_is_up_to_date_needs_no_encoder(folder, monkeypatch, device, source):
    pytest.importorskip("ispc_texcomp")
    (first,) = bake(source, "baked", for_="blocks.toml", size=16, quality="draft", device=device)
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    (second,) = bake(source, "baked", for_="blocks.toml", size=16, quality="draft", device=device)
    assert (first.state, second.state) == ("done", "skipped")


@pytest.mark.parametrize("form", ["rgba16f", "rgbd", "text", "float32", "b10g11r11"])
def test_other_formats_need_no_package(monkeypatch, form):
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    monkeypatch.setitem(sys.modules, "astc_encoder", None)
    require_encoder(form)
