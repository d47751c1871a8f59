"""Reads and writes every file of the package.

Only modules of this package import OpenImageIO, and only when they need it: loading it would slow down `--help`.
"""

import whitefurnace.files.forks  # noqa: F401  it registers what a forked process needs
from whitefurnace.files.arrays import is_arrays, read_header, read_npy, read_npz
from whitefurnace.files.atomic import Transaction, digest_file, write_atomic
from whitefurnace.files.codec import decode, encode, require_encoder
from whitefurnace.files.containers import is_texture, read_texture, write_texture
from whitefurnace.files.env import EnvMap, read_env, write_env
from whitefurnace.files.exr import write_exr
from whitefurnace.files.gltf import Gltf
from whitefurnace.files.gltf_lights import GltfLight, read_gltf_lights, write_gltf_lights
from whitefurnace.files.harmonics import read_sh
from whitefurnace.files.hdr import pack_hdr, unpack_hdr, write_hdr
from whitefurnace.files.image import Image, check_choice, decode_srgb, read_image, srgb_table
from whitefurnace.files.inputs import head_of, input_size, inside, is_input, open_input, read_input, read_text
from whitefurnace.files.lights import (
    Deferred,
    Light,
    is_light,
    light_digest,
    light_extent,
    light_files,
    read_light,
    read_radiance,
)
from whitefurnace.files.lock import Lock, acquire, is_lock, is_safe, lock_path, locks_in
from whitefurnace.files.manifest import read_manifest, write_manifest
from whitefurnace.files.npy import release, scratch, write_npy
from whitefurnace.files.npz import write_npz
from whitefurnace.files.ownership import FileOutput, FolderOutput, system_errors
from whitefurnace.files.packing import pack, unpack
from whitefurnace.files.png import write_png
from whitefurnace.files.stored import ImageFacts, image_facts, read_rgbd, read_stored
from whitefurnace.files.tables import Stored, check_table, identifier, number, stored_format, write_table, write_text
from whitefurnace.files.texture import Texture, text_value

__all__ = [
    "Deferred",
    "EnvMap",
    "FileOutput",
    "FolderOutput",
    "Gltf",
    "GltfLight",
    "Image",
    "ImageFacts",
    "Light",
    "Lock",
    "Stored",
    "Texture",
    "Transaction",
    "acquire",
    "check_choice",
    "check_table",
    "decode",
    "decode_srgb",
    "digest_file",
    "encode",
    "head_of",
    "identifier",
    "image_facts",
    "input_size",
    "inside",
    "is_arrays",
    "is_input",
    "is_light",
    "is_lock",
    "is_safe",
    "is_texture",
    "light_digest",
    "light_extent",
    "light_files",
    "lock_path",
    "locks_in",
    "number",
    "open_input",
    "pack",
    "pack_hdr",
    "read_env",
    "read_gltf_lights",
    "read_header",
    "read_image",
    "read_input",
    "read_light",
    "read_manifest",
    "read_npy",
    "read_npz",
    "read_radiance",
    "read_rgbd",
    "read_sh",
    "read_stored",
    "read_text",
    "read_texture",
    "release",
    "require_encoder",
    "scratch",
    "srgb_table",
    "stored_format",
    "system_errors",
    "text_value",
    "unpack",
    "unpack_hdr",
    "write_atomic",
    "write_env",
    "write_exr",
    "write_gltf_lights",
    "write_hdr",
    "write_manifest",
    "write_npy",
    "write_npz",
    "write_png",
    "write_table",
    "write_text",
    "write_texture",
]
