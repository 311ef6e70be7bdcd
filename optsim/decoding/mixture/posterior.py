"""Posterior of a patch measured through a code, under a Gaussian mixture.

With ``signal = A (base + basis' z + rest) + noise`` the posterior of z is again a mixture. A component's
share follows from its likelihood of the signal. Its mean is the linear estimator of least mean square error
(S. M. Kay, *Fundamentals of Statistical Signal Processing: Estimation Theory*, 1993, theorem 11.1). The
eigenvectors of each component's signal covariance are found once for all patches that share A. Each patch may
then have its own noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Floats
from optsim.priors.mixture import Mixture

# Components less likely than this beside the best one are left out of a patch.
_NEGLIGIBLE = 1e-3
# Least accepted noise variance, relative to the strongest direction's power: float32 signals have some 1e-7
# of rounding, which would else count as signal.
_LEAST_NOISE = np.float32(1e-12)
_TINY = np.float32(1e-30)
# Numbers from 1 to 1 / _LEAST_NOISE whose product float64 holds: a logarithm costs ten multiplications.
_MULTIPLIED = 16


@dataclass(frozen=True, eq=False)
class MeasuredMixture:
    """A mixture seen through a matrix of weights; k components, m measurements, rank r.

    Parameters
    ----------
    log_shares : ndarray of shape (k,), float64
        Logarithms of the shares.
    signals : ndarray of shape (k, m), float32
        Mean signal of each component.
    rotations : ndarray of shape (k, m, m), float32
        Eigenvectors of each component's signal covariance, in columns.
    powers : ndarray of shape (k, m), float32
        Eigenvalues.
    means : ndarray of shape (k, r), float32
        Mean of z.
    backs : ndarray of shape (k, m, r), float32
        Covariance of the rotated signal with z.
    rest : ndarray of shape (k,), float32
        Mean variance of a measurement from outside the basis.
    """

    log_shares: Doubles
    signals: Floats
    rotations: Floats
    powers: Floats
    means: Floats
    backs: Floats
    rest: Floats


def measured_through(mixture: Mixture, weights: Floats) -> MeasuredMixture:
    """Compute a mixture's signal statistics for weights of shape (pixel, slot)."""
    pixels, slots = weights.shape
    matrix = np.einsum("rpt,pt->pr", mixture.basis.reshape(-1, pixels, slots), weights, optimize=True)
    base = (mixture.base.reshape(pixels, slots) * weights).sum(axis=1)
    exact = matrix.astype(np.float64)
    back = exact @ mixture.covariances
    powers, rotations = np.linalg.eigh(back @ exact.T)
    return MeasuredMixture(
        np.log(mixture.shares),
        (mixture.means @ exact.T + base).astype(np.float32),
        rotations.astype(np.float32),
        powers.clip(0).astype(np.float32),
        mixture.means.astype(np.float32),
        (rotations.transpose(0, 2, 1) @ back).astype(np.float32),
        (mixture.rest * (weights.astype(np.float64) ** 2).sum(axis=1).mean()).astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of p patches seen through the same weights, component by component.

    Parameters
    ----------
    measured_prior : Seen
        The prior seen through the weights.
    chance : ndarray of shape (p, k), float64
        Shares of the components; 0 for those left out.
    rotated : list of k ndarray of shape (p, m), float32
        Signals minus the component's mean, along its eigenvectors.
    noise : ndarray of shape (p, k), float32
        Variance of a measurement: its noise, and each component's variance outside the basis.
    """

    measured_prior: MeasuredMixture
    chance: Doubles
    rotated: list[Floats]
    noise: Floats

    def some(self, rows: Bools) -> Posterior:
        """Select some of the patches."""
        return Posterior(
            self.measured_prior, self.chance[rows], [part[rows] for part in self.rotated], self.noise[rows]
        )

    def mean(self) -> Floats:
        """Mean of z: array of shape (p, r), float32."""
        measured_prior, chance = self.measured_prior, self.chance
        z = (chance.astype(np.float32)) @ measured_prior.means
        for k, part in enumerate(self.rotated):
            some = np.flatnonzero(chance[:, k])
            if some.size:
                pull = part[some] / (measured_prior.powers[k] + self.noise[some, k, None])
                z[some] += chance[some, k, None].astype(np.float32) * (pull @ measured_prior.backs[k])
        return z


def posterior(measured_prior: MeasuredMixture, signals: Floats, variance: Floats) -> Posterior:
    """Compute the posterior of measured patches."""
    least = np.maximum(_LEAST_NOISE * measured_prior.powers.max(), _TINY)
    noise = np.maximum(variance[:, None] + measured_prior.rest, least)
    rotated = [
        (signals - mean) @ rotation
        for mean, rotation in zip(measured_prior.signals, measured_prior.rotations, strict=True)
    ]
    logs = np.empty((len(signals), len(rotated)))
    for k, part in enumerate(rotated):
        _log_density(part, measured_prior.powers[k], noise[:, k], measured_prior.log_shares[k], logs[:, k])
    chance = np.exp(logs - logs.max(axis=1, keepdims=True))
    chance[chance < _NEGLIGIBLE] = 0
    chance /= chance.sum(axis=1, keepdims=True)
    return Posterior(measured_prior, chance, rotated, noise)


@compiled(fastmath={"reassoc", "contract", "arcp"})
def _log_density(rotated: Floats, powers: Floats, noise: Floats, log_share: float, found: Doubles) -> None:
    """Logarithm of a component's share times its density, up to a term that all components share."""
    n = len(powers)
    for p in range(len(rotated)):
        level = np.float64(noise[p])
        scale, logs = 1 / level, n * np.log(level)
        squares = np.float32(0)
        for j in range(n):
            squares += rotated[p, j] * rotated[p, j] / (powers[j] + noise[p])
        for first in range(0, n, _MULTIPLIED):
            product = 1.0
            for j in range(first, min(first + _MULTIPLIED, n)):
                product *= scale * (powers[j] + level)
            logs += np.log(product)
        found[p] = log_share - 0.5 * (logs + squares)
