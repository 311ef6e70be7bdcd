"""The mixture of velocities against dense algebra, what it says of its errors, and the joined decoder."""

import math
from functools import cache

import numpy as np
import pytest
from ideal_camera import expose, film, ideal_calibration

from optsim.coding import RandomExposure
from optsim.core.quantities import ExposureCode
from optsim.decoding import Joined, SparseCoding, VelocityMixture
from optsim.decoding.coded_images import coded_images
from optsim.decoding.joined import held_out
from optsim.decoding.mixture import moving_textures
from optsim.decoding.mixture.moving_textures import Windows, posterior
from optsim.decoding.shared_weights import followed_tile

SIDE, SLOTS, MEAN, LENGTH, TIMES = 6, 8, 31.0, 6.0, (100.0, 3000.0)
VELOCITIES = [(0.0, 0.0), (0.4, -0.2), (0.0, 0.9)]
COMPONENTS = [(*velocity, time) for time in TIMES for velocity in VELOCITIES]
ROWS, COLS, EDGE = 32, 40, 28


@cache
def dense_covariance(component):
    """Covariance of the light of all pixels and slots, pixel by pixel and slot by slot."""
    v, u, time = component
    places = [(y, x, t) for y in range(SIDE) for x in range(SIDE) for t in range(SLOTS)]
    found = np.empty((len(places), len(places)))
    for i, (y, x, t) in enumerate(places):
        for j, (b, a, s) in enumerate(places):
            far = math.hypot(y - b - v * (t - s), x - a - u * (t - s))
            found[i, j] = math.exp(-far / LENGTH - abs(t - s) / time)
    return found + MEAN - 1


def measuring(weights):
    """Matrix (pixel, pixel * slot) of weights (pixel, slot)."""
    matrix = np.zeros((SIDE**2, SIDE**2 * SLOTS))
    for pixel, row in enumerate(weights):
        matrix[pixel, pixel * SLOTS : (pixel + 1) * SLOTS] = row
    return matrix


def drawn_weights(rng):
    weights = rng.random((SIDE**2, SLOTS)) * (rng.random((SIDE**2, SLOTS)) < 0.4) + 0.01
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def dense_posterior(weights, samples, noise, there):
    """Mean video and left-out residuals, from what is said of the model alone."""
    mean = samples[there].mean()
    y = samples[there] - mean
    texture = max(np.square(y).mean() - noise, 0.05 * noise)
    still = measuring(weights) @ dense_covariance(COMPONENTS[0]) @ measuring(weights).T
    unit = np.diag(still).mean() - still.mean()
    level = 4.0 ** round(math.log(min(max(noise * unit / texture, 1e-4), 20), 4))
    logs, videos, residuals = [], [], []
    for component in COMPONENTS:
        matrix = measuring(weights)[there]
        light = dense_covariance(component)
        covariance = matrix @ light @ matrix.T + level * np.eye(there.sum())
        _, log_det = np.linalg.slogdet(covariance)
        logs.append(-(len(y) - 1) / 2 * math.log(y @ np.linalg.solve(covariance, y)) - log_det / 2)
        videos.append(light @ matrix.T @ np.linalg.solve(covariance, y))
        off = []
        for i in range(len(y)):
            rest = np.arange(len(y)) != i
            pull = np.linalg.solve(covariance[np.ix_(rest, rest)], y[rest])
            off.append(y[i] - covariance[i, rest] @ pull)
        residuals.append(off)
    shares = np.exp(np.array(logs) - max(logs))
    shares[shares < 0.05] = 0
    shares /= shares.sum()
    return mean + shares @ np.array(videos), shares @ np.array(residuals), shares


