"""Moving pixels by the truth, and the agreement of a scheme's mask with them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage  # type: ignore[import-untyped]

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, Floats, checked
from optsim.metrics.records import PooledMask
from optsim.metrics.scoring import by_method_and_phase

SIGMAS = 2.0
RELATIVE_CHANGE = 0.02
# Standard deviations of the truth's own noise that a change must exceed in both halves: noise alone does so
# in fewer than one pixel in 1000, for any number of rendered poses (tests/test_metrics_scoring.py).
_TRUTH_SIGMAS = 3.0
# Side of the square over which the truth's noise is averaged, pixels: one pixel has few independent poses.
_POOLED_PX = 5
# Pixels beyond which the objective's blur correlates no noise.
_APART_PX = 4


def oracle_moving(
    reference_w_m2: Floats,
    previous_w_m2: Floats | None,
    slot_sigma_w_m2: Floats | float,
    half_differences_w_m2: Sequence[Floats] = (),
) -> Bools:
    """Pixels whose slot irradiance changes within a coded frame or since the previous one.

    A change is a range (largest minus smallest slot) above max(2 sigma of a slot's predicted noise,
    2 % of the mid-range); moving shadows and bounce light count. The thresholds are this project's
    definition, without outside source. A rendered truth has noise, whose range could be mistaken for
    motion. So one half of the samples selects the slots and the other gives the change. Both ways round it
    must exceed the threshold and 3 standard deviations of that noise.

    Parameters
    ----------
    reference_w_m2 : ndarray of shape (slot, v, u), float32
        Truth during the frame, W/m^2.
    previous_w_m2 : ndarray of shape (slot, v, u), float32, or None
        Truth during the frame before; None for the first.
    slot_sigma_w_m2 : ndarray of shape (v, u) or float
        Predicted noise of a slot, W/m^2.
    half_differences_w_m2 : sequence of ndarray of shape (slot, v, u), float32
        (half A - half B) / 2 of the truth during the frame, and during the one before if that is given,
        W/m^2; empty for a truth without Monte-Carlo noise.

    Returns
    -------
    ndarray of shape (v, u), bool
        True for moving pixels.

    Raises
    ------
    ValueCheckError
        For non-finite values, or frames of different panels.
    """
    frames = [reference_w_m2] if previous_w_m2 is None else [reference_w_m2, previous_w_m2]
    for frame in (*frames, *half_differences_w_m2):
        checked(
            "reference",
            frame,
            axes=("slot", "v", "u"),
            dtype=np.float32,
            unit="W m^-2",
            nonnegative=False,
        )
    panel = reference_w_m2.shape[1:]
    sigma = np.asarray(slot_sigma_w_m2, np.float32)
    if frames[-1].shape[1:] != panel or sigma.shape not in ((), panel):
        raise ValueCheckError(
            f"oracle mask: frames {[f.shape for f in frames]} and noise {sigma.shape} are of different panels"
        )
    if half_differences_w_m2 and [h.shape for h in half_differences_w_m2] != [f.shape for f in frames]:
        raise ValueCheckError(
            f"oracle mask: half differences {[h.shape for h in half_differences_w_m2]}, expected those of "
            f"the frames, {[f.shape for f in frames]}"
        )
    if not (np.isfinite(sigma).all() and (sigma >= 0).all()):
        raise ValueCheckError("oracle mask: the noise of a slot must be finite and not negative")
    light = np.concatenate(frames)
    low, high = light.min(axis=0), light.max(axis=0)
    threshold = np.maximum(SIGMAS * sigma, RELATIVE_CHANGE * np.abs(high + low) / 2)
    if not half_differences_w_m2:
        return cast("Bools", high - low > threshold)
    half = np.concatenate(half_differences_w_m2)
    first, second = light + half, light - half
    change = np.minimum(_change(second, first), _change(first, second))
    # Another pixel's noise selects the slots; one half has twice the variance of the mean.
    by_chance = _change(half, np.roll(first, _APART_PX, axis=1))
    mean = cast("Callable[..., Floats]", ndimage.uniform_filter)
    # Its running sum may end below 0.
    noise = np.sqrt(2 * mean(by_chance**2, _POOLED_PX).clip(0))
    return change > np.maximum(threshold, _TRUTH_SIGMAS * noise)


def _change(light: Floats, chosen_by: Floats) -> Floats:
    """Change of light between the slots at which another video is darkest and brightest, (v, u)."""
    darkest, brightest = (
        np.expand_dims(at, 0) for at in (chosen_by.argmin(axis=0), chosen_by.argmax(axis=0))
    )
    return (np.take_along_axis(light, brightest, 0) - np.take_along_axis(light, darkest, 0))[0]


@dataclass(frozen=True)
class MaskAgreement:
    """Counts of a mask against the oracle; shares are None where they are undefined.

    Precision and recall as in C. J. van Rijsbergen, Information Retrieval, 2nd ed. (1979), chapter 7;
    intersection over union is the index of P. Jaccard, New Phytologist 11, 37 (1912).

    Parameters
    ----------
    hits, false_alarms, misses, correct_static : int
        Pixels: both moving, only the mask, only the oracle, neither.
    """

    hits: int
    false_alarms: int
    misses: int
    correct_static: int

    @property
    def precision(self) -> float | None:
        """Share of marked pixels that move."""
        return _share(self.hits, self.hits + self.false_alarms)

    @property
    def recall(self) -> float | None:
        """Share of moving pixels that are marked."""
        return _share(self.hits, self.hits + self.misses)

    @property
    def iou(self) -> float | None:
        """Intersection over union."""
        return _share(self.hits, self.hits + self.false_alarms + self.misses)


def mask_agreement(mask: Bools, oracle: Bools) -> MaskAgreement:
    """Compare a motion mask with the oracle, both of shape (v, u)."""
    if mask.shape != oracle.shape or mask.dtype != np.bool_ or oracle.dtype != np.bool_:
        raise ValueCheckError(
            f"masks: got {mask.dtype} {mask.shape} and {oracle.dtype} {oracle.shape}, "
            "expected bool of one size"
        )
    hits = int(np.count_nonzero(mask & oracle))
    in_mask, in_oracle = int(np.count_nonzero(mask)), int(np.count_nonzero(oracle))
    false_alarms, misses = in_mask - hits, in_oracle - hits
    return MaskAgreement(hits, false_alarms, misses, mask.size - hits - false_alarms - misses)


@dataclass(frozen=True)
class MaskTally:
    """One method's mask in one coded frame, counted against the oracle.

    Parameters
    ----------
    method : str
        Method of the mask.
    index : int
        Coded-frame index.
    agreement : MaskAgreement
        Agreement over all panel pixels.
    """

    method: str
    index: int
    agreement: MaskAgreement


def pooled_agreement(agreements: Iterable[MaskAgreement]) -> MaskAgreement:
    """Add up the counts of several frames.

    A mean of the frames' own shares would give a nearly static frame the same weight as the others,
    and would have to leave out frames without a share.
    """
    counts = [(a.hits, a.false_alarms, a.misses, a.correct_static) for a in agreements]
    return MaskAgreement(*(sum(column) for column in zip(*counts, strict=True)))


def pooled_mask_records(tallies: Iterable[MaskTally], latency_frames: int) -> list[PooledMask]:
    """Pool masks by method and phase; phases without frames are left out."""
    found: list[PooledMask] = []
    for (method, phase), group in by_method_and_phase(tallies, latency_frames).items():
        mask = pooled_agreement(t.agreement for t in group)
        pixels = mask.hits + mask.false_alarms + mask.misses + mask.correct_static
        found.append(
            PooledMask(
                method=method,
                phase=phase,
                moves=(mask.hits + mask.misses) / pixels,
                marked=(mask.hits + mask.false_alarms) / pixels,
                precision=mask.precision,
                recall=mask.recall,
                iou=mask.iou,
            )
        )
    return found


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
