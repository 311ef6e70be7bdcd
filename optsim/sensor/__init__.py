"""The image sensor with its true parameters."""

from optsim.sensor.ccd import Ccd

__all__ = ["Ccd"]
