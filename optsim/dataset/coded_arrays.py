"""Arrays of a sequence that explain its coded frames: light on the panel, target, weights, noise, operator.

Light is stored as radiance: irradiance on the modulator over ``irradiance_per_radiance`` of the light rule.
So it does not depend on the neutral density, and half floats hold its dark parts.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.calibration import Calibration
from optsim.camera.camera import CodedCamera
from optsim.camera.true_operator import true_operator
from optsim.core.files import atomic, write_exr
from optsim.core.quantities import CodedFrame, ExposureCode, Floats, IrradianceVideo, PanelState
from optsim.dataset.channels import slot_mean
from optsim.optics.fringe_correction import cell_weights
from optsim.optics.fringing import fine_image

LIGHT, TARGET, OPERATOR = "light_on_panel", "target", "operator.npz"
_RADIANCE = "W m^-2 sr^-1, irradiance on the modulator over irradiance_per_radiance"


def write_light(
    folder: Path, camera: CodedCamera, truth: IrradianceVideo, n_frames: int, *, half: bool
) -> None:
    """Write what all coded frames of a sequence see: each slot's light, and its mean a panel pixel."""
    if (folder / OPERATOR).is_file():
        return
    per_radiance = camera.irradiance_per_radiance
    for index in range(n_frames):
        target = camera.reference(truth, index) / np.float32(per_radiance)
        write_exr(
            folder / TARGET / f"{index:06d}.exr",
            {f"slot{slot:02d}": target[slot] for slot in range(len(target))},
            attributes={"unit": _RADIANCE, "axes": "slot, v, u", "frame": index, "shading": "divided out"},
            half=half,
        )
        for slot in range(index * len(target), (index + 1) * len(target)):
            write_exr(
                folder / LIGHT / f"slot{slot:06d}.exr",
                {"E": slot_mean(truth, slot) / np.float32(per_radiance)},
                attributes={"unit": _RADIANCE, "axes": "y, x", "slot": slot, "shading": "included"},
                half=half,
            )
    operator = true_operator(camera)
    held: dict[str, Any] = {each.name: getattr(operator, each.name) for each in fields(operator)}
    with atomic(folder / OPERATOR) as part, part.open("wb") as stream:
        np.savez_compressed(stream, **cast("Any", {**held, "core": operator.core.astype(np.float16)}))


def write_explained(
    folder: Path,
    method: str,
    camera: CodedCamera,
    truth: IrradianceVideo,
    calibration: Calibration,
    frames: tuple[CodedFrame, ...],
) -> None:
    """Write each frame of a method without noise, its noise, and what the panel let through in each slot."""
    sensor = camera.sensor
    before: PanelState | None = None
    known: PanelState | None = None
    for frame in frames:
        panel = before
        expected_e, before = camera.expected_electrons(truth, frame.index, frame.code, before)
        signal_e = sensor.signal_e(np.maximum(expected_e, 0), camera.exposure_s, camera.serial_number)
        expected_dn = np.clip(signal_e / sensor.step_e + sensor.zero_dn, 0, sensor.max_dn)
        noise_dn = sensor.noise_e(expected_e, camera.exposure_s) / sensor.step_e
        write_exr(
            folder / "expected" / method / f"{frame.index:06d}.exr",
            {"expected": expected_dn.astype(np.float32), "sigma": noise_dn.astype(np.float32)},
            attributes={"unit": "DN", "axes": "y, x", "frame": frame.index},
        )
        weights, known = calibration.weights(frame.code, known)
        for kind, axes, each in (
            ("weights", "slot, v, u", weights),
            ("transmission", "slot, y, x", _transmission(camera, frame.code, panel)),
        ):
            write_exr(
                folder / kind / method / f"{frame.index:06d}.exr",
                {f"slot{slot:02d}": each[slot] for slot in range(len(each))},
                attributes={"unit": "1", "axes": axes, "frame": frame.index},
                half=True,
            )


def _transmission(camera: CodedCamera, code: ExposureCode, panel: PanelState | None) -> Floats:
    """Mean transmission of each fine sample of the panel in each slot, fully on as 1: (slot, y, x)."""
    shutter, _ = camera.shutter(code, panel, 1)
    if shutter.fringe_correction is not None:
        return cell_weights(shutter.fringe_correction, shutter.weights)
    return np.stack([fine_image(each, shutter.borders).astype(np.float32) for each in shutter.weights])
