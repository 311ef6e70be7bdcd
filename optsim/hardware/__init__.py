"""Data-sheet instances, a source beside each number."""

from collections.abc import Callable

from optsim.camera import CodedCamera
from optsim.hardware.cameras import demo, prototype, prototype_relay
from optsim.hardware.lcr720 import lcr720
from optsim.hardware.sensors import icx674, imx174

# Cameras by the name that `hardware = "..."` in a [camera] table uses.
ALL: dict[str, Callable[[], CodedCamera]] = {"prototype": prototype, "demo": demo}

__all__ = ["ALL", "demo", "icx674", "imx174", "lcr720", "prototype", "prototype_relay"]
