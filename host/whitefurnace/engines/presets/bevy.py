"""Preset of Bevy."""

from __future__ import annotations

from whitefurnace.engines.engine import READ_IN_ITS_SOURCE, Dfg, Engine, File, Preset, Published

PRESET = Preset(
    order=60,
    published=Published(
        levels=5,
        width=256,
        lod=2.0,
        bend=1 - 0.75 * (0.8660254037844386 + 0.25),
        direction=(1, 2, -3),
        table=(0.3, 0.5),
    ),
    engine=Engine(
        title="Bevy: two KTX 2 of RGB9E5 with Zstandard",
        facts=READ_IN_ITS_SOURCE,
        min_size=4,  # levels at equal steps of r need two more for half the error between them
        lod="max_lod * r",
        axes="+x +y -z",
        least=0.089,
        dfg=Dfg(64),
        shading="fdez_aguera",
        # mix(n, r, s (√s + α)) with s = 1 - α [Lagarde2014, listing 22]
        bend="1 - (1 - alpha) * (sqrt(1 - alpha) + alpha)",
        file=(
            File("specular", "{stem}_specular.ktx2", "rgb9e5", 19),
            File("irradiance", "{stem}_diffuse.ktx2", "rgb9e5", 19),
            File("dfg", "{stem}_dfg.ktx2", "rg16f", 19),
        ),
        steps=(
            'EnvironmentMapLight { diffuse_map: assets.load("STEM_diffuse.ktx2"), '
            'specular_map: assets.load("STEM_specular.ktx2"), intensity, ..default() }',
        ),
    ),
)
