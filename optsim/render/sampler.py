"""Random numbers keyed by pixel: a pixel's samples do not depend on the other pixels rendered.

Hash-based Owen scrambling of the first two Sobol dimensions, padded with an independent shuffle for each
further pair: B. Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020; the permutation is that of
S. Laine and T. Karras, "Stratified Sampling for Stochastic Transparency", EGSR 2011.
"""

from __future__ import annotations

from typing import Any


def pixel_sampler(mi: Any, dr: Any) -> Any:
    """Make the sampler class of the active Mitsuba variant (a ``mi.Sampler``)."""

    def mix(x: Any, y: Any) -> Any:
        """Hash two 32-bit integers into one (murmur3's finaliser after a multiplicative combination)."""
        h = (
            mi.UInt32(x) * mi.UInt32(0x9E3779B1)
            + mi.UInt32(y) * mi.UInt32(0x85EBCA77)
            + mi.UInt32(0x165667B1)
        )
        h = (h ^ (h >> 16)) * mi.UInt32(0x7FEB352D)
        h = (h ^ (h >> 15)) * mi.UInt32(0x846CA68B)
        return h ^ (h >> 16)

    def owen(x: Any, key: Any) -> Any:
        """Owen-scramble the bits of x from the most significant down."""
        x = dr.brev(x)
        x += key
        x ^= x * mi.UInt32(0x6C50B47C)
        x ^= x * mi.UInt32(0xB82F1E52)
        x ^= x * mi.UInt32(0xC7AFE638)
        x ^= x * mi.UInt32(0x8D22F6E6)
        return dr.brev(x)

    def unit(x: Any) -> Any:
        return mi.Float(x >> 8) * 2**-24

    class PixelSampler(mi.Sampler):
        """Sample number, hash of (pixel, seed) and dimension, as state of the renderer's loops."""

        def __init__(self, props: Any = None) -> None:
            mi.Sampler.__init__(self, props or mi.Properties())
            self.index, self.key, self.dimension = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

        def start(self, seed: Any, pixel: Any, index: Any) -> None:
            self.index, self.key, self.dimension = mi.UInt32(index), mix(pixel, seed), mi.UInt32(0)

        def next_1d(self, active: Any = True) -> Any:
            key = mix(self.key, self.dimension)
            self.dimension += 1
            return unit(owen(dr.brev(owen(self.index, key)), mix(key, 1)))

        def next_2d(self, active: Any = True) -> Any:
            key = mix(self.key, self.dimension)
            self.dimension += 1
            shuffled = owen(self.index, key)
            second = mi.UInt32(mi.sobol_2(shuffled, mi.UInt32(0)) * 2**24) << 8
            return mi.Point2f(unit(owen(dr.brev(shuffled), mix(key, 1))), unit(owen(second, mix(key, 2))))

        def fork(self) -> Any:
            return PixelSampler()

        def clone(self) -> Any:
            return PixelSampler()

        def seed(self, seed: Any, wavefront_size: Any = 0) -> None:
            pass

        def schedule_state(self) -> None:
            dr.schedule(self.index, self.key, self.dimension)

    return PixelSampler
