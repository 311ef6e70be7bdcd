"""Decoders: coded frames -> Reconstruction, causally, from the calibration alone. One decoder a file."""

from typing import Annotated, get_args

from pydantic import Field

from optsim.core.config import Part
from optsim.core.extensions import AS_IT_IS, DECODERS, or_offered
from optsim.decoding.average import Average
from optsim.decoding.partial import PartialDecoder
from optsim.decoding.partial_decoders import (
    AnyPartialDecoder,
    GaussianMixture,
    HdrMerge,
    Interpolation,
    MotionDeblurring,
    SparseCoding,
    TotalVariation,
)
from optsim.decoding.union import Union

# Decoders that the union may take for moving pixels stand in one list,
# :mod:`optsim.decoding.partial_decoders`.
ALL: tuple[type[Part], ...] = (*get_args(AnyPartialDecoder), Average, Union)
Decoder = Annotated[
    AnyPartialDecoder | Average | Union,
    Field(discriminator="kind"),
    or_offered(DECODERS, Part),
    AS_IT_IS,
]

__all__ = [
    "ALL",
    "Average",
    "Decoder",
    "GaussianMixture",
    "HdrMerge",
    "Interpolation",
    "MotionDeblurring",
    "PartialDecoder",
    "SparseCoding",
    "TotalVariation",
    "Union",
]
