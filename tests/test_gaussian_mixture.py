"""The mixture of Gaussians: its posterior against dense algebra, its training, its file, its decoder."""

import os
from dataclasses import replace

import numpy as np
import pytest
from ideal_camera import SLOTS, film, ideal_calibration, still_light

from optsim.coding import RandomExposure
from optsim.errors import ConfigError, StorageError, ValueCheckError
from optsim.reconstruct import Average, GaussianMixture, SparseCoding
from optsim.reconstruct.mixture import Mixture, load_mixture, save_mixture
from optsim.reconstruct.mixture_training import log_densities, train_mixture
from optsim.reconstruct.posterior import expected, seen_through


def some_mixture(rng, k=3, r=6, patch=3, slots=5, rest=0.01):
    """Any mixture, well conditioned."""
    basis = np.linalg.qr(rng.standard_normal((patch * patch * slots, r)))[0].T.reshape(r, patch, patch, slots)
    roots = rng.standard_normal((k, r, r))
    shares = rng.random(k) + 0.2
    return Mixture(
        rng.random((patch, patch, slots)).astype(np.float32),
        basis.astype(np.float32),
        shares / shares.sum(),
        rng.standard_normal((k, r)),
        roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(r),
        rest,
    )


def dense_posterior(mixture, weights, signal, variance):
    """Posterior mean of z, by densities and inverses of whole matrices in float64."""
    pixels, slots = weights.shape
    matrix = np.zeros((pixels, pixels * slots))
    for p in range(pixels):
        matrix[p, p * slots : (p + 1) * slots] = weights[p]
    basis = mixture.basis.reshape(len(mixture.basis), -1).astype(np.float64).T
    base = mixture.base.ravel().astype(np.float64)
    logs, means = [], []
    for share, mean, covariance in zip(mixture.shares, mixture.means, mixture.covariances, strict=True):
        a = matrix @ basis
        total = a @ covariance @ a.T + mixture.rest * matrix @ matrix.T + variance * np.eye(pixels)
        off = signal - matrix @ (base + basis @ mean)
        solved = np.linalg.inv(total) @ off
        logs.append(np.log(share) - 0.5 * (np.linalg.slogdet(total)[1] + off @ solved))
        means.append(mean + covariance @ a.T @ solved)
    chance = np.exp(np.array(logs) - max(logs))
    return chance / chance.sum() @ np.array(means)


@pytest.mark.parametrize("variance", [1e-4, 0.1, 10.0])
def test_posterior_is_that_of_dense_algebra(variance):
    rng = np.random.default_rng(5)
    mixture = some_mixture(rng)
    # Every pixel's weights have the same norm: then what the basis leaves out is the same in all, exactly.
    weights = rng.random((9, 5))
    weights = (weights / np.linalg.norm(weights, axis=1, keepdims=True)).astype(np.float32)
    signals = rng.standard_normal((4, 9)).astype(np.float32) + 1
    found = expected(seen_through(mixture, weights), signals, np.full(4, variance, np.float32))
    wanted = [dense_posterior(mixture, weights.astype(np.float64), s, variance) for s in signals]
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=2e-3 * np.abs(wanted).max())


def test_nothing_measured_gives_the_prior_mean():
    mixture = some_mixture(np.random.default_rng(2))
    weights = np.zeros((9, 5), np.float32)
    found = expected(seen_through(mixture, weights), np.zeros((1, 9), np.float32), np.ones(1, np.float32))
    np.testing.assert_allclose(found[0], mixture.shares @ mixture.means, rtol=1e-5)


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


def filmed(video, *, noise=True):
    calibration = ideal_calibration(*video.shape[1:], leak=0.01)
    rng = np.random.default_rng(1) if noise else None
    return calibration, film(calibration, RandomExposure(), [video], rng)


def test_it_beats_the_blur_and_the_dictionary_on_what_it_has_learned(trained):
    video = drifting(np.random.default_rng(99))
    calibration, frames = filmed(video)
    blur = np.square(video.mean(axis=0) - video).mean()
    errors = {}
    for name, decoder in {
        "mixture": GaussianMixture(mixture=trained),
        "single": GaussianMixture(mixture=trained, single=True),
        "dictionary": SparseCoding(stride_px=2),
        "average": Average(sparse=SparseCoding(stride_px=2), mixture=GaussianMixture(mixture=trained)),
    }.items():
        (found,) = decoder.decode(frames, calibration)
        assert found.valid.all()
        errors[name] = np.square(found.irradiance_w_m2 - video).mean() / blur
    # The prior has seen this texture's statistics, the shipped dictionary has not.
    assert errors["mixture"] < errors["single"] < 0.5
    assert errors["mixture"] < errors["dictionary"]
    # A mean is never worse than the worse of two, and here their errors are partly independent.
    assert errors["average"] < 0.5 * (errors["dictionary"] + errors["mixture"])


def test_patches_solved_alone_equal_shared_ones_and_survive_dead_pixels(trained):
    video = drifting(np.random.default_rng(7), 24, 24)
    calibration, frames = filmed(video)
    decoder = GaussianMixture(mixture=trained)
    (shared,) = decoder.decode(frames, calibration)
    (alone,) = decoder.model_copy(update={"tile_px": 7}).decode(frames, calibration)
    np.testing.assert_allclose(alone.irradiance_w_m2, shared.irradiance_w_m2, atol=2e-3)
    valid = calibration.valid.copy()
    valid[12, 12] = False
    dead = [replace(frames[0], dn=np.where(valid, frames[0].dn, 0).astype(np.uint16))]
    (found,) = decoder.decode(dead, replace(calibration, valid=valid))
    assert not found.valid[12, 12]
    assert found.valid.sum() == valid.sum()
    change = np.abs(found.irradiance_w_m2 - shared.irradiance_w_m2)
    assert change[:, 10:15, 10:15].mean() < 0.05, "a dead pixel's zero is left out, not believed"


def test_darkness_stays_dark_in_the_mean(trained):
    video = still_light(np.zeros((64, 64), np.float32))
    calibration, frames = filmed(video)
    (layer,) = GaussianMixture(mixture=trained).layers(frames, calibration)
    # 4096 pixels of 3 DN of noise and 270 DN a slot; each patch has the mean of its own signals. Leak of
    # 33 slots at 1 % adds a tenth to what three open slots gather.
    deviation = 3 / 270 / 3.33 / 64
    assert abs(float(layer.irradiance_w_m2.mean())) < 4 * deviation


def test_results_do_not_depend_on_the_number_of_workers(trained, monkeypatch):
    calibration, frames = filmed(drifting(np.random.default_rng(8)))
    found = []
    for workers in (1, 3):
        monkeypatch.setattr(os, "cpu_count", lambda workers=workers: workers)
        (result,) = GaussianMixture(mixture=trained).decode(frames, calibration)
        found.append(result.irradiance_w_m2)
    np.testing.assert_array_equal(*found)


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