@pytest.mark.parametrize("missing", [0, 9])
def test_posterior_and_left_out_errors_are_those_of_dense_algebra(missing):
    rng = np.random.default_rng(missing)
    weights = drawn_weights(rng)
    there = np.ones((3, SIDE**2), bool)
    for row in there:
        row[rng.permutation(SIDE**2)[:missing]] = False
    root = np.linalg.cholesky(dense_covariance(COMPONENTS[1]) - MEAN + 1.0 + 1e-9 * np.eye(SIDE**2 * SLOTS))
    videos = 5 + rng.standard_normal((3, SIDE**2 * SLOTS)) @ root.T
    samples = videos @ measuring(weights).T + 0.1 * rng.standard_normal((3, SIDE**2))
    samples = np.where(there, samples, 77).astype(np.float32)
    noise = np.full(samples.shape, 0.01, np.float32)
    # The small weights of a sample are gathered in a few slots by the decoder, not here.
    found = posterior(weights, Windows(samples, noise, there), COMPONENTS, 1.0)
    for k in range(3):
        video, residuals, shares = dense_posterior(weights, samples[k].astype(float), 0.01, there[k])
        np.testing.assert_allclose(found.videos[k], video, atol=2e-3)
        np.testing.assert_allclose(found.residuals[k][there[k]], residuals, atol=2e-3)
        assert (found.residuals[k][~there[k]] == 0).all()
    assert shares[1] > 0


def test_draws_from_a_component_err_by_what_is_said():
    rng = np.random.default_rng(4)
    root = np.linalg.cholesky(
        dense_covariance((0.4, -0.2, 100.0)) - MEAN + 1.0 + 1e-9 * np.eye(SIDE**2 * SLOTS)
    )
    scores = []
    for _ in range(6):
        weights, n = drawn_weights(rng), 300
        videos = 5 + rng.standard_normal((n, SIDE**2 * SLOTS)) @ root.T
        samples = videos @ measuring(weights).T + 0.1 * rng.standard_normal((n, SIDE**2))
        windows = Windows(
            samples.astype(np.float32),
            np.full(samples.shape, 0.01, np.float32),
            np.ones(samples.shape, bool),
        )
        found = posterior(weights, windows, [(0.4, -0.2, 100.0)], 1.0, spread=True)
        scores.append((np.square(found.videos - videos) / found.variances).mean(axis=1))
    # The level of noise over texture is known to a factor of four only: some per cent of the variance.
    assert np.concatenate(scores).mean() == pytest.approx(1, abs=0.1)


def test_few_velocities_represent_all_in_windows_of_mostly_noise(monkeypatch):
    rng = np.random.default_rng(6)
    weights, noise = drawn_weights(rng), 0.5
    root = np.linalg.cholesky(dense_covariance(COMPONENTS[1]) - MEAN + 1.0 + 1e-9 * np.eye(SIDE**2 * SLOTS))
    videos = 5 + 0.3 * rng.standard_normal((20, SIDE**2 * SLOTS)) @ root.T
    samples = videos @ measuring(weights).T + noise * rng.standard_normal((20, SIDE**2))
    windows = Windows(
        samples.astype(np.float32), np.full(samples.shape, noise**2, np.float32), np.ones(samples.shape, bool)
    )
    components = [
        (v, u, time) for time in TIMES for v in np.arange(-1, 1, 0.2) for u in np.arange(-1, 1, 0.2)
    ]
    few = posterior(weights, windows, components, 1.0)
    monkeypatch.setattr(moving_textures, "_ROUGH", 99)
    every = posterior(weights, windows, components, 1.0)
    change, wrong = np.square(few.videos - every.videos).mean(), np.square(every.videos - videos).mean()
    assert 0 < change < 0.02 * wrong


