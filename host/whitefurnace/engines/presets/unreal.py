"""Preset of Unreal Engine."""

from __future__ import annotations

from whitefurnace.engines.engine import READ_IN_COPIES, Engine, File, Preset, Published

PRESET = Preset(
    order=90,
    published=Published(levels=8, width=128, lod=3.8, diffuse_lod=5),
    engine=Engine(
        title="Unreal Engine: a lat-long that it filters on import, and the chain as a DDS cube",
        facts=READ_IN_COPIES,
        lod="max_lod - 2 + 1.2 * log2(r)",
        min_size=1,
        whole=True,
        least=0.001,
        file=(File("environment", "{stem}.hdr"), File("specular", "{stem}_cube.dds", "rgba16f")),
        steps=(
            "import STEM.hdr: it becomes a TextureCube; an .exr stays 2-D",
            "a Sky Light of source type SLS Specified Cubemap filters it again: the energy, the rotation and "
            "the extracted sun of the bake survive, the levels do not",
            "STEM_cube.dds holds levels for its mapping, for shaders that sample a TextureCube themselves",
        ),
    ),
)
