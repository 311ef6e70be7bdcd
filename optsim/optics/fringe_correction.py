# pyright: reportMissingTypeStubs=false
"""Correction of fringing fields at the edges of panel pixels, beyond the mixing of weights.

Without it the adaptive scheme scores up to 1.8 dB too well in ``night_street``; in ``window_room`` and
``half_moving`` scores move by less than 0.1 dB (``reports/fidelity.md``).

Fringing fields blur retardance, and intensity is a bent function of it: ``sin^2(Gamma / 2)``. Mixing the
neighbours' weights (:mod:`optsim.optics.fringing`) is right for a straight border between black and white
that stands still; on grey levels, in corners and between two levels edges differ. Here the difference
is found by quadrature: at nodes in each pixel and in each instant the retardances of a pixel and its eight
neighbours, which relax as in :mod:`optsim.optics.relaxation`, are blurred, and

    weight of a cell = mix of weights
                       + mean over nodes of (sin^2(blurred Gamma / 2) - mix of sin^2(Gamma / 2))

The mix is that of a settled straight border between black and white. There the bracket is zero, whichever
nodes are used. Intensity is a smooth function of the neighbour's share in the retardance along a pixel, and
of what is left of a step in time. So the nodes are those of Gauss-Radau rules in these two (G. H. Golub, SIAM
Review 15(2) 318, 1973). Fixed nodes lie where the neighbour has no share and where an instant ends.
``validation/fringing`` measures what is left. Neighbouring rows are assumed to switch at the same instant;
the error is the scan time of one row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from scipy.special import ndtr

from optsim.core.compiled import FEW
from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Ints, PanelState
from optsim.core.threads import in_bands
from optsim.optics.fringe_loops import Light, Nodes, Quadrature, Switching, Times, fill_cells
from optsim.optics.fringing import border_shares, fine_image
from optsim.optics.panel import PanelResponse, drive_targets, early_rows, row_switching
from optsim.optics.radau import middles, moment_weights, radau
from optsim.optics.relaxation import SETTLED_RAD, paces

FringeModel = Literal["fine", "coarse", "mixed"]
# Free nodes on each side of a pixel, and in an instant. Where fringing reaches 0.12 pixels far the error is
# below 0.1 % and 5 % of what mixing leaves out; at 0.25 pixels, or with time constants that differ 500-fold,
# fine is right to 1 %.
_NODES: dict[str, tuple[int, int]] = {"fine": (2, 4), "coarse": (1, 3)}
_SAMPLES = 4000  # of a pixel and of an instant, to find the nodes
_BAND = 8  # rows of the panel at a time: what lies on their cells in all instants stays in the cache
_AT_ONCE = 1e-4  # of an instant


@dataclass(frozen=True, eq=False)
class FringeCorrection:
    """Inputs of the fringe-field correction during an exposure.

    Parameters
    ----------
    levels : ndarray of shape (slot, v, u), uint8
        Drive levels that rows switch to while the shutter is open.
    start : PanelState
        The panel when the first slot begins. Both as :func:`optsim.optics.panel.switched` has them.
    response : PanelResponse
        How it answers.
    slot_s : float
        Duration of a slot, s.
    instants_per_slot : int
        Instants to a slot.
    leaks : ndarray of shape (u,), float64
        Weight of a dark pixel in each column.
    sigma_px : float
        Standard deviation of the blur of the retardance, panel pixels.
    pitch : int
        Fine cells to a pixel.
    model : {"fine", "coarse"}
        How finely it is found.
    """

    levels: Bytes
    start: PanelState
    response: PanelResponse
    slot_s: float
    instants_per_slot: int
    leaks: Doubles
    sigma_px: float
    pitch: int
    model: Literal["fine", "coarse"]

    @property
    def instant_s(self) -> float:
        """Duration of an instant, s."""
        return self.slot_s / self.instants_per_slot

    @property
    def taus(self) -> Doubles:
        """Time constants towards larger and smaller retardance, s."""
        return np.array([self.response.tau_on_s, self.response.tau_off_s])

    @cached_property
    def targets(self) -> Floats:
        """Retardance that each level asks for, from the slot before the first to that after the last, rad."""
        return drive_targets(self.response, self.start.slots_displayed, len(self.levels)).astype(np.float32)

    @property
    def quadrature(self) -> Quadrature:
        """Quadrature nodes in a pixel and in an instant, and what the panel makes of light."""
        span = (1 - self.leaks) / self.response.white
        return Quadrature(
            border_shares(self.sigma_px, self.pitch).astype(np.float32),
            _pixel_nodes(self.sigma_px, self.pitch, _NODES[self.model][0]),
            _times(float(self.taus.max()) / self.instant_s, _NODES[self.model][1]),
            Light(np.minimum(self.leaks, 1).astype(np.float32), span.astype(np.float32)),
        )


@lru_cache(maxsize=8)
def _pixel_nodes(sigma_px: float, pitch: int, n: int) -> Nodes:
    """Nodes along a pixel, n on each side."""
    cells: Doubles = ndtr(-middles(pitch * _SAMPLES) / sigma_px).reshape(pitch, -1)
    nodes, _ = radau(cells.ravel(), np.ones(cells.size), n)
    before = np.stack([moment_weights(nodes, cell, np.ones(_SAMPLES)) for cell in cells])
    after = before[::-1, ::-1]
    own = 1 - before.sum(axis=1) - after.sum(axis=1)
    means = np.column_stack([before, own, after])
    # Nodes of the far border: less than single precision shows.
    means[np.abs(means) < 1e-7] = 0
    nothing = np.zeros(n)
    left, right = np.concatenate([nodes, [0], nothing]), np.concatenate([nothing, [0], nodes[::-1]])
    first, last = (np.sin(np.pi / 2 * share) ** 2 for share in (left, right))
    borders = means @ np.stack([first, 1 - first - last, last], axis=1)
    shares = np.stack([left, 1 - left - right, right], axis=1)
    return Nodes(*(each.astype(np.float32) for each in (shares, means, borders)))


@lru_cache(maxsize=8)
def _times(tau: float, n: int) -> Times:
    """Find n times in an instant, and its end, for the larger constant in instants."""
    # Nothing is on its way where the panel answers at once.
    if tau < _AT_ONCE:
        return Times(np.ones(1), np.ones(1))
    # Denser early on, so that short constants are seen.
    x: Doubles = middles(_SAMPLES)
    end = np.exp(-1 / tau)
    nodes, weights = radau(np.exp(-np.power(x, 3) / tau) - end, 3 * x * x, n)
    times = -tau * np.log(nodes + end)
    return Times(np.append(times, 1.0), np.append(weights, 1 - weights.sum()))


def fine_weights(
    fringe: FringeCorrection,
    weights: Floats,
    keys: Floats,
    moving: Bools,
    add: Callable[[Floats, Floats, int], None],
    panel: PanelState,
    first: int,
) -> PanelState:
    """Find the weights of fine cells, band by band of the panel's rows."""
    n_slots = len(weights) // fringe.instants_per_slot
    levels = fringe.levels[first : first + n_slots]
    after = PanelState(panel.retardance_rad.copy(), panel.levels.copy(), panel.slots_displayed + n_slots)
    _, n_rows, n_cols = weights.shape
    switch_at, early_s = row_switching(fringe.response, n_rows, fringe.instant_s, fringe.slot_s)
    n_early = early_rows(fringe.response, n_rows)
    quadrature = fringe.quadrature
    # Pixels that all do the same need no correction.
    once = quadrature._replace(times=Times(np.ones(1), np.zeros(1)))
    # Arrays of few numbers are worked through whole.
    few = weights.size < FEW
    run, height = (_fill_together, n_rows) if few else (fill_cells, _BAND)

    def band(top: int, bottom: int) -> None:
        # The last band has fewer rows. All arrays lie whole in memory: one layout, one compiled loop.
        most = height * fringe.pitch * n_cols * fringe.pitch
        rooms = [np.empty(n * most, np.float32) for n in (len(keys), len(weights))]
        end = top
        while end < bottom:
            # Rows that are early, and those that aren't, apart.
            row, ahead = end, int(end < n_early)
            end = min(row + height, bottom, n_early if ahead else bottom)
            # Beyond the panel's edge the nearest pixel counts.
            around = np.clip(np.arange(row - 1, end + 1), 0, n_rows - 1)
            displayed, gamma, driven = (
                panel.levels[around],
                panel.retardance_rad[around],
                levels.take(around, 1),
            )
            switching = Switching(switch_at[around], early_s[around], fringe.instant_s)
            for each in np.flatnonzero((around < n_early) != ahead).tolist():
                _switch_between(each, ahead, driven, displayed, switching, fringe.instants_per_slot)
            targets = fringe.targets[first + ahead : first + ahead + n_slots + 1]
            even = all(
                (each == each.flat[0]).all()
                for each in (displayed, gamma, switching.instant, switching.early_s, *driven)
            )
            size = (end - row) * fringe.pitch * n_cols * fringe.pitch
            sums, cells = (
                room[: n * size].reshape(n, -1, n_cols * fringe.pitch)
                for n, room in zip((len(keys), len(weights)), rooms, strict=True)
            )
            run(
                driven, gamma, displayed, targets, fringe.taus, switching, once if even else quadrature,
                weights.take(around, 1), keys, _runs(moving[row:end]), sums, cells,
            )  # fmt: skip
            after.retardance_rad[row:end], after.levels[row:end] = gamma[1:-1], displayed[1:-1]
            add(sums, cells, row * fringe.pitch)

    in_bands(n_rows, band)
    return after


