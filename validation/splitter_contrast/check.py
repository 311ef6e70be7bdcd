"""Contrast of splitter, polarisers and panel against a Jones ray trace in three dimensions."""

from __future__ import annotations

import numpy as np

from optsim.camera.hardware import lcr720
from optsim.camera.parts import Splitter
from optsim.camera.parts.chain import throughput

CLAIM = (
    "transmission of polarisers, splitter and panel, dark and bright, follows from the parts, with the "
    "splitter in collimated space (by column) and in converging space (skew rays)"
)
ORACLE = (
    "field vectors of 200 x 200 rays in lab coordinates: transverse axes of the polarisers, p and s of the "
    "coating from vector products, a mirror that turns the transverse field over, depolarised halves added "
    "as powers; numpy only"
)
SOURCE = "R. C. Jones, J. Opt. Soc. Am. 31(7) 488 (1941); Chipman, Lam and Young, Polarized Light (2018)"
TOLERANCE = 0.01
REASON = (
    "Mueller matrices in the frame of the ray leave out terms of the fourth order in the angle: 0.3 % of "
    "the dark level at f/2.8. Eight rings of twelve rays leave 0.5 % of what skew rays leak."
)
FILES = ("optsim/optics/mueller.py", "optsim/camera/parts/*.py", "optsim/camera/hardware/lcr720.py")

_INDEX, _ACCEPTANCE, _COLLIMATOR = 1.52, 0.035, 75e-3
_TP, _TS, _RS, _RP, _FACES, _CLEAN, _RATIO = 0.95, 0.001, 0.99, 0.03, 0.97, 0.9, 1000.0


def _across(axis: list[float], k: np.ndarray) -> np.ndarray:
    """Return the unit vector nearest to an axis that is transverse to each ray."""
    a = np.array(axis) - (k @ axis)[:, None] * k
    return a / np.linalg.norm(a, axis=1, keepdims=True)


def _through(field: np.ndarray, one: np.ndarray, other: np.ndarray, powers: tuple) -> np.ndarray:
    """Pass a diattenuator with two transverse axes and the powers that it passes along them."""
    parts = [
        np.sqrt(p)[:, None] * (field * a).sum(1, keepdims=True) * a
        for p, a in zip(powers, (one, other), strict=True)
    ]
    return parts[0] + parts[1]


def _traced(rays: np.ndarray, *, bright: bool) -> float:
    """Power transmission for unpolarised light, mean over rays (n, 3) in glass on their way to the panel."""
    panel = lcr720()
    normal, back = np.array([1.0, 0, 1]) / np.sqrt(2), rays * [1, 1, -1]
    growth = np.maximum(((np.arccos(rays @ normal) - np.pi / 4) / _ACCEPTANCE) ** 2, 1)
    s_in, s_out = (np.cross(k, normal) for k in (rays, back))
    s_in, s_out = (s / np.linalg.norm(s, axis=1, keepdims=True) for s in (s_in, s_out))
    p_in, p_out = np.cross(rays, s_in), np.cross(back, s_out)
    ones = np.ones(len(rays))
    tp, ts = _TP - _RP * (growth - 1), _TS * growth
    rp, rs = _RP * growth, _RS - _TS * (growth - 1)
    clean = (_CLEAN * ones, _CLEAN / _RATIO * ones)
    total = 0.0
    for first in (_across([1.0, 0, 0], rays), _across([0, 1.0, 0], rays)):
        field = _through(first, _across([1.0, 0, 0], rays), _across([0, 1.0, 0], rays), clean)
        field = _through(field, p_in, s_in, (tp, ts))
        before = (field**2).sum(1)
        turned = field[:, [1, 0, 2]] if bright else field
        turned = turned * [-1, -1, 1]
        if bright:
            turned = turned - (turned * back).sum(1, keepdims=True) * back
        share = panel.depolarised_share

        def analysed(light: np.ndarray) -> np.ndarray:
            seen = _through(light, p_out, s_out, (rp, rs))
            seen = _through(seen, _across([0, 1.0, 0], back), _across([1.0, 0, 0], back), clean)
            return _FACES * (seen**2).sum(1)

        mixed = sum(analysed(axis) for axis in (p_out, s_out)) / 2
        mirror = panel.mirror_reflectivity * panel.fill_factor
        gaps = (1 - panel.fill_factor) * panel.gap_reflectivity
        kept = mirror * ((1 - share) * analysed(turned) + share * before * mixed) + gaps * before * mixed
        total += 0.5 * kept.mean()
    return total


def _cone(f_number: float) -> np.ndarray:
    radius, turn = np.meshgrid(
        np.sqrt((np.arange(200) + 0.5) / 200), 2 * np.pi * (np.arange(200) + 0.5) / 200
    )
    edge = 1 / (2 * f_number * _INDEX)
    a, b = (edge * radius * f(turn) for f in (np.cos, np.sin))
    return np.stack([a, b, np.sqrt(1 - a**2 - b**2)], -1).reshape(-1, 3)


def _deviation(index: float) -> float:
    panel, worst = lcr720(), 0.0
    for bright, retardance in ((False, 0.0), (True, np.pi)):
        for f_number in (2.8, 4.0, 6.0, 11.0):
            splitter = Splitter(placement="converging", glass_index=index)
            found = throughput(splitter, panel, retardance, f_number, np.zeros(1))[0]
            worst = max(worst, found / _traced(_cone(f_number), bright=bright) - 1, key=abs)
        for x_m in (-6e-3, 0.0, 4e-3, 6e-3):
            found = throughput(Splitter(glass_index=index), panel, retardance, 6.0, np.array([x_m]))[0]
            sine = np.sin(np.arctan(x_m / _COLLIMATOR)) / _INDEX
            ray = np.array([[sine, 0.0, np.sqrt(1 - sine**2)]])
            worst = max(worst, found / _traced(ray, bright=bright) - 1, key=abs)
    return float(worst)


def measure() -> float:
    """Find the largest relative deviation of a transmission, dark or bright."""
    return _deviation(_INDEX)


def perturbed() -> float:
    """With a cube of another glass."""
    return _deviation(1.3)
