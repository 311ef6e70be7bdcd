"""Score a made-up run with sewar, permetrics and scipy: light in, scores out.

A program for the environment of validation/environments.py, not for optsim's: ``python reference.py RUN
RESULT``. Curves and regions are written here anew, from the papers that ``check.py`` names and from the
manual. Errors, structural similarities, gains and intervals are the packages'.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable

import numpy as np
from permetrics import RegressionMetric
from scipy import ndimage, stats
from sewar.full_ref import msssim, psnr, ssim
from sewar.utils import Filter

Light = np.ndarray
Region = np.ndarray

# CIE 018:2019, table 1: the eye at 550 nm. The candela's definition: 683 lm/W.
_LM_W = 683 * 0.9949501
_PU21 = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204, 596.3148142)
_WEIGHTS = np.array([0.0448, 0.2856, 0.3001])
_WINDOW = {"fltr": Filter.GAUSSIAN, "sigma": 1.5, "ws": 11}


def main(run: str, result: str) -> None:
    """Write the scores of each coded frame and of all together, by metric and region."""
    with np.load(run) as made:
        per_irradiance = _LM_W / float(made["irradiance_per_radiance"])
        white = _LM_W * float(made["white_w_m2_sr"])
        truths, estimates = (made[name] * per_irradiance for name in ("truth_w_m2", "estimate_w_m2"))
        moving, scored = made["moving"], made["valid"]
    frames = [Frame(t, e, moving, scored, white) for t, e in zip(truths, estimates, strict=True)]
    one_by_one = {
        name: {region: [score(frame, region) for frame in frames] for region in regions}
        for name, (score, regions) in METRICS.items()
    }
    record = {"frames": one_by_one, "together": _together(frames, one_by_one)}
    with open(result, "w") as file:
        json.dump(record, file, allow_nan=False)


class Frame:
    """One coded frame: luminance of truth and estimate (slot, v, u), and its regions."""

    def __init__(self, truth: Light, estimate: Light, moving: Region, scored: Region, white: float) -> None:
        self.truth, self.estimate, self.scored, self.white = truth, estimate, scored, white
        n = len(truth)
        # The middles of six equal parts of the exposure.
        self.slots = [int(n * (2 * k + 1) / 12) for k in range(6)]
        third = stats.rankdata(truth.mean(axis=0), "ordinal").reshape(scored.shape) * 3 / scored.size
        inward, outward = (ndimage.distance_transform_cdt(each, "chessboard") for each in (moving, ~moving))
        self.regions = {
            "all": np.ones_like(moving),
            "moving": moving,
            "static": ~moving,
            "dark": third <= 1,
            "mid": (third > 1) & (third <= 2),
            "bright": third > 2,
            "rim": (inward <= 2) & (outward <= 2),
        }

    def samples(self, region: str, slots: list[int] | slice = slice(None)) -> tuple[Light, Light]:
        """Truth and estimate of a region's scored pixels, (slot, pixel)."""
        where = self.regions[region] & self.scored
        return self.truth[slots][:, where], self.estimate[slots][:, where]

    def pictures(self, slot: int) -> tuple[Light, Light]:
        """PU21-encoded pictures of a slot; pixels that aren't scored show the truth on both sides."""
        truth = pu21(self.truth[slot])
        return truth, np.where(self.scored, pu21(self.estimate[slot]), truth)


def pu21(luminance: Light) -> Light:
    """Encode cd/m^2."""
    p1, p2, p3, p4, p5, p6, p7 = _PU21
    y = np.clip(luminance, 0.005, 10_000) ** p4
    return np.maximum(p7 * (((p1 + p2 * y) / (1 + p3 * y)) ** p5 - p6), 0)


# -- metrics of samples: each takes truth and estimate, and the luminance of white --------------------------


def pu21_psnr(truth: Light, estimate: Light, white: float) -> float:
    return psnr(pu21(truth), pu21(estimate), MAX=256)


def linear_psnr(truth: Light, estimate: Light, white: float) -> float:
    return psnr(truth, estimate, MAX=white)


def mu_law_psnr(truth: Light, estimate: Light, white: float) -> float:
    curves = (np.log(1 + 5000 * np.maximum(light, 0) / white) / np.log(5001) for light in (truth, estimate))
    return psnr(*curves, MAX=1)


def log_rmse(truth: Light, estimate: Light, white: float) -> float:
    # log(1 + L / e) on both sides: (t + e) / (r + e), in natural logarithms.
    shares = (np.maximum(light, 0).ravel() / 0.01 for light in (truth, estimate))
    return float(np.sqrt(RegressionMetric(*shares).mean_squared_log_error())) / np.log(2)


