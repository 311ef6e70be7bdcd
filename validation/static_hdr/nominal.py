"""The same pictures through the demo's camera with all its nominal effects."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.calibration import Calibration, calibrate_from
from optsim.camera.camera import CodedCamera
from optsim.camera.laboratory import measure_bench
from optsim.camera.true_calibration import true_calibration
from optsim.coding import HdrMosaic
from optsim.core.quantities import CodedFrame, PanelState
from optsim.decoding import HdrMerge
from optsim.footage.made import still

# Share of the light of the ideal setting. There, one pixel in 200 saturates its shortest exposure; here the
# blur of the relay adds light of neighbours with up to 36 times that exposure, and many more would.
LIGHT = 0.125
_FRAMES = 4


class Seen(NamedTuple):
    """One picture on the modulator, 1 as in the ideal setting, and what was made of it.

    Parameters
    ----------
    truth : ndarray of shape (v, u)
        Means over panel pixels behind the objective: what is scored.
    fine : ndarray of shape (y, x)
        The same on the fine grid.
    found, valid : dict of ndarray of shape (v, u)
        By calibration.
    """

    truth: np.ndarray
    fine: np.ndarray
    found: dict[str, np.ndarray]
    valid: dict[str, np.ndarray]


def calibrations(lens: CodedCamera) -> dict[str, Calibration]:
    bench = calibrate_from(measure_bench(lens, np.random.default_rng(33)))
    return {"true calibration": true_calibration(lens), "bench": bench}


def centres(seen: Seen) -> np.ndarray:
    """Pick the fine sample in the middle of each panel pixel, as a CCD pixel behind a sharp relay would.

    It is off the mean that is scored by what the picture changes within a panel pixel.
    """
    step = seen.fine.shape[0] // seen.truth.shape[0]
    return seen.fine[step // 2 :: step, step // 2 :: step]


def see(lens: CodedCamera, known: dict[str, Calibration], radiance: np.ndarray) -> Seen:
    """Take four frames of a picture and merge them; 1 would fill the well on axis in a slot."""
    electrons_a_slot = {row.stage: row.value for row in lens.ledger(1.0)}["electrons a slot"]
    full_w_m2_sr = LIGHT * lens.sensor.full_well_e / electrons_a_slot
    video = still(
        (radiance * full_w_m2_sr).astype(np.float32),
        n_slots=_FRAMES * lens.slots_per_frame,
        slot_s=lens.slot_s,
        samples_per_pitch=lens.view.samples_per_pitch,
    )
    truth = lens.form_image(video)
    rng = np.random.default_rng(34)
    scheme = HdrMosaic()
    state = scheme.init(known["true calibration"], rng)
    panel: PanelState | None = None
    frames: list[CodedFrame] = []
    for f in range(_FRAMES):
        code, state = scheme.next(f, frames, state)
        frame, panel = lens.expose(truth, f, code, panel, rng)
        frames.append(frame)
    full_w_m2 = full_w_m2_sr * lens.irradiance_per_radiance
    found: dict[str, np.ndarray] = {}
    valid: dict[str, np.ndarray] = {}
    for name, calibration in known.items():
        *_, last = HdrMerge().decode(frames, calibration)
        found[name], valid[name] = last.irradiance_w_m2[0] / full_w_m2, last.valid
    fine = truth.load(0).start / truth.shading.repeat(3, axis=0).repeat(3, axis=1)
    return Seen(lens.reference(truth, _FRAMES - 1)[0] / full_w_m2, fine / full_w_m2, found, valid)
