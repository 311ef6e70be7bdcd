# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""What probes look at.

Reflectances over a decade and a half, something that moves, and, where the experiment has a bright light in
the picture, one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.core.quantities import Block, Floats, RadianceVideo, Segment, made_radiance
from optsim.scene import BrightLight

# Declared white over the interior's bright places: about that of window_room, whose interior is lit by its
# window alone; in brighter rooms a lamp in the picture is then taken for too bright.
WHITE_OVER_INTERIOR = 40.0
_WAY_PX = 30  # fine samples that the patch moves
# Of a frame, of which it moves in the first: with 36 slots, the longest that a renderer's straight lines are.
_PARTS = (2, 3, 5, 1)


def made_scene(camera: CodedCamera, white_w_m2_sr: float, bright: BrightLight | None) -> RadianceVideo:
    """Make a scene of which a camera sees a frame.

    Parameters
    ----------
    camera : CodedCamera
        Small, as the cost is that of its frame.
    white_w_m2_sr : float
        Radiance of the brightest reflectance.
    bright : BrightLight or None
        Brightest light in the picture.
    """
    view, n_slots = camera.view, camera.slots_per_frame
    rng = np.random.default_rng(1288)
    base = white_w_m2_sr * _reflectances(rng, view.rows, view.cols)
    if bright is not None:
        side = np.sqrt(bright.share)
        height, width = max(1, round(view.rows * side)), max(1, round(view.cols * side))
        # A lamp smaller than a sample brings as much light by a less bright one.
        over = bright.over_white * bright.share * view.rows * view.cols / (height * width)
        # Its left part is in the way of what moves.
        row, col = (view.rows - height) // 3, (view.cols - width) // 4
        base[row : row + height, col : col + width] = over * WHITE_OVER_INTERIOR * float(base.mean())
    parts = next(n for n in _PARTS if n_slots % n == 0)
    n = n_slots // parts
    height, width = view.rows // 3, view.cols // 3
    # A panel of a few pixels leaves less way to go.
    reach = min(_WAY_PX, view.cols // 3)
    row, col = view.rows * 5 // 12, max(0, (view.cols - width - reach) // 2)
    width = min(width, view.cols - col - reach)
    patch = white_w_m2_sr * _reflectances(rng, height, width)

    def picture(share: float) -> Floats:
        """Patch a share of its way along."""
        left, seen = col + round(share * reach), base.copy()
        seen[row : row + height, left : left + width] = patch
        return seen

    start, stop = picture(0.0), picture(1.0)
    # It moves for a part of the frame, and stands: to move in all parts takes as many times as long.
    still = Segment(stop, stop, (), n)
    lines = Segment(start, stop, (), n)
    window = np.s_[row : row + height, col : col + width + reach]
    excess = np.stack([picture((t + 0.5) / n)[window] - lines.instant(t)[window] for t in range(n)])
    moving = replace(lines, blocks=(Block(row, col, excess),))
    segments = [moving, *[still] * (parts - 1)]
    return made_radiance(
        view,
        camera.slot_s,
        lambda index: segments[index],
        slots_per_segment=n,
        n_slots=n_slots,
        white_w_m2_sr=white_w_m2_sr,
    )


def _reflectances(rng: np.random.Generator, rows: int, cols: int) -> Floats:
    """Patches of some samples, from 0.03 to 1."""
    coarse = rng.random((-(-rows // 12), -(-cols // 12)), np.float32)
    fine = np.repeat(np.repeat(coarse, 12, 0), 12, 1)[:rows, :cols]
    # A Gaussian of one sample, cut at four of them, mirrored at the border.
    line = np.exp(-(np.arange(-4.0, 5.0) ** 2) / 2)
    for axis in (0, 1):
        wide = np.pad(fine, [(4, 4) if axis == each else (0, 0) for each in (0, 1)], "symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(wide, 9, axis)
        fine = np.asarray(windows @ (line / line.sum()), np.float32)
    return np.asarray(10 ** (fine * 1.5 - 1.5), np.float32)
