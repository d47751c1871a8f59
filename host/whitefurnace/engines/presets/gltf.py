"""Preset of the glTF extension EXT_lights_image_based."""

from __future__ import annotations

from whitefurnace.engines.engine import Dfg, Engine, File, Preset, Published

PRESET = Preset(
    order=70,
    published=Published(levels=5, width=256, lod=2.0, table=(0.3, 0.5)),
    engine=Engine(
        title="glTF EXT_lights_image_based: RGBD faces and irradiance coefficients in one .gltf",
        facts="the extension's specification",
        lod="max_lod * r",
        sh="irradiance",
        dfg=Dfg(128),
        file=(File("specular", "{stem}.gltf", "rgbd"), File("dfg", "{stem}_dfg.ktx2", "rg16f", 19)),
        steps=(
            "copy `images` and `extensions.EXT_lights_image_based` into the scene's glTF, and name the light in the "
            'scene: "extensions": {"EXT_lights_image_based": {"light": 0}}',
        ),
    ),
)
