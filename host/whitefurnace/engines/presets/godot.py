"""Preset of Godot 4."""

from __future__ import annotations

import math

from whitefurnace.engines.engine import READ_IN_ITS_SOURCE, Engine, File, Preset, Published

PRESET = Preset(
    order=110,
    published=Published(levels=5, width=256, lod=math.sqrt(0.5) * 4, bend=0.25),
    engine=Engine(
        title="Godot 4: a panorama that it filters itself",
        facts=READ_IN_ITS_SOURCE,
        lod="sqrt(r) * max_lod",
        bend="alpha",
        file=(File("environment", "{stem}.hdr"),),
        steps=(
            "import STEM.hdr as a PanoramaSkyMaterial's panorama; Godot filters the sky; the energy, the "
            "rotation and the extracted sun of the bake survive",
        ),
    ),
)
