"""Decoders against closed forms: what light, slot and error they must find, whatever the code inside."""

import numpy as np
import pytest
from ideal_camera import SLOTS, film, ideal_calibration, still_light

from optsim.coding import HdrMosaic, NormalPhotography, RandomExposure
from optsim.decoding import GaussianMixture, HdrMerge, Interpolation, SparseCoding, TotalVariation
from optsim.decoding.coded_images import coded_images
from optsim.decoding.patch_grid import patch_corners
from optsim.decoding.shared_weights import shared_weights
from optsim.decoding.sparse.patch_codes import PatchCoder
from optsim.priors.dictionary import shipped_dictionary

ELECTRONS_A_SLOT = 270.0


@pytest.mark.parametrize(("electrons", "read_e"), [(2.0, 14.0), (2.0, 1.0), (300.0, 14.0)])
def test_four_exposures_are_worth_what_their_electrons_are(electrons: float, read_e: float) -> None:
    """Of weights W_i with noise W_i N + r^2: 1 / sum of W_i^2 over it, and its own share of the gain."""
    calibration = ideal_calibration(120, 120, read_noise_dn=read_e, gain_uncertainty=0.03)
    light = electrons / ELECTRONS_A_SLOT
    frames = film(
        calibration, HdrMosaic(), [still_light(np.full((120, 120), light))] * 4, np.random.default_rng(5)
    )
    *_, layer = HdrMerge(threshold_sigma=8, neighbours=False).partials(frames, calibration)
    slots = np.array([1.0, 3.0, 11.0, 36.0])
    certainty = float((slots**2 / (slots * electrons + read_e**2)).sum())
    found = layer.irradiance_w_m2[0].astype(np.float64) / light
    relative = 1 / np.sqrt(certainty) / electrons
    # Its own error: of 14 400 pixels, 5 standard errors are 3 %; rounding to whole numbers adds 1/12.
    assert np.std(found) == pytest.approx(relative, rel=0.05)
    assert np.mean(found) == pytest.approx(1, abs=5 * relative / 120 + 2e-3)
    stated = layer.uncertainty_w_m2[0].astype(np.float64) / light
    assert np.sqrt(np.mean(stated**2)) == pytest.approx(np.hypot(relative, 0.03), rel=0.05)


def test_the_long_exposure_is_worth_its_electrons_too() -> None:
    """One frame of 36 slots, whose weights leave no choice."""
    calibration = ideal_calibration(120, 120)
    frames = film(
        calibration, NormalPhotography(), [still_light(np.full((120, 120), 0.1))], np.random.default_rng(6)
    )
    *_, layer = HdrMerge(neighbours=False).partials(frames, calibration)
    electrons = 36 * ELECTRONS_A_SLOT * 0.1
    relative = np.sqrt(electrons + 9) / electrons
    assert np.std(layer.irradiance_w_m2[0] / 0.1) == pytest.approx(relative, rel=0.04)
    assert np.mean(layer.uncertainty_w_m2[0] / 0.1) == pytest.approx(relative, rel=0.04)


@pytest.mark.parametrize("brighter", [1, -1])
@pytest.mark.parametrize(
    "decoder",
    [SparseCoding(stride_px=2), GaussianMixture(), Interpolation(), TotalVariation()],
    ids=lambda each: each.kind,
)
def test_a_video_is_neither_early_nor_late(decoder: object, brighter: int) -> None:
    """Light that grows or falls steadily: a slot late, all would be off by one slot's growth."""
    calibration = ideal_calibration(24, 32)
    time = np.arange(SLOTS) - (SLOTS - 1) / 2
    level = 0.6 + brighter * 0.012 * time
    light = np.broadcast_to(level[:, None, None], (SLOTS, 24, 32)).astype(np.float32)
    frames = film(calibration, RandomExposure(), [light], None)
    (video,) = decoder.decode(frames, calibration)  # type: ignore[attr-defined]
    seen = video.irradiance_w_m2.mean(axis=(1, 2))
    middle = slice(9, -9)
    late = (level - seen)[middle] / (brighter * 0.012)
    assert abs(late.mean()) < 0.25
    # And the growth itself, not its mirror image.
    assert np.polyfit(time[middle], seen[middle], 1)[0] == pytest.approx(brighter * 0.012, rel=0.2)


def test_a_patch_is_done_at_the_stated_multiple_of_its_noise() -> None:
    """With the atoms picked what is left is less, without the last one it is more, by least squares here."""
    calibration = ideal_calibration(24, 24, leak=0.01)
    light = np.random.default_rng(3).uniform(0.05, 1.0, (SLOTS, 24, 24)).astype(np.float32)
    frames = film(calibration, RandomExposure(), [light], np.random.default_rng(4))
    ((_, image),) = coded_images(frames, calibration, "undone")
    everywhere = np.ones((24, 24), np.bool_)
    corners = patch_corners(everywhere, 8, 4)
    shared = shared_weights(image.weights, everywhere, corners, 8, 0.02)
    coder, gain, cap = PatchCoder.of(shipped_dictionary()), 1.1, 40
    support, _ = coder.encode(image, corners, shared, cap=cap, noise_gain=gain)
    atoms = coder.atoms.astype(np.float64)
    seen = 0
    for (v, u), picked in zip(corners, support, strict=True):
        patch = np.s_[v : v + 8, u : u + 8]
        chosen = picked[picked >= 0]
        matrix = (atoms[chosen] * image.weights[patch]).sum(axis=3).reshape(len(chosen), -1).T
        signal = image.signal[patch].ravel().astype(np.float64)

        def left(n: int, matrix: np.ndarray = matrix, signal: np.ndarray = signal) -> float:
            fit = np.linalg.lstsq(matrix[:, :n], signal)[0]
            return float(np.square(signal - matrix[:, :n] @ fit).sum())

        enough = gain**2 * float(image.variance[patch].sum(dtype=np.float64))
        if 0 < len(chosen) < cap:
            seen += 1
            assert left(len(chosen)) <= enough * 1.001
            assert left(len(chosen) - 1) > enough * 0.999
    assert seen > 10
