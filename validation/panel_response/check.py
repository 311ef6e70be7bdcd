"""Slot weights of the liquid crystal, with history, against a brute-force relaxation."""

from __future__ import annotations

import numpy as np

from optsim.optics.panel import PanelResponse, settled_panel, slot_weights

CLAIM = (
    "mean transmission of each slot follows from exponential relaxation of the retardance, history included, "
    "with rows that turn late and fields that are driven differently"
)
ORACLE = "rate equation of the retardance in small steps, sin^2 averaged by the midpoint rule; numpy only"
SOURCE = "dG/dt = (G_inf - G) / tau, tau by direction; sin^2(G/2) of a retarder between crossed polarisers"
TOLERANCE = 1e-5
REASON = (
    "Weights claim 1.2e-7; steps of a thousandth of tau leave the midpoint rule 1e-7, and float32 "
    "retardance carried through the slots some 1e-6."
)
FILES = (
    "optsim/optics/panel.py",
    "optsim/optics/relaxation.py",
)

_SLOT_S, _SLOTS, _PIXELS, _STEPS = 1 / 180, 12, 24, 12_000
_LEAK, _EXPONENT, _FIELDS = 0.01, 1.2, (1.0, 0.95, 1.03)
_ROWS, _DELAY_STEPS, _SCAN_STEPS = 3, 600, 3600  # a row turns by whole steps


def _oracle(levels: np.ndarray, late_steps: int, tau_on_s: float, tau_off_s: float) -> np.ndarray:
    """Relax in small steps by the midpoint rule."""
    step = _SLOT_S / _STEPS
    told = np.concatenate([np.zeros_like(levels[:1]), levels])
    drive = np.array([_FIELDS[(slot - 1) % 3] for slot in range(len(told))])[:, None]
    targets = drive * np.pi * (told / 255) ** _EXPONENT
    gamma = targets[0].copy()
    weights = np.empty(levels.shape)
    for slot in range(len(levels)):
        total = np.zeros_like(gamma)
        for now in range(_STEPS):
            target = targets[slot] if now < late_steps else targets[slot + 1]
            tau = np.where(target > gamma, tau_on_s, tau_off_s)
            half = gamma + (target - gamma) / tau * step / 2
            total += np.sin(half / 2) ** 2
            gamma = gamma + (target - half) / tau * step
        weights[slot] = _LEAK + (1 - _LEAK) * total / _STEPS
    return weights


def _worst(tau_on_s: float, tau_off_s: float) -> float:
    rng = np.random.default_rng(1)
    levels = rng.choice([0, 40, 128, 255], (_SLOTS, _ROWS, _PIXELS)).astype(np.uint8)
    response = PanelResponse(
        tau_on_s=tau_on_s,
        tau_off_s=tau_off_s,
        leak=_LEAK,
        drive_exponent=_EXPONENT,
        field_drive=_FIELDS,
        delay_s=_DELAY_STEPS / _STEPS * _SLOT_S,
        scan_s=_SCAN_STEPS / _STEPS * _SLOT_S,
    )
    found, _ = slot_weights(levels, settled_panel(0 * levels[0], response), response, _SLOT_S)
    worst = 0.0
    for row in range(_ROWS):
        late = _DELAY_STEPS + round(_SCAN_STEPS * (row + 0.5) / _ROWS)
        error = found[:, row] - _oracle(levels[:, row], late, 0.5e-3, 1.0e-3)
        worst = max(worst, float(error.ravel()[np.abs(error).argmax()]), key=abs)
    return worst


def measure() -> float:
    """Find the largest deviation of a weight over random sequences of levels."""
    return _worst(0.5e-3, 1.0e-3)


def perturbed() -> float:
    """Swap rise and fall."""
    return _worst(1.0e-3, 0.5e-3)
