"""What the points of a study share: truth, light, targets, and the panel's light of earlier exposures."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Generic, TypeVar

import numpy as np
from numpy.random import Generator

from optsim.camera.camera import CodedCamera
from optsim.core.config import build
from optsim.core.memory import available_bytes
from optsim.core.quantities import (
    Bools,
    CodedFrame,
    ExposureCode,
    Floats,
    IrradianceVideo,
    PanelState,
    Segment,
)
from optsim.experiment.calibrations import Calibrations, calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import LightLevel, planned, set_light
from optsim.experiment.resume import run_key
from optsim.experiment.scoring import Scorer
from optsim.experiment.truth import render_truth
from optsim.metrics.scoring import ScoreBoard, first_steady, phase_of

# Memory for the truth's segments, bytes, if an eighth of what is free allows it: the full panel's first eight
# frames take 1.3 GB. Read in turn, all would be lost in less. And memory for the panel's light.
_SEGMENT_BYTES, _LIGHT_BYTES = 1.5e9, 0.4e9
T = TypeVar("T")


@dataclass(eq=False)
class Memory(Generic[T]):
    """Results by their key, the least recently used forgotten first."""

    size_of: Callable[[T], float]
    most_bytes: float
    found: int = 0
    made: int = 0
    _kept: OrderedDict[Hashable, T] = field(default_factory=lambda: OrderedDict[Hashable, T]())
    _bytes: float = 0.0

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Recall a result, or make and keep it."""
        if key in self._kept:
            self.found += 1
            self._kept.move_to_end(key)
            return self._kept[key]
        self.made += 1
        result = make()
        self._kept[key] = result
        self._bytes += self.size_of(result)
        while self._bytes > self.most_bytes and len(self._kept) > 1:
            _, old = self._kept.popitem(last=False)
            self._bytes -= self.size_of(old)
        return result


@dataclass(frozen=True, eq=False)
class Target:
    """What one coded frame is scored against: (slot, v, u), W m^-2, and where it moves, (v, u)."""

    reference_w_m2: Floats
    moving: Bools


@dataclass(frozen=True, eq=False)
class Stage:
    """The unchanged camera before its scene, ready for points."""

    base: Experiment
    calibrations: Calibrations
    light: LightLevel  # All points that share the truth keep its density.
    truth: IrradianceVideo  # Light on the panel; segments are remembered.
    board: ScoreBoard  # Scoring rules.
    targets: dict[int, Target]  # Scored coded frame -> its target.
    key: str  # Hash of all that decides the numbers but the points themselves.
    # Light that left the panel, and the panel after it, of earlier exposures.
    panel_light: Memory[tuple[Floats, PanelState]]

    @property
    def scored(self) -> tuple[int, ...]:
        """Coded frames that are decoded and scored."""
        return tuple(self.targets)

    def expose(
        self,
        camera: CodedCamera,
        truth: IrradianceVideo,
        index: int,
        code: ExposureCode,
        panel: PanelState | None,
        rng: Generator,
    ) -> tuple[CodedFrame, PanelState]:
        """Take one coded frame, as :meth:`CodedCamera.expose` does, and recall the panel's light."""

        def light() -> tuple[Floats, PanelState]:
            shutter, after = camera.shutter(code, panel, truth.instants_per_slot, truth.samples_per_pitch)
            return camera.panel_energy(truth, index, shutter), after

        # The same panel with the same code before the same truth: only relay and CCD are new.
        key = _panel_side(camera), index, _digest(code.levels), None if panel is None else _state(panel)
        energy, after = self.panel_light.get(key, light)
        expected = camera.electrons_of(camera.relay_operator(truth.samples_per_pitch).apply(energy))
        sensor = camera.sensor
        dn, negative_light = sensor.digitise(expected, camera.exposure_s, camera.serial_number, rng)
        return CodedFrame(index, dn, code, negative_light), after


def frames_to_score(experiment: Experiment, wanted: int) -> tuple[int, ...]:
    """First coded frames of the steady phase, or the last of a shorter experiment, all of one phase."""
    latency = experiment.camera.latency_frames
    last = min(experiment.n_frames, first_steady(latency) + wanted) - 1
    phase = phase_of(last, latency)
    frames = range(max(0, last - wanted + 1), last + 1)
    return tuple(index for index in frames if phase_of(index, latency) == phase)


def scored_part(experiment: Experiment, wanted: int) -> Experiment:
    """Return an experiment that ends with the last coded frame that a study scores."""
    return experiment.model_copy(update={"n_frames": frames_to_score(experiment, wanted)[-1] + 1})


@lru_cache(maxsize=2)
def stage_of(text: str, frames: int) -> Stage:
    """Prepare the stage of an experiment, as JSON, for some scored frames; the last two are kept."""
    base = build(Experiment, json.loads(text), where="study")
    return make_stage(base, frames_to_score(base, frames))


def make_stage(base: Experiment, scored: tuple[int, ...]) -> Stage:
    """Render or find the truth, calibrate the unchanged camera, set its light, and make the targets."""
    modelled, _ = planned(base)
    calibrations = calibrate_all(modelled)
    modelled.check_methods(calibrations)
    radiance = render_truth(base)
    camera, light = set_light(modelled, radiance, calibrations[modelled.calibration_choice])
    truth = camera.form_image(radiance)
    segments = Memory[Segment](_segment_bytes, min(_SEGMENT_BYTES, available_bytes() / 8))
    truth = replace(truth, load=partial(_remembered, segments, truth.load))
    scorer = Scorer(modelled, camera, truth, radiance)
    targets = {index: Target(scorer.reference(index), scorer.moving(index)) for index in scored}
    # What people only read, and what is only written, changes no number.
    key = run_key(base.model_copy(update={"save_reconstructions": (), "description": "", "name": "study"}))
    memory = Memory(_light_bytes, _LIGHT_BYTES)
    return Stage(base, calibrations, light, truth, scorer.board, targets, key, memory)


def _remembered(segments: Memory[Segment], load: Callable[[int], Segment], index: int) -> Segment:
    return segments.get(index, lambda: load(index))


def _segment_bytes(segment: Segment) -> float:
    return segment.start.nbytes + segment.stop.nbytes + sum(block.excess.nbytes for block in segment.blocks)


def _light_bytes(light: tuple[Floats, PanelState]) -> float:
    energy, panel = light
    return energy.nbytes + panel.retardance_rad.nbytes + panel.levels.nbytes


def _digest(array: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).data, digest_size=16).digest()


def _state(panel: PanelState) -> tuple[bytes, bytes, int]:
    return _digest(panel.retardance_rad), _digest(panel.levels), panel.slots_displayed


def _panel_side(camera: CodedCamera) -> str:
    """All of a camera that decides the light that leaves its panel."""
    return camera.model_dump_json(exclude={"relay", "sensor"}) + f"{camera.coded_slots}"
