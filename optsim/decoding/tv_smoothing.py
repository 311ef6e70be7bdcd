"""Total variation lowered by a few steps of Chambolle's dual projection, row by row inside the cache.

A. Chambolle, J. Math. Imaging Vis. 20, 89 (2004), doi:10.1023/B:JMIV.0000011325.36760.1e, isotropic; from a
dual field of zero the first steps are those of scikit-image's ``denoise_tv_chambolle``.
"""

from __future__ import annotations

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Floats

_fast = compiled(fastmath={"reassoc", "contract", "nsz", "arcp"})


def smoothed(video: Floats, weight: float, steps: int, *, time_weight: float) -> Floats:
    """Lower the total variation of a video by a number of dual steps."""
    rows, cols, slots = video.shape
    # Slots side by side: neighbours in a row are then a fixed distance apart, and loops are long.
    lines = np.ascontiguousarray(video, np.float32).reshape(rows, cols * slots)
    down, right = np.zeros_like(lines), np.zeros_like(lines)
    later = np.zeros_like(lines) if time_weight else lines[:0]
    links = np.full((cols, slots), time_weight, np.float32)
    links[:, -1] = 0  # no slot comes after the last
    step = np.float32(1 / (4 + 2 * time_weight**2))
    result = np.empty_like(lines)
    _smooth(lines, down, right, later, links.ravel(), slots, steps, step, np.float32(step / weight), result)
    return result.reshape(video.shape)


@_fast
def _smooth(
    lines: Floats,
    down: Floats,
    right: Floats,
    later: Floats,
    links: Floats,
    slots: int,
    steps: int,
    step: np.float32,
    damping: np.float32,
    result: Floats,
) -> None:
    rows, n = lines.shape
    none = np.zeros(n, np.float32)
    here, below = np.empty(n, np.float32), np.empty(n, np.float32)
    timed = len(later) > 0
    for _ in range(steps):
        # A row's fields change once the row below has been made from the old ones.
        _light(lines[0], down[0], none, right[0], later[0] if timed else none, links, timed, slots, here)
        for v in range(rows):
            if v + 1 < rows:
                late = later[v + 1] if timed else none
                _light(lines[v + 1], down[v + 1], down[v], right[v + 1], late, links, timed, slots, below)
            else:
                below[:] = here
            if timed:
                _step_in_time(down[v], right[v], later[v], here, below, links, slots, step, damping)
            else:
                _step(down[v], right[v], here, below, slots, step, damping)
            here, below = below, here
    for v in range(rows):
        above, late = down[v - 1] if v else none, later[v] if timed else none
        _light(lines[v], down[v], above, right[v], late, links, timed, slots, result[v])


@_fast
def _light(
    line: Floats,
    down: Floats,
    above: Floats,
    right: Floats,
    later: Floats,
    links: Floats,
    timed: bool,
    slots: int,
    out: Floats,
) -> None:
    """Add the divergence of the dual field to a row."""
    n = len(line)
    for k in range(n):
        out[k] = line[k] + (down[k] - above[k]) + right[k]
    beside, left = out[slots:], right[: n - slots]
    for k in range(n - slots):
        beside[k] -= left[k]
    if timed:
        for k in range(n):
            out[k] += links[k] * later[k]
        after, before = out[1:], later[: n - 1]
        for k in range(n - 1):
            after[k] -= links[k] * before[k]


@_fast
def _step(
    down: Floats,
    right: Floats,
    here: Floats,
    below: Floats,
    slots: int,
    step: np.float32,
    damping: np.float32,
) -> None:
    """Move the fields of a row along its gradients, and project them onto the unit disc."""
    n = len(here)
    beside = here[slots:]
    for k in range(n - slots):
        dv, du = below[k] - here[k], beside[k] - here[k]
        shrink = np.float32(1) / (np.float32(1) + damping * np.sqrt(dv * dv + du * du))
        down[k] = (down[k] + step * dv) * shrink
        right[k] = (right[k] + step * du) * shrink
    for k in range(max(0, n - slots), n):
        dv = below[k] - here[k]
        down[k] = (down[k] + step * dv) / (np.float32(1) + damping * np.abs(dv))


@_fast
def _step_in_time(
    down: Floats,
    right: Floats,
    later: Floats,
    here: Floats,
    below: Floats,
    links: Floats,
    slots: int,
    step: np.float32,
    damping: np.float32,
) -> None:
    """Do the same with differences in time."""
    n = len(here)
    beside, after = here[slots:], here[1:]
    for k in range(n - slots):
        dv, du = below[k] - here[k], beside[k] - here[k]
        dt = (after[k] - here[k]) * links[k]
        shrink = np.float32(1) / (np.float32(1) + damping * np.sqrt(dv * dv + du * du + dt * dt))
        down[k] = (down[k] + step * dv) * shrink
        right[k] = (right[k] + step * du) * shrink
        later[k] = (later[k] + step * dt) * shrink
    for k in range(n - slots, n):
        dv = below[k] - here[k]
        dt = (here[min(k + 1, n - 1)] - here[k]) * links[k]
        shrink = np.float32(1) / (np.float32(1) + damping * np.sqrt(dv * dv + dt * dt))
        down[k] = (down[k] + step * dv) * shrink
        later[k] = (later[k] + step * dt) * shrink
