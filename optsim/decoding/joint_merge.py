# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Pixels that saturate each other's frames, from all their frames at once: a sparse least-squares problem.

Without it the mosaic loses 0.18 dB where ``window_room`` is static, 0.35 dB while frames still merge
(``reports/fidelity.md``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np
from scipy import sparse

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import DemixedFrame, noise_variance, predicted_variance
from optsim.core.quantities import Bools, Doubles, Floats, Ints

# How far from even light a pixel is, one standard deviation (a sensible default, no source).
_UNEVEN = 0.3
# The variances depend on the light, and shares that are smaller on average wait for the next round.
_ROUNDS = 3
_SMALL = 1e-3
_MOST_STEPS = 100
_REMAINDER = 1e-4


def solved_together(
    calibration: Calibration,
    samples: Sequence[DemixedFrame],
    alive: Sequence[Bools],
    usable: Sequence[Bools],
    irradiance: Floats,
    least: Floats,
    unknown: Bools,
) -> Floats:
    """Irradiance of still pixels whose samples hold more light of saturated neighbours than of their own.

    Where a pixel open for a slot lies among others open for long, each is needed to find the others. What the
    frames measured is linear in all of them, ``mix(irradiance x exposure)``. This is the irradiance that
    explains it best, weighted by the variances of noise and attribution, and near to even light where the
    frames do not say: the maximum of the posterior for a Gaussian prior. Even light is what the measured
    samples say on average, but no less than saturated ones do.

    Parameters
    ----------
    calibration : Calibration
        Holds the kernel.
    samples : sequence of Sample
        The frames.
    alive : sequence of ndarray of shape (v, u), bool
        Where each frame shows the same light as the newest.
    usable : sequence of ndarray of shape (v, u), bool
        Where it measured that light.
    irradiance : ndarray of shape (v, u), float32
        W m^-2; right where it is not unknown.
    least : ndarray of shape (v, u), float32
        From saturated frames (:attr:`~optsim.calibration.demixed.DemixedFrame.least`), W m^-2: taken for the
        light of pixels that no frame measured, unless their neighbours know better.
    unknown : ndarray of shape (v, u), bool
        The pixels to find: measured in a frame, or saturated.

    Returns
    -------
    ndarray of shape (v, u), float32
        With the unknown pixels found, W m^-2, none of them negative.
    """
    even, sigma = _expected(calibration, samples, alive, usable, least)
    number = np.where(unknown, np.cumsum(unknown).reshape(unknown.shape) - 1, -1)
    found = np.where(unknown, even, irradiance).astype(np.float32)
    known = np.logical_or.reduce(usable) | unknown
    for _ in range(_ROUNDS):
        matrices, lacks = zip(
            *(
                _equations(calibration, sample, ok & known, use, found, number)
                for sample, ok, use in zip(samples, alive, usable, strict=True)
            ),
            strict=True,
        )
        # In standard deviations from even light.
        matrix = sparse.vstack(matrices).tocsr() @ sparse.diags_array(sigma[unknown])
        wanted = np.concatenate(lacks) + matrix @ ((found - even)[unknown] / sigma[unknown])
        found[unknown] = np.maximum(even[unknown] + sigma[unknown] * _least_squares(matrix, wanted), 0)
    return found


def _expected(
    calibration: Calibration,
    samples: Sequence[DemixedFrame],
    alive: Sequence[Bools],
    usable: Sequence[Bools],
    least: Floats,
) -> tuple[Doubles, Doubles]:
    """Irradiance if all around were as bright, and its standard deviation: by noise and by unevenness."""
    top, bottom = np.zeros((2, *calibration.shape))
    for sample, use in zip(samples, usable, strict=True):
        certainty = np.where(use, sample.gathered / noise_variance(calibration, sample.measured), 0)
        top += certainty * sample.measured
        bottom += certainty * sample.gathered
    measured = bottom > 0
    even = np.where(measured, np.maximum(top, 0) / np.where(measured, bottom, 1), least)
    for sample, ok in zip(samples, alive, strict=True):
        saturated = measured & ok & sample.valid & sample.saturated
        even = np.where(saturated, np.maximum(even, sample.even), even)
    noise = np.where(measured, 1 / np.where(measured, bottom, 1), 0)
    return even, np.sqrt((_UNEVEN * even) ** 2 + noise)


def _least_squares(matrix: sparse.csr_array, wanted: Doubles) -> Doubles:
    """Minimise ``|matrix @ x - wanted|^2 + |x|^2``.

    Columns are brought to one length first: those of dark pixels, open for long, would else be found last.
    """
    # It takes a while to import, and few frames need it.
    from scipy.sparse.linalg import lsmr

    length = np.sqrt(matrix.power(2).sum(axis=0) + 1)
    whole = sparse.vstack([matrix, sparse.identity(len(length))]).tocsr() @ sparse.diags_array(1 / length)
    padded = np.concatenate([wanted, np.zeros(len(length))])
    solve = cast("Callable[..., tuple[Doubles, ...]]", lsmr)
    return solve(whole, padded, atol=_REMAINDER, btol=_REMAINDER, maxiter=_MOST_STEPS)[0] / length


def _equations(
    calibration: Calibration,
    sample: DemixedFrame,
    alive: Bools,
    usable: Bools,
    irradiance: Floats,
    number: Ints,
) -> tuple[sparse.csr_array, Doubles]:
    """Gather each unknown pixel in each sample, and what the sample lacks: both in the sample's noise."""
    mixed = calibration.mix(np.where(alive, irradiance * sample.exposure, sample.signal))
    rows = usable & (number >= 0)
    variance = predicted_variance(calibration, sample.exposure, np.maximum(irradiance, 0))
    certainty = 1 / (calibration.own_share * np.sqrt(variance))[rows]
    v, u = np.nonzero(rows)
    strong = calibration.crosstalk.mean(axis=(0, 1)) > _SMALL
    dv, du = np.nonzero(strong) - np.array(strong.shape)[:, None] // 2
    beside = (
        np.clip(v[:, None] + dv, 0, number.shape[0] - 1),
        np.clip(u[:, None] + du, 0, number.shape[1] - 1),
    )
    gathered = calibration.crosstalk[v, u][:, strong] * sample.exposure[beside] * certainty[:, None]
    column = number[beside]
    counts = (column >= 0) & alive[beside]
    row = np.broadcast_to(np.arange(len(v))[:, None], column.shape)
    shape = (len(v), int(number.max()) + 1)
    matrix = sparse.csr_array(
        (gathered[counts].astype(np.float64), (row[counts], column[counts])), shape=shape
    )
    return matrix, (sample.measured - mixed)[rows] * certainty
