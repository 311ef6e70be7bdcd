"""Posterior of windows under textures that translate, one Gaussian a velocity.

The light of two pixels in two slots has the covariance ``exp(-|dx - v dt| / length - |dt| / time)``, times a
scale that is integrated out, and a free mean. Evidence and means are those of Gaussian processes (C. E.
Rasmussen and C. K. I. Williams, *Gaussian Processes for Machine Learning*, 2006, chapters 2 and 5). Windows
that share their weights share one factor of each Gaussian. A missing sample is taken out of it exactly, by
the part of the inverse that belongs to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Floats, Ints

# Distance and times over which a texture's covariance falls to 1/e: found by trial on photographs that move
# and on the demo.
_LENGTH_PX = 6.0
TIMES_SLOTS = 100.0, 3000.0
# Variance of a window's mean, relative to its texture's, and 1: large, so that the mean is free.
_MEAN = 31.0
# Noise over texture, variances, in steps of a factor of four: of two cost 0.001 dB less and 30 % more time.
_CLEAN, _NOISY = 1e-4, 20.0
_LEAST_TEXTURE = 0.05  # of the noise
_NEGLIGIBLE = 0.05  # of the best component's share
_UNLIKELY = 8.0  # logarithm of the evidence below the best one's
_TINY = np.float32(1e-12)

Component = tuple[float, float, float]
"""Velocity along v and u, panel pixels a slot, and coherence time, slots."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Samples of n windows of p pixels.

    Parameters
    ----------
    means, noise : ndarray of shape (n, p), float32
        Mean light of each pixel while it was open, and its noise variance.
    measured : ndarray of shape (n, p), bool
        Pixels with a sample.
    """

    means: Floats
    noise: Floats
    measured: Bools

    def some(self, members: Ints) -> Windows:
        """Select some of them."""
        return Windows(self.means[members], self.noise[members], self.measured[members])


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known of n windows.

    Parameters
    ----------
    videos : ndarray of shape (n, p * slot), float32
        Posterior means.
    residuals : ndarray of shape (n, p), float32
        Each sample minus what the others predict; 0 without a sample.
    variances : ndarray of shape (n, p * slot), float32, or None
        Posterior variances, if asked for.
    """

    videos: Floats
    residuals: Floats
    variances: Floats | None

    @classmethod
    def joined(cls, parts: list[Posterior]) -> Posterior:
        """Join those of several groups of windows."""
        spreads = [part.variances for part in parts if part.variances is not None]
        return cls(
            np.concatenate([part.videos for part in parts]),
            np.concatenate([part.residuals for part in parts]),
            np.concatenate(spreads) if spreads else None,
        )


def posterior(
    weights: Floats,
    windows: Windows,
    components: list[Component],
    noise_gain: float,
    *,
    spread: bool = False,
) -> Posterior:
    """Compute the videos of windows that share their weights.

    Parameters
    ----------
    weights : ndarray of shape (p, slot), float32
        Share of each slot in a pixel's mean; rows sum to 1.
    windows : Windows
        Their samples.
    components : list of tuple
        The Gaussians. Those of one velocity follow the first of it.
    noise_gain : float
        Assumed standard deviation of the noise, relative to the stated one.
    spread : bool
        Whether the variances are wanted.
    """
    samples, mean, level = _normalised(weights, windows, noise_gain)
    shares = likelihoods(weights, windows, components, noise_gain)
    found = _mixed(weights, samples, windows.measured, level, components, shares, spread)
    return replace(found, videos=found.videos + mean[:, None])


def likelihoods(weights: Floats, windows: Windows, components: list[Component], noise_gain: float) -> Doubles:
    """Share of each component in each window, (k, n), by its evidence; 0 for negligible ones."""
    samples, _, level = _normalised(weights, windows, noise_gain)
    n = windows.measured.sum(axis=1)
    table, signals = _space(weights), np.empty((len(weights), len(weights)))
    logs = np.full((len(components), len(samples)), -np.inf)
    first: dict[tuple[float, float], int] = {}
    for k, component in enumerate(components):
        # What was unlikely at one time is so at the others.
        before = first.setdefault(component[:2], k)
        likely = (before == k) | (logs[before] >= logs.max(axis=0) - _UNLIKELY)
        if not likely.any():
            continue
        _fill_table(*component, table)
        _fill_signal_covariance(table, weights, signals)
        for each in np.unique(level[likely]):
            some = np.flatnonzero(likely & (level == each))
            solved = _solved(signals + _MEAN, 2.0**each, samples[some], windows.measured[some], whole=False)
            logs[k, some] = -(n[some] - 1) / 2 * np.log(solved.squares + _TINY**2) - solved.log_root
    shares = np.exp(logs - logs.max(axis=0))
    shares[shares < _NEGLIGIBLE] = 0
    return shares / shares.sum(axis=0)


