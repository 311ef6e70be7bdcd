"""The decoders that others are made of."""

from optsim.reconstruct.gaussian_mixture import GaussianMixture
from optsim.reconstruct.hdr_merge import HdrMerge
from optsim.reconstruct.interpolation import Interpolation
from optsim.reconstruct.motion_deblurring import MotionDeblurring
from optsim.reconstruct.sparse_coding import SparseCoding
from optsim.reconstruct.total_variation import TotalVariation

__all__ = [
    "GaussianMixture",
    "HdrMerge",
    "Interpolation",
    "MotionDeblurring",
    "SparseCoding",
    "TotalVariation",
]