def _switch_between(
    row: int, ahead: int, levels: Bytes, displayed: Bytes, switching: Switching, n_sub: int
) -> None:
    """Let a neighbour switch just as slots begin: off by less than the time between two rows."""
    switching.early_s[row] = 0
    # A late neighbour switches as late as early rows may, an early one as soon as late rows may.
    if ahead:
        switching.instant[row], displayed[row] = n_sub, levels[0, row]
        levels[:-1, row] = levels[1:, row].copy()
    else:
        switching.instant[row] = 0
        levels[1:, row], levels[0, row] = levels[:-1, row].copy(), displayed[row].copy()


def _runs(wanted: Bools) -> Ints:
    """Find runs of columns in which any row, (v, u), is wanted: first and after the last, (run, 2)."""
    ends = np.diff(wanted.any(axis=0), prepend=False, append=False)  # pyright: ignore
    return np.flatnonzero(ends).reshape(-1, 2)


def _spread(n: int, shares: Floats) -> Floats:
    """Values at the points of n pixels in a row from those of the pixels, as a matrix."""
    matrix, own = np.zeros((n, len(shares), n), np.float32), np.arange(n)
    # Beyond the end the nearest pixel counts.
    for ruler, share in zip((np.maximum(own - 1, 0), own, np.minimum(own + 1, n - 1)), shares.T, strict=True):
        matrix[own, :, ruler] += share
    return matrix.reshape(-1, n)


