"""Schemes: which code to show next, from the frames that have arrived. One scheme a file."""

from typing import Annotated

from pydantic import Field

from optsim.coding.leaves import LEAVES, HdrMosaic, NormalPhotography, RandomExposure
from optsim.coding.motion_adaptive import MotionAdaptive

ALL = (*LEAVES, MotionAdaptive)
Scheme = Annotated[
    NormalPhotography | HdrMosaic | RandomExposure | MotionAdaptive, Field(discriminator="kind")
]

__all__ = ["ALL", "HdrMosaic", "MotionAdaptive", "NormalPhotography", "RandomExposure", "Scheme"]
