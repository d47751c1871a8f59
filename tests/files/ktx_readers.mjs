// Opens KTX files with readers that are not ours: ktx-parse (KTX 2), libktx as WASM (KTX 1 and 2), which unpacks and
// "uploads" them to a WebGL2 that only writes down what it is given, and Filament's bundle as WASM (KTX 1 of the one
// format that its cubes have, which libktx refuses). One line of JSON a file and reader.
//
//   node ktx_readers.mjs FOLDER_OF_NODE_MODULES FILE...
//   node ktx_readers.mjs FOLDER_OF_NODE_MODULES --names        ktx-parse's numbers of Vulkan's formats
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [, , modules, ...files] = process.argv;
const digest = (data) => createHash("sha256").update(data).digest("hex");

function parsed(read, bytes) {
  const c = read(bytes);
  const { levels, dataFormatDescriptor, keyValue, globalData, ...header } = c;
  return {
    header,
    descriptor: dataFormatDescriptor[0],
    keys: Object.fromEntries(Object.entries(keyValue).map(([k, v]) => [k, typeof v === "string" ? v : [...v]])),
    levels: levels.map((l) => ({ digest: digest(l.levelData), bytes: l.levelData.length,
                                 unpacked: l.uncompressedByteLength })),
  };
}

// A WebGL2 context of stubs; uploads are kept.
function recorder(uploads) {
  let alignment = 4;
  const keep = (kind, target, level, width, height, layers, format, type, data, offset, length) => {
    // Without a length the data is all of the library's memory from there on.
    const texel = { 0x1401: 1, 0x1403: 2, 0x140b: 2, 0x1406: 4 }[type]
                  * { 0x1903: 1, 0x8227: 2, 0x1907: 3, 0x1908: 4 }[format] || 4;
    const row = Math.ceil((width * texel) / alignment) * alignment;
    const bytes = new Uint8Array(data.buffer, data.byteOffset + offset * data.BYTES_PER_ELEMENT,
                                 length ?? row * height * layers);
    uploads.push({ kind, target, level, width, height, layers, format, type, bytes: bytes.slice() });
  };
  const own = {
    getParameter: (name) => ({ 0x1f02: "WebGL 2.0", 0x8b8c: "WebGL GLSL ES 3.00", 0x0cf5: 4 }[name] ?? 0),
    getSupportedExtensions: () => ["EXT_texture_compression_bptc", "WEBGL_compressed_texture_astc"],
    getExtension: () => ({}),
    getError: () => 0,
    pixelStorei: (name, value) => { if (name === 0x0cf5) alignment = value; },
    texImage2D: (t, l, i, w, h, b, f, y, d, o = 0) => keep(i, t, l, w, h, 1, f, y, d, o),
    texImage3D: (t, l, i, w, h, n, b, f, y, d, o = 0) => keep(i, t, l, w, h, n, f, y, d, o),
    texSubImage2D: (t, l, x, y0, w, h, f, y, d, o = 0) => keep(0, t, l, w, h, 1, f, y, d, o),
    texSubImage3D: (t, l, x, y0, z, w, h, n, f, y, d, o = 0) => keep(0, t, l, w, h, n, f, y, d, o),
    compressedTexImage2D: (t, l, i, w, h, b, d, o = 0, n = 0) => keep(i, t, l, w, h, 1, 0, 0, d, o, n || undefined),
    compressedTexSubImage2D: (t, l, x, y, w, h, i, d, o = 0, n = 0) =>
      keep(i, t, l, w, h, 1, 0, 0, d, o, n || undefined),
  };
  // Else emscripten takes uploads for ones from a bound buffer.
  Object.assign(own, { currentPixelUnpackBufferBinding: null, currentPixelPackBufferBinding: null });
  const stub = (name) => (String(name).startsWith("create") ? () => ({}) : () => 0);
  return new Proxy(own, { get: (o, name) => (name in o ? o[name] : stub(name)) });
}

// Scripts made for browsers: neither import nor require takes them.
async function wasm(folder, name, variable) {
  const text = readFileSync(path.join(modules, folder, `${name}.js`), "utf8");
  const make = new Function("require", "__dirname", "__filename", "window", "document",
                            `${text}; return ${variable};`)(
    createRequire(import.meta.url), path.join(modules, folder), path.join(modules, folder, `${name}.js`), globalThis,
    { currentScript: { src: "" }, createElement: () => ({}), addEventListener() {} });
  return make({ wasmBinary: readFileSync(path.join(modules, folder, `${name}.wasm`)) });
}

function bundled(filament, bytes) {
  const buffer = new filament.driver$BufferDescriptor(bytes.length);
  buffer.getBytes().set(bytes);
  const bundle = new filament.Ktx1Bundle(buffer);
  const faces = [];
  for (let level = 0; level < bundle.getNumMipLevels(); level++)
    for (let face = 0; face < 6; face++) {
      const blob = bundle._getBlob([level, 0, face]);
      faces.push({ level, face, digest: digest(blob.getBytes()) });
      blob.delete();
    }
  const named = (kinds, value) => Object.keys(kinds).find((name) => kinds[name] === value);
  return {
    layers: bundle.getArrayLength(), cube: bundle.isCubemap(), sh: bundle.getMetadata("sh"), faces,
    internal: named(filament.Texture$InternalFormat, bundle.getInternalFormat(false)),
    format: named(filament.PixelDataFormat, bundle.getPixelDataFormat()),
    type: named(filament.PixelDataType, bundle.getPixelDataType()),
  };
}

const parse = await import(pathToFileURL(path.join(modules, "ktx-parse/dist/index.mjs")));
const { read } = parse;
if (files[0] === "--names") {
  const formats = Object.entries(parse).filter(([name]) => name.startsWith("VK_FORMAT_"));
  console.log(JSON.stringify(Object.fromEntries(formats)));
  process.exit(0);
}
const ktx = await wasm("@khronosgroup/gltf-viewer/dist/libs", "libktx", "LIBKTX");
const filament = await wasm("filament", "filament", "Filament");
for (const file of files) {
  const bytes = new Uint8Array(readFileSync(file));
  const say = (reader, result) => console.log(JSON.stringify({ file, reader, ...result }));
  if (file.endsWith(".ktx2")) {
    try { say("ktx-parse", parsed(read, bytes)); } catch (e) { say("ktx-parse", { error: String(e) }); }
  }
  if (file.endsWith("filament.ktx")) {
    try { say("filament", bundled(filament, bytes)); } catch (e) { say("filament", { error: String(e) }); }
    continue;
  }
  try {
    const uploads = [];
    ktx.GL.makeContextCurrent(ktx.GL.registerContext(recorder(uploads), { majorVersion: 2, minorVersion: 0 }));
    const texture = new ktx.ktxTexture(bytes);
    const { vkFormat, baseWidth, baseHeight, numComponents, needsTranscoding } = texture;
    const { error, target } = texture.glUpload();
    say("libktx", { vkFormat: vkFormat?.value ?? vkFormat, baseWidth, baseHeight, numComponents, needsTranscoding,
                    failed: error, target: target?.value ?? target,
                    uploads: uploads.map((u) => ({ ...u, bytes: u.bytes.length, digest: digest(u.bytes) })) });
  } catch (e) { say("libktx", { error: String(e) }); }
}