def _normalised(weights: Floats, windows: Windows, noise_gain: float) -> tuple[Floats, Floats, Ints]:
    """Subtract each window's mean, and find its noise.

    Returns samples (n, p), 0 if missing; means (n,); log2 of noise variance over texture variance (n,).
    """
    measured = windows.measured
    n = measured.sum(axis=1)
    mean = (windows.means * measured).sum(axis=1) / n
    samples = np.where(measured, windows.means - mean[:, None], 0).astype(np.float32)
    noise = noise_gain**2 * (windows.noise * measured).sum(axis=1) / n
    texture = np.square(samples).sum(axis=1) / n - noise
    texture = np.maximum(texture, _LEAST_TEXTURE * noise + _TINY * np.square(mean) + _TINY**2)
    table, signals = _space(weights), np.empty((len(weights), len(weights)))
    _fill_table(0.0, 0.0, TIMES_SLOTS[0], table)
    _fill_signal_covariance(table, weights, signals)
    # Scatter of samples about their mean, of a texture of unit variance.
    unit = np.trace(signals) / len(signals) - signals.mean()
    level = 2 * np.rint(np.log2(np.clip(noise * unit / texture, _CLEAN, _NOISY)) / 2).astype(np.int64)
    return samples, mean.astype(np.float32), level


