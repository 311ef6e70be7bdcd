"""Quality against time of all decoders of moving light, on one and the same made exposure.

The film is :func:`benchmarks.made_film.made_film`, which no prior was trained on, seen through the
paper's equations in a random code of single exposures. Quality is the PSNR of all slots; its peak is the
film's white. What a long exposure would show, still, is the floor that needs no time.
"""

from __future__ import annotations

import math
import os
import time
from typing import Any

import numpy as np

from benchmarks.made_film import made_film, photograph
from optsim.camera.hardware import prototype
from optsim.camera.true_calibration import ideal_calibration
from optsim.coding import RandomExposure
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats
from optsim.decoding import (
    GaussianMixture,
    Interpolation,
    Joined,
    P2c2,
    SparseCoding,
    TotalVariation,
    VelocityMixture,
)
from optsim.decoding.partial import PartialDecoder

_SIDE = 256
_ROUNDS = 2


def decoders() -> list[tuple[str, str, PartialDecoder]]:
    """Every decoder for any code, over what trades its time for quality: (line, setting, decoder)."""
    strides, atoms, rounds = (4, 2, 1), (3, 5, 10, 20), (15, 30, 60)
    sparse = [("sparse_coding", f"stride {n}", SparseCoding(stride_px=n)) for n in strides]
    few = [("sparse_coding, stride 2", f"{n} atoms", SparseCoding(stride_px=2, max_atoms=n)) for n in atoms]
    mixed = [("gaussian_mixture", f"stride {n}", GaussianMixture(stride_px=n)) for n in strides]
    single = [("single Gaussian", f"stride {n}", GaussianMixture(stride_px=n, single=True)) for n in strides]
    velocity = [("velocity_mixture", f"stride {n}", VelocityMixture(stride_px=n)) for n in (6, 4)]
    joined = [
        ("joined", f"stride {n}", Joined(decoders=(SparseCoding(stride_px=n), VelocityMixture())))
        for n in (2, 1)
    ]
    variation = [("total_variation", f"{n} rounds", TotalVariation(rounds=n)) for n in rounds]
    return [
        ("interpolation", "", Interpolation()),
        *sparse,
        *few,
        *mixed,
        *single,
        *velocity,
        *joined,
        *variation,
        *[("p2c2", f"{n} rounds", P2c2(rounds=n)) for n in (15, 40)],
    ]


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Decode one exposure by all of them.

    Parameters
    ----------
    name : str
        ``reconstruct.quality``.
    progress : Progress
        Told after each decoding.
    """
    rng = np.random.default_rng(36)
    calibration = ideal_calibration(prototype().model_copy(update={"panel_rows": _SIDE, "panel_cols": _SIDE}))
    scheme = RandomExposure()
    code, _ = scheme.next(0, [], scheme.init(calibration, rng))
    film = made_film(_SIDE, _SIDE, calibration.slots_per_frame, rng)
    frame, white = photograph(calibration, code, film, rng)
    chosen = decoders()
    points: list[dict[str, Any]] = []
    for done, (line, setting, decoder) in enumerate(chosen):
        seconds, found = np.inf, film
        for _ in range(_ROUNDS):
            start = time.perf_counter()
            found = next(decoder.decode([frame], calibration)).irradiance_w_m2
            seconds = min(seconds, time.perf_counter() - start)
        psnr = psnr_db(found / white, film)
        points.append({"decoder": line, "setting": setting, "seconds": seconds, "psnr_db": psnr})
        progress(name, done + 1, len(chosen))
    best = max(points, key=lambda point: point["psnr_db"])
    floor = points[0]["psnr_db"]
    return {
        "name": name,
        "value": best["psnr_db"],
        "unit": "dB",
        "peer": "interpolation",
        "peer_value": floor,
        "ratio": 10 ** ((best["psnr_db"] - floor) / 10),
        "conditions": {
            "quality": points,
            "best": f"{best['decoder']}, {best['setting']}",
            "long_exposure_psnr_db": psnr_db(film.mean(axis=0), film),
            "pixels": f"{_SIDE} x {_SIDE}",
            "slots": calibration.slots_per_frame,
            "threads": os.cpu_count() or 1,
            "note": f"made film, {scheme.kind} of {scheme.bump_slots} slots, ideal camera with its noise; "
            f"best time of {_ROUNDS}, counts to video; peak of the PSNR: the film's white; ratio is that of "
            "squared errors",
        },
    }


def psnr_db(found: Floats, film: Floats) -> float:
    """PSNR of light relative to white, dB."""
    return -10 * math.log10(float(np.square(found - film, dtype=np.float64).mean()))
