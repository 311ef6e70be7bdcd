"""The list of the decoders that a union may join; add a new decoder to it."""

from optsim.decoding.gaussian_mixture import GaussianMixture
from optsim.decoding.hdr_merge import HdrMerge
from optsim.decoding.interpolation import Interpolation
from optsim.decoding.motion_deblurring import MotionDeblurring
from optsim.decoding.p2c2 import P2c2
from optsim.decoding.sparse_coding import SparseCoding
from optsim.decoding.total_variation import TotalVariation
from optsim.decoding.velocity_mixture import VelocityMixture

AnyPartialDecoder = (
    HdrMerge
    | SparseCoding
    | GaussianMixture
    | VelocityMixture
    | Interpolation
    | TotalVariation
    | P2c2
    | MotionDeblurring
)
