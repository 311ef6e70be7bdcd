"""The mixture of Gaussians: its posterior against dense algebra, its training, its file, its decoder."""

import os
from dataclasses import replace

import numpy as np
import pytest
from dense_mixture import asked, dense_posterior, dense_variance, drawn, some_mixture, unit_weights
from ideal_camera import SLOTS, film, ideal_calibration, still_light

from optsim.calibration.demixed import demixed_frame
from optsim.coding import RandomExposure
from optsim.core.errors import ConfigError, StorageError, ValueCheckError
from optsim.core.quantities import ExposureCode
from optsim.decoding import (
    GaussianMixture,
    Joined,
    SparseCoding,
    coded_images,
    gaussian_mixture,
    shared_weights,
)
from optsim.decoding.mixture.posterior import measured_through, posterior
from optsim.decoding.mixture.posterior_spread import Spread
from optsim.priors.mixture import load_mixture, save_mixture
from optsim.priors.mixture_training import log_densities, train_mixture


@pytest.mark.parametrize("variance", [1e-4, 0.1, 10.0])
def test_posterior_is_that_of_dense_algebra(variance):
    rng = np.random.default_rng(5)
    mixture = some_mixture(rng)
    # Every pixel's weights have the same norm: then what the basis leaves out is the same in all, exactly.
    weights = rng.random((9, 5))
    weights = (weights / np.linalg.norm(weights, axis=1, keepdims=True)).astype(np.float32)
    signals = rng.standard_normal((4, 9)).astype(np.float32) + 1
    found = posterior(measured_through(mixture, weights), signals, np.full(4, variance, np.float32)).mean()
    wanted = [dense_posterior(mixture, weights.astype(np.float64), s, variance) for s in signals]
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=2e-3 * np.abs(wanted).max())


def test_nothing_measured_gives_the_prior_mean():
    mixture = some_mixture(np.random.default_rng(2))
    weights = np.zeros((9, 5), np.float32)
    found = posterior(
        measured_through(mixture, weights), np.zeros((1, 9), np.float32), np.ones(1, np.float32)
    ).mean()
    np.testing.assert_allclose(found[0], mixture.shares @ mixture.means, rtol=1e-5)


@pytest.mark.parametrize("variance", [1e-4, 0.1, 10.0])
def test_spread_is_that_of_dense_algebra(variance):
    rng = np.random.default_rng(5)
    mixture = some_mixture(rng, r=12)
    weights = unit_weights(rng)
    signals = rng.standard_normal((40, 9)).astype(np.float32) + 1
    _, found = asked(mixture, weights, signals, variance)
    wanted = [dense_variance(mixture, weights.astype(np.float64), s, variance) for s in signals]
    np.testing.assert_allclose(found.reshape(40, -1), wanted, rtol=1e-3, atol=1e-5)
    assert np.ptp(wanted, axis=0).max() > 0.1 * np.mean(wanted), "shares differ from patch to patch"


@pytest.mark.parametrize("k", [1, 3])
def test_draws_from_the_prior_err_by_what_is_said(k):
    rng = np.random.default_rng(k)
    mixture = some_mixture(rng, k=k, r=12, rest=0.0)
    n, scores = 500, []
    for _ in range(8):
        weights = rng.random((9, 5)).astype(np.float32)
        patches = drawn(mixture, n, rng)
        signals = (patches * weights).sum(axis=2) + np.sqrt(0.3) * rng.standard_normal((n, 9))
        estimate, variance = asked(mixture, weights, signals, 0.3)
        scores.append((np.square(estimate - patches) / variance).mean(axis=(1, 2)))
    # Patches are independent, their elements are not: four standard errors of the mean over patches, a false
    # alarm in 16 000.
    scores = np.concatenate(scores)
    error = scores.std() / np.sqrt(scores.size)
    assert error < 0.02
    assert abs(scores.mean() - 1) < 4 * error


def test_energy_outside_the_rank_is_in_it():
    rng = np.random.default_rng(9)
    mixture = some_mixture(rng, r=4, rest=0.5)
    weights = unit_weights(rng)
    patches = drawn(mixture, 4000, rng)
    signals = (patches * weights).sum(axis=2) + np.sqrt(0.05) * rng.standard_normal((4000, 9))
    estimate, variance = asked(mixture, weights, signals, 0.05)
    score = (np.square(estimate - patches) / variance).mean()
    # 4000 patches of 45 elements scatter by less than 1 %. The rest is taken for noise of the signal although
    # a part of it is what was measured: a few per cent more error is owned than made.
    assert 0.85 < score < 1.03


