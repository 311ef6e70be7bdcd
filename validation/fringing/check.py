"""Weights mixed with the neighbours' against retardance blurred on a grid inside the pixels."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from optsim.forward.fringing import border_shares
from optsim.forward.integrate import fine_image
from optsim.forward.panel import PanelResponse, settled_panel, slot_weights

CLAIM = (
    "mixing each pixel's weight with its neighbours' does to a random code, at the rims and summed over a "
    "frame, most of what a Gaussian blur of the retardance does"
)
ORACLE = (
    "retardance on 15 x 15 points a pixel, blurred in each of 120 steps a slot of its relaxation; sin^2 "
    "averaged over fine cells and the frame; numpy and scipy's Gaussian filter"
)
SOURCE = "PHYSICS: fringing acts on retardance; sin^2(G/2) of a retarder between crossed polarisers"
# Rms over fine cells of the error of the weight summed over a frame, relative to that sum's rms change by
# fringing: what the short cut leaves of the effect. Straight borders between black and white that stand still
# are exact, and a still black and white mosaic leaves 0.1; greys and passing times leave 0.37. It is worth
# its name as long as it is nearer to the truth than to nothing by a good margin.
TOLERANCE = 0.4
FILES = (
    "optsim/forward/fringing.py",
    "optsim/forward/panel.py",
    "optsim/forward/relaxation.py",
    "optsim/forward/integrate.py",
)

_POINTS, _SIDE, _SLOTS, _STEPS, _SLOT_S = 15, 16, 36, 120, 1 / 180


def _oracle(levels: np.ndarray, sigma_px: float) -> np.ndarray:
    """Sum of the fine cells' weights over all slots, (3 v, 3 u)."""
    gamma = np.zeros((_SIDE, _SIDE))
    total = np.zeros((3 * _SIDE, 3 * _SIDE))
    part = _POINTS // 3
    for level in levels:
        target = np.pi * (level / 255) ** 1.2
        tau = np.where(target > gamma, 0.5e-3, 1.0e-3)
        for step in range(_STEPS):
            now = target + (gamma - target) * np.exp(-(step + 0.5) * _SLOT_S / _STEPS / tau)
            points = now.repeat(_POINTS, 0).repeat(_POINTS, 1)
            bright = np.sin(gaussian_filter(points, sigma_px * _POINTS, mode="nearest") / 2) ** 2
            total += bright.reshape(3 * _SIDE, part, 3 * _SIDE, part).mean(axis=(1, 3)) / _STEPS
        gamma = target + (gamma - target) * np.exp(-_SLOT_S / tau)
    return total


def _error(sigma_px: float) -> float:
    levels = np.random.default_rng(7).choice([0, 255], (_SLOTS, _SIDE, _SIDE), p=[0.7, 0.3]).astype(np.uint8)
    levels[:, :, _SIDE // 2 :] = np.random.default_rng(8).choice([0, 64, 160, 255], (_SIDE, _SIDE // 2))
    response = PanelResponse(leak=0.0)
    weights, _ = slot_weights(levels, settled_panel(levels[0] * 0, response), response, _SLOT_S)
    summed = weights.sum(axis=0, dtype=np.float64)
    ours, plain = (fine_image(summed, border_shares(s, 3)) for s in (sigma_px, 0.0))
    true = _oracle(levels, 0.1)
    inner = np.s_[3:-3, 3:-3]
    return float(np.sqrt(np.mean((ours - true)[inner] ** 2) / np.mean((plain - true)[inner] ** 2)))


def measure() -> float:
    """Find what the short cut leaves of the effect."""
    return _error(0.1)


def perturbed() -> float:
    """With a blur of the weights as wide as that of the retardance, half as wide again as it should be."""
    return _error(0.16)
