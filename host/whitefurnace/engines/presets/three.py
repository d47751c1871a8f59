"""Preset of three.js from r187."""

from __future__ import annotations

from whitefurnace.engines.engine import Dfg, Engine, File, Preset, Published

PRESET = Preset(
    order=40,
    published=Published(
        levels=6, width=256, lod=0.75 * 5, bend=1 / 16, direction=(-1, 2, 3), table=(0.5, 0.3), diffuse_lod=5
    ),
    engine=Engine(
        title="three.js from r187: a KTX 2 cube of half floats that needs no filtering, and an .hdr",
        facts="three.js r187 rendered STEM.ktx2; the .hdr and the table were not tried",
        proven=True,
        axes="-x +y +z",
        bend="alpha * alpha",
        least=0.045,
        min_size=8,
        dfg=Dfg(16, x="roughness", y="NoV"),
        shading="fdez_aguera",
        sheen="a fit of its own (IBLSheenBRDF), in the light of the irradiance",
        file=(
            File("specular", "{stem}.ktx2", "rgba16f", 19),
            File("environment", "{stem}.hdr"),
            File("dfg", "{stem}_dfg.ktx2", "rg16f", 19),
        ),
        # KTX2Loader of r187 refuses BC6H, which loses 8 % in small levels, and makes a 2-D texture of other cubes.
        steps=(
            "import { CompressedCubeTexture, LinearFilter, LinearMipmapLinearFilter } from 'three'",
            "import { KTX2Loader } from 'three/addons/loaders/KTX2Loader.js'",
            "const { mipmaps, format, type } = await new KTX2Loader().detectSupport(renderer).loadAsync('STEM.ktx2')",
            "const faces = [0, 1, 2, 3, 4, 5].map(f => ({ width: mipmaps[0].width, height: mipmaps[0].height, "
            "mipmaps: mipmaps.map(({ data, width, height }) => ({ width, height, "
            "data: data.subarray(f * data.length / 6, (f + 1) * data.length / 6) })) }))",
            "const texture = new CompressedCubeTexture(faces, format, type)",
            "Object.assign(texture, { minFilter: LinearMipmapLinearFilter, magFilter: LinearFilter, "
            "isPMREMTexture: true, needsUpdate: true })",
            "scene.environment = texture // its last level is the diffuse light too",
            "// before r187: scene.environment = the texture of RGBELoader for STEM.hdr, which it filters itself",
        ),
    ),
)
