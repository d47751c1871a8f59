"""Preset of this project's own arrays, one .npz an environment."""

from __future__ import annotations

from whitefurnace.engines.engine import Engine, Preset

PRESET = Preset(
    order=10,
    engine=Engine(
        title="numpy arrays in one .npz, GL-direct faces",
        container="npz",
        facts="this project's own",
    ),
)
