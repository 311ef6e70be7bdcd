"""What latency costs the adaptive scheme: its mask against the oracle's over speed x latency, and the loss.

A disc crosses a panel long enough for it (:class:`benchmarks.crossing.Crossing`), through the paper's
equations. The light is that of the project's rule: the 90th percentile of the ground reaches 80 % of
saturation where the panel is always open. Scored is the first frame whose mask was made from frames whose
own masks were made with all that the scheme uses, so that the loop has closed. The loss is that of the
scheme's reconstruction against full random exposure, both decoded by the mixture, where the oracle says
that it moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.crossing import Crossing
from benchmarks.made_film import exposed
from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import noise_variance
from optsim.camera.hardware import prototype
from optsim.camera.true_calibration import ideal_calibration
from optsim.coding import MotionAdaptive, RandomExposure
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, CodedFrame, ExposureCode, Floats
from optsim.decoding import GaussianMixture, Union
from optsim.metrics import MaskAgreement, mask_agreement, oracle_moving, pooled_agreement
from optsim.optics.neighbourhoods import dilated

SPEEDS_PX = (0.25, 0.5, 1.0, 2.0, 4.0)
LATENCIES = (1, 2, 3)
# Half the threshold: a sensible default, no source.
_RELEASE_SIGMA = 2.0
_SEEDS = (1, 2, 3)
_ROWS, _RADIUS_PX, _MARGIN_PX = 64, 12, 20
_PERCENTILE, _SATURATION_SHARE = 90, 0.8
_MERGED = 4


def schemes() -> dict[str, MotionAdaptive]:
    """Name the options of the adaptive scheme's mask."""
    return {
        "default": MotionAdaptive(),
        "hysteresis": MotionAdaptive(release_sigma=_RELEASE_SIGMA),
        "growth": MotionAdaptive(growth="displacement"),
        "both": MotionAdaptive(release_sigma=_RELEASE_SIGMA, growth="displacement"),
    }


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Score the mask of every option at every speed and latency.

    Parameters
    ----------
    name : str
        ``mask.speed_latency``.
    progress : Progress
        Told after each speed and latency.
    """
    chosen = schemes()
    settings = [(speed, latency) for speed in SPEEDS_PX for latency in LATENCIES]
    points: list[dict[str, Any]] = []
    slots = prototype().slots_per_frame
    for done, (speed, latency) in enumerate(settings):
        found: dict[str, list[Score]] = {option: [] for option in chosen}
        for seed in _SEEDS:
            for option, score in zip(chosen, scores(chosen, speed, latency, seed), strict=True):
                found[option].append(score)
        for option, parts in found.items():
            point = {"option": option, "speed_px": speed, "latency_frames": latency}
            points.append(point | {"lag_px": speed * latency * slots} | pooled(parts))
        progress(name, done + 1, len(settings))
    losses = {o: float(np.mean([p["loss_db"] for p in points if p["option"] == o])) for o in chosen}
    return {
        "name": name,
        "value": losses["growth"],
        "unit": "dB",
        "peer": "no growth",
        "peer_value": losses["default"],
        "ratio": 10 ** ((losses["default"] - losses["growth"]) / 10),
        "conditions": {
            "mask": points,
            "mean_loss_db": losses,
            "release_sigma": _RELEASE_SIGMA,
            "disc_px": 2 * _RADIUS_PX,
            "slots": slots,
            "seeds": len(_SEEDS),
            "note": "made disc on a ground that stands still, ideal camera with its noise; one frame a seed, "
            "pixels and squared errors pooled; the loss is against random exposure of everything where the "
            "oracle says it moves; value and peer are means over speeds and latencies, ratio is of squared "
            "errors",
        },
    }


@dataclass(frozen=True)
class Score:
    """One frame of one option.

    Parameters
    ----------
    agreement : MaskAgreement
        With the oracle.
    squared, squared_random : float
        Sums of squared errors where it moves, of the adaptive scheme and of random exposure, of white.
    """

    agreement: MaskAgreement
    squared: float
    squared_random: float


def pooled(scores: list[Score]) -> dict[str, float | None]:
    """Precision, recall, IoU and loss in dB of several frames together."""
    mask = pooled_agreement(s.agreement for s in scores)
    ratio = sum(s.squared for s in scores) / sum(s.squared_random for s in scores)
    return {
        "precision": mask.precision,
        "recall": mask.recall,
        "iou": mask.iou,
        "loss_db": 10 * math.log10(ratio),
    }


def scores(
    chosen: dict[str, MotionAdaptive], speed_px: float, latency_frames: int, seed: int
) -> Iterator[Score]:
    """Run every option on one and the same crossing, in their order."""
    # A mask uses three frames; those of frame L + 2 are the first that all have arrived for.
    first_full = latency_frames + 2
    last = first_full + latency_frames + 2
    camera = prototype()
    cols = 2 * (_MARGIN_PX + _RADIUS_PX) + math.ceil((last + 1) * camera.slots_per_frame * speed_px)
    crossing = Crossing(
        _ROWS, cols, _RADIUS_PX, speed_px, _MARGIN_PX + _RADIUS_PX, camera.slots_per_frame, seed
    )
    # A panel of this shape needs another sensor than the prototype's.
    sensor = camera.sensor.model_copy(update={"rows": 4 * _ROWS, "cols": 4 * cols})
    calibration = ideal_calibration(
        camera.model_copy(update={"panel_rows": _ROWS, "panel_cols": cols, "sensor": sensor})
    )
    light = [crossing.frame(index) for index in range(last + 1)]
    scale = _light_scale(calibration, crossing)
    film = [scale * frame for frame in light]
    sigma = np.sqrt(noise_variance(calibration, film[last].mean(axis=0)))
    oracle = oracle_moving(film[last], film[last - 1], sigma)
    random = _random(calibration, film[last], last, oracle, seed)
    video = next(GaussianMixture().decode([random], calibration))
    apart = (video.irradiance_w_m2 - film[last]) / scale
    for scheme in chosen.values():
        frames = _taken(scheme, calibration, film, latency_frames, seed)
        *_, joined = Union(moving=GaussianMixture()).decode(frames, calibration)
        where = oracle & video.valid & joined.valid
        error = (joined.irradiance_w_m2 - film[last]) / scale
        yield Score(
            mask_agreement(frames[-1].code.moving, oracle),
            float(np.square(error[:, where], dtype=np.float64).sum()),
            float(np.square(apart[:, where], dtype=np.float64).sum()),
        )


def _light_scale(calibration: Calibration, crossing: Crossing) -> float:
    """W m^-2 of a light of 1 by the light rule."""
    ground = replace(crossing, start_px=-1e6).frame(0)[0]
    all_on_dn = np.percentile(ground * calibration.responsivity_dn, _PERCENTILE) * calibration.coded_slots
    room_dn = np.median(calibration.saturation_dn - calibration.black_dn)
    return float(_SATURATION_SHARE * room_dn / all_on_dn)


def _taken(
    scheme: MotionAdaptive, calibration: Calibration, film: list[Floats], latency_frames: int, seed: int
) -> list[CodedFrame]:
    """Frames of the closed loop that the merge looks at; only of the last is a video wanted."""
    state = scheme.init(calibration, np.random.default_rng(seed))
    frames: list[CodedFrame] = []
    for index, light in enumerate(film):
        code, state = scheme.next(index, frames[: max(0, index - latency_frames + 1)], state)
        frames.append(exposed(calibration, index, code, light, np.random.default_rng([seed, index])))
    *earlier, newest = frames[-_MERGED:]
    still = np.zeros(calibration.shape, np.bool_)
    return [replace(f, code=ExposureCode(f.code.levels, still)) for f in earlier] + [newest]


def _random(calibration: Calibration, light: Floats, index: int, oracle: Bools, seed: int) -> CodedFrame:
    """Expose everything at random, but ask only for the surroundings of what moves."""
    scheme = RandomExposure()
    code, _ = scheme.next(index, [], scheme.init(calibration, np.random.default_rng(seed)))
    asked = ExposureCode(code.levels, dilated(oracle, _RADIUS_PX))
    return exposed(calibration, index, asked, light, np.random.default_rng([seed, index]))
