"""Hardware from data sheets, with a source beside each number: cameras, sensors and the panel."""

from collections.abc import Callable

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware.cameras import demo, prototype, prototype_relay
from optsim.camera.hardware.emva import SUFFIXES, sensor_of
from optsim.camera.hardware.lcr720 import lcr720
from optsim.camera.hardware.sensors import icx674, imx174
from optsim.camera.hardware.sources import sources
from optsim.camera.parts import Ccd

# Cameras by the name that `hardware = "..."` in a [camera] table uses.
ALL: dict[str, Callable[[], CodedCamera]] = {"prototype": prototype, "demo": demo}
# Image sensors by the name that `sensor = "..."` in it uses.
SENSORS: dict[str, Callable[[], Ccd]] = {"icx674": icx674, "imx174": imx174}

__all__ = [
    "ALL",
    "SENSORS",
    "SUFFIXES",
    "demo",
    "icx674",
    "imx174",
    "lcr720",
    "prototype",
    "prototype_relay",
    "sensor_of",
    "sources",
]
