"""Preset of this project's own levels as OpenEXR images."""

from __future__ import annotations

from whitefurnace.engines.engine import Engine, Preset

PRESET = Preset(
    order=20,
    engine=Engine(
        title="OpenEXR float32: a vertical strip and a lat-long a level",
        container="exr",
        latlong=True,
        facts="this project's own",
    ),
)
