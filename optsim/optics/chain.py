"""What splitter, polarisers and panel let through together: contrast is an output, never an input."""

from __future__ import annotations

import numpy as np

from optsim.forward.mueller import UNPOLARISED
from optsim.optics.modulator import Modulator
from optsim.optics.splitter import Splitter


def stage_transmissions(
    splitter: Splitter, modulator: Modulator, retardance_rad: float
) -> tuple[float, float, float]:
    """Power transmission of the way in, of the panel and of the way out, for unpolarised light.

    Parameters
    ----------
    splitter, modulator
        True parts.
    retardance_rad : float
        Round-trip retardance of the panel: 0 dark, pi bright.
    """
    at_panel = splitter.inbound() @ UNPOLARISED
    back = modulator.mueller(retardance_rad) @ at_panel
    out = splitter.outbound() @ back
    return float(at_panel[0]), float(back[0] / at_panel[0]), float(out[0] / back[0])


def throughput(splitter: Splitter, modulator: Modulator, retardance_rad: float) -> float:
    """Power transmission of the whole chain for unpolarised light; affine in cos(retardance)."""
    return float(np.prod(stage_transmissions(splitter, modulator, retardance_rad)))


def leak(splitter: Splitter, modulator: Modulator) -> float:
    """Transmission fully off over fully on: one over the system contrast."""
    return throughput(splitter, modulator, 0.0) / throughput(splitter, modulator, np.pi)
