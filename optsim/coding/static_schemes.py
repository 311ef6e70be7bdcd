"""The schemes that the adaptive one can be made of: all but itself, listed here and nowhere else."""

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
# The same once more: a type checker reads no tuple.
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
