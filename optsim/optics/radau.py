"""Gauss-Radau rules: few nodes for the mean of a smooth function of something that is often near 0.

G. H. Golub, SIAM Review 15(2) 318 (1973). The free nodes are the roots of the polynomial that is orthogonal
to all of lower degree under values times density; for the few nodes that are used here, moments are exact
enough to find it by.
"""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Doubles


def middles(n: int) -> Doubles:
    """Return the middles of n equal parts of 0 to 1."""
    return (np.arange(n) + 0.5) / n


def radau(values: Doubles, density: Doubles, n: int) -> tuple[Doubles, Doubles]:
    """Nodes and weights for means of smooth functions of values; a further node is at 0."""
    scaled = values / values.max()
    moments = [float((density * scaled ** (k + 1)).mean()) for k in range(2 * n)]
    hankel: Doubles = np.array([moments[k : k + n] for k in range(n)])
    monic = np.append(np.linalg.solve(hankel, -np.array(moments[n:])), 1.0)
    nodes = np.sort(np.roots(monic[::-1]).real)[::-1] * values.max()
    return nodes, moment_weights(nodes, values, density)


def moment_weights(nodes: Doubles, values: Doubles, density: Doubles) -> Doubles:
    """Weights of nodes by which the first moments of values are right."""
    n, scale = len(nodes), float(nodes.max())
    moments = np.array([float((density * (values / scale) ** (k + 1)).mean()) for k in range(n)])
    powers = np.vander(nodes / scale, n + 1, increasing=True)[:, 1:].T
    return np.asarray(np.linalg.solve(powers, moments), np.float64)
