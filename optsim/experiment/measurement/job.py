"""A measurement decoded into a folder: OpenEXR of the light, an overview image, a film and scores."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from optsim import __version__
from optsim.core.errors import ConfigError
from optsim.core.files import write_exr, write_json
from optsim.core.folder_claims import claimed_empty
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, Reconstruction
from optsim.decoding import Decoder
from optsim.experiment.measurement.coded import Measurement
from optsim.experiment.measurement.pictures import draw_film, draw_slots


def decode_measurement(
    measurement: Measurement,
    decoder: Decoder,
    folder: Path,
    *,
    peak: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Decode every coded image into a folder.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    decoder : decoder
        Any of :mod:`optsim.decoding`.
    folder : Path
        New or empty: gets ``reconstruction/*.exr`` (float32 channels ``slot00`` and on, ``valid``,
        ``interpolated``, and ``sigma00`` and on where the decoder predicts its uncertainty), ``slots.png``,
        ``film.gif`` (logarithmic for scenes with bright lights) and ``results.json``.
    peak : float, optional
        Peak of the PSNR, in the light's unit; default the brightest of the truth.
    progress : Progress
        Called after each coded image.

    Returns
    -------
    dict
        The content of results.json; PSNR and its peak are None without a truth. The PSNR counts
        slots in which the code opens a pixel, and valid pixels.

    Raises
    ------
    StorageError
        When the folder holds files, or another process writes into it.
    ConfigError
        When the peak is invalid.
    """
    if peak is not None and not 0 < peak < float("inf"):
        raise ConfigError(f"--peak: got {peak:g}, expected more than 0, in the unit of the light")
    brightest = max((float(each.max()) for each in measurement.truth), default=0.0)
    top = (peak or brightest) if measurement.truth else None
    with claimed_empty(folder):
        return _decode(measurement, decoder, folder, top, progress)


def _decode(
    measurement: Measurement, decoder: Decoder, folder: Path, top: float | None, progress: Progress
) -> dict[str, Any]:
    decoded: list[Reconstruction] = []
    seconds = 0.0
    errors: list[float | None] = []
    start = time.perf_counter()
    for video in decoder.decode(measurement.frames, measurement.calibration):
        seconds += time.perf_counter() - start
        decoded.append(video)
        _write(folder, video, measurement.unit)
        if measurement.truth:
            seen = _opened(measurement, video.index)
            off = (video.irradiance_w_m2 - measurement.truth[video.index])[seen][:, video.valid]
            errors.append(float(np.mean(off.astype(np.float64) ** 2)) if off.size else None)
        progress("decode", len(decoded), len(measurement.frames))
        start = time.perf_counter()
    draw_slots(folder / "slots.png", measurement, decoded[0])
    draw_film(folder / "film.gif", measurement, decoded)
    record: dict[str, Any] = {
        "optsim": __version__,
        "measurement": dict(measurement.origin),
        "decoder": decoder.model_dump(mode="json"),
        "frames": len(decoded),
        "slots": measurement.calibration.slots_per_frame,
        "slots_opened": max(int(_opened(measurement, k).sum()) for k in range(len(decoded))),
        "pixels": list(measurement.calibration.shape),
        "unit": measurement.unit,
        "weights_rounded_by": measurement.rounded,
        "read_noise": _read_noise(measurement),
        "saturated_share": _saturated(measurement),
        "dead_pixels": int((~measurement.calibration.valid).sum()),
        "valid_share": float(np.mean([video.valid.mean() for video in decoded])),
        "interpolated_share": float(
            np.mean([(video.interpolated & video.valid).mean() for video in decoded])
        ),
        "decode_s": round(seconds, 3),
        "psnr_peak": top,
        "psnr_db": [_psnr_db(top, error) for error in errors] or None,
    }
    write_json(folder / "results.json", record)
    return record


def _psnr_db(peak: float | None, squared_error: float | None) -> float | None:
    if not (peak and squared_error):
        return None
    return round(float(10 * np.log10(peak**2 / squared_error)), 3)


def _opened(measurement: Measurement, index: int) -> Bools:
    """Slots in which a frame's code opens any pixel, (slot,); a decoder can only guess the others."""
    opened: Bools = np.asarray(measurement.frames[index].code.levels.any(axis=(1, 2)))
    opened[measurement.calibration.coded_slots :] = False
    return opened


def _read_noise(measurement: Measurement) -> float:
    """Noise in the dark that decoders assume, in the unit of the image: the light's times slots."""
    known = measurement.calibration
    return float(known.read_noise_dn / np.median(known.responsivity_dn))


def _saturated(measurement: Measurement) -> float:
    seen = [measurement.calibration.observe(frame) for frame in measurement.frames]
    return float(np.mean([(each.saturated & each.valid).mean() for each in seen]))


def _write(folder: Path, video: Reconstruction, unit: str) -> None:
    light = {f"slot{slot:02d}": each for slot, each in enumerate(video.irradiance_w_m2)}
    about: dict[str, str | int] = {"unit": unit, "axes": "slot, v, u", "frame": video.index}
    if video.uncertainty_w_m2 is not None:
        about["sigma"] = "standard deviation of the light; 0 where it isn't known"
        light |= {f"sigma{slot:02d}": each for slot, each in enumerate(video.uncertainty_w_m2)}
    write_exr(
        folder / "reconstruction" / f"{video.index:06d}.exr",
        {
            **light,
            "valid": video.valid.astype(np.float32),
            "interpolated": video.interpolated.astype(np.float32),
        },
        attributes=about,
    )