def _mixed(
    weights: Floats,
    samples: Floats,
    measured: Bools,
    level: Ints,
    components: list[Component],
    shares: Doubles,
    spread: bool,
) -> Posterior:
    """Mean over the components by their shares, (k, n)."""
    pixels, slots = weights.shape
    videos = np.zeros((len(samples), pixels * slots), np.float32)
    residuals = np.zeros(samples.shape, np.float32)
    squares = np.zeros_like(videos) if spread else None
    table, light = _space(weights), np.empty((pixels, pixels * slots), np.float32)
    signals = np.empty((pixels, pixels))
    for k in np.flatnonzero(shares.any(axis=1)):
        _fill_table(*components[k], table)
        _fill_light_covariance(table, weights, light)
        _fill_signal_covariance(table, weights, signals)
        for each in np.unique(level[shares[k] > 0]):
            some = np.flatnonzero((level == each) & (shares[k] > 0))
            solved = _solved(signals + _MEAN, 2.0**each, samples[some], measured[some], whole=True)
            share = shares[k, some, None].astype(np.float32)
            free = _MEAN * solved.pulls.sum(axis=1, dtype=np.float64)
            video = solved.pulls @ light + free[:, None].astype(np.float32)
            videos[some] += share * video
            residuals[some] += share * solved.pulls / solved.diagonal
            if squares is not None:
                reached = solved.root @ (light + np.float32(_MEAN))
                unit = (_MEAN - np.einsum("pe,pe->e", reached, reached)).clip(0)
                freedom = np.maximum(measured[some].sum(axis=1) - 3, 1)
                scale = (solved.squares / freedom).astype(np.float32)[:, None]
                squares[some] += share * (np.square(video) + scale * unit)
    if squares is not None:
        squares = (squares - np.square(videos)).clip(0)
    return Posterior(videos, residuals, squares)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Samples solved for a covariance: n windows of p pixels.

    ``pulls`` (n, p) is the inverse covariance times the samples, ``diagonal`` (n, p) that of the inverse;
    ``squares`` and ``log_root`` (n,) are what the log density is of. ``root`` (p, p) is the inverse of the
    covariance's lower root.
    """

    root: Floats
    pulls: Floats
    diagonal: Floats
    squares: Doubles
    log_root: Doubles


def _solved(covariance: Doubles, noise: float, samples: Floats, measured: Bools, *, whole: bool) -> _Solved:
    """Solve for samples under a covariance and noise; pixels without a sample are taken out exactly."""
    root, log_root = np.empty(covariance.shape, np.float32), np.full(len(samples), np.nan)
    log_root[:] = _invert_root(covariance, noise, root)
    half = samples @ root.T
    squares = np.square(half, dtype=np.float64).sum(axis=1)
    holes = not measured.all()
    pulls = half @ root if whole or holes else half
    diagonal = np.empty_like(pulls)
    diagonal[:] = np.square(root).sum(axis=0)
    if holes:
        wide = root.astype(np.float64)
        _leave_out(wide.T @ wide, measured, pulls, diagonal, squares, log_root, whole)
    return _Solved(root, pulls, diagonal, squares.clip(0), log_root)


def _space(weights: Floats) -> Floats:
    """Room for the covariances of a window: (2 v - 1, 2 u - 1, 2 slot - 1)."""
    side = 2 * math.isqrt(len(weights)) - 1
    return np.empty((side, side, 2 * weights.shape[1] - 1), np.float32)


@compiled(fastmath=True)
def _fill_table(v: float, u: float, time: float, table: Floats) -> None:
    """Covariance of light minus 1 by distance along v, u and time; all lie in [-1, 0] and round finely."""
    side, slots = table.shape[0] // 2, table.shape[2] // 2
    for a in range(table.shape[0]):
        for b in range(table.shape[1]):
            for c in range(table.shape[2]):
                dt = c - slots
                far = math.sqrt((a - side - v * dt) ** 2 + (b - side - u * dt) ** 2)
                table[a, b, c] = math.exp(-far / _LENGTH_PX - abs(dt) / time) - 1


@compiled(fastmath={"reassoc", "contract"})
def _fill_light_covariance(table: Floats, weights: Floats, found: Floats) -> None:
    """Covariance of each pixel's sample with the light of all: (p, p * slot)."""
    pixels, slots = weights.shape
    side = (table.shape[0] + 1) // 2
    for j in range(pixels):
        for i in range(pixels):
            row = table[i // side - j // side + side - 1, i % side - j % side + side - 1]
            sums = found[j, i * slots : (i + 1) * slots]
            sums[:] = 0
            for s in range(slots):
                w = weights[j, s]
                if w != 0:
                    for t in range(slots):
                        sums[t] += w * row[t - s + slots - 1]


@compiled(fastmath={"reassoc", "contract"})
def _fill_signal_covariance(table: Floats, weights: Floats, found: Doubles) -> None:
    """Covariance of the samples: (p, p)."""
    pixels, slots = weights.shape
    side = (table.shape[0] + 1) // 2
    count, opened = np.zeros(pixels, np.int64), np.empty((pixels, slots), np.int64)
    for j in range(pixels):
        for t in range(slots):
            if weights[j, t] != 0:
                opened[j, count[j]] = t
                count[j] += 1
    for j in range(pixels):
        for i in range(j + 1):
            row = table[i // side - j // side + side - 1, i % side - j % side + side - 1]
            total = np.float32(0)
            for a in range(count[j]):
                s = opened[j, a]
                part = np.float32(0)
                for b in range(count[i]):
                    part += weights[i, opened[i, b]] * row[opened[i, b] - s + slots - 1]
                total += weights[j, s] * part
            found[i, j] = found[j, i] = total


@compiled(fastmath={"reassoc", "contract"})
def _invert_root(covariance: Doubles, noise: float, found: Floats) -> float:
    """Inverse of the lower root of a covariance plus noise, (p, p); returns the root's log determinant."""
    n = len(covariance)
    root = np.linalg.cholesky(covariance + noise * np.eye(n))
    inverse = np.zeros((n, n))
    log_root = 0.0
    for i in range(n):
        for k in range(i):
            for j in range(k + 1):
                inverse[i, j] -= root[i, k] * inverse[k, j]
        inverse[i, i] = 1
        inverse[i, : i + 1] /= root[i, i]
        log_root += math.log(root[i, i])
    found[:] = inverse
    return log_root


@compiled(fastmath={"reassoc", "contract"})
def _leave_out(
    inverse: Doubles,
    measured: Bools,
    pulls: Floats,
    diagonal: Floats,
    squares: Doubles,
    log_root: Doubles,
    whole: bool,
) -> None:
    """Change what was solved with zeros for missing samples to what it is without them."""
    n, pixels = measured.shape
    for w in range(n):
        out = np.flatnonzero(~measured[w])
        r = len(out)
        if r == 0:
            continue
        # Rows: root of the inverse's part of the missing ones, then their pull and, at the end, all columns.
        block = np.empty((r, r))
        for a in range(r):
            for b in range(r):
                block[a, b] = inverse[out[a], out[b]]
        root = np.linalg.cholesky(block)
        pull = np.empty(r)
        for a in range(r):
            x = np.float64(pulls[w, out[a]])
            for b in range(a):
                x -= root[a, b] * pull[b]
            pull[a] = x / root[a, a]
            squares[w] -= pull[a] ** 2
            log_root[w] += math.log(root[a, a])
        if not whole:
            continue
        columns = np.empty((r, pixels))
        for a in range(r):
            for i in range(pixels):
                columns[a, i] = inverse[out[a], i]
            for b in range(a):
                for i in range(pixels):
                    columns[a, i] -= root[a, b] * columns[b, i]
            for i in range(pixels):
                columns[a, i] /= root[a, a]
                pulls[w, i] -= columns[a, i] * pull[a]
                diagonal[w, i] -= columns[a, i] ** 2
        for a in range(r):
            pulls[w, out[a]] = 0
            diagonal[w, out[a]] = 1
