"""Schemes: which code to show next, from the frames that have arrived. One scheme a file."""

from typing import Annotated

from pydantic import Field

from optsim.coding.leaves import (
    LEAVES,
    AnyLeaf,
    CodedRollingShutter,
    FlutterShutter,
    HdrMosaic,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    RandomLengths,
    ShutterGrid,
)
from optsim.coding.motion_adaptive import MotionAdaptive

ALL = (*LEAVES, MotionAdaptive)
Scheme = Annotated[AnyLeaf | MotionAdaptive, Field(discriminator="kind")]

__all__ = [
    "ALL",
    "CodedRollingShutter",
    "FlutterShutter",
    "HdrMosaic",
    "MotionAdaptive",
    "NormalPhotography",
    "RandomBinary",
    "RandomExposure",
    "RandomLengths",
    "Scheme",
    "ShutterGrid",
]
