"""Names of the pixel formats of Vulkan, DXGI and OpenGL, so that an error can name a format that is not read.

A texture of such a format is valid, and a message of its name is more help than a number.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

_INTEGERS = ("UNORM", "SNORM", "USCALED", "SSCALED", "UINT", "SINT")
_ASTC = ("4x4", "5x4", "5x5", "6x5", "6x6", "8x5", "8x6", "8x8", "10x5", "10x6", "10x8", "10x10", "12x10", "12x12")


def vk_name(code: int) -> str | None:
    """Return the name of a VkFormat without its prefix VK_FORMAT_, such as BC7_SRGB_BLOCK; None where it has none."""
    return _vk_names().get(code)


def dxgi_name(code: int) -> str | None:
    """Return the name of a DXGI_FORMAT without its prefix, such as BC7_UNORM_SRGB; None where it has none."""
    names = _dxgi_names()
    return names[code] if 0 < code < len(names) else None


def gl_name(code: int) -> str | None:
    """Return the name of an internal format of OpenGL, such as GL_ETC1_RGB8_OES; None where it is not listed here."""
    return _gl_names().get(code)


@cache
def _vk_names() -> dict[int, str]:
    """The numbers of VkFormat [Vulkan 1.3, 49.1]."""
    names = dict(enumerate(_vk_core()))
    for k, size in enumerate(("PVRTC1_2BPP", "PVRTC1_4BPP", "PVRTC2_2BPP", "PVRTC2_4BPP")):
        names[1000054000 + k], names[1000054004 + k] = f"{size}_UNORM_BLOCK_IMG", f"{size}_SRGB_BLOCK_IMG"
    names |= {1000066000 + k: f"ASTC_{size}_SFLOAT_BLOCK" for k, size in enumerate(_ASTC)}
    names |= {1000340000: "A4R4G4B4_UNORM_PACK16", 1000340001: "A4B4G4R4_UNORM_PACK16"}
    return names


def _vk_core() -> Iterator[str]:
    yield "UNDEFINED"
    yield "R4G4_UNORM_PACK8"
    for order in ("R4G4B4A4", "B4G4R4A4", "R5G6B5", "B5G6R5", "R5G5B5A1", "B5G5R5A1", "A1R5G5B5"):
        yield f"{order}_UNORM_PACK16"
    for order in ("R8", "R8G8", "R8G8B8", "B8G8R8", "R8G8B8A8", "B8G8R8A8", "A8B8G8R8"):
        end = "_PACK32" if order[0] == "A" else ""
        yield from (f"{order}_{kind}{end}" for kind in (*_INTEGERS, "SRGB"))
    for order in ("A2R10G10B10", "A2B10G10R10"):
        yield from (f"{order}_{kind}_PACK32" for kind in _INTEGERS)
    for bits, kinds in (
        (16, (*_INTEGERS, "SFLOAT")),
        (32, ("UINT", "SINT", "SFLOAT")),
        (64, ("UINT", "SINT", "SFLOAT")),
    ):
        for letters in ("R", "RG", "RGB", "RGBA"):
            order = "".join(f"{letter}{bits}" for letter in letters)
            yield from (f"{order}_{kind}" for kind in kinds)
    yield from ("B10G11R11_UFLOAT_PACK32", "E5B9G9R9_UFLOAT_PACK32", "D16_UNORM", "X8_D24_UNORM_PACK32", "D32_SFLOAT")
    yield from ("S8_UINT", "D16_UNORM_S8_UINT", "D24_UNORM_S8_UINT", "D32_SFLOAT_S8_UINT")
    for block in ("BC1_RGB", "BC1_RGBA", "BC2", "BC3", "BC4", "BC5", "BC6H", "BC7"):
        pairs = {"BC4": ("UNORM", "SNORM"), "BC5": ("UNORM", "SNORM"), "BC6H": ("UFLOAT", "SFLOAT")}
        yield from (f"{block}_{kind}_BLOCK" for kind in pairs.get(block, ("UNORM", "SRGB")))
    for block in ("ETC2_R8G8B8", "ETC2_R8G8B8A1", "ETC2_R8G8B8A8", "EAC_R11", "EAC_R11G11"):
        yield from (f"{block}_{kind}_BLOCK" for kind in ("UNORM", "SNORM" if block[:3] == "EAC" else "SRGB"))
    for size in _ASTC:
        yield from (f"ASTC_{size}_{kind}_BLOCK" for kind in ("UNORM", "SRGB"))


@cache
def _dxgi_names() -> tuple[str, ...]:
    """The numbers of DXGI_FORMAT from 0 on [Microsoft, dxgiformat.h]; texts of several names share a beginning."""
    families = (
        "UNKNOWN",
        "R32G32B32A32 TYPELESS FLOAT UINT SINT",
        "R32G32B32 TYPELESS FLOAT UINT SINT",
        "R16G16B16A16 TYPELESS FLOAT UNORM UINT SNORM SINT",
        "R32G32 TYPELESS FLOAT UINT SINT",
        "R32G8X24_TYPELESS",
        "D32_FLOAT_S8X24_UINT",
        "R32_FLOAT_X8X24_TYPELESS",
        "X32_TYPELESS_G8X24_UINT",
        "R10G10B10A2 TYPELESS UNORM UINT",
        "R11G11B10_FLOAT",
        "R8G8B8A8 TYPELESS UNORM UNORM_SRGB UINT SNORM SINT",
        "R16G16 TYPELESS FLOAT UNORM UINT SNORM SINT",
        "R32_TYPELESS",
        "D32_FLOAT",
        "R32 FLOAT UINT SINT",
        "R24G8_TYPELESS",
        "D24_UNORM_S8_UINT",
        "R24_UNORM_X8_TYPELESS",
        "X24_TYPELESS_G8_UINT",
        "R8G8 TYPELESS UNORM UINT SNORM SINT",
        "R16 TYPELESS FLOAT",
        "D16_UNORM",
        "R16 UNORM UINT SNORM SINT",
        "R8 TYPELESS UNORM UINT SNORM SINT",
        "A8_UNORM",
        "R1_UNORM",
        "R9G9B9E5_SHAREDEXP",
        "R8G8_B8G8_UNORM",
        "G8R8_G8B8_UNORM",
        "BC1 TYPELESS UNORM UNORM_SRGB",
        "BC2 TYPELESS UNORM UNORM_SRGB",
        "BC3 TYPELESS UNORM UNORM_SRGB",
        "BC4 TYPELESS UNORM SNORM",
        "BC5 TYPELESS UNORM SNORM",
        "B5G6R5_UNORM",
        "B5G5R5A1_UNORM",
        "B8G8R8A8_UNORM",
        "B8G8R8X8_UNORM",
        "R10G10B10_XR_BIAS_A2_UNORM",
        "B8G8R8A8 TYPELESS UNORM_SRGB",
        "B8G8R8X8 TYPELESS UNORM_SRGB",
        "BC6H TYPELESS UF16 SF16",
        "BC7 TYPELESS UNORM UNORM_SRGB",
        *("AYUV", "Y410", "Y416", "NV12", "P010", "P016", "420_OPAQUE", "YUY2", "Y210", "Y216", "NV11", "AI44", "IA44"),
        *("P8", "A8P8", "B4G4R4A4_UNORM"),
    )
    names: list[str] = []
    for family in families:
        stem, *ends = family.split()
        names += [f"{stem}_{end}" for end in ends] if ends else [stem]
    return tuple(names)


@cache
def _gl_names() -> dict[int, str]:
    """The numbers of OpenGL that KTX 1 files have as internal formats [GL 4.6 core and the registry of extensions]."""
    names = {
        0x2A10: "GL_R3_G3_B2",
        0x8C40: "GL_SRGB",
        0x8C42: "GL_SRGB_ALPHA",
        0x8D62: "GL_RGB565",
        0x8D64: "GL_ETC1_RGB8_OES",
        0x8FBD: "GL_SR8_EXT",
        0x8FBE: "GL_SRG8_EXT",
        0x906F: "GL_RGB10_A2UI",
    }
    runs = {
        0x1902: "DEPTH_COMPONENT RED GREEN BLUE ALPHA RGB RGBA LUMINANCE LUMINANCE_ALPHA",
        0x803B: "ALPHA4 ALPHA8 ALPHA12 ALPHA16 LUMINANCE4 LUMINANCE8 LUMINANCE12 LUMINANCE16",
        0x8043: "LUMINANCE4_ALPHA4 LUMINANCE6_ALPHA2 LUMINANCE8_ALPHA8 LUMINANCE12_ALPHA4 LUMINANCE12_ALPHA12",
        0x8048: "LUMINANCE16_ALPHA16 INTENSITY INTENSITY4 INTENSITY8 INTENSITY12 INTENSITY16",
        0x804F: "RGB4 RGB5 RGB8 RGB10 RGB12 RGB16 RGBA2 RGBA4 RGB5_A1 RGBA8 RGB10_A2 RGBA12 RGBA16",
        0x81A5: "DEPTH_COMPONENT16 DEPTH_COMPONENT24 DEPTH_COMPONENT32",
        0x8227: "RG RG_INTEGER R8 R16 RG8 RG16 R16F R32F RG16F RG32F R8I R8UI R16I R16UI R32I R32UI RG8I RG8UI",
        0x8239: "RG16I RG16UI RG32I RG32UI",
        0x83F0: "COMPRESSED_RGB_S3TC_DXT1 COMPRESSED_RGBA_S3TC_DXT1 COMPRESSED_RGBA_S3TC_DXT3",
        0x83F3: "COMPRESSED_RGBA_S3TC_DXT5",
        0x8814: "RGBA32F RGB32F ALPHA32F INTENSITY32F LUMINANCE32F LUMINANCE_ALPHA32F",
        0x881A: "RGBA16F RGB16F ALPHA16F INTENSITY16F LUMINANCE16F LUMINANCE_ALPHA16F",
        0x8C00: "COMPRESSED_RGB_PVRTC_4BPPV1 COMPRESSED_RGB_PVRTC_2BPPV1 COMPRESSED_RGBA_PVRTC_4BPPV1",
        0x8C03: "COMPRESSED_RGBA_PVRTC_2BPPV1",
        0x8C3A: "R11F_G11F_B10F",
        0x8C3D: "RGB9_E5",
        0x8C41: "SRGB8",
        0x8C43: "SRGB8_ALPHA8",
        0x8C4C: "COMPRESSED_SRGB_S3TC_DXT1 COMPRESSED_SRGB_ALPHA_S3TC_DXT1 COMPRESSED_SRGB_ALPHA_S3TC_DXT3",
        0x8C4F: "COMPRESSED_SRGB_ALPHA_S3TC_DXT5",
        0x8D70: "RGBA32UI RGB32UI",
        0x8D76: "RGBA16UI RGB16UI",
        0x8D7C: "RGBA8UI RGB8UI",
        0x8D82: "RGBA32I RGB32I",
        0x8D88: "RGBA16I RGB16I",
        0x8D8E: "RGBA8I RGB8I",
        0x8DBB: "COMPRESSED_RED_RGTC1 COMPRESSED_SIGNED_RED_RGTC1 COMPRESSED_RG_RGTC2 COMPRESSED_SIGNED_RG_RGTC2",
        0x8E8C: "COMPRESSED_RGBA_BPTC_UNORM COMPRESSED_SRGB_ALPHA_BPTC_UNORM COMPRESSED_RGB_BPTC_SIGNED_FLOAT",
        0x8E8F: "COMPRESSED_RGB_BPTC_UNSIGNED_FLOAT",
        0x8F94: "R8_SNORM RG8_SNORM RGB8_SNORM RGBA8_SNORM R16_SNORM RG16_SNORM RGB16_SNORM RGBA16_SNORM",
        0x9270: "COMPRESSED_R11_EAC COMPRESSED_SIGNED_R11_EAC COMPRESSED_RG11_EAC COMPRESSED_SIGNED_RG11_EAC",
        0x9274: "COMPRESSED_RGB8_ETC2 COMPRESSED_SRGB8_ETC2 COMPRESSED_RGB8_PUNCHTHROUGH_ALPHA1_ETC2",
        0x9277: "COMPRESSED_SRGB8_PUNCHTHROUGH_ALPHA1_ETC2 COMPRESSED_RGBA8_ETC2_EAC COMPRESSED_SRGB8_ALPHA8_ETC2_EAC",
    }
    for first, run in runs.items():
        names |= {first + k: f"GL_{name}" for k, name in enumerate(run.split())}
    for k, size in enumerate(_ASTC):
        names[0x93B0 + k] = f"GL_COMPRESSED_RGBA_ASTC_{size}_KHR"
        names[0x93D0 + k] = f"GL_COMPRESSED_SRGB8_ALPHA8_ASTC_{size}_KHR"
    return names