def moving_texture(speed, seed=0):
    """A smooth random texture that moves along u: (slot, v, u), about 1."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 0.5, (12, 2)), rng.uniform(0, 2 * np.pi, 12)
    v, u = np.mgrid[:ROWS, :COLS]
    slots = []
    for t in range(36):
        phase = waves[0][:, 0, None, None] * v + waves[0][:, 1, None, None] * (u - speed * t)
        slots.append(1 + 0.08 * np.cos(phase + waves[1][:, None, None]).sum(axis=0))
    return np.stack(slots).astype(np.float32)


def error(decoder, frames, calibration, light):
    (found,) = decoder.decode(frames, calibration)
    assert found.valid.all()
    return float(np.square(found.irradiance_w_m2 - light).mean())


def test_it_needs_its_velocities_and_beats_the_dictionary_on_what_moves():
    light = moving_texture(0.55)
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, RandomExposure(), [light], np.random.default_rng(1))
    still, moving, sparse, joined = (
        error(each, frames, calibration, light)
        for each in (VelocityMixture(fastest=0), VelocityMixture(), SparseCoding(), Joined())
    )
    assert moving < 0.5 * still
    assert moving < 0.8 * sparse
    assert joined < 0.8 * sparse


def test_pixels_of_another_code_count_by_their_own_weights():
    """Beside a long exposure, which is no part of the tile, light is nearly as well known as without it."""
    light = moving_texture(0.35)
    calibration = ideal_calibration(ROWS, COLS)
    scheme = RandomExposure()
    code, _ = scheme.next(0, [], scheme.init(calibration, np.random.default_rng(2)))
    mixed = code.levels.copy()
    mixed[:, :, EDGE:] = 0
    mixed[12:24, :, EDGE:] = 255
    left = np.broadcast_to(np.arange(COLS) < EDGE, (ROWS, COLS))
    beside = (slice(None), slice(None), slice(EDGE - 4, EDGE))
    errors = []
    for levels, moving in ((code.levels, np.ones_like(left)), (mixed, left)):
        frame, _ = expose(calibration, light, 0, ExposureCode(levels, moving), None, np.random.default_rng(3))
        (found,) = VelocityMixture(fastest=0.35).decode([frame], calibration)
        errors.append(float(np.square(found.irradiance_w_m2 - light)[beside].mean()))
    scatter = float(np.square(light - light.mean()).mean())
    assert errors[1] < 1.5 * errors[0] < 0.1 * scatter


def test_its_own_left_out_errors_are_near_those_of_four_turns():
    light = moving_texture(0.35, seed=2)
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, RandomExposure(), [light], np.random.default_rng(3))
    ((frame, image),) = coded_images(frames, calibration, "undone")
    decode = VelocityMixture(fastest=0.35, stride_px=6).image_decoder(calibration)
    own, turns = decode(frame, image).held_out, held_out(frame, image, decode)
    assert np.isfinite(own).all()
    assert np.isfinite(turns).all()
    # A quarter fewer samples are a little worse than one.
    assert 0.7 < np.mean(turns) / np.mean(own) < 2.0


def test_shares_go_to_the_decoder_that_predicts_better():
    light = moving_texture(0.35)
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    frames = film(calibration, RandomExposure(), [light], np.random.default_rng(1))
    good, bad = VelocityMixture(fastest=0.35), VelocityMixture(fastest=0)
    errors = [
        error(each, frames, calibration, light)
        for each in (good, Joined(decoders=(good, bad)), bad, Joined(decoders=(good, bad), power=0))
    ]
    assert errors[0] < errors[1] * 1.2
    assert errors[1] < 0.7 * errors[3] < errors[2]
    alone = error(Joined(decoders=(good, good)), frames, calibration, light)
    assert alone == pytest.approx(errors[0], rel=1e-4)


def test_a_tile_is_followed_by_all_pixels_but_strangers_and_holes():
    rng = np.random.default_rng(5)
    tile = rng.random((8, 8, 5)).astype(np.float32)
    weights = np.tile(tile, (6, 7, 1)) * (1 + 0.02 * rng.standard_normal((48, 56, 1))).astype(np.float32)
    mask = rng.random((48, 56)) > 0.1
    strange = np.zeros_like(mask)
    strange[:10, :12] = True
    weights[strange] = 0.3
    weights[~mask] = 0
    there = mask & ~strange
    # Beyond the mask the code goes on.
    mask[:, 40:] = False
    found, follows = followed_tile(weights, mask, 0.25)
    assert found.shape == tile.shape
    np.testing.assert_allclose(found, tile, rtol=0.05, atol=0.01)
    np.testing.assert_array_equal(follows, there)