def relaxed(fringe: FringeCorrection, panel: PanelState, first: int, last: int) -> PanelState:
    """Panel after the slots of an exposure from the first to before the last, without its light."""
    delay_s = fringe.response.row_delays_s(len(panel.levels))[:, None]
    ahead = (delay_s < 0).astype(np.int64)
    delay_s = delay_s % fringe.slot_s
    gamma, displayed = panel.retardance_rad, panel.levels
    for slot in range(first, last):
        for at, level, length_s in (
            (slot, displayed, delay_s),
            (slot + 1, fringe.levels[slot], fringe.slot_s - delay_s),
        ):
            target = fringe.targets[at + ahead, level]
            step = _step_from(gamma, target)
            gamma = (target + step * np.exp(-paces(step, length_s, fringe.taus))).astype(np.float32)
        displayed = fringe.levels[slot]
    return PanelState(gamma, displayed.copy(), panel.slots_displayed + last - first)


def _step_from(gamma: Floats, target: Floats) -> Floats:
    """Distance from the target; none where pixels have settled, as in the compiled loops."""
    step_rad = gamma - target
    return np.where(np.abs(step_rad) > SETTLED_RAD, step_rad, np.float32(0))


def cell_weights(fringe: FringeCorrection, weights: Floats, slots: int | None = None) -> Floats:
    """Weights of all fine cells in the instants of an exposure, (t, y, x); of pixel weights (t, v, u).

    The total of so many slots at a time is kept, as where they are a segment of a video; by default of all.
    """
    n, rows, cols = weights.shape
    found = np.zeros((n, rows * fringe.pitch, cols * fringe.pitch), np.float32)
    everywhere, panel = np.ones((rows, cols), np.bool_), fringe.start
    for first in range(0, len(fringe.levels), slots or len(fringe.levels)):
        begin = first * fringe.instants_per_slot
        end = min(first + (slots or len(fringe.levels)), len(fringe.levels)) * fringe.instants_per_slot

        def add(_: Floats, cells: Floats, row: int, begin: int = begin, end: int = end) -> None:
            found[begin:end, row : row + cells.shape[1]] = cells

        together = np.ones((1, end - begin), np.float32)
        panel = fine_weights(fringe, weights[begin:end], together, everywhere, add, panel, first)
    return found


