"""Every metric of a report, by region, and the interval of each score, by other programs.

Run as a program it prints what is behind the one number of the evidence: ``check.py`` the scores of both
sides; ``check.py breaks`` what the check says of each metric made wrong on purpose.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import skimage.metrics

sys.path.append(str(Path(__file__).parents[2]))  # the checks are files, not a package

from optsim import metrics
from optsim.core.errors import StorageError
from optsim.core.quantities import Bools, Floats, Reconstruction
from optsim.metrics import (
    FrameEstimate,
    FrameMetric,
    FrameReference,
    Metric,
    PhotometricScale,
    ScoreBoard,
    after_gain,
    ms_ssim,
    pu21,
    scoring,
)
from validation.environments import reference_python

CLAIM = (
    "each metric of a report scores a made-up run as other programs do: whole, where it moves and is static, "
    "dark, mid and bright, at the rim; frame by frame and together, with Student's interval of 95 %"
)
ORACLE = (
    "packages sewar 0.4.10 (PSNR, SSIM, MS-SSIM) and permetrics 2.1.0 (logarithmic, relative, symmetric "
    "error) with scipy (gain, interval, rim), run as a separate program on the irradiance of both sides; the "
    "curves of PU21 and mu-law, and the eye at 550 nm, typed again there from their sources"
)
SOURCE = (
    "Mantiuk and Azimi, PCS 2021 (PU21); Kalantari and Ramamoorthi, ACM TOG 36(4), 2017 (mu-law); Wang et "
    "al., IEEE TIP 13(4), 2004 (SSIM), Asilomar 2003 (MS-SSIM); Rousselle et al., ACM TOG 30(6), 2011 "
    "(relMSE); Vogels et al., ACM TOG 37(4), 2018 (SMAPE); CIE 018:2019 (V)"
)
TOLERANCE = 1.0
REASON = (
    "In units of what each score is allowed, below: a thousandth of the loss that comparisons accept, 1e-7 "
    "for relMSE, which decides nothing; for MS-SSIM a tenth, since sewar halves pictures between other rows."
)
FILES = (
    "optsim/metrics/after_gain.py",
    "optsim/metrics/class_scores.py",
    "optsim/metrics/classes.py",
    "optsim/metrics/frame_difference.py",
    "optsim/metrics/frame_metric.py",
    "optsim/metrics/log_error.py",
    "optsim/metrics/metric.py",
    "optsim/metrics/ms_ssim.py",
    "optsim/metrics/mu_law.py",
    "optsim/metrics/pairs.py",
    "optsim/metrics/photometry.py",
    "optsim/metrics/psnr.py",
    "optsim/metrics/pu21.py",
    "optsim/metrics/relative_error.py",
    "optsim/metrics/scoring.py",
    "optsim/metrics/smape.py",
    "optsim/metrics/ssim.py",
    "optsim/metrics/student.py",
)

_ALLOWED = {"dB": 1e-4, "stops": 1e-5, "ratio": 3e-6, "SSIM": 3e-6, "PU21-MS-SSIM": 3e-4, "relMSE": 1e-7}
_SCALE = PhotometricScale(white_w_m2_sr=0.5, irradiance_per_radiance=0.02)
_FRAMES, _SLOTS, _ROWS, _COLS = 4, 9, 96, 120
_LATENCY = 1

Key = tuple[str, str, str]  # metric, region, and frame, "together", "low" or "high"
Scores = dict[Key, float]


def measure() -> float:
    """Deviation over its allowance, of the worst score."""
    return max(_ratios(metrics.ALL).values(), key=abs)


def perturbed() -> float:
    """Each metric made wrong in turn, and the interval: the one that is seen least."""
    return min(_breaks().values())


# -- a made-up run ------------------------------------------------------------------------------------------


@cache
def _run() -> tuple[Floats, Floats, Bools, Bools]:
    """Truth and estimate (frame, slot, v, u), W/m^2; pixels that move, and those that are valid.

    A dim textured room with black corners and a window beyond PU21's range. The estimate is noisy, a little
    too bright, and flickers.
    """
    rng = np.random.default_rng(11)
    v, u = np.mgrid[0:_ROWS, 0:_COLS]
    moving = (v >= 40) & (v < 75) & (u >= 50) & (u < 90)
    valid = u >= 12
    time = np.arange(_FRAMES * _SLOTS).reshape(_FRAMES, _SLOTS, 1, 1)
    cd_m2 = 30 * np.exp(1.3 * np.sin(v / 6) * np.cos(u / 9)) * (1 + 0.2 * rng.random((_ROWS, _COLS)))
    cd_m2 = np.where((v < 25) & (u < 40), 500 * cd_m2, cd_m2)
    cd_m2 = np.where(v > 85, 2e-4 * cd_m2, cd_m2)
    cd_m2 = np.where((v > 90) & (u > 90), 0, cd_m2)
    truth = cd_m2 * np.where(moving, 2 + np.sin((u - time) / 4), 1)
    noise = np.where(moving, 0.1, 0.03) * (1 + time // _SLOTS / 4)
    error = 1 + noise * rng.normal(size=truth.shape) + 0.02 * (time % 2)
    estimate = np.maximum(1.03 * truth * error + 0.002 * rng.random(truth.shape), 0)
    to_irradiance = _SCALE.irradiance_per_radiance / 683
    return (
        (truth * to_irradiance).astype(np.float32),
        (estimate * to_irradiance).astype(np.float32),
        moving,
        valid,
    )


# -- both sides ---------------------------------------------------------------------------------------------


def _ours(chosen: tuple[Metric | FrameMetric, ...], scale: PhotometricScale = _SCALE) -> Scores:
    truths, estimates, moving, valid = _run()
    sampled = [m for m in chosen if isinstance(m, Metric)]
    board = ScoreBoard(sampled, scale, _LATENCY, _SLOTS)
    tallies, by_class = [], []
    for place, (truth, estimate) in enumerate(zip(truths, estimates, strict=True)):
        index = scoring.first_steady(_LATENCY) + place
        video = Reconstruction(index, estimate, valid, ~valid, moving)
        tallies.append(board.tally("made", video, truth, moving))
        errors = metrics.pixel_errors(sampled, scale, estimate, truth, valid, _SLOTS)
        light = scale.luminance_cd_m2(truth)
        reference = FrameReference(light, metrics.class_masks(light, moving))
        frame = FrameEstimate(reference, scale.luminance_cd_m2(estimate), valid)
        by_class.append(metrics.tally_classes("made", index, chosen, errors, frame))
    kinds = {m.name: m.kind for m in chosen}
    found: Scores = {}
    for s in board.records(tallies):
        for name, value in (("together", s.value), ("low", s.low), ("high", s.high)):
            assert value is not None
            found[kinds[s.metric], s.region, name] = value
    for series in metrics.class_series(chosen, by_class):
        for place, value in enumerate(series.values):
            if series.metric in kinds and value is not None:
                found[kinds[series.metric], series.region, str(place)] = value
    return found


@cache
def _theirs() -> Scores:
    truth, estimate, moving, valid = _run()
    with tempfile.TemporaryDirectory() as folder:
        run, result = Path(folder) / "run.npz", Path(folder) / "result.json"
        about = _SCALE.model_dump(include={"white_w_m2_sr", "irradiance_per_radiance"})
        np.savez(run, truth_w_m2=truth, estimate_w_m2=estimate, moving=moving, valid=valid, **about)
        program = str(Path(__file__).with_name("reference.py"))
        # -I: neither variables nor folders of this environment reach that one.
        command = [str(reference_python("scores")), "-I", program, str(run), str(result)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise StorageError(f"the reference scores failed: {done.stderr.strip()[-600:]}")
        record = json.loads(result.read_text(encoding="utf-8"))
    found = {
        (kind, region, str(place)): value
        for kind, regions in record["frames"].items()
        for region, values in regions.items()
        for place, value in enumerate(values)
    }
    for kind, regions in record["together"].items():
        for region, values in regions.items():
            found |= zip(((kind, region, n) for n in ("together", "low", "high")), values, strict=True)
    return found


def _ratios(chosen: tuple[Metric | FrameMetric, ...], scale: PhotometricScale = _SCALE) -> dict[Key, float]:
    """Deviation of each score that the other side has, over its allowance."""
    allowed = {m.kind: _ALLOWED.get(m.name.partition("[")[0], _ALLOWED[m.unit]) for m in chosen}
    ours = _ours(chosen, scale)
    return {k: (ours[k] - v) / allowed[k[0]] for k, v in _theirs().items() if k[0] in allowed}


# -- broken on purpose --------------------------------------------------------------------------------------


def _breaks() -> dict[str, float]:
    """Largest deviation over its allowance of each metric made wrong, and of the interval."""
    brighter = (*pu21._P[:-1], 1.001 * pu21._P[-1])
    similar: Callable[..., Any] = skimage.metrics.structural_similarity
    encoding = mock.patch.object(pu21, "_P", brighter)
    white = _SCALE.model_copy(update={"white_w_m2_sr": 1.001 * _SCALE.white_w_m2_sr})
    broken: dict[str, tuple[Metric | FrameMetric, AbstractContextManager[Any]]] = {
        "pu21_psnr: 0.1 % more of a step": (metrics.Pu21Psnr(), encoding),
        "log_rmse: offset 1 % larger": (metrics.LogRmse(e_cd_m2=0.0101), nullcontext()),
        "mu_law_psnr: mu 1 % larger": (metrics.MuLawPsnr(mu=5050), nullcontext()),
        "rel_mse: offset 1 % larger": (metrics.RelMse(e_cd_m2=1.01), nullcontext()),
        "smape: offset 1 % larger": (metrics.Smape(e_cd_m2=0.0101), nullcontext()),
        "pu21_ssim: range 255": (
            metrics.Pu21Ssim(),
            mock.patch.object(
                skimage.metrics,
                "structural_similarity",
                lambda *pair, **rest: similar(*pair, **{**rest, "data_range": 255.0}),
            ),
        ),
        "pu21_ms_ssim: the coarse scales' weights": (
            metrics.Pu21MsSsim(),
            mock.patch.object(ms_ssim, "_WEIGHTS", (0.3001, 0.2363, 0.1333)),
        ),
        "frame_difference_psnr: 0.1 % more of a step": (metrics.FrameDifferencePsnr(), encoding),
        "after_gain_psnr: no gain": (
            metrics.AfterGainPsnr(),
            mock.patch.object(after_gain, "best_gain", return_value=1.0),
        ),
        "interval: 1.96, as of endless frames": (
            metrics.Pu21Psnr(),
            mock.patch.object(scoring, "quantile", return_value=1.96),
        ),
    }
    found = {"psnr: white 0.1 % brighter": _largest(metrics.Psnr(), white)}
    for name, (metric, patched) in broken.items():
        with patched:
            found[name] = _largest(metric)
    return found


def _largest(metric: Metric | FrameMetric, scale: PhotometricScale = _SCALE) -> float:
    return max(abs(ratio) for ratio in _ratios((metric,), scale).values())


# -- what is behind the one number --------------------------------------------------------------------------


def print_table() -> None:
    ours, theirs, ratios = _ours(metrics.ALL), _theirs(), _ratios(metrics.ALL)
    print(f"{'metric':24s}{'region':9s}{'frame':10s}{'optsim':>15s}{'theirs':>15s}{'of allowed':>12s}")
    for key, value in theirs.items():
        print(f"{key[0]:24s}{key[1]:9s}{key[2]:10s}{ours[key]:15.9f}{value:15.9f}{ratios[key]:12.4f}")


def print_breaks() -> None:
    for name, ratio in _breaks().items():
        print(f"{name:46s}{ratio:10.1f} times what is allowed")


if __name__ == "__main__":
    print_breaks() if sys.argv[1:] == ["breaks"] else print_table()