def test_without_noise_nothing_is_uncertain_and_unmeasured_is_the_prior():
    rng = np.random.default_rng(11)
    mixture = some_mixture(rng, k=1, r=6, rest=0.0)
    basis = mixture.basis.reshape(6, -1)
    prior = np.einsum("ie,ij,je->e", basis, mixture.covariances[0], basis)
    weights = rng.random((9, 5)).astype(np.float32)
    patches = drawn(mixture, 50, rng)
    for noise in (1e-6, 1e-9, 0.0):
        estimate, variance = asked(mixture, weights, (patches * weights).sum(axis=2), noise)
        assert (variance >= 0).all()
        assert np.isfinite(estimate).all()
        # Six unknowns, nine measurements; float32 leaves a thousandth of the prior's deviation.
        assert np.sqrt(variance.max()) < 2e-3 * np.sqrt(prior.max()) + 20 * np.sqrt(noise)
    blind = np.zeros_like(weights)
    mixed = some_mixture(rng, rest=0.02)
    basis = mixed.basis.reshape(6, -1)
    wanted = np.einsum("ie,ij,je->e", basis, mixed.single().covariances[0], basis)
    wanted += mixed.single().rest * (1 - np.square(basis).sum(axis=0))
    for noise in (0.0, 1.0, 1e12):
        _, variance = asked(mixed, blind, np.zeros((2, 9)), noise)
        np.testing.assert_allclose(variance.reshape(2, -1), np.stack([wanted] * 2), rtol=1e-4)


def test_single_gaussian_has_the_moments_of_the_mixture():
    rng = np.random.default_rng(3)
    mixture = some_mixture(rng)
    n = 200_000
    member = rng.choice(3, n, p=mixture.shares)
    roots = np.linalg.cholesky(mixture.covariances)
    z = mixture.means[member] + np.einsum("nij,nj->ni", roots[member], rng.standard_normal((n, 6)))
    single = mixture.single()
    # Six means and 21 covariances, five standard errors each: one false alarm in 60 000 such tests.
    off = z - single.means[0]
    assert (np.abs(off.mean(axis=0)) < 5 * z.std(axis=0) / np.sqrt(n)).all()
    products = off[:, :, None] * off[:, None, :]
    error = products.mean(axis=0) - single.covariances[0]
    assert (np.abs(error) < 5 * products.std(axis=0) / np.sqrt(n)).all()


def test_log_densities_are_those_of_the_formula():
    rng = np.random.default_rng(4)
    mixture = some_mixture(rng)
    z = rng.standard_normal((5, 6))
    found = log_densities(z, mixture.shares, mixture.means, mixture.covariances)
    for k in range(3):
        off = z - mixture.means[k]
        quadratic = np.einsum("ni,ij,nj->n", off, np.linalg.inv(mixture.covariances[k]), off)
        norm = np.linalg.slogdet(2 * np.pi * mixture.covariances[k])[1]
        np.testing.assert_allclose(
            found[:, k], np.log(mixture.shares[k]) - 0.5 * (quadratic + norm), rtol=1e-5
        )


def drifting(rng, rows=48, cols=48):
    """A random texture that drifts, (slot, v, u)."""
    from scipy.ndimage import gaussian_filter, shift

    texture = gaussian_filter(rng.random((rows + 40, cols + 40)), 1.5, mode="wrap")
    texture = 0.1 + (texture - texture.min()) / np.ptp(texture)
    velocity = rng.uniform(-0.5, 0.5, 2)
    poses = [shift(texture, velocity * t, order=1, mode="wrap")[20:-20, 20:-20] for t in range(SLOTS)]
    return np.stack(poses).astype(np.float32)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    clips = [drifting(np.random.default_rng(seed)) for seed in range(6)]
    mixture = train_mixture(
        clips, rng=np.random.default_rng(0), n_components=3, rank=48, n_patches=1500, iterations=5
    )
    path = tmp_path_factory.mktemp("mixture") / "drifting.npz"
    save_mixture(path, mixture)
    return str(path)