def _fill_together(
    levels: Bytes,
    gamma: Floats,
    displayed: Bytes,
    targets: Floats,
    taus: Doubles,
    switching: Switching,
    quadrature: Quadrature,
    weights: Floats,
    keys: Floats,
    moving: Ints,
    sums: Floats,
    cells: Floats,
) -> None:
    """As :func:`optsim.optics.fringe_loops.fill_cells`, all pixels at a time."""
    n_sub, nodes, instant_s = len(weights) // len(levels), quadrature.nodes, switching.instant_s
    n_nodes = len(nodes.shares)
    down, across = (_spread(n, nodes.shares) for n in displayed.shape)
    down = down[n_nodes:-n_nodes]
    inner = (len(displayed) - 2, n_nodes, displayed.shape[1], n_nodes)
    alone, blurred = np.zeros(weights.shape, np.float32), np.zeros((len(weights), *inner), np.float32)
    for t in range(len(weights)):
        slot, sub = divmod(t, n_sub)
        before_s = np.clip((switching.instant - sub) * instant_s + switching.early_s, 0, instant_s)[:, None]
        for at, level, length_s in (
            (slot, displayed, before_s),
            (slot + 1, levels[slot], instant_s - before_s),
        ):
            if not length_s.any():
                continue
            target = targets[at, level]
            step = _step_from(gamma, target)
            pace = paces(step, length_s, taus)
            now = gamma
            for time, weight in zip(*quadrature.times, strict=True):
                now = (target + step * np.exp(-time * pace)).astype(np.float32)
                share = (weight * length_s / instant_s).astype(np.float32)
                alone[t] += share * np.cos(now)
                cosines = np.cos(down @ now @ across.T).reshape(inner)
                blurred[t] += share[1:-1, :, None, None] * cosines
            gamma[:] = now
        if sub == n_sub - 1:
            displayed[:] = levels[slot]
    if len(moving):
        _open_together(weights, alone, blurred, quadrature, np.ones(len(weights), np.float32), cells)
    of_keys = [np.tensordot(keys, each, 1) for each in (weights, alone, blurred)]
    _open_together(of_keys[0], of_keys[1], of_keys[2], quadrature, keys.sum(axis=1), sums)
    # As in fringe_loops.tie_sums.
    for first, end in moving * len(quadrature.borders):
        tied, least = (
            np.s_[:, :, first:end],
            quadrature.light.least.repeat(len(quadrature.borders))[first:end],
        )
        dark = keys.sum() * least
        beyond = np.tensordot(keys.sum(axis=0), cells[tied], 1).astype(np.float32) - dark
        total = sums[tied].sum(axis=0) - dark
        factor = np.divide(total, beyond, out=np.ones_like(beyond), where=beyond > 0)
        cells[tied] = least + factor * (cells[tied] - least)
        sums[tied] = np.tensordot(keys, cells[tied], 1)


def _open_together(
    opened: Floats, alone: Floats, blurred: Floats, quadrature: Quadrature, instants: Floats, cells: Floats
) -> None:
    """Fill cells, (n, y, x), from integrals over so many instants, (n,), each."""
    nodes, pitch = quadrature.nodes, len(quadrature.borders)
    least, span = (each.repeat(pitch) for each in quadrature.light)
    mixed, own = (
        np.moveaxis(fine_image(np.moveaxis(each, 0, -1), borders), -1, 0)[:, pitch:-pitch]
        for each, borders in ((opened, quadrature.borders), (alone, nodes.borders))
    )
    means = np.einsum("nvaub,ia,jb->nviuj", blurred, nodes.means, nodes.means, optimize=True)
    beyond = own - means.reshape(cells.shape)
    # No edge is darker than a dark pixel: the nodes are too few to show that.
    np.maximum(mixed + span * beyond / 2, instants[:, None, None] * least, out=cells)
