"""Schemes: each chooses the next code from the frames that have arrived. One scheme a file."""

from typing import Annotated

from pydantic import Field

from optsim.coding.motion_adaptive import MotionAdaptive
from optsim.coding.static_schemes import (
    STATIC_SCHEMES,
    AnyStaticScheme,
    CodedRollingShutter,
    FlutterShutter,
    HdrMosaic,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    RandomLengths,
    ShutterGrid,
)

ALL = (*STATIC_SCHEMES, MotionAdaptive)
Scheme = Annotated[AnyStaticScheme | MotionAdaptive, Field(discriminator="kind")]

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
