"""Calibrations of an experiment: from the bench, the true or ideal operator, or a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

from numpy.random import Generator

from optsim.calibration import Bench, Calibration
from optsim.calibration.choice import CalibrationChoice
from optsim.camera.bench_calibration import bench_calibration
from optsim.camera.laboratory import measure_bench
from optsim.camera.true_calibration import ideal_calibration, stored_calibration, true_calibration
from optsim.core.random_streams import stream
from optsim.experiment.experiment import Experiment

Calibrations = Mapping[CalibrationChoice, Calibration]


def bench_noise(experiment: Experiment) -> Generator:
    """Return the stream of the bench's noise, at its start."""
    return stream(experiment.seed, "laboratory")


def calibrate(experiment: Experiment, choice: CalibrationChoice | None = None) -> Calibration:
    """Make a calibration: from the bench, the true or ideal operator, or a file."""
    return _calibrations(experiment, (choice or experiment.calibration_choice,))[0]


def calibrate_all(experiment: Experiment) -> Calibrations:
    """Make each calibration that the light rule or a method needs, once: the bench takes long."""
    return dict(
        zip(
            experiment.calibration_choices,
            _calibrations(experiment, experiment.calibration_choices),
            strict=True,
        )
    )


def _calibrations(experiment: Experiment, wanted: Sequence[CalibrationChoice]) -> list[Calibration]:
    camera = experiment.camera.with_nd(1.0)

    @cache
    def bench() -> Bench:
        return measure_bench(camera, bench_noise(experiment))

    def make(choice: CalibrationChoice) -> Calibration:
        if choice.file is not None:
            return stored_calibration(choice, camera)
        if choice.operator == "true":
            return true_calibration(camera, choice.reading_px)
        if choice.operator == "ideal":
            return ideal_calibration(camera, choice.reading_px)
        return bench_calibration(camera, experiment.seed, choice.reading_px, bench)

    return [make(choice) for choice in wanted]
