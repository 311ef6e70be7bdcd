"""One frame of an experiment under its plan, and under the full model."""

from __future__ import annotations

import math
from typing import TypedDict

import numpy as np

from optsim.core.progress import Progress, silent
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import capture, planned, set_light
from optsim.experiment.truth import render_truth


class SkipCheck(TypedDict):
    """Deviation of a method's first frame from the full model's, relative to its noise, and in dB of PSNR."""

    method: str
    left_out: list[str]
    tolerance: float
    error: float
    loss_db: float


def check_skips(
    experiment: Experiment, *, backend: str | None = None, progress: Progress = silent
) -> list[SkipCheck]:
    """Expose each method's first frame by the planned camera, and by the full model.

    Parameters
    ----------
    experiment : Experiment
        Its truth is rendered, or read from the cache.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Stages of the render and of the capture.

    Returns
    -------
    list of dict
        One a method: rms difference of the expected electrons over the frame's noise, where neither clips,
        and the loss by an equally large independent error in a PSNR that noise limits.
    """
    radiance = render_truth(experiment, backend=backend, progress=progress)
    modelled, skipping = planned(experiment.model_copy(update={"n_frames": 1}))
    full, _ = planned(modelled.model_copy(update={"camera": experiment.camera, "tolerance": 0.0}))
    calibrations = calibrate_all(modelled)
    camera, _ = set_light(modelled, radiance, calibrations[modelled.calibration_choice])
    exact = full.at_work().with_nd(camera.objective.nd_transmission)
    truth, exact_truth = camera.form_image(radiance), exact.form_image(radiance)
    found: list[SkipCheck] = []
    for name, frames in capture(modelled, camera, truth, calibrations, progress=progress).items():
        ours, _ = camera.expected_electrons(truth, 0, frames[0].code, None)
        whole, _ = exact.expected_electrons(exact_truth, 0, frames[0].code, None)
        usable = (ours < camera.sensor.most_e) & (whole < camera.sensor.most_e)
        noise_e = math.sqrt(float(np.mean(whole[usable])) + camera.sensor.dark_noise_e**2)
        error = float(np.sqrt(np.mean((ours - whole)[usable] ** 2))) / noise_e
        found.append(
            {
                "method": name,
                "left_out": [choice.skip for choice in skipping.choices if choice.skipped],
                "tolerance": skipping.tolerance,
                "error": error,
                "loss_db": 10 * math.log10(1 + error**2),
            }
        )
    return found