def test_a_quarter_of_the_basis_stands_still_and_still_patches_leave_less():
    clips = [drifting(np.random.default_rng(seed)) for seed in range(3)]
    fine = np.random.default_rng(5).uniform(0.8, 1.2, (48, 48)).astype(np.float32)
    clips += [np.repeat(fine[None], SLOTS, axis=0)] * 3
    rng = np.random.default_rng(0)
    mixture = train_mixture(clips, rng=rng, n_components=2, rank=256, n_patches=1500, iterations=5)
    basis = mixture.basis.reshape(256, -1)
    np.testing.assert_allclose(basis @ basis.T, np.eye(256), atol=1e-4)
    assert np.abs(np.ptp(mixture.basis[:64], axis=3)).max() < 1e-6
    assert np.abs(mixture.basis[64:].mean(axis=3)).max() < 1e-4
    # White noise that stands still has 64 equal directions, all of which are kept.
    quiet = np.argsort(mixture.rest)
    assert 0 <= mixture.rest[quiet[0]] < 0.05 * mixture.rest[quiet[1]]


def filmed(video, *, noise=True):
    calibration = ideal_calibration(*video.shape[1:], leak=0.01)
    rng = np.random.default_rng(1) if noise else None
    return calibration, film(calibration, RandomExposure(), [video], rng)


def test_it_beats_the_blur_and_one_gaussian_on_what_it_has_learned(trained):
    video = drifting(np.random.default_rng(99))
    calibration, frames = filmed(video)
    blur = np.square(video.mean(axis=0) - video).mean()
    errors = {}
    for name, decoder in {
        "mixture": GaussianMixture(mixture=trained),
        "single": GaussianMixture(mixture=trained, single=True),
        "dictionary": SparseCoding(stride_px=2),
        "joined": Joined(decoders=(SparseCoding(stride_px=2), GaussianMixture(mixture=trained))),
    }.items():
        (found,) = decoder.decode(frames, calibration)
        assert found.valid.all()
        errors[name] = np.square(found.irradiance_w_m2 - video).mean() / blur
    assert errors["mixture"] < errors["single"] < 0.5
    # Here their errors are partly independent.
    assert errors["joined"] < 0.5 * (errors["dictionary"] + errors["mixture"])


def test_patches_solved_alone_equal_shared_ones_and_survive_dead_pixels(trained, monkeypatch):
    video = drifting(np.random.default_rng(7), 24, 24)
    calibration, frames = filmed(video)
    decoder = GaussianMixture(mixture=trained)
    (shared,) = decoder.decode(frames, calibration)
    with monkeypatch.context() as patched:
        patched.setattr(shared_weights, "code_period", lambda weights, *_: weights.shape[:2])
        (alone,) = decoder.decode(frames, calibration)
    np.testing.assert_allclose(alone.irradiance_w_m2, shared.irradiance_w_m2, atol=2e-3)
    valid = calibration.valid.copy()
    valid[12, 12] = False
    dead = [replace(frames[0], dn=np.where(valid, frames[0].dn, 0).astype(np.uint16))]
    (found,) = decoder.decode(dead, replace(calibration, valid=valid))
    assert not found.valid[12, 12]
    assert found.valid.sum() == valid.sum()
    change = np.abs(found.irradiance_w_m2 - shared.irradiance_w_m2)
    assert change[:, 10:15, 10:15].mean() < 0.05, "a dead pixel's zero is left out, not believed"


def test_darkness_stays_dark_in_the_mean(trained, monkeypatch):
    video = still_light(np.zeros((64, 64), np.float32))
    calibration, frames = filmed(video)
    decoder = GaussianMixture(mixture=trained)
    # 4096 pixels of 3 DN of noise and 270 DN a slot; each patch has the mean of its own signals. Leak of
    # 33 slots at 1 % adds a tenth to what three open slots gather.
    deviation = 3 / 270 / 3.33 / 64
    (layer,) = decoder.partials(frames, calibration)
    # What may be there is the noise of a patch, of 64 pixels.
    assert 0.5 * 8 * deviation < float(layer.irradiance_w_m2.mean()) < 1.5 * 8 * deviation
    monkeypatch.setattr(coded_images, "positive_mean", lambda mean, variance: mean)
    (signed,) = decoder.partials(frames, calibration)
    assert abs(float(signed.irradiance_w_m2.mean())) < 4 * deviation


