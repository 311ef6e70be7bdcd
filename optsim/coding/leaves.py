"""The schemes that the adaptive one can be made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from optsim.coding.hdr_mosaic import HdrMosaic
from optsim.coding.normal_photography import NormalPhotography
from optsim.coding.random_exposure import RandomExposure

LEAVES = (NormalPhotography, HdrMosaic, RandomExposure)
Leaf = Annotated[NormalPhotography | HdrMosaic | RandomExposure, Field(discriminator="kind")]
