"""Preset of Filament."""

from __future__ import annotations

from whitefurnace.engines.engine import Dfg, Engine, File, Preset, Published

PRESET = Preset(
    order=30,
    published=Published(levels=5, width=256, lod=0.75 * 4, bend=1 / 16, table=(0.3, 0.5), form="multiscatter"),
    engine=Engine(
        title="Filament: KTX 1 of R11G11B10F with its harmonics, and a skybox",
        facts="its WASM build rendered STEM_ibl.ktx with its harmonics, its least r .089; skybox, table and desktop "
        "builds were not tried",
        proven=True,
        # One level more than its own tool makes, which reduces the error of reads between levels to .6 to .7.
        bend="alpha * alpha",
        least=0.045,
        min_size=8,
        sh="filament",
        dfg=Dfg(128, form="multiscatter", charlie=True),
        shading="scaled",
        sheen="Charlie under Neubelt's V, its table's third channel, in the light of the specular chain",
        file=(
            File("specular", "{stem}_ibl.ktx", "b10g11r11"),
            File("skybox", "{stem}_skybox.ktx", "b10g11r11"),
            File("sh", "{stem}_sh.txt"),
            File("dfg", "{stem}_dfg.ktx2", "rgba16f", 19),
        ),
        # JavaScript, since that is rendered by a test. The light that createIblFromKtx1 makes there has no harmonics.
        steps=(
            "const bytes = async url => new Uint8Array(await (await fetch(url)).arrayBuffer())",
            "const ibl = engine.createIblFromKtx1(await bytes('STEM_ibl.ktx'))",
            "const light = Filament.IndirectLight.Builder().reflections(ibl.getReflectionsTexture())"
            ".irradianceSh(3, ibl.shfloats).build(engine)",
            "scene.setIndirectLight(light)",
            "// the background: scene.setSkybox(engine.createSkyFromKtx1(await bytes('STEM_skybox.ktx')))",
            "// in C++: ktxreader::Ktx1Reader::createTexture for both, and getSphericalHarmonics for irradiance(3, …)",
        ),
    ),
)