def test_results_do_not_depend_on_the_number_of_workers(trained, monkeypatch):
    calibration, frames = filmed(drifting(np.random.default_rng(8)))
    found = []
    for workers in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda workers=workers: workers)
        (result,) = GaussianMixture(mixture=trained, uncertainty=True).decode(frames, calibration)
        found.append((result.irradiance_w_m2, result.uncertainty_w_m2))
    np.testing.assert_array_equal(*found)


def decodable(tmp_path, rng, k, rank=40):
    """A mixture whose patches are about 1 with a tenth of variation, as a decoder reads it."""
    mixture = some_mixture(rng, k=k, r=rank, patch=8, slots=SLOTS, rest=0.0)
    # An element has the variance of z times rank over elements; the roots have that of rank.
    size = 0.1 * np.sqrt(2304 / rank)
    mixture = replace(
        mixture,
        base=np.ones_like(mixture.base),
        means=mixture.means * size * 0.7,
        covariances=mixture.covariances * size**2 / rank,
    )
    save_mixture(tmp_path / "prior.npz", mixture)
    return load_mixture(tmp_path / "prior.npz"), str(tmp_path / "prior.npz")


@pytest.mark.parametrize("k", [1, 3])
def test_the_decoder_errs_by_what_it_says(tmp_path, k):
    rng = np.random.default_rng(20 + k)
    mixture, path = decodable(tmp_path, rng, k)
    patches = drawn(mixture, 256, rng)
    video = patches.reshape(16, 16, 8, 8, SLOTS).transpose(4, 0, 2, 1, 3).reshape(SLOTS, 128, 128)
    calibration, frames = filmed(video.astype(np.float32))
    (layer,) = GaussianMixture(mixture=path, stride_px=8, uncertainty=True).partials(frames, calibration)
    error = (layer.irradiance_w_m2 - video) / layer.uncertainty_w_m2
    scores = np.square(error).reshape(SLOTS, 16, 8, 16, 8).mean(axis=(0, 2, 4)).ravel()
    bound = 4 * scores.std() / 16
    # Four standard errors over 256 patches; 5 % for a brightness that is measured, not known.
    assert bound < 0.1
    assert abs(scores.mean() - 1) < bound + 0.05


def test_one_patch_is_dense_algebra_at_its_brightness(tmp_path):
    rng = np.random.default_rng(31)
    mixture, path = decodable(tmp_path, rng, 3)
    video = 0.5 * drawn(mixture, 1, rng).transpose(2, 0, 1).reshape(SLOTS, 8, 8)
    calibration, frames = filmed(video.astype(np.float32))
    decoder = GaussianMixture(mixture=path, uncertainty=True, noise_gain=2.0)
    (layer,) = decoder.partials(frames, calibration)
    sample, _ = demixed_frame(calibration, frames[0], None, "undone")
    scale = sample.signal.sum() / sample.exposure.sum()
    weights = np.moveaxis(sample.weights, 0, -1).reshape(64, SLOTS).astype(np.float64)
    noise = 4 * sample.variance.mean() / scale**2
    wanted = scale**2 * dense_variance(mixture, weights, sample.signal.ravel() / scale, noise)
    wanted += 4 * sample.variance.sum() / sample.exposure.sum() ** 2
    found = np.square(layer.uncertainty_w_m2).transpose(1, 2, 0).ravel()
    np.testing.assert_allclose(found, wanted, rtol=1e-3)


