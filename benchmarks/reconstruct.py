# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
"""Time of the sparse decoder over the share of the picture that moves, against decoding all of it.

The frame is made, not rendered: smooth textures that drift, seen through the prototype's panel size as the
paper's equations have it, in a random code that repeats tile by tile. What is asked to be decoded is a band
of rows; shares are of the panel's pixels.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy import ndimage

from benchmarks.made_film import photograph
from optsim.calibration.calibration import Calibration
from optsim.camera.hardware import prototype
from optsim.camera.true_calibration import ideal_calibration
from optsim.coding import RandomExposure
from optsim.core.progress import Progress, silent
from optsim.core.quantities import CodedFrame, ExposureCode, Floats
from optsim.decoding import SparseCoding
from optsim.decoding.patch_grid import patch_corners
from optsim.priors.dictionary import shipped_dictionary

_ROWS, _COLS = 400, 480
_SHARES = (0.05, 0.1, 0.2, 0.5, 1.0)
_QUOTED = 0.2
_ROUNDS = 3


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Decode one coded frame with more and more of it moving.

    Parameters
    ----------
    name : str
        ``reconstruct.moving_share``.
    progress : Progress
        Told after each decoding.
    """
    camera = prototype().model_copy(update={"panel_rows": _ROWS, "panel_cols": _COLS})
    calibration = ideal_calibration(camera)
    frame = _frame(calibration, np.random.default_rng(36))
    decoder = SparseCoding()
    frames = {share: _moving(frame, share) for share in _SHARES}
    seconds = dict.fromkeys(_SHARES, np.inf)
    next(iter(decoder.decode([frames[_SHARES[0]]], calibration)))  # compiles
    for done in range(_ROUNDS):
        for share in _SHARES:
            start = time.perf_counter()
            next(iter(decoder.decode([frames[share]], calibration)))
            seconds[share] = min(seconds[share], time.perf_counter() - start)
            progress(name, done * len(_SHARES) + _SHARES.index(share) + 1, _ROUNDS * len(_SHARES))
    shares, times = np.array(_SHARES), np.array([seconds[share] for share in _SHARES])
    slope, intercept = np.polyfit(shares, times, 1)
    patch = shipped_dictionary().patch
    patches = [len(patch_corners(frames[share].code.moving, patch, decoder.stride_px)) for share in _SHARES]
    quoted, whole = seconds[_QUOTED], seconds[1.0]
    return {
        "name": name,
        "value": 1 / quoted,
        "unit": "frames/s",
        "peer": "the whole frame decoded",
        "peer_value": 1 / whole,
        "ratio": whole / quoted,
        "conditions": {
            "panel": f"{_COLS} x {_ROWS}",
            "moving_share": _QUOTED,
            "seconds_over_share": [
                {"moving_share": share, "seconds": seconds[share], "patches": n}
                for share, n in zip(_SHARES, patches, strict=True)
            ],
            "slope_s": float(slope),
            "intercept_s": float(intercept),
            "intercept_share": float(intercept / whole),
            "max_deviation_from_line": float(np.abs(times - slope * shares - intercept).max() / whole),
            "note": f"stride {decoder.stride_px}, at most {decoder.max_atoms} atoms; best of {_ROUNDS}, in "
            "turn; intercept and deviation relative to the whole frame",
        },
    }


def _frame(calibration: Calibration, rng: np.random.Generator) -> CodedFrame:
    """Make a coded frame of drifting textures, all of whose pixels are said to move."""
    scheme = RandomExposure()
    code, _ = scheme.next(0, [], scheme.init(calibration, rng))
    texture = ndimage.gaussian_filter(rng.standard_normal((_ROWS, _COLS), np.float32), 3, mode="wrap")
    light = np.exp(0.5 * texture / texture.std())
    drifting: list[Floats] = [np.roll(light, t // 2, axis=1) for t in range(calibration.slots_per_frame)]
    frame, _ = photograph(calibration, code, drifting, rng)
    return frame


def _moving(frame: CodedFrame, share: float) -> CodedFrame:
    """Say that a band of the frame moves, and nothing else."""
    moving = np.zeros((_ROWS, _COLS), np.bool_)
    first = round(_ROWS * (1 - share) / 2)
    moving[first : first + round(_ROWS * share)] = True
    return CodedFrame(frame.index, frame.dn, ExposureCode(frame.code.levels, moving))
