# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Quality of the shipped priors on moving photographs that neither of them has seen.

Eight films of :func:`benchmarks.made_film.made_film`: a photograph that drifts, before it discs that
carry another one. All come from the scikit-image wheel, none from ``scenes/training_mix``, and count as light
just as they are stored, 8 bits and encoded, as published high-speed clips do. One coded image of each, 36
slots in bumps of three, with a noise of one count of 8 bits. The shipped
dictionary's size and footage were chosen on them. Photographs that move are no recordings: nothing bends,
and nothing is lit anew.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.resources import as_file, files
from itertools import cycle
from typing import Any, cast

import numpy as np
from scipy import ndimage
from skimage import color, io, transform, util

from benchmarks.made_film import made_film
from benchmarks.quality import psnr_db
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
from optsim.experiment.measurement import Measurement, Sensor, coded_measurement

NAMES = (
    *("brick.png", "camera.png", "cell.png", "clock_motion.png"),
    *("ihc.png", "motorcycle_left.png", "page.png", "retina.jpg"),
)
_SIDE, _FULL, _NOISE = 128, 255, 1.0
# Cameras of the records: ideal; light beside its panel pixels, unknown to decoders; closed pixels that pass a
# twentieth, as decoders know.
_CAMERAS: dict[str, dict[str, float]] = {
    "reconstruct.photographs": {},
    "reconstruct.photographs_misregistered": {"shift_px": 0.15},
    "reconstruct.photographs_contrast_20": {"leak": 1 / 20},
}
# A ground twice as wide as the picture shows half of a photograph.
_DETAIL = 2 * _SIDE


def decoders() -> dict[str, PartialDecoder]:
    """Name the decoders as the record does."""
    sparse, mixture = SparseCoding(stride_px=2), GaussianMixture(stride_px=2)
    return {
        "interpolation": Interpolation(),
        "total variation": TotalVariation(),
        "p2c2": P2c2(),
        "single Gaussian": GaussianMixture(stride_px=2, single=True),
        "dictionary": sparse,
        "mixture": mixture,
        "velocity mixture": VelocityMixture(),
        "joined": Joined(decoders=(sparse, VelocityMixture())),
    }


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Decode a coded image of each film by all of them.

    Parameters
    ----------
    name : str
        ``reconstruct.photographs``, or the same ``_misregistered`` or with ``_contrast_20``.
    progress : Progress
        Told after each film.
    """
    chosen = decoders()
    found: dict[str, list[float]] = {each: [] for each in chosen}
    for number in range(len(NAMES)):
        progress(name, number, len(NAMES))
        measurement = photographed(number, **_CAMERAS[name])
        (truth,) = measurement.truth
        for each, decoder in chosen.items():
            (video,) = decoder.decode(measurement.frames, measurement.calibration)
            found[each].append(psnr_db(video.irradiance_w_m2 / np.float32(_FULL), truth / np.float32(_FULL)))
    progress(name, len(NAMES), len(NAMES))
    means = {each: float(np.mean(values)) for each, values in found.items()}
    best = max(means, key=lambda each: means[each])
    return {
        "name": name,
        "value": means[best],
        "unit": "dB",
        "peer": "interpolation",
        "peer_value": means["interpolation"],
        "ratio": 10 ** ((means[best] - means["interpolation"]) / 10),
        "conditions": {
            "best": best,
            "mean_psnr_db": means,
            "psnr_db": {each: dict(zip(NAMES, values, strict=True)) for each, values in found.items()},
            "pixels": f"{_SIDE} x {_SIDE}",
            "slots": 36,
            **_CAMERAS[name],
            "note": f"bumps of 3 slots, noise of {_NOISE:g} count of 8 bits, stride 2; mean of "
            f"{len(NAMES)} films; peak of the PSNR: 255; ratio is that of squared errors",
        },
    }


def photographed(number: int, *, shift_px: float = 0.0, leak: float = 0.0) -> Measurement:
    """One coded image, with its film: that of the photograph of a number, others on the discs."""
    rng = np.random.default_rng([8, number])
    calibration = ideal_calibration(prototype().model_copy(update={"panel_rows": _SIDE, "panel_cols": _SIDE}))
    scheme = RandomExposure(bump_slots=3)
    code, _ = scheme.next(0, [], scheme.init(calibration, rng))
    film = _FULL * filmed(number, code.levels.shape[0], rng)
    weights = np.where(code.levels > 0, 1, leak).astype(np.float32)
    # The brightest exposure just fits into 8 bits.
    total = np.einsum("tvu,tvu->vu", weights, _beside(film, shift_px))
    gain = _FULL / total.max()
    image = np.rint(gain * total + rng.normal(0, _NOISE, total.shape)).clip(0, _FULL)
    sensor = Sensor(saturation=_FULL / gain, read_noise=_NOISE / gain)
    return coded_measurement(image / gain, weights, sensor=sensor, truth=film)


def _beside(film: Floats, shift_px: float) -> Floats:
    """Film shifted to the right, by a part of a pixel."""
    moved = cast("Callable[..., Floats]", ndimage.shift)
    return moved(film, (0, 0, shift_px), order=3, mode="nearest") if shift_px else film


def filmed(number: int, slots: int, rng: np.random.Generator) -> Floats:
    """Film of a photograph that drifts, 0 .. 1: its neighbours in the list lie on the discs."""
    names = cycle(NAMES[number:] + NAMES[:number])

    def cut(side: int, rng: np.random.Generator) -> Floats:
        picture = _photograph(next(names))
        side = min(side, len(picture))
        top, left = rng.integers(0, len(picture) - side + 1, 2)
        return picture[top : top + side, left : left + side]

    return made_film(_SIDE, _SIDE, slots, rng, cut)


@cache
def _photograph(name: str) -> Floats:
    """Square middle of a photograph, grey, 0 .. 1."""
    with as_file(files("skimage.data") / name) as path:
        picture = util.img_as_float32(io.imread(path))
    grey = color.rgb2gray(picture[..., :3]) if picture.ndim == 3 else picture
    side = min(grey.shape)
    top, left = ((size - side) // 2 for size in grey.shape)
    square = grey[top : top + side, left : left + side]
    return np.asarray(transform.resize(square, (_DETAIL, _DETAIL), anti_aliasing=True), np.float32)
