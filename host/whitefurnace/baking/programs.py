"""Lists the kernel programs that a bake compiles, with their texts. They hold only the models of its recipe."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from whitefurnace.catalogue import Model, integral, model
from whitefurnace.catalogue.registry import LOBE
from whitefurnace.integrals.quadrature import own_kernel_of
from whitefurnace.opencl import source
from whitefurnace.opencl.source import Source
from whitefurnace.prefiltering.plan import plan_chain
from whitefurnace.prefiltering.recipe import Chain

LEAST_TERMS = 16
"""Smallest number of terms of a table of Smith's area. The true number is known when the table is made, and is one line
of the text."""


@dataclass(frozen=True)
class Program:
    """A kernel program of a bake.

    name  its purpose
    when  the condition on the image or the device under which it is built; empty where it is always built
    """

    name: str
    source: Source
    when: str = ""

    @property
    def nbytes(self) -> int:
        """Bytes of the program's text."""
        return len(self.source.text.encode())

    def data(self) -> dict[str, Any]:
        """The program as data for JSON."""
        text = self.source.text
        return {
            "program": self.name,
            "when": self.when or None,
            "digest": self.source.digest,
            "bytes": self.nbytes,
            "lines": text.count("\n"),
            "text": text,
        }


def programs(
    chains: Sequence[Chain], kind: str, texel: float, *, demo: bool = False, charlie: Sequence[str] = ()
) -> tuple[Program, ...]:
    """Return the programs that a bake builds, with those of the split-sum table; equal texts appear once.

    chains: chains of the engines. kind: "latlong" or "cube". texel: width of a source texel in radians. demo: True if
    the built-in environment is made. charlie: maskings of Charlie's albedo in the engines' tables.
    """
    found: dict[str, Program] = {}
    for one in _programs(chains, kind, texel, demo, charlie):
        old = found.get(one.source.digest)
        if old is None or (old.when and not one.when):
            found[one.source.digest] = one
    return tuple(found.values())


def _programs(
    chains: Sequence[Chain], kind: str, texel: float, demo: bool, charlie: Sequence[str]
) -> Iterator[Program]:
    if demo:
        yield Program("built-in environment", source.demo())
    yield Program(f"nodes and harmonics of a {kind}", source.texels(kind))
    yield Program("means over texels", source.overlap(), "where level 0 is made, and in certificates of it")
    sampled = all(chain.samples for chain in chains)
    if any(chain.samples for chain in chains):
        yield Program("filtered importance sampling", source.samples())
    if not sampled:
        yield Program("convolution by the symmetries of the cube", source.octahedral())
        yield Program("interpolation", source.interpolation(), "where a level has more texels than its lobe detail")
    for chain in chains:
        entry = chain.ndf.model
        if not any(level.roughness > 0 for level in plan_chain(chain, texel)):
            continue
        yield Program(
            f"certificates of {entry.name}",
            source.convolution(entry),
            "" if chain.certify else "where levels are certified",
        )
        yield Program(f"bright texels under {entry.name}", source.apart(entry), "where texels stand out")
        yield Program(
            f"texels near a narrow lobe of {entry.name}",
            source.near_texels(kind, entry),
            "where a lobe is narrower than a texel",
        )
        if entry.text is not None:
            yield from _derived(entry)
    yield Program(
        "certificates of irradiance", source.convolution(None), "" if chains[0].certify else "where it is certified"
    )
    yield Program("bright texels under the cosine", source.apart(None), "where texels stand out")
    yield from _integrated("dfg", chains[0].ndf.model)
    for masking in charlie:
        yield from _integrated("albedo", model("ndf", "charlie"), masking)


def _derived(entry: Model) -> Iterator[Program]:
    """Programs that measure a user's NDF: its shape, its norm and its lobe."""
    yield Program(f"shape of {entry.name}", source.evaluation("NDF_D", {"ndf": entry}))
    for one in (integral("normalization"), LOBE):
        yield Program(f"{one.title} of {entry.name}", source.integration(one, {"ndf": entry}))


def _integrated(name: str, ndf: Model, masking: str = "smith") -> Iterator[Program]:
    """Programs of an integral over an NDF with a masking and white Fresnel, as `integrate` builds them."""
    entry = integral(name)
    slots = {"ndf": ndf, "masking": model("masking", masking)}
    if name != "dfg":
        slots["fresnel"] = model("fresnel", "one")
    own = own_kernel_of(entry, slots)
    if own:
        yield Program(f"{name} of {ndf.name}", source.closed(own, slots))
        return
    tabled = "NDF_AREA" in slots["masking"].needs and "NDF_AREA" not in ndf.provides
    yield Program(
        f"{name} of {ndf.name}",
        source.integration(entry, slots, LEAST_TERMS if tabled else 0),
        "with as many AREA_TERMS as its table takes" if tabled else "",
    )
    if tabled:
        yield Program(f"Smith's area of {ndf.name}", source.area(ndf))
        yield Program(f"width of {ndf.name}", source.evaluation("NDF_WIDTH", {"ndf": ndf}))
