"""The learned Gaussian mixture of space-time patches, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Doubles, Floats, checked
from optsim.priors.prior_file import eight_bits, read_prior, write_prior


@dataclass(frozen=True, eq=False)
class Mixture:
    """Prior of space-time patches divided by their mean light: ``base + basis' z + rest``.

    z follows a mixture of Gaussians. The rest follows independent ones with the component's own small
    variance: the basis leaves out less of patches that hardly change than of those that change most.

    Parameters
    ----------
    base : ndarray of shape (v, u, slot), float32
        Mean patch.
    basis : ndarray of shape (r, v, u, slot), float32
        Orthonormal basis.
    shares : ndarray of shape (k,), float64
        Probability of each component; they sum to 1.
    means : ndarray of shape (k, r), float64
        Means of z.
    covariances : ndarray of shape (k, r, r), float64
        Covariances of z.
    rest : ndarray of shape (k,), float64
        Variance of each element outside the basis, by component.
    provenance : Mapping
        Settings, seed and training set.
    """

    base: Floats
    basis: Floats
    shares: Doubles
    means: Doubles
    covariances: Doubles
    rest: Doubles
    provenance: Mapping[str, object] = field(default_factory=dict[str, object])

    def __post_init__(self) -> None:
        axes = ("r", "v", "u", "slot")
        checked("mixture basis", self.basis, axes=axes, dtype=np.float32, unit="1", nonnegative=False)
        k, r = len(self.shares), len(self.basis)
        shapes = (self.base.shape, self.means.shape, self.covariances.shape, self.rest.shape)
        expected = (self.basis.shape[1:], (k, r), (k, r, r), (k,))
        if shapes != expected:
            raise ValueCheckError(
                f"mixture: got base, means, covariances, rest of {shapes}, expected {expected}"
            )
        positive = float(self.shares.min()) > 0 and bool((self.rest >= 0).all())
        if abs(float(self.shares.sum()) - 1) > 1e-6 or not positive:
            raise ValueCheckError(
                "mixture: expected positive shares that sum to 1 and variances of the rest >= 0"
            )

    @property
    def patch(self) -> int:
        """Side of a patch, panel pixels."""
        return self.basis.shape[1]

    @property
    def slots(self) -> int:
        """Slots of a patch."""
        return self.basis.shape[3]

    def shortened(self, slots: int) -> Mixture:
        """Return the mixture of the first slots: its marginal, on a new orthonormal basis."""
        first = self.basis[..., :slots]
        axes, turn = np.linalg.qr(first.reshape(len(first), -1).T.astype(np.float64))
        basis = axes.T.reshape(-1, *first.shape[1:]).astype(np.float32)
        covariances = turn @ self.covariances @ turn.T
        base, means = self.base[..., :slots], self.means @ turn.T
        return Mixture(base, basis, self.shares, means, covariances, self.rest, self.provenance)

    def single(self) -> Mixture:
        """One Gaussian with the mixture's mean and covariance: the best linear estimator's prior."""
        mean = self.shares @ self.means
        off = self.means - mean
        covariance = np.einsum("k,kij->ij", self.shares, self.covariances)
        covariance += np.einsum("k,ki,kj->ij", self.shares, off, off)
        rest = np.array([self.shares @ self.rest])
        return Mixture(self.base, self.basis, np.ones(1), mean[None], covariance[None], rest, self.provenance)


def save_mixture(path: Path, mixture: Mixture) -> None:
    """Write a mixture as a compressed .npz: covariances by factors in 16 bits a number, basis in 8."""
    factors = np.linalg.cholesky(mixture.covariances)
    low = np.tril_indices(factors.shape[1])
    # Rows of the factors differ by decades: each is stored relative to its largest element.
    scales = np.abs(factors).max(axis=2)
    codes, steps = eight_bits(mixture.basis)
    arrays = {
        "base": mixture.base.astype(np.float16),
        "basis": codes,
        "steps": steps,
        "shares": mixture.shares,
        "means": mixture.means.astype(np.float32),
        "scales": scales.astype(np.float32),
        "factors": (factors / scales[:, :, None])[:, low[0], low[1]].astype(np.float16),
        "rest": mixture.rest,
    }
    write_prior(path, arrays, mixture.provenance)


def load_mixture(path: Path) -> Mixture:
    """Read a file of :func:`save_mixture`.

    Raises
    ------
    StorageError
        When the file is missing or is no mixture.
    """
    names = ("base", "basis", "steps", "shares", "means", "scales", "factors", "rest")
    stored, provenance = read_prior(path, "mixture", names)
    scales = stored["scales"].astype(np.float64)
    factors = np.zeros((*scales.shape, scales.shape[1]))
    low = np.tril_indices(scales.shape[1])
    factors[:, low[0], low[1]] = stored["factors"]
    factors *= scales[:, :, None]
    return Mixture(
        stored["base"].astype(np.float32),
        stored["basis"] * stored["steps"][:, None, None, None],
        stored["shares"],
        stored["means"].astype(np.float64),
        factors @ factors.transpose(0, 2, 1),
        stored["rest"],
        provenance,
    )


@lru_cache(maxsize=2)
def shipped_mixture() -> Mixture:
    """Load the mixture shipped with the package."""
    with resources.as_file(resources.files("optsim.priors") / "mixture.npz") as path:
        return load_mixture(path)
