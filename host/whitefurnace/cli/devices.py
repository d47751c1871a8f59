"""`whitefurnace devices`: what it prints and its JSON rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from whitefurnace.cli import options
from whitefurnace.cli.terminal import print_row
from whitefurnace.errors import DeviceError
from whitefurnace.text import table

if TYPE_CHECKING:
    from whitefurnace.opencl.device import Candidate

EPILOG = "\b\nExample:\n  whitefurnace devices\n\nExit codes: 0 a device works, 4 no device works."


@options.command("Lists", "List the OpenCL devices and whether they work", EPILOG)
@options.as_json()
def devices(as_json: bool) -> None:
    """List the OpenCL devices. The verdict comes from a small program that is built and run on each device and whose
    result is checked."""
    from whitefurnace.opencl.device import advice, find_devices

    found = find_devices()
    for candidate in found if as_json else ():
        print_row(asdict(candidate))
    if found and not as_json:
        click.echo(devices_text(found))
    if not any(candidate.works for candidate in found):
        why = "".join(f"; {candidate.name}: {candidate.verdict}" for candidate in found)
        raise DeviceError(f"no OpenCL device {'works' if found else 'was found'}{why}{advice()}")


def devices_text(found: Sequence[Candidate]) -> str:
    """Return the table of devices with their verdicts."""
    rows = [
        [str(c.index), c.type, f"{c.platform}: {c.name}", c.driver, "yes" if c.fp64 else "no", c.verdict] for c in found
    ]
    return table(["", "type", "device", "driver", "float64", "verdict"], rows, left=6)