def smape(truth: Light, estimate: Light, white: float) -> float:
    # Half of e more on both sides leaves the difference and adds e to the sum.
    lifted = (light.ravel() + 0.01 / 2 for light in (truth, estimate))
    return float(RegressionMetric(*lifted).symmetric_mean_absolute_percentage_error_simplified())


def rel_mse(truth: Light, estimate: Light, white: float) -> float:
    size = np.sqrt(truth**2 + 1.0**2)
    return float(RegressionMetric((truth / size).ravel(), (estimate / size).ravel()).mean_squared_error())


# -- metrics of frames: each takes a frame and a region -----------------------------------------------------


def frame_difference_psnr(frame: Frame, region: str) -> float:
    truth, estimate = (pu21(light) for light in frame.samples(region))
    return psnr(truth[1:] - truth[:-1], estimate[1:] - estimate[:-1], MAX=256)


def after_gain_psnr(frame: Frame, region: str) -> float:
    truth, estimate = frame.samples("all", frame.slots)
    gain = stats.gmean((truth + 0.01) / (estimate + 0.01), axis=None)
    truth, estimate = frame.samples(region, frame.slots)
    return psnr(pu21(truth), pu21(gain * estimate), MAX=256)


def pu21_ssim(frame: Frame, region: str) -> float:
    """Structural similarity of windows centred on a region, which is a rectangle, or all but one."""
    if region == "static":
        every, moved = (np.sum(frame.regions[name] & frame.scored) for name in ("all", "moving"))
        total = every * pu21_ssim(frame, "all") - moved * pu21_ssim(frame, "moving")
        return float(total / (every - moved))
    rows, cols = np.nonzero(frame.regions[region] & frame.scored)
    box = np.s_[rows.min() : rows.max() + 11, cols.min() : cols.max() + 11]
    found = []
    for slot in frame.slots:
        # Windows reach over the picture's edge, where it is mirrored.
        wide = (np.pad(picture, 5, "symmetric")[box] for picture in frame.pictures(slot))
        found.append(ssim(*wide, MAX=256, fltr_specs=_WINDOW)[0])
    return float(np.mean(found))


def pu21_ms_ssim(frame: Frame, region: str) -> float:
    weights = _WEIGHTS / _WEIGHTS.sum()
    return float(np.mean([msssim(*frame.pictures(s), weights=weights, MAX=256) for s in frame.slots]))


SAMPLE_METRICS: dict[str, Callable[[Light, Light, float], float]] = {
    "pu21_psnr": pu21_psnr,
    "log_rmse": log_rmse,
    "psnr": linear_psnr,
    "mu_law_psnr": mu_law_psnr,
    "rel_mse": rel_mse,
    "smape": smape,
}
EVERYWHERE = ("all", "moving", "static", "dark", "mid", "bright", "rim")


def _of_samples(metric: Callable[[Light, Light, float], float]) -> Callable[[Frame, str], float]:
    return lambda frame, region: metric(*frame.samples(region), frame.white)


METRICS: dict[str, tuple[Callable[[Frame, str], float], tuple[str, ...]]] = {
    **{name: (_of_samples(metric), EVERYWHERE) for name, metric in SAMPLE_METRICS.items()},
    "frame_difference_psnr": (frame_difference_psnr, EVERYWHERE),
    "after_gain_psnr": (after_gain_psnr, EVERYWHERE),
    "pu21_ssim": (pu21_ssim, EVERYWHERE[:3]),
    "pu21_ms_ssim": (pu21_ms_ssim, EVERYWHERE[:1]),
}


def _together(
    frames: list[Frame], one_by_one: dict[str, dict[str, list[float]]]
) -> dict[str, dict[str, list[float]]]:
    """Score of all frames' samples, and its interval of 95 % by the scatter of the frames' scores."""
    found: dict[str, dict[str, list[float]]] = {}
    for name, metric in SAMPLE_METRICS.items():
        found[name] = {}
        for region in EVERYWHERE[:3]:
            sides = zip(*(frame.samples(region) for frame in frames), strict=True)
            value = metric(*map(np.concatenate, sides), frames[0].white)
            scores = one_by_one[name][region]
            around = stats.t.interval(0.95, len(scores) - 1, loc=value, scale=stats.sem(scores))
            found[name][region] = [value, *map(float, around)]
    return found


if __name__ == "__main__":
    main(*sys.argv[1:])
