# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Time of the mixture decoder for 36 frames of 256 x 256 from one, against plain numpy and matrix products.

The peer asks the same of each patch by dense algebra in double precision: it solves with the covariance of
the signal, for all components and patches, where ours has prepared eigenvectors. It takes minutes for all, so
it decodes a corner, and its time is scaled to the number of patches.
"""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from benchmarks.made_film import made_film, photograph
from optsim.calibration.calibration import Calibration
from optsim.camera.hardware import prototype
from optsim.camera.true_calibration import ideal_calibration
from optsim.coding import RandomExposure
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, CodedFrame, Doubles, ExposureCode
from optsim.decoding import GaussianMixture
from optsim.decoding.coded_images import CodedImage, coded_images
from optsim.decoding.patch_grid import patch_corners
from optsim.priors.mixture import Mixture, shipped_mixture

_SIDE, _CORNER, _TILE = 256, 48, 8
_ROUNDS, _PEER_ROUNDS = 5, 3
_WANTED_S = 0.5
# Components less likely than this beside the best one are left out, by both.
_NEGLIGIBLE = 1e-3
# Side of the square matrices that are multiplied for comparison.
_SQUARE = 2048


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Decode one made exposure.

    Parameters
    ----------
    name : str
        ``gmm.36x256``.
    progress : Progress
        Told after each decoding.
    """
    rng = np.random.default_rng(36)
    calibration, frame, prior, decoder = *_exposure(rng), shipped_mixture(), GaussianMixture()
    next(decoder.decode([frame], calibration))  # compiles
    square = rng.standard_normal((_SQUARE, _SQUARE)).astype(np.float32)
    seconds, product_s = np.inf, np.inf
    for done in range(_ROUNDS):
        start = time.perf_counter()
        next(decoder.decode([frame], calibration))
        middle = time.perf_counter()
        np.matmul(square, square)
        seconds = min(seconds, middle - start)
        product_s = min(product_s, time.perf_counter() - middle)
        progress(name, done + 1, _ROUNDS + 1)
    corner = np.zeros((_SIDE, _SIDE), np.bool_)
    corner[:_CORNER, :_CORNER] = True
    patches = [patch_corners(mask, prior.patch, decoder.stride_px) for mask in (frame.code.moving, corner)]
    seconds_peer, difference = _peer(prior, decoder, frame, calibration, corner)
    seconds_peer *= len(patches[0]) / len(patches[1])
    gflop, rate = 1e-9 * _flop(prior, len(patches[0]), decoder.stride_px), 2e-9 * _SQUARE**3 / product_s
    return {
        "name": name,
        "value": 1 / seconds,
        "unit": "coded frames/s",
        "peer": "numpy, patch by patch",
        "peer_value": 1 / seconds_peer,
        "ratio": seconds_peer / seconds,
        "conditions": {
            "seconds": seconds,
            "wanted_seconds": _WANTED_S,
            "slots": prior.slots,
            "pixels": f"{_SIDE} x {_SIDE}",
            "patches": len(patches[0]),
            "components": len(prior.shares),
            "rank": len(prior.basis),
            "threads": os.cpu_count() or 1,
            "peer_patches": len(patches[1]),
            "max_difference": difference,
            "gflop": gflop,
            "sgemm_gflop_s": rate,
            "seconds_over_sgemm": seconds * rate / gflop,
            "note": f"stride {decoder.stride_px}, made film, counts to video; best of {_ROUNDS}, in turn "
            f"with products of {_SQUARE}-square float32 matrices on all cores; gflop counts the products of "
            f"matrices that the estimator is made of; the peer decoded a corner of {_CORNER} x {_CORNER} "
            f"pixels, best of {_PEER_ROUNDS}, scaled by patches; difference there, relative to the brightest",
        },
    }


