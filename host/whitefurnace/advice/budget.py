"""The error budget of a scene in an environment: the error of each approximation, and the cheapest bake within a
tolerance."""

from __future__ import annotations

from collections.abc import Sequence

from whitefurnace.advice.choose import TOLERANCE_RANGE, Choice, choose
from whitefurnace.advice.measure import Budget, Entry, ErrorMeter
from whitefurnace.advice.points import ScenePoints, sample_points
from whitefurnace.engines.presets import Engine
from whitefurnace.opencl.device import Device, choose_device
from whitefurnace.prefiltering.recipe import Chain, chain
from whitefurnace.scenes.materials import Scene
from whitefurnace.sphere.environments import Environment, environment


def usual(engine: Engine, *, size: int | None = None) -> Chain:
    """Return the chain that is baked for an engine by default.

    size: face edge of level 0 in texels, a power of two; None for the engine's own. Raises UsageError otherwise.
    """
    return chain(
        size=engine.size if size is None else size,
        levels=engine.levels or None,
        lods=engine.lods,
        usual_min=engine.min_size,
    )


def measure(scene: Scene, env: Environment, engine: Engine, recipe: Chain | None, device: Device) -> Budget:
    """Measure the error budget of a scene in an environment under an engine's bake.

    recipe: the chain that is baked; None for the engine's usual one. Raises InputError for a scene without lit
    materials, UnsupportedError for an engine that gets no prefiltered chain, and DeviceError.
    """
    return ErrorMeter(scene, env, engine, device).budget(recipe or usual(engine))


def of_image(
    scene: Scene,
    source: str,
    engine: Engine,
    tolerance: float | None = None,
    device: str | None = None,
    without: Sequence[str] = (),
) -> tuple[Budget, Choice | None]:
    """Measure the error budget of an engine's usual bake, and find the cheapest set of files within a tolerance.

    source: path of an image, or "demo" for the built-in environment. tolerance: largest RMS error, in TOLERANCE_RANGE;
    None to choose no files. without: parts of the engine's files to leave out. Raises the errors of `ErrorMeter`,
    `choose`, `environment` and `choose_device`.
    """
    on = choose_device(device)
    env = environment(source, device=on)
    meter, recipe = ErrorMeter(scene, env, engine, on, without=without), usual(engine)
    return meter.budget(recipe), None if tolerance is None else choose(meter, tolerance, recipe)


__all__ = [
    "TOLERANCE_RANGE",
    "Budget",
    "Choice",
    "Entry",
    "ErrorMeter",
    "ScenePoints",
    "choose",
    "measure",
    "of_image",
    "sample_points",
    "usual",
]
