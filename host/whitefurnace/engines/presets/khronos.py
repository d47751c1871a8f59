"""Preset of Khronos glTF Sample Viewer."""

from __future__ import annotations

from whitefurnace.engines.engine import READ_IN_ITS_SOURCE, Dfg, Engine, File, Preset, Published

PRESET = Preset(
    order=80,
    published=Published(levels=5, width=256, lod=2.0, table=(0.3, 0.5)),
    engine=Engine(
        title="Khronos glTF Sample Viewer: KTX 2 of half floats, Lambert, GGX and Charlie",
        facts=READ_IN_ITS_SOURCE,
        lod="max_lod * r",
        min_size=4,
        dfg=Dfg(128, charlie=True),
        shading="khronos",
        sheen="Charlie under Neubelt's V, its table's third channel, in the light of Charlie's chain; with Estevez "
        "and Kulla's fitted Λ in the light of lamps",
        file=(
            File("specular", "{stem}_ggx.ktx2", "rgba16f", 19),
            File("irradiance", "{stem}_lambertian.ktx2", "rgba16f", 19),
            File("sheen", "{stem}_charlie.ktx2", "rgba16f", 19),
            File("dfg", "{stem}_dfg.ktx2", "rgba16f", 19),
        ),
        steps=("give the three cubes to ResourceLoader.loadEnvironment as lambertian, ggx and charlie",),
    ),
)
