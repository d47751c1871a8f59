"""Preset of Unity."""

from __future__ import annotations

from whitefurnace.engines.engine import READ_IN_COPIES, Engine, File, Preset, Published

PRESET = Preset(
    order=100,
    published=Published(levels=7, width=256, lod=4.05, diffuse_lod=6),
    engine=Engine(
        title="Unity: a lat-long that it filters on import, and the chain as a DDS cube",
        facts=READ_IN_COPIES,
        lod="6 * r * (1.7 - 0.7 * r)",
        levels=7,
        file=(File("environment", "{stem}.exr"), File("specular", "{stem}_cube.dds", "rgba16f")),
        steps=(
            "import STEM.exr with Texture Shape: Cube, Mapping: Latitude-Longitude, Convolution Type: Specular; Unity "
            "filters it then; the energy, the rotation and the extracted sun of the bake survive",
            "with Convolution Type: None it stays unfiltered; Cubemap.SetPixelData can set the levels of STEM_cube.dds",
        ),
    ),
)
