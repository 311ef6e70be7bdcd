"""Static (non-adaptive) schemes; the adaptive scheme combines two of them. This is their only list."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from optsim.coding.coded_rolling_shutter import CodedRollingShutter
from optsim.coding.flutter_shutter import FlutterShutter
from optsim.coding.hdr_mosaic import HdrMosaic
from optsim.coding.normal_photography import NormalPhotography
from optsim.coding.random_binary import RandomBinary
from optsim.coding.random_exposure import RandomExposure
from optsim.coding.random_lengths import RandomLengths
from optsim.coding.shutter_grid import ShutterGrid

STATIC_SCHEMES = (
    NormalPhotography,
    HdrMosaic,
    RandomExposure,
    RandomLengths,
    RandomBinary,
    FlutterShutter,
    CodedRollingShutter,
    ShutterGrid,
)
# The same list as a union: a type checker cannot read the tuple.
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
StaticScheme = Annotated[AnyStaticScheme, Field(discriminator="kind")]
