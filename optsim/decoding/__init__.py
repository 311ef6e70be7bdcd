"""Decoders: coded frames -> Reconstruction, causally, from the calibration alone. One decoder a file."""

from typing import Annotated, get_args

from pydantic import Field

from optsim.core.config import Part
from optsim.core.extensions import AS_IT_IS, DECODERS, or_offered
from optsim.decoding.joined import Joined
from optsim.decoding.partial import PartialDecoder
from optsim.decoding.partial_decoders import (
    AnyPartialDecoder,
    GaussianMixture,
    HdrMerge,
    Interpolation,
    MotionDeblurring,
    P2c2,
    SparseCoding,
    TotalVariation,
    VelocityMixture,
)
from optsim.decoding.union import Union

# Decoders that the union may take for moving pixels stand in one list,
# :mod:`optsim.decoding.partial_decoders`.
ALL: tuple[type[Part], ...] = (*get_args(AnyPartialDecoder), Joined, Union)
Decoder = Annotated[
    AnyPartialDecoder | Joined | Union,
    Field(discriminator="kind"),
    or_offered(DECODERS, Part),
    AS_IT_IS,
]

__all__ = [
    "ALL",
    "Decoder",
    "GaussianMixture",
    "HdrMerge",
    "Interpolation",
    "Joined",
    "MotionDeblurring",
    "P2c2",
    "PartialDecoder",
    "SparseCoding",
    "TotalVariation",
    "Union",
    "VelocityMixture",
]
