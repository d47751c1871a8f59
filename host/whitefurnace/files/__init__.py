"""Everything that is read from or written to a file. The only importer of OpenImageIO, which is loaded when
first needed: it takes longer to load than `--help` may."""

from whitefurnace.files.atomic import Transaction, digest_file, write_atomic
from whitefurnace.files.containers import is_texture, read_texture, write_texture
from whitefurnace.files.exr import write_exr
from whitefurnace.files.image import Image, decode_srgb, read_image
from whitefurnace.files.manifest import read_manifest, write_manifest
from whitefurnace.files.npy import release, scratch, write_npy
from whitefurnace.files.npz import write_npz
from whitefurnace.files.texture import Texture

__all__ = [
    "Image",
    "Texture",
    "Transaction",
    "decode_srgb",
    "digest_file",
    "is_texture",
    "read_image",
    "read_manifest",
    "read_texture",
    "release",
    "scratch",
    "write_atomic",
    "write_exr",
    "write_manifest",
    "write_npy",
    "write_npz",
    "write_texture",
]