def _exposure(rng: np.random.Generator) -> tuple[Calibration, CodedFrame]:
    calibration = ideal_calibration(prototype().model_copy(update={"panel_rows": _SIDE, "panel_cols": _SIDE}))
    scheme = RandomExposure()
    code, _ = scheme.next(0, [], scheme.init(calibration, rng))
    frame, _ = photograph(calibration, code, made_film(_SIDE, _SIDE, calibration.slots_per_frame, rng), rng)
    return calibration, frame


def _flop(prior: Mixture, patches: int, stride: int) -> float:
    """Of products of matrices: signals with eigenvectors, those with the basis, and what prepares these."""
    k, r, m = len(prior.shares), len(prior.basis), prior.patch**2
    matrices = (_TILE // np.gcd(stride, _TILE)) ** 2
    # Of the components a patch needs one at least.
    a_patch = 2 * (k * m * m + m * r + r * m * prior.slots)
    return float(patches * a_patch + matrices * 2 * k * (m * r * r + 2 * m * m * r))


def _peer(
    prior: Mixture, decoder: GaussianMixture, frame: CodedFrame, calibration: Calibration, corner: Bools
) -> tuple[float, float]:
    """Seconds of the plain computation on a corner, and its largest difference from ours."""
    cut = CodedFrame(frame.index, frame.dn, ExposureCode(frame.code.levels, corner))
    ours = next(decoder.decode([cut], calibration)).irradiance_w_m2[:, corner]
    ((_, image),) = coded_images([cut], calibration, decoder.crosstalk)
    corners = [(int(v), int(u)) for v, u in patch_corners(corner, prior.patch, decoder.stride_px)]
    seconds, video = np.inf, np.zeros(image.weights.shape)
    for _ in range(_PEER_ROUNDS):
        start = time.perf_counter()
        video = _plain(prior, image, corners)
        seconds = min(seconds, time.perf_counter() - start)
    theirs = np.maximum(video, 0)[corner].T
    return seconds, float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def _plain(prior: Mixture, image: CodedImage, corners: list[tuple[int, int]]) -> Doubles:
    """Mean of the patches' posterior means, (v, u, slot): plain numpy, one patch after the other."""
    size, slots = prior.patch, prior.slots
    basis, base = prior.basis.reshape(-1, size**2, slots).astype(np.float64), prior.base.reshape(-1, slots)
    known: dict[tuple[int, int], tuple[Doubles, Doubles, Doubles]] = {}
    total, count = np.zeros(image.weights.shape), np.zeros((*image.signal.shape, 1))
    for v, u in corners:
        part = slice(v, v + size), slice(u, u + size)
        weights = image.weights[part].reshape(-1, slots).astype(np.float64)
        signal, variance = image.signal[part].ravel().astype(np.float64), float(image.variance[part].mean())
        if (v % _TILE, u % _TILE) not in known:
            matrix = np.einsum("rpt,pt->pr", basis, weights)
            back = matrix @ prior.covariances
            known[v % _TILE, u % _TILE] = matrix, back, back @ matrix.T
        matrix, back, covariances = known[v % _TILE, u % _TILE]
        scale = signal.sum() / weights.sum()
        noise = variance / scale**2 + prior.rest * np.square(weights).sum(axis=1).mean()
        off = signal / scale - (prior.means @ matrix.T + (base * weights).sum(axis=1))
        inner = covariances + noise[:, None, None] * np.eye(size**2)
        solved = np.linalg.solve(inner, off[:, :, None])[:, :, 0]
        logs = np.log(prior.shares) - 0.5 * (np.linalg.slogdet(inner)[1] + (off * solved).sum(axis=1))
        chance = np.exp(logs - logs.max())
        chance[chance < _NEGLIGIBLE] = 0
        z = prior.means + np.einsum("kmr,km->kr", back, solved)
        patch = (chance / chance.sum() @ z) @ basis.reshape(len(basis), -1) + base.ravel()
        total[part] += scale * patch.reshape(size, size, slots)
        count[part] += 1
    return total / np.maximum(count, 1)
