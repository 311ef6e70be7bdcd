"""The true operator of the readings, as arrays that numpy alone can apply.

A reading is the CCD pixel at a panel pixel's centre. Its light comes by four ways: the PSF core, exact for
each panel pixel and fine sample; the tails, with one kernel for the whole field; the ghost; veiling glare.
Left out are the tails' variation over the field and the smear of the CCD.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.core.quantities import Doubles, Floats, Ints
from optsim.optics.fringing import whole_cells
from optsim.optics.relay import RelayOperator

# Half width of the core, fine samples. Beside a window 100 times as bright a reading is off by up to 6 sigma
# with 6, by 2 with 8 or 12.
_HALF = 8
# Spacing of readings that are traced back together, panel pixels: with 7 tails enter each other's cores.
_SPACING = 12
# Largest half width of the tails, panel pixels; of the ghost, standard deviations of its blur.
_REACH, _GHOST_SIGMAS = 30, 3


@dataclass(frozen=True, eq=False)
class TrueOperator:
    """Readings of a camera by the light on its panel, without noise and saturation."""

    row: Ints  # (v, u), CCD pixel at the centre of each panel pixel, like ``col``.
    col: Ints
    black_dn: Floats  # (v, u), dark reading: black level, dark current, fixed pattern.
    gain_dn: Floats  # (v, u), DN of even irradiance of 1 W m^-2 in one slot, panel fully on.
    core: Floats  # (v, u, k, k), shares of the fine samples around the middle one of each panel pixel.
    tails: Floats  # (n, n), shares of the panel pixels around the reading's own, beyond the core.
    mirrored: Floats  # (m, m), shares of the panel pixels around the opposite one: the ghost.
    veil: float  # Share of the light that is spread evenly over the CCD.
    bend: float  # A signal s above black is read as s (1 - bend (s / full_dn)^5).
    full_dn: float


def true_operator(camera: CodedCamera) -> TrueOperator:
    """Trace the readings of a camera back to its panel; its neutral density plays no part."""
    return _operator(camera.with_nd(1.0).model_dump_json())


# Many sequences are of one camera, and tracing takes seconds.
@lru_cache(maxsize=2)
def _operator(table: str) -> TrueOperator:
    camera = CodedCamera.model_validate_json(table)
    pitch, sensor = SAMPLES_PER_PITCH, camera.sensor
    row, col, _ = camera.relay_geometry().ccd_pixels(pitch)
    whole = camera.relay_operator()
    ghost = whole.ghost
    operator = replace(whole, glare_share=0.0, ghost=None)
    gain = whole_cells(camera.panel_gain, pitch)
    flat_e = camera.photon_electrons(operator.apply(gain * camera.slot_s))[row, col]
    black_e = sensor.dark_signal_e(camera.serial_number)[row, col] + camera.dark_e
    core, sums = _core(operator, row, col)
    share, blur_px = (ghost.share, ghost.blur_px) if ghost is not None else (0.0, 0.0)
    return TrueOperator(
        row=row,
        col=col,
        black_dn=(sensor.zero_dn + black_e / sensor.step_e).astype(np.float32),
        gain_dn=(flat_e / sensor.step_e).astype(np.float32),
        core=((1 - share) * core / sums[..., None, None]).astype(np.float32),
        tails=((1 - share) * _tails(operator, row, col)).astype(np.float32),
        mirrored=(share * _gaussian(blur_px if share else 0.0)).astype(np.float32),
        veil=whole.glare_share,
        bend=sensor.bend_at_full_well,
        full_dn=sensor.full_well_e / sensor.step_e,
    )


def _core(operator: RelayOperator, row: Ints, col: Ints) -> tuple[Doubles, Doubles]:
    """Light of the fine samples around each panel pixel in its reading, (v, u, k, k); and of all, (v, u)."""
    (rows, cols), side, pitch = row.shape, 2 * _HALF + 1, SAMPLES_PER_PITCH
    core = np.zeros((rows, cols, side, side))
    for first_v in range(_SPACING):
        for first_u in range(_SPACING):
            chosen = np.s_[first_v::_SPACING, first_u::_SPACING]
            wide = np.pad(_traced(operator, row[chosen], col[chosen]), _HALF)
            windows = np.lib.stride_tricks.sliding_window_view(wide, (side, side))
            step = _SPACING * pitch
            middle = pitch // 2
            core[chosen] = windows[first_v * pitch + middle :: step, first_u * pitch + middle :: step]
    return core, operator.apply(np.ones(operator.blur.shape))[row, col]


def _tails(operator: RelayOperator, row: Ints, col: Ints) -> Doubles:
    """Shares beyond the core, on panel pixels: mean over nine readings around the panel's middle."""
    rows, cols = row.shape
    reach, pitch = min(_REACH, (min(rows, cols) - 1) // 2), SAMPLES_PER_PITCH
    total = np.zeros((2 * reach + 1, 2 * reach + 1))
    places = [(v, u) for v in _thirds(rows, reach) for u in _thirds(cols, reach)]
    for v, u in places:
        traced = _traced(operator, row[v : v + 1, u : u + 1], col[v : v + 1, u : u + 1])
        middle = [at * pitch + pitch // 2 for at in (v, u)]
        own = tuple(slice(max(at - _HALF, 0), at + _HALF + 1) for at in middle)
        light = traced.sum()
        traced[own] = 0
        cells = np.pad(traced.reshape(rows, pitch, cols, pitch).sum(axis=(1, 3)) / light, reach)
        total += cells[v : v + 2 * reach + 1, u : u + 2 * reach + 1]
    return total / len(places)


def _gaussian(sigma_px: float) -> Doubles:
    """Kernel that sums to 1."""
    reach = int(np.ceil(_GHOST_SIGMAS * sigma_px))
    line = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma_px, 1e-6)) ** 2)
    return np.outer(line, line) / line.sum() ** 2


def _thirds(size: int, reach: int) -> list[int]:
    """Three places along an axis, as far apart as the reach allows, at most a sixth of it from the middle."""
    apart = min(size // 6, max((size - 1) // 2 - reach, 0))
    return sorted({size // 2 - apart, size // 2, size // 2 + apart})


def _traced(operator: RelayOperator, row: Ints, col: Ints) -> Doubles:
    """Light of each fine sample in the sum of some CCD pixels."""
    seen = np.zeros(operator.ccd_shape)
    seen[row, col] = 1
    return operator.adjoint(seen)
