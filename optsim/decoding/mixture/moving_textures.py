"""Posterior of windows under textures that translate, one Gaussian a velocity.

The light of two pixels in two slots has the covariance ``exp(-|dx - v dt| / length - |dt| / time)``, times a
scale that is integrated out, and a free mean. Evidence and means are those of Gaussian processes (C. E.
Rasmussen and C. K. I. Williams, *Gaussian Processes for Machine Learning*, 2006, chapters 2 and 5). Windows
that share their weights share one factor of each Gaussian. A missing sample is taken out of it exactly, by
the part of the inverse that belongs to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
# From this log2 of noise over texture, variances, on windows hardly tell velocities apart: few represent all.
_ROUGH, _FEW = 0, 43
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
    given = _normalised(weights, windows, noise_gain)
    logs, solved = _evidence(weights, given, components, keep=True)
    return _mixed(weights, given, components, _shares(logs), solved, spread)


def likelihoods(weights: Floats, windows: Windows, components: list[Component], noise_gain: float) -> Doubles:
    """Share of each component in each window, (k, n), by its evidence; 0 for negligible ones."""
    given = _normalised(weights, windows, noise_gain)
    return _shares(_evidence(weights, given, components, keep=False)[0])


def _shares(logs: Doubles) -> Doubles:
    shares = np.exp(logs - logs.max(axis=0))
    shares[shares < _NEGLIGIBLE] = 0
    return shares / shares.sum(axis=0)


@dataclass(frozen=True, eq=False)
class _Normalised:
    """Samples (n, p) less their window's mean, 0 if missing; log2 of noise over texture, variances, (n,)."""

    samples: Floats
    measured: Bools
    mean: Floats
    level: Ints


@dataclass(frozen=True, eq=False)
class _Solved:
    """Some windows' samples solved for a covariance.

    ``members`` (m,) are their numbers; ``pulls`` (m, p) is the inverse covariance times the samples,
    ``diagonal`` (m, p) that of the inverse; ``squares`` and ``log_root`` (m,) are what the log density is of.
    """

    members: Ints
    pulls: Floats
    diagonal: Floats
    squares: Doubles
    log_root: Doubles


