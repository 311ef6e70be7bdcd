"""The decoders that the union can be made of."""

from optsim.reconstruct.hdr_merge import HdrMerge
from optsim.reconstruct.sparse_coding import SparseCoding

__all__ = ["HdrMerge", "SparseCoding"]
