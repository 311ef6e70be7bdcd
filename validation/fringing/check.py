"""Weights of fine cells against retardance blurred on a grid inside the pixels."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.special import ndtr

from optsim.optics.fringe_correction import FringeCorrection, cell_weights
from optsim.optics.fringing import border_shares, fine_image
from optsim.optics.panel import PanelResponse, settled_panel, slot_weights

CLAIM = (
    "under fringing fields the weights of fine cells, summed over a frame of random, short and grey codes, "
    "are those of retardance blurred by a Gaussian, to 2 % of what fringing changes"
)
ORACLE = (
    "retardance on 15 x 15 Gauss-Legendre points a pixel, blurred by scipy's normal law at 24 times of each "
    "slot of its relaxation; sin^2 averaged over fine cells and the frame; numpy and scipy only"
)
SOURCE = "PHYSICS: fringing acts on retardance; sin^2(G/2) of a retarder between crossed polarisers"
TOLERANCE = 0.025
REASON = (
    "Rms over fine cells, relative to the rms change that fringing makes in their sums. The default nodes "
    "leave 1.7 %, which moves no score by 0.1 dB (reports/fidelity.md); the finer ones leave 0.04 %, mixing "
    "the neighbours' weights 37 %."
)
FILES = (
    "optsim/optics/fringing.py",
    "optsim/optics/panel.py",
    "optsim/optics/radau.py",
    "optsim/optics/relaxation.py",
    "optsim/optics/fringe_correction.py",
    "optsim/optics/fringe_loops.py",
)

# Pixels enough for the compiled loop, and rows for several of its bands.
_SIDE, _SLOTS, _TIMES, _SLOT_S = 56, 36, 24, 1 / 180
_NODES, _SHARES = np.polynomial.legendre.leggauss(5)
_DRIVES, _SIGMA_PX = (1.01, 1.0, 0.99), 0.1


def _oracle(levels: np.ndarray) -> np.ndarray:
    """Sum of the fine cells' weights over all slots, (3 v, 3 u)."""
    gamma = np.zeros((_SIDE, _SIDE))
    total = np.zeros((3 * _SIDE, 3 * _SIDE))
    place = ((np.arange(3 * _SIDE)[:, None] + (_NODES + 1) / 2) / 3).reshape(-1, 1)
    # Beyond the border the nearest pixel counts.
    edges = np.concatenate([[-np.inf], np.arange(1.0, _SIDE), [np.inf]])
    blur = csr_array(np.diff(ndtr((edges - place) / _SIGMA_PX), axis=1).astype(np.float32))
    roots, weights = np.polynomial.legendre.leggauss(_TIMES)
    # Times lie denser where a slot has just begun: they are squares of the roots, from 0 to 1.
    times, weights = ((roots + 1) / 2) ** 2, weights * (roots + 1) / 2
    for slot, level in enumerate(levels):
        target = _DRIVES[slot % 3] * np.pi * (level / 255) ** 1.2
        tau = np.where(target > gamma, 0.5e-3, 1.0e-3)
        for time, weight in zip(times, weights, strict=True):
            now = (target + (gamma - target) * np.exp(-time * _SLOT_S / tau)).astype(np.float32)
            bright = (1 - np.cos((blur @ (blur @ now).T).T)) / 2
            cells = bright.reshape(3 * _SIDE, 5, 3 * _SIDE, 5) @ (_SHARES / 2)
            total += weight * np.tensordot(cells, _SHARES / 2, (1, 0))
        gamma = target + (gamma - target) * np.exp(-_SLOT_S / tau)
    return total


def _error(sigma_px: float) -> float:
    rng = np.random.default_rng(7)
    levels = rng.choice([0, 255], (_SLOTS, _SIDE, _SIDE), p=[0.7, 0.3]).astype(np.uint8)
    start = rng.integers(0, _SLOTS - 2, (_SIDE, _SIDE // 4))
    slot = np.arange(_SLOTS)[:, None, None]
    levels[:, :, _SIDE // 4 : _SIDE // 2] = ((slot >= start) & (slot < start + 3)) * 255
    levels[:, :, _SIDE // 2 :] = rng.choice([0, 64, 160, 255], (_SIDE, _SIDE // 2))
    response = PanelResponse(leak=0.0, field_drive=_DRIVES)
    dark = settled_panel(levels[0] * 0, response)
    weights, _ = slot_weights(levels, dark, response, _SLOT_S)
    fringe_correction = FringeCorrection(
        levels, dark, response, _SLOT_S, 1, np.zeros(_SIDE), sigma_px, 3, "coarse"
    )
    ours = cell_weights(fringe_correction, weights).sum(axis=0, dtype=np.float64)
    plain = fine_image(weights.sum(axis=0, dtype=np.float64), border_shares(0.0, 3))
    true = _oracle(levels)
    return float(np.sqrt(np.mean((ours - true) ** 2) / np.mean((plain - true) ** 2)))


def measure() -> float:
    """Find what is left of the effect."""
    return _error(_SIGMA_PX)


def perturbed() -> float:
    """With a blur a twentieth wider."""
    return _error(1.05 * _SIGMA_PX)
