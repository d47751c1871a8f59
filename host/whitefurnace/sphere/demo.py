"""The pixels of the built-in environment, made by a kernel."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from whitefurnace.opencl import source
from whitefurnace.opencl.device import Device

HEIGHT = 512
SUN_RADIUS = math.radians(0.2665)  # of the sun as seen from the earth
SUN_RADIANCE = 4e5


def demo_pixels(device: Device, height: int = HEIGHT) -> npt.NDArray[np.float32]:
    """Return a lat-long (height, 2·height, 3): sky, ground, and a sun of more than 1e5 times the mean radiance."""
    program = device.build(source.demo().text, {"W": 1, "T": 1, "PRECISION": 32})
    # At the centre of a texel, so that the disc covers one whole and the maximum is the sun's own radiance.
    theta = (round(0.29 * height) + 0.5) * math.pi / height
    phi = (round(1.27 * height) + 0.5) * math.pi / height - math.pi
    size = device.local_size
    image = device.empty((height, 2 * height, 3), np.float32)
    count = -(-2 * height * height // size) * size
    sun = [math.sin(theta) * math.cos(phi), math.cos(theta), math.sin(theta) * math.sin(phi)]
    device.launch(
        program.kernel("demo"),
        (count,),
        (
            image,
            np.int32(height),
            np.int32(4),
            *(np.float32(x) for x in sun),
            np.float32(math.cos(SUN_RADIUS)),
            np.float32(SUN_RADIANCE),
        ),
    )
    found: npt.NDArray[np.float32] = image.read()
    return found
