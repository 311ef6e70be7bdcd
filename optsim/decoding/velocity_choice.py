"""Choice of a velocity for each neighbourhood of a coded image: the one with the most natural sharp image."""

from __future__ import annotations

import math

import numpy as np

from optsim.core.quantities import Floats, Ints
from optsim.core.threads import side_by_side
from optsim.decoding.coded_blur import CodedBlur, Velocity, VelocityBlur
from optsim.decoding.coded_images import box_mean

_LEAST = 1e-6
# Mean of the roots of two gradients, of Gaussian noise of standard deviation 1.
_OF_NOISE = 2 * 2**0.25 * math.gamma(0.75) / math.sqrt(math.pi)
# The costs of the search are sampled at this many pixels a neighbourhood side.
_KEPT = 4
# Least decrease of the mean cost by one more velocity, nats a pixel, and the most velocities.
_WORTH, _MOST = 0.004, 16
# Halvings of the step around each velocity chosen.
_HALVINGS = 3
# Pixels of evidence in a neighbourhood's mean cost, and rounds until shares converge.
_EVIDENCE, _SETTLED = 10.0, 10
# Side of the square that smooths the borders between velocities, pixels.
_SOFT = 7


def velocity_grid(fastest: float, step: float) -> list[Velocity]:
    """Velocities up to the fastest, in pixels a slot; the slowest, zero, first."""
    n = int(fastest / step + 1e-9)
    velocities = [(i * step, k * step) for i in range(-n, n + 1) for k in range(-n, n + 1)]
    slow = [each for each in velocities if np.hypot(*each) <= fastest + 1e-9]
    return sorted(slow, key=lambda each: (float(np.hypot(*each)), each))


def explained(
    blur: CodedBlur, shape: tuple[int, ...], grid: tuple[float, float], around: int, rounds: int
) -> tuple[list[Velocity], Floats, Floats]:
    """Find velocities that explain a coded image, their masks and the sharp images."""
    corner = blur.margin
    inside = (slice(corner, corner + shape[0]), slice(corner, corner + shape[1]))
    velocities = likely_velocities(blur, inside, *grid, around)

    def sharp(velocity: Velocity) -> tuple[Floats, Floats]:
        along = blur.along(velocity)
        picture = blur.restored(along, rounds)
        return picture, gradient_cost(blur.equalised(picture, along), along, inside, around)

    pictures, costs = zip(
        *side_by_side(lambda velocity=velocity: sharp(velocity) for velocity in velocities), strict=True
    )
    labels = velocity_labels(np.stack(costs))
    pixels = np.bincount(labels.ravel(), minlength=len(velocities))
    most = int(pixels.argmax())
    order = [k for k in np.argsort([np.hypot(*each) for each in velocities], kind="stable") if pixels[k]]
    order.sort(key=lambda k: k != most)
    sides = [(corner, n - side - corner) for n, side in zip(blur.light.shape, shape, strict=True)]
    masks = [np.pad(box_mean(labels == k, _SOFT), sides, mode="edge") for k in order]
    return [velocities[k] for k in order], np.stack(masks), np.stack([pictures[k] for k in order])


def gradient_cost(picture: Floats, along: VelocityBlur, inside: tuple[slice, slice], around: int) -> Floats:
    """Cost of a velocity in each neighbourhood, nats a pixel: (v, u).

    Minus the log-likelihood of the coded image if the gradients of its sharp image follow one generalised
    Gaussian of any scale, with the exponent 1/2 (A. Levin, R. Fergus, F. Durand and W. T. Freeman, ACM Trans.
    Graph. 26(3), 70 (2007), doi:10.1145/1276377.1276464, take 0.8).
    """
    rows, cols = inside
    near = picture[rows.start - 1 : rows.stop, cols.start - 1 : cols.stop]
    here = near[1:, 1:]
    rough = np.sqrt(np.abs(here - near[:-1, 1:])) + np.sqrt(np.abs(here - near[1:, :-1]))
    # Light is not negative; negative light counts as a gradient of that size.
    rough += np.sqrt(np.maximum(-here, 0))
    # The determinant of the deblurring filter, without which the blurred image would be the likeliest.
    undone = 0.5 * float(np.log(along.power).mean(dtype=np.float64))
    # In pure noise no velocity can score better than the noise allows.
    least = np.float32(max(_OF_NOISE * math.sqrt(along.rough), _LEAST))
    return 2 * np.log(np.maximum(box_mean(rough, around), least)) + np.float32(undone)


def likely_velocities(
    blur: CodedBlur, inside: tuple[slice, slice], fastest: float, step: float, around: int
) -> list[Velocity]:
    """Select a few velocities, zero first, with their opposites; one of them explains each neighbourhood.

    A greedy search over the closed forms of a grid adds the velocity that lowers most the mean of the
    neighbourhoods' least costs, while it pays. Each is then refined by halving the step, where it is chosen.
    The opposite velocity has nearly the same blur, so the better sharp images must decide.
    """
    every = max(1, around // _KEPT)

    def cost(velocity: Velocity) -> Floats:
        along = blur.along(velocity)
        return gradient_cost(blur.equalised(blur.wiener(along), along), along, inside, around)[
            ::every, ::every
        ]

    def costs_of(velocities: list[Velocity]) -> list[Floats]:
        return side_by_side(lambda velocity=velocity: cost(velocity) for velocity in velocities)

    grid = velocity_grid(fastest, step)
    costs = np.stack(costs_of(grid))
    chosen, least = [0], costs[0]
    while len(chosen) < _MOST:
        means = [float(np.minimum(each, least).mean(dtype=np.float64)) for each in costs]
        best = int(np.argmin(means))
        if means[best] > least.mean(dtype=np.float64) - _WORTH:
            break
        chosen.append(best)
        least = np.minimum(least, costs[best])
    labels = costs[chosen].argmin(axis=0)
    # Beyond the border light is mirrored, and the mirror image moves the wrong way.
    inner = np.minimum(*np.ix_(*(_to_border(n) for n in labels.shape))) * every >= blur.margin / 2
    found = [grid[0]]
    for label, index in enumerate(chosen):
        here = labels == label
        here &= inner | (not (here & inner).any())
        if index == 0 or not here.any():
            continue
        best, reach = grid[index], step
        for _ in range(_HALVINGS):
            reach /= 2
            tried = [(best[0] + i * reach, best[1] + k * reach) for i, k in _AROUND]
            best = tried[int(np.argmin([each[here].mean() for each in costs_of(tried)]))]
        found += [best, (-best[0], -best[1])]
    return list(dict.fromkeys(found))


# The place itself first: it stays unless another is better.
_AROUND = sorted(((i, k) for i in (-1, 0, 1) for k in (-1, 0, 1)), key=lambda step: step != (0, 0))


def velocity_labels(costs: Floats) -> Ints:
    """Choose a velocity for each pixel: the index of its least cost, (v, u)."""
    shares = np.full(len(costs), 1 / len(costs))
    labels = np.zeros(costs.shape[1:], np.int64)
    for _ in range(_SETTLED):
        # Its share of all pixels, as in a fitted mixture: it decides where the costs give little evidence.
        prior = np.log(np.maximum(shares, 1 / labels.size)) / _EVIDENCE
        labels = (costs - prior[:, None, None]).argmin(axis=0)
        shares = np.bincount(labels.ravel(), minlength=len(costs)) / labels.size
    return labels


def _to_border(n: int) -> Ints:
    place = np.arange(n)
    return np.minimum(place, n - 1 - place)
