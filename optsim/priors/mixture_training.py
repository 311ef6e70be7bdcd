# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Training of the Gaussian mixture from high-frame-rate clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

from optsim.core.cache import Arrays
from optsim.core.errors import ValueCheckError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Doubles, Floats
from optsim.priors.iterations import iterate, learning_key
from optsim.priors.mixture import Mixture
from optsim.priors.training_patches import training_patches

# Weight of the pooled covariance in a component's, in patches, as a multiple of the rank.
_PRIOR_PATCHES = 0.05
_BUMP = 3
_LEAST_SHARE = 1e-3
# Principal components in which the first memberships are found.
_FIRST = 24
# Least membership with which a patch trains a component.
_NEGLIGIBLE = 1e-6
# Floor of the variance in a direction, relative to the mean one; above rounding in single precision.
_EMPTY = 1e-5


def train_mixture(
    clips: Sequence[Floats],
    *,
    rng: np.random.Generator,
    n_components: int = 20,
    rank: int = 256,
    patch: int = 8,
    slots: int = 36,
    n_patches: int = 40_000,
    iterations: int = 25,
    provenance: Mapping[str, object] | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Mixture:
    """Learn a mixture of Gaussians by expectation maximisation in a subspace of principal components.

    Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1 (1977); for coded video Yang et al., IEEE Trans. Image
    Process. 23, 4863 (2014), doi:10.1109/TIP.2014.2344294. A decoder knows a patch's mean light only through
    its code. So training patches are divided by their mean over a random bump of three slots a pixel.

    Parameters
    ----------
    clips : sequence of ndarray of shape (slot, v, u), float32
        Mean light in each slot, any scale.
    rng : numpy.random.Generator
        Generator of patches, codes and first memberships.
    n_components, rank, patch, slots : int
        Size of the mixture.
    n_patches, iterations : int
        Training patches and iterations.
    provenance : Mapping, optional
        Record of the clips for the file.
    checkpoint : Path, optional
        Folder of a cache that keeps the state after each iteration, from which the same training
        continues, as in :func:`optsim.priors.training.train_dictionary`.
    progress : Progress
        Called after each iteration.

    Raises
    ------
    ValueCheckError
        When a clip is too small, or the training set is.
    """
    signals = training_patches(clips, rng, patch, slots, n_patches)
    least = max(4 * rank, 40 * n_components)
    if len(signals) < least:
        raise ValueCheckError(
            f"training: got {len(signals)} usable patches, expected at least {least} for {n_components} "
            f"components of rank {rank}"
        )
    signals /= _brightness(signals.reshape(-1, patch * patch, slots), rng)[:, None]
    key = learning_key(signals, "mixture", n_components, rank, patch, slots, iterations)
    base = signals.mean(axis=0, dtype=np.float64).astype(np.float32)
    signals -= base
    basis = _basis(signals, rank, slots)
    z = (signals @ basis.T).astype(np.float64)
    energy = np.einsum("ne,ne->n", signals, signals)
    left = energy - (z**2).sum(axis=1)
    pooled = z.T @ z / len(z)

    def maximise(state: Arrays) -> Arrays:
        member = _memberships(z, **state)[0] if state else _nearest(z, rng, n_components)
        return _most_likely(z, member, pooled)

    fitted = iterate(maximise, {}, iterations, key=key, checkpoint=checkpoint, progress=progress)
    member, likelihood = _memberships(z, **fitted)
    # Mean variance outside the basis over each component's patches.
    unexplained = left / max(1, signals.shape[1] - rank)
    rest = (unexplained @ member / np.maximum(member.sum(axis=0), 1)).clip(0)
    record = {
        "method": "EM",
        "components": len(fitted["shares"]),
        "rank": rank,
        "patches": len(signals),
        "kept_energy": float(1 - left.sum(dtype=np.float64) / energy.sum(dtype=np.float64)),
        "mean_log_likelihood": likelihood,
        **(provenance or {}),
    }
    shape = (patch, patch, slots)
    return Mixture(base.reshape(shape), basis.reshape(rank, *shape), **fitted, rest=rest, provenance=record)


def _basis(signals: Floats, rank: int, slots: int) -> Floats:
    """Principal components of the static part, a quarter of the rank, and of the changing part: (rank, e)."""
    # The finest detail of the static part has so little energy that joint principal components would leave it
    # out. Yet a code measures it best: in every pixel.
    blocks = signals.reshape(len(signals), -1, slots)
    still = blocks.mean(axis=2)
    n_still = min(rank // 4, still.shape[1])
    changing = (blocks - still[:, :, None]).reshape(len(signals), -1)
    patterns = np.repeat(_principal(still, n_still), slots, axis=1) / np.float32(np.sqrt(slots))
    return np.concatenate([patterns, _principal(changing, rank - n_still)])


def _principal(rows: Floats, n: int) -> Floats:
    """Find the n unit vectors, (n, e), with most of the energy of rows of shape (patch, e)."""
    vectors: Doubles = np.linalg.eigh((rows.T @ rows).astype(np.float64))[1]
    return np.ascontiguousarray(vectors[:, ::-1][:, :n].T, np.float32)


def _brightness(blocks: Floats, rng: np.random.Generator) -> Floats:
    """Mean of each patch, (n, pixel, slot), over the slots of a random bump a pixel."""
    n, pixels, slots = blocks.shape
    width = min(_BUMP, slots)
    starts = rng.integers(slots - width + 1, size=(n, pixels))
    total = np.zeros(n)
    for step in range(width):
        total += np.take_along_axis(blocks, (starts + step)[:, :, None], axis=2)[:, :, 0].mean(axis=1)
    return np.maximum(total / width, 1e-3).astype(np.float32)


def _nearest(z: Doubles, rng: np.random.Generator, n_components: int) -> Doubles:
    """First memberships, (n, k): 1 for the nearest mean of k-means, otherwise 0."""
    _, nearest = kmeans2(z[:, :_FIRST], n_components, iter=20, minit="++", rng=rng)
    member = np.zeros((len(z), n_components))
    member[np.arange(len(z)), nearest] = 1
    return member


def _most_likely(z: Doubles, member: Doubles, pooled: Doubles) -> Arrays:
    """Shares, means and covariances for given memberships, (n, k)."""
    (n, rank), n_components = z.shape, member.shape[1]
    shares, means = np.zeros(n_components), np.zeros((n_components, rank))
    covariances = np.zeros((n_components, rank, rank))
    for k, weight in enumerate(member.T):
        some = np.flatnonzero(weight > _NEGLIGIBLE)
        part, count = weight[some], float(weight.sum())
        shares[k] = count / n
        means[k] = part @ z[some] / (count + 1)
        off = (z[some] - means[k]).astype(np.float32)
        inner = (off * part[:, None].astype(np.float32)).T @ off
        prior = _PRIOR_PATCHES * rank
        covariances[k] = _definite((inner + prior * pooled) / (count + prior))
    shares = np.maximum(shares, _LEAST_SHARE)
    return {"shares": shares / shares.sum(), "means": means, "covariances": covariances}


def _definite(covariance: Doubles) -> Doubles:
    """Fill directions without variance in footage of few patterns: a density would be infinite there."""
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        rank = len(covariance)
        return covariance + _EMPTY * np.trace(covariance) / rank * np.eye(rank)
    return covariance


def _memberships(z: Doubles, shares: Doubles, means: Doubles, covariances: Doubles) -> tuple[Doubles, float]:
    """Membership of each patch in each component, (n, k), and the mean log likelihood."""
    logs = log_densities(z, shares, means, covariances)
    top = logs.max(axis=1, keepdims=True)
    member = np.exp(logs - top)
    total = member.sum(axis=1, keepdims=True)
    return member / total, float((top[:, 0] + np.log(total[:, 0])).mean())


def log_densities(z: Doubles, shares: Doubles, means: Doubles, covariances: Doubles) -> Doubles:
    """Logarithm of share times density of each component: array of shape (n, k)."""
    logs = np.empty((len(z), len(shares)))
    for k, factor in enumerate(np.linalg.cholesky(covariances)):
        # A product with the inverse, in single precision, is ten times as fast as solving.
        inverse: Doubles = np.asarray(np.linalg.inv(factor))
        white = (z - means[k]).astype(np.float32) @ inverse.T.astype(np.float32)
        size = 2 * np.log(np.diag(factor)).sum() + factor.shape[0] * np.log(2 * np.pi)
        logs[:, k] = np.log(shares[k]) - 0.5 * ((white**2).sum(axis=1, dtype=np.float64) + size)
    return logs
