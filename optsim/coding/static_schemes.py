"""Static (non-adaptive) schemes; the adaptive scheme combines two of them.

This is their only list, and a new one goes into it.
"""

from __future__ import annotations

from typing import Annotated, get_args

from pydantic import Field

from optsim.coding.coded_rolling_shutter import CodedRollingShutter
from optsim.coding.flutter_shutter import FlutterShutter
from optsim.coding.hdr_mosaic import HdrMosaic
from optsim.coding.normal_photography import NormalPhotography
from optsim.coding.periodic import PeriodicScheme
from optsim.coding.random_binary import RandomBinary
from optsim.coding.random_exposure import RandomExposure
from optsim.coding.random_lengths import RandomLengths
from optsim.coding.shutter_grid import ShutterGrid
from optsim.core.extensions import AS_IT_IS, SCHEMES, or_offered

AnyStaticScheme = (
    NormalPhotography
    | HdrMosaic
    | RandomExposure
    | RandomLengths
    | RandomBinary
    | FlutterShutter
    | CodedRollingShutter
    | ShutterGrid
)
STATIC_SCHEMES: tuple[type[PeriodicScheme], ...] = get_args(AnyStaticScheme)
StaticScheme = Annotated[
    AnyStaticScheme, Field(discriminator="kind"), or_offered(SCHEMES, PeriodicScheme), AS_IT_IS
]