def test_darkness_and_closed_pixels_are_as_uncertain_as_they_should_be(trained):
    dark = still_light(np.zeros((64, 64), np.float32))
    calibration, frames = filmed(dark)
    decoder = GaussianMixture(mixture=trained, uncertainty=True)
    (layer,) = decoder.partials(frames, calibration)
    score = np.sqrt(np.square(layer.irradiance_w_m2 / layer.uncertainty_w_m2).mean())
    # Errors are the noise of the brightness, a part of which the overlap averages out; said is that of one
    # patch, and the prior's variation at the brightness that noise lent to it.
    assert 0.5 < score < 1.1
    video = drifting(np.random.default_rng(3), 64, 64)
    calibration = ideal_calibration(64, 64)
    levels = film(calibration, RandomExposure(), [video], None)[0].code.levels.copy()
    levels[:, 8:40, 8:40] = 0
    code = ExposureCode(levels, np.ones((64, 64), np.bool_))
    (frame,) = film(calibration, Closed(code), [video], np.random.default_rng(4))
    (layer,) = decoder.partials([frame], calibration)
    spread = layer.uncertainty_w_m2
    assert spread[:, 20:28, 20:28].min() > 0.5 * video.mean(), "never open: as uncertain as bright"
    assert spread[:, 20:28, 20:28].max() < 5 * video.max()
    filled = layer.irradiance_w_m2[:, 20:28, 20:28]
    around = video[:, 4:44, 4:44]
    assert around.min() < filled.mean() < around.max(), "as bright as around, not black"
    assert np.all(spread[:, 20:28, 20:28] >= filled)
    assert spread[:, 48:, 48:].max() < video.mean()


class Closed:
    """A scheme that shows one code."""

    def __init__(self, code):
        self.code = code

    def init(self, calibration, rng):
        return None

    def next(self, index, frames, state):
        return self.code, state


def test_without_being_asked_it_neither_says_nor_computes(trained, monkeypatch):
    calibration, frames = filmed(drifting(np.random.default_rng(8)))
    decoder = GaussianMixture(mixture=trained)
    (asked_for,) = decoder.model_copy(update={"uncertainty": True}).decode(frames, calibration)
    assert asked_for.uncertainty_w_m2.min() > 0
    monkeypatch.setattr(Spread, "of", lambda mixture: pytest.fail("computed"))
    monkeypatch.setattr(Spread, "variance", lambda self, known: pytest.fail("computed"))
    (silent,) = decoder.decode(frames, calibration)
    assert silent.uncertainty_w_m2 is None
    np.testing.assert_array_equal(silent.irradiance_w_m2, asked_for.irradiance_w_m2)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_some_of_the_patches_speak_for_all(trained, monkeypatch, stride):
    video = drifting(np.random.default_rng(8), 48, 49)
    calibration, frames = filmed(video)
    moving = np.zeros((48, 49), np.bool_)
    moving[13:30, 11:32] = True
    frames = [replace(f, code=replace(f.code, moving=moving)) for f in frames]
    decoder = GaussianMixture(mixture=trained, stride_px=stride, uncertainty=True)
    (some,) = decoder.partials(frames, calibration)
    monkeypatch.setattr(gaussian_mixture, "_half_apart", lambda corners, *_: np.ones(len(corners), np.bool_))
    (every,) = decoder.partials(frames, calibration)
    assert (some.uncertainty_w_m2[:, some.blend_weight > 0] > 0).all()
    inside = np.square(some.uncertainty_w_m2[:, moving]), np.square(every.uncertainty_w_m2[:, moving])
    assert inside[0].mean() == pytest.approx(inside[1].mean(), rel=0.05)
    assert np.sqrt(np.square(inside[0] / inside[1] - 1).mean()) < 0.15


def test_file_keeps_what_counts_and_others_are_refused(tmp_path):
    mixture = some_mixture(np.random.default_rng(6))
    save_mixture(tmp_path / "m.npz", mixture)
    again = load_mixture(tmp_path / "m.npz")
    # Half precision: 2^-11 a number, twice that in a product of factors.
    size = np.abs(mixture.covariances).max()
    np.testing.assert_allclose(again.covariances, mixture.covariances, atol=6 * 2**-11 * size)
    np.testing.assert_allclose(again.means, mixture.means, rtol=1e-6)
    with pytest.raises(StorageError, match="optsim train"):
        load_mixture(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"no")
    with pytest.raises(StorageError, match="not a mixture"):
        load_mixture(tmp_path / "bad.npz")
    calibration, frames = filmed(still_light(np.ones((16, 16), np.float32)))
    with pytest.raises(ConfigError, match="5 slots"):
        next(GaussianMixture(mixture=str(tmp_path / "m.npz")).decode(frames, calibration))


def test_too_little_to_learn_from_is_said():
    with pytest.raises(ValueCheckError, match="usable patches"):
        train_mixture([drifting(np.random.default_rng(1))], rng=np.random.default_rng(0), n_patches=50)
