"""Slot weights of the liquid crystal, with history, against a brute-force relaxation."""

from __future__ import annotations

import numpy as np

from optsim.forward.panel import PanelResponse, slot_weights

CLAIM = (
    "mean transmission of each slot follows from exponential relaxation of the retardance, history included"
)
ORACLE = "rate equation of the retardance in small steps, sin^2 averaged by the midpoint rule; numpy only"
SOURCE = "dG/dt = (G_inf - G) / tau, tau by direction; sin^2(G/2) of a retarder between crossed polarisers"
# The table claims 3e-6; steps of a thousandth of tau leave the midpoint rule 1e-7.
TOLERANCE = 1e-5
FILES = ("optsim/forward/panel.py",)

_SLOT_S, _SLOTS, _PIXELS, _STEPS = 1 / 180, 12, 24, 12_000
_LEAK, _EXPONENT = 0.01, 1.2


def _oracle(levels: np.ndarray, tau_on_s: float, tau_off_s: float) -> np.ndarray:
    """Relax in small steps by the midpoint rule."""
    step = _SLOT_S / _STEPS
    gamma = np.zeros(levels.shape[1])
    weights = np.empty(levels.shape)
    for slot, level in enumerate(levels):
        target = np.pi * (level / 255) ** _EXPONENT
        tau = np.where(target > gamma, tau_on_s, tau_off_s)
        total = np.zeros_like(gamma)
        for _ in range(_STEPS):
            half = gamma + (target - gamma) / tau * step / 2
            total += np.sin(half / 2) ** 2
            gamma = gamma + (target - half) / tau * step
        weights[slot] = _LEAK + (1 - _LEAK) * total / _STEPS
    return weights


def _worst(tau_on_s: float, tau_off_s: float) -> float:
    rng = np.random.default_rng(1)
    levels = rng.choice([0, 40, 128, 255], (_SLOTS, _PIXELS)).astype(np.uint8)
    response = PanelResponse(tau_on_s=tau_on_s, tau_off_s=tau_off_s, leak=_LEAK, drive_exponent=_EXPONENT)
    found, _ = slot_weights(levels[:, None, :], np.zeros((1, _PIXELS), np.float32), response, _SLOT_S)
    error = found[:, 0, :] - _oracle(levels, 0.5e-3, 1.0e-3)
    return float(error.ravel()[np.abs(error).argmax()])


def measure() -> float:
    """Find the largest deviation of a weight over random sequences of levels."""
    return _worst(0.5e-3, 1.0e-3)


def perturbed() -> float:
    """Swap rise and fall."""
    return _worst(1.0e-3, 0.5e-3)
