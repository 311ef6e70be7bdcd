"""Schemes: each chooses the next code from the frames that have arrived. One scheme a file."""

from typing import Annotated

from pydantic import Field

from optsim.coding.closed_loop_density import ClosedLoopDensity
from optsim.coding.closed_loop_rate import ClosedLoopRate
from optsim.coding.motion_adaptive import MotionAdaptive
from optsim.coding.periodic import PeriodicScheme
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
from optsim.core.config import Part
from optsim.core.extensions import AS_IT_IS, SCHEMES, or_offered

ALL = (*STATIC_SCHEMES, ClosedLoopDensity, ClosedLoopRate, MotionAdaptive)
Scheme = Annotated[
    AnyStaticScheme | ClosedLoopDensity | ClosedLoopRate | MotionAdaptive,
    Field(discriminator="kind"),
    or_offered(SCHEMES, Part),
    AS_IT_IS,
]

__all__ = [
    "ALL",
    "ClosedLoopDensity",
    "ClosedLoopRate",
    "CodedRollingShutter",
    "FlutterShutter",
    "HdrMosaic",
    "MotionAdaptive",
    "NormalPhotography",
    "PeriodicScheme",
    "RandomBinary",
    "RandomExposure",
    "RandomLengths",
    "Scheme",
    "ShutterGrid",
]