def _evidence(
    weights: Floats, given: _Normalised, components: list[Component], *, keep: bool
) -> tuple[Doubles, list[list[_Solved]]]:
    """Log evidence of each component in each window, (k, n), and the windows for which it may matter.

    If none are to be kept, no velocity is left out.
    """
    n = given.measured.sum(axis=1)
    logs = np.full((len(components), len(n)), -np.inf)
    best = np.full(len(n), -np.inf)
    solved: list[list[_Solved]] = [[] for _ in components]
    first: dict[tuple[float, float], int] = {}
    coarse = -(-len({component[:2] for component in components}) // _FEW)
    signals = np.empty((len(weights), len(weights)))
    for k, component in enumerate(components):
        # What was unlikely at one time is so at the others.
        before = first.setdefault(component[:2], k)
        likely = (before == k) | (logs[before] >= best - _UNLIKELY)
        if keep and before % coarse:
            likely &= given.level < _ROUGH
        if not likely.any():
            continue
        _fill_signal_covariance(_table(component, weights), weights, signals)
        for each in np.unique(given.level[likely]):
            root, log_root = _inverse_root(signals, int(each))
            some = np.flatnonzero(likely & (given.level == each))
            found = _solve(root, log_root, given, some, whole=False)
            logs[k, some] = -(n[some] - 1) / 2 * np.log(found.squares + _TINY**2) - found.log_root
            best[some] = np.maximum(best[some], logs[k, some])
            near = some[logs[k, some] >= best[some] + math.log(_NEGLIGIBLE)]
            if keep and len(near):
                solved[k].append(_solve(root, log_root, given, near, whole=True))
    return logs, solved


def _normalised(weights: Floats, windows: Windows, noise_gain: float) -> _Normalised:
    """Subtract each window's mean, and find its noise."""
    measured = windows.measured
    n = measured.sum(axis=1)
    mean = (windows.means * measured).sum(axis=1) / n
    samples = np.where(measured, windows.means - mean[:, None], 0).astype(np.float32)
    noise = noise_gain**2 * (windows.noise * measured).sum(axis=1) / n
    texture = np.square(samples).sum(axis=1) / n - noise
    texture = np.maximum(texture, _LEAST_TEXTURE * noise + _TINY * np.square(mean) + _TINY**2)
    v, u = np.divmod(np.arange(len(weights)), math.isqrt(len(weights)))
    slots = np.arange(weights.shape[1], dtype=np.int64)
    apart = np.exp(-np.hypot(v[:, None] - v, u[:, None] - u) / _LENGTH_PX)
    later = np.exp(-np.abs(slots[:, None] - slots) / TIMES_SLOTS[0])
    still = apart * (weights @ later @ weights.T)
    # Scatter of samples about their mean, of a still texture of unit variance.
    unit = np.trace(still) / len(still) - still.mean()
    level = 2 * np.rint(np.log2(np.clip(noise * unit / texture, _CLEAN, _NOISY)) / 2).astype(np.int64)
    return _Normalised(samples, measured, mean.astype(np.float32), level)


def _mixed(
    weights: Floats,
    given: _Normalised,
    components: list[Component],
    shares: Doubles,
    solved: list[list[_Solved]],
    spread: bool,
) -> Posterior:
    """Mean over the components by their shares, (k, n)."""
    pixels, slots = weights.shape
    videos = np.zeros((len(given.mean), pixels * slots), np.float32)
    residuals = np.zeros(given.samples.shape, np.float32)
    squares = np.zeros_like(videos) if spread else None
    light = np.empty((pixels, pixels * slots), np.float32)
    for k in np.flatnonzero(shares.any(axis=1)):
        table = _table(components[k], weights)
        _fill_light_covariance(table, weights, light)
        for found in solved[k]:
            there = shares[k, found.members] > 0
            some = found.members[there]
            if len(some) == 0:
                continue
            share = shares[k, some, None].astype(np.float32)
            pulls = share * found.pulls[there]
            free = _MEAN * pulls.sum(axis=1, dtype=np.float64)
            video = pulls @ light + free[:, None].astype(np.float32)
            videos[some] += video
            residuals[some] += pulls / found.diagonal[there]
            if squares is not None:
                signals = np.empty((pixels, pixels))
                _fill_signal_covariance(table, weights, signals)
                reached = _inverse_root(signals, int(given.level[some[0]]))[0] @ (light + np.float32(_MEAN))
                unit = (_MEAN - np.einsum("pe,pe->e", reached, reached)).clip(0)
                freedom = np.maximum(given.measured[some].sum(axis=1) - 3, 1)
                scale = (found.squares[there] / freedom).astype(np.float32)[:, None]
                squares[some] += np.square(video) / share + share * scale * unit
    if squares is not None:
        squares = (squares - np.square(videos)).clip(0)
    return Posterior(videos + given.mean[:, None], residuals, squares)


def _inverse_root(signals: Doubles, level: int) -> tuple[Floats, float]:
    """Inverse of the covariance's lower root, (p, p), and the root's log determinant."""
    root = np.empty(signals.shape, np.float32)
    return root, _invert_root(signals + _MEAN, 2.0**level, root)


def _solve(root: Floats, log_root: float, given: _Normalised, members: Ints, *, whole: bool) -> _Solved:
    """Solve for some windows' samples; pixels without a sample are taken out exactly."""
    measured = given.measured[members]
    half = given.samples[members] @ root.T
    squares = np.square(half, dtype=np.float64).sum(axis=1)
    log_roots = np.full(len(members), log_root)
    holes = not measured.all()
    pulls = half @ root if whole or holes else half
    diagonal = np.tile(np.square(root).sum(axis=0), (len(members), 1)) if whole else pulls
    if holes:
        wide = root.astype(np.float64)
        _leave_out(wide.T @ wide, measured, pulls, diagonal, squares, log_roots, whole)
    return _Solved(members, pulls, diagonal, squares.clip(0), log_roots)


def _table(component: Component, weights: Floats) -> Floats:
    """Covariance of light minus 1 by distance along v, u and time: (2 v - 1, 2 u - 1, 2 slot - 1).

    All values lie in [-1, 0] and round finely.
    """
    v, u, time = np.array(component, np.float32)
    side, slots = math.isqrt(len(weights)), weights.shape[1]
    dx, dt = np.arange(1 - side, side, dtype=np.float32)[:, None], np.arange(slots, dtype=np.float32)
    far = np.sqrt(np.square(dx - v * dt)[:, None] + np.square(dx - u * dt))
    later = np.exp(far * np.float32(-1 / _LENGTH_PX) - dt / time) - 1
    return np.concatenate([later[::-1, ::-1, :0:-1], later], axis=2)


@compiled(fastmath={"reassoc", "contract"})
def _fill_light_covariance(table: Floats, weights: Floats, found: Floats) -> None:
    """Covariance of each pixel's sample with the light of all: (p, p * slot)."""
    pixels, slots = weights.shape
    side = (table.shape[0] + 1) // 2
    for j in range(pixels):
        opened = np.flatnonzero(weights[j])
        for i in range(pixels):
            row = table[i // side - j // side + side - 1, i % side - j % side + side - 1]
            sums = found[j, i * slots : (i + 1) * slots]
            sums[:] = 0
            for s in opened:
                w, late = weights[j, s], row[slots - 1 - s : 2 * slots - 1 - s]
                for t in range(slots):
                    sums[t] += w * late[t]


@compiled(fastmath={"reassoc", "contract"})
def _fill_signal_covariance(table: Floats, weights: Floats, found: Doubles) -> None:
    """Covariance of the samples: (p, p)."""
    pixels, slots = weights.shape
    side = (table.shape[0] + 1) // 2
    count, opened = np.zeros(pixels, np.int64), np.empty((pixels, slots), np.uint64)
    shares = np.empty((pixels, slots), np.float32)
    for j in range(pixels):
        for t in range(slots):
            if weights[j, t] != 0:
                opened[j, count[j]], shares[j, count[j]] = t, weights[j, t]
                count[j] += 1
    for j in range(pixels):
        for i in range(j + 1):
            row = table[i // side - j // side + side - 1, i % side - j % side + side - 1]
            total = np.float32(0)
            for a in range(count[j]):
                late = row[slots - 1 - opened[j, a] :]
                part = np.float32(0)
                for b in range(count[i]):
                    part += shares[i, b] * late[opened[i, b]]
                total += shares[j, a] * part
            found[i, j] = found[j, i] = total


@compiled(fastmath={"reassoc", "contract"})
def _invert_root(covariance: Doubles, noise: float, found: Floats) -> float:
    """Inverse of the lower root of a covariance plus noise, (p, p); returns the root's log determinant."""
    n = len(covariance)
    root = np.linalg.cholesky(covariance + noise * np.eye(n))
    found[:] = 0
    log_root = 0.0
    for i in range(n):
        line, x = found[i], root[i].astype(np.float32)
        # Four rows at a time, since memory is slower than sums.
        whole = i // 4 * 4
        for k in range(0, whole, 4):
            a, b, c, d = found[k], found[k + 1], found[k + 2], found[k + 3]
            for j in range(k + 4):
                line[j] -= x[k] * a[j] + x[k + 1] * b[j] + x[k + 2] * c[j] + x[k + 3] * d[j]
        for k in range(whole, i):
            for j in range(k + 1):
                line[j] -= x[k] * found[k, j]
        line[i] = 1
        line[: i + 1] /= x[i]
        log_root += math.log(root[i, i])
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
