"""Preset of Babylon.js 9."""

from __future__ import annotations

import math

from whitefurnace.engines.engine import Dfg, Engine, File, Preset, Published

PRESET = Preset(
    order=50,
    published=Published(
        levels=8,
        width=128,
        lod=0.8 * math.log2(128 * 0.2505),
        blend=0.2505,
        direction=(1, 2, -3),
        table=(0.3, 0.5),
        form="multiscatter",
    ),
    engine=Engine(
        title="Babylon.js 9: .env of RGBD with its polynomials",
        facts="Babylon.js 9.35 rendered STEM.env, and STEM_dfg.png as the table of its materials, a sheen among them",
        proven=True,
        # A right-handed world, ours, in its left-handed one: the world's z is -z there, and in a right-handed scene it
        # reads at -z. It mixes diffuse light into rough reflections (mixIblRadianceWithIrradiance).
        axes="+x +y -z",
        blend="alpha + 0.0005",
        lod="0.8 * log2(width * (alpha + 0.0005))",  # its MINIMUMVARIANCE
        follow=True,
        min_size=1,
        whole=True,
        sh="babylon",
        dfg=Dfg(256, form="multiscatter", charlie=True),
        shading="babylon",
        sheen="Charlie under Neubelt's V, its table's third channel, in the light of the specular chain",
        file=(File("specular", "{stem}.env", "rgbd"), File("dfg", "{stem}_dfg.png", "rgbd")),
        steps=(
            "import { CubeTexture } from '@babylonjs/core/Materials/Textures/cubeTexture.js'",
            "import '@babylonjs/core/Materials/Textures/Loaders/envTextureLoader.js'",
            "scene.environmentTexture = CubeTexture.CreateFromPrefilteredData('STEM.env', scene)",
        ),
    ),
)
