"""Posterior variance of each element of a patch under a Gaussian mixture.

A code measures m directions of each component's variance; the noise leaves the share
``noise / (power + noise)`` of each. The variance is then a sum of positive terms. The textbook form, prior
minus gain (S. M. Kay, *Fundamentals of Statistical Signal Processing: Estimation Theory*, 1993, theorem
11.1), cancels where the noise is small and may come out negative. The law of total variance adds the
distances between the means of the components.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Floats, Ints
from optsim.decoding.mixture.posterior import MeasuredMixture, Posterior
from optsim.priors.mixture import Mixture

# Patches whose elements are held at once: 1024 of 8 x 8 x 36 are 9 MB.
_TOGETHER = 1024
# A direction whose power is a smaller share of the strongest one's is lost in the rounding of the
# eigenvalues (float64, some 1e-15): it counts as not measured.
_DROWNED = 1e-12


@dataclass(frozen=True, eq=False)
class Spread:
    """A mixture's elements before a measurement; k components, rank r, e elements of a patch.

    Parameters
    ----------
    basis : ndarray of shape (r, e), float32
        The mixture's basis.
    means : ndarray of shape (k, e), float32
        Mean of each component, without the mixture's base.
    variances : ndarray of shape (k, e), float32
        Variance of each component within the basis.
    outside : ndarray of shape (k, e), float32
        Variance outside the basis. No code reduces it here.
    """

    basis: Floats
    means: Floats
    variances: Floats
    outside: Floats

    @classmethod
    def of(cls, mixture: Mixture) -> Spread:
        """Compute the elements of a mixture, once for all patches."""
        basis = mixture.basis.reshape(len(mixture.basis), -1)
        roots = np.linalg.cholesky(mixture.covariances).astype(np.float32)
        spread = (root.T @ basis for root in roots)
        variances = [np.einsum("re,re->e", part, part) for part in spread]
        # The rest is orthogonal to the basis: an element has one minus its share within it.
        outside = np.outer(mixture.rest, (1 - np.square(basis).sum(axis=0)).clip(0))
        return cls(
            basis, mixture.means.astype(np.float32) @ basis, np.stack(variances), outside.astype(np.float32)
        )

    def variance(self, known: Posterior) -> Floats:
        """Posterior variance of each element: array of shape (p, e), float32, nowhere negative."""
        measured: dict[int, tuple[Floats, Floats, Floats]] = {}
        total = np.empty((len(known.chance), self.basis.shape[1]), np.float32)
        for start in range(0, len(total), _TOGETHER):
            block = slice(start, start + _TOGETHER)
            self._fill(known, block, total[block], measured)
        return total

    def _fill(
        self,
        known: Posterior,
        block: slice,
        total: Floats,
        measured: dict[int, tuple[Floats, Floats, Floats]],
    ) -> None:
        measured_prior, chance, noise = known.measured_prior, known.chance[block], known.noise[block]
        mean, weight = np.zeros_like(total), np.zeros(len(total))
        total[:] = 0
        for k, rotated in enumerate(known.rotated):
            some = np.flatnonzero(chance[:, k])
            if not some.size:
                continue
            if k not in measured:
                measured[k] = self._measured(measured_prior, k)
            gains, square_gains, unmeasured = measured[k]
            own = noise[some, k, None]
            spread = measured_prior.powers[k] + own
            within = (own / spread) @ square_gains
            share = chance[some, k]
            if share.min() == 1:
                here, step = within[:0], share
            else:
                here = (rotated[block][some] * np.sqrt(measured_prior.powers[k]) / spread) @ gains
                weight[some] += share
                step = share / weight[some]
            _blend(
                some,
                share.astype(np.float32),
                step.astype(np.float32),
                within,
                unmeasured,
                here,
                self.means[k],
                mean,
                total,
            )

    def _measured(self, measured_prior: MeasuredMixture, k: int) -> tuple[Floats, Floats, Floats]:
        """Effect of each direction's standard deviation on the elements, its square, and the rest."""
        powers = measured_prior.powers[k].astype(np.float64)
        measurable = powers > _DROWNED * powers.max()
        scale = np.where(measurable, 1 / np.sqrt(np.where(measurable, powers, 1)), 0)
        gains = (measured_prior.backs[k] * scale[:, None]).astype(np.float32) @ self.basis
        squares = np.empty_like(gains)
        unmeasured = self.variances[k].copy()
        _square(gains, squares, unmeasured)
        return gains, squares, unmeasured.clip(0) + self.outside[k]


@compiled()
def _square(rows: Floats, squares: Floats, left: Floats) -> None:
    for j in range(rows.shape[0]):
        for e in range(rows.shape[1]):
            square = rows[j, e] * rows[j, e]
            squares[j, e] = square
            left[e] -= square


@compiled()
def _blend(
    some: Ints,
    share: Floats,
    step: Floats,
    within: Floats,
    unmeasured: Floats,
    here: Floats,
    prior: Floats,
    mean: Floats,
    total: Floats,
) -> None:
    """Add a component to the patches that have it: its own variance and the distance of its mean."""
    # Running mean and variance (West, Commun. ACM 22, 532 (1979), doi:10.1145/359146.359153) avoid
    # differences of large squares. Without ``here`` the patches have no other component.
    for i in range(len(some)):
        row, average = total[some[i]], mean[some[i]]
        a, b, c = share[i], step[i], share[i] * (1 - step[i])
        if len(here):
            for e in range(len(row)):
                off = here[i, e] + prior[e] - average[e]
                average[e] += b * off
                row[e] += a * (within[i, e] + unmeasured[e]) + c * off * off
        else:
            for e in range(len(row)):
                row[e] += within[i, e] + unmeasured[e]
