# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportMissingTypeStubs=false
# pyright: reportUnknownArgumentType=false
"""Video from one coded image by total variation, then along its own optical flow: no training, any code."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Floats
from optsim.decoding.coded_images import CodedImage
from optsim.decoding.projected_video import ProjectedVideo

_BRIGHTEST = 1.5  # of the white that light is divided by


class P2c2(ProjectedVideo):
    """Total variation, and light that stays the same along optical flow.

    After Reddy, Veeraraghavan and Chellappa, "P2C2: Programmable pixel compressive camera for high speed
    imaging", CVPR 2011, doi:10.1109/CVPR.2011.5995542. A first video gives the flow between means of some
    slots, forwards and backwards. Where both agree, a pixel shares its light with those it comes from and
    goes to, and the video is made again. Adapted: one coded image at a time, total variation in place of
    wavelets, and alternating projections as in :class:`TotalVariation` in place of their solver. Its numbers
    were chosen on ``reconstruct.photographs``.

    Parameters
    ----------
    alternations : int
        How often flow is found and the video made again.
    group_slots : int
        Slots whose mean makes a picture that flow is found between.
    consistent_px : float
        Largest distance that a pixel may end from where it began, once forth and back, panel pixels.
    share : float
        Weight of each neighbour along the flow, against the pixel's own, in every step.
    weight, time_weight, rounds, inner_rounds, crosstalk
        As in :class:`~optsim.decoding.projected_video.ProjectedVideo`.
    """

    kind: Literal["p2c2"] = "p2c2"
    weight: float = Field(default=0.3, gt=0, le=10)
    alternations: int = Field(default=2, ge=1, le=10)
    group_slots: int = Field(default=4, ge=1, le=64)
    consistent_px: float = Field(default=2.0, gt=0, le=10)
    share: float = Field(default=5.0, gt=0, le=100)

    def _video(self, image: CodedImage, start: Floats, white: np.float32) -> Floats:
        video = self._alternated(image, start, white)
        groups = start.shape[2] // self.group_slots
        if groups < 2 or min(start.shape[:2]) < 2:
            return video
        for _ in range(self.alternations):
            ahead, behind = self._flow(video, groups)
            along = partial(_shared, ahead=ahead, behind=behind, share=np.float32(self.share))
            video = self._alternated(image, video, white, along)
        return video

    def _flow(self, video: Floats, groups: int) -> tuple[Floats, Floats]:
        """Motion to the next and from the last slot, (2, v, u, slot); NaN where both ways disagree."""
        from skimage.registration import optical_flow_ilk

        edges = np.linspace(0, video.shape[2], groups + 1).astype(int)
        # Flow takes equal steps of light for equal ones: lamps are cut off, and shades opened.
        pictures = [
            np.sqrt(np.clip(video[:, :, first:end].mean(axis=2), 0, _BRIGHTEST))
            for first, end in pairwise(edges)
        ]
        middles = (edges[1:] + edges[:-1]) / 2
        ahead = np.full((2, *video.shape[:2], groups), np.nan, np.float32)
        behind = ahead.copy()
        for k, (first, second) in enumerate(pairwise(pictures)):
            forth, back = optical_flow_ilk(first, second), optical_flow_ilk(second, first)
            slots = middles[k + 1] - middles[k]
            ahead[..., k] = np.where(self._agree(forth, back), forth, np.nan) / slots
            behind[..., k + 1] = np.where(self._agree(back, forth), -back, np.nan) / slots
        ahead[..., -1], behind[..., 0] = behind[..., -1], ahead[..., 0]
        return np.repeat(ahead, np.diff(edges), axis=3), np.repeat(behind, np.diff(edges), axis=3)

    def _agree(self, forth: Floats, back: Floats) -> Bools:
        """Whether a pixel that goes forth and back ends near where it began, (v, u)."""
        from scipy import ndimage

        there = np.indices(forth.shape[1:]) + forth
        returned = [ndimage.map_coordinates(each, there, order=1, mode="nearest") for each in back]
        return np.hypot(*(forth + np.stack(returned))) <= self.consistent_px


@compiled(fastmath={"reassoc", "contract"})
def _shared(video: Floats, ahead: Floats, behind: Floats, share: np.float32) -> Floats:
    """Mean of each pixel and those it comes from and goes to."""
    rows, cols, slots = video.shape
    result = np.empty_like(video)
    for v in range(rows):
        for u in range(cols):
            for t in range(slots):
                total, count = video[v, u, t], np.float32(1)
                for step in (-1, 1):
                    flow = ahead if step > 0 else behind
                    y, x = v + step * flow[0, v, u, t], u + step * flow[1, v, u, t]
                    # A NaN fails both.
                    if 0 <= t + step < slots and 0 <= y <= rows - 1 and 0 <= x <= cols - 1:
                        top, left = min(int(y), rows - 2), min(int(x), cols - 2)
                        down, right = y - top, x - left
                        near, next_ = video[top], video[top + 1]
                        upper = near[left, t + step] * (1 - right) + near[left + 1, t + step] * right
                        lower = next_[left, t + step] * (1 - right) + next_[left + 1, t + step] * right
                        total += share * (upper * (1 - down) + lower * down)
                        count += share
                result[v, u, t] = total / count
    return result
