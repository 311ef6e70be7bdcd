"""Pictures of a run: light of all methods in its last coded frame, and in the worst of the first method."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.quantities import CodedFrame, Floats, Reconstruction
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Frames
from optsim.experiment.scoring import Scorer
from optsim.metrics import PHASES, LogRmse, LuminanceBin, Place, error_by_luminance, worst_place
from optsim.report import light_code
from optsim.report.shown import Moment, ViewedFrame, captured_pictures, still_pictures, write_viewer

SHOWN_LAST = 1
"""Coded frames at the end of a run that every report shows."""
# Share of the panel's height and width of the place where a method errs most: large enough to tell what it
# is, small enough to show pixels.
_PLACE_SHARE = 0.15


@dataclass(eq=False)
class Figures:
    """Collector of frames during decoding, which writes all pictures at the end."""

    experiment: Experiment
    scorer: Scorer
    saturation_dn: float
    # The last frame and, in the latest phase, the one of the first method's largest error in stops.
    _moments: dict[int, Moment] = field(default_factory=dict[int, Moment], init=False)
    _bins: list[LuminanceBin] = field(default_factory=list[LuminanceBin], init=False)
    _places: list[Place] = field(default_factory=list[Place], init=False)

    @property
    def worst(self) -> int | None:
        """Worst coded frame of the first method among those scored so far."""
        board, name = self.scorer.board, self.experiment.methods[0].name
        metric = LogRmse().name
        errors = {
            index: value
            for series in board.frame_series([t for t in self.scorer.tallies if t.method == name])
            if (series.metric, series.region) == (metric, "all")
            for index, value in zip(series.x, series.values, strict=True)
            if value is not None
        }
        return max(
            errors, key=lambda index: (PHASES.index(board.phase(index)), errors[index], -index), default=None
        )

    def add(self, index: int, videos: dict[str, Reconstruction], frames: Frames) -> None:
        """Hold one coded frame if a report may show it; its scores must have been added."""
        last, worst = self.experiment.n_frames - 1, self.worst
        if index not in (last, worst):
            return
        self._moments = {k: moment for k, moment in self._moments.items() if k in (last, worst)}
        scale, floor = self.scorer.scale, light_code.floor_of(LogRmse().e_cd_m2)
        truth = scale.luminance_cd_m2(np.maximum(self.scorer.reference(index), 0))
        shots: dict[str, ViewedFrame] = {}
        for name, video in videos.items():
            estimate = scale.luminance_cd_m2(video.irradiance_w_m2)
            frame = frames[name][index]
            shots[name] = ViewedFrame(
                light=light_code.encode(estimate, floor),
                marks=light_code.marks_of(video.valid, frame.code.moving),
                levels=frame.code.levels,
                dn=frame.dn,
            )
            if index == last:
                self._measure(name, video, frame, estimate, truth)
        moving = self.scorer.moving(index)
        self._moments[index] = Moment(
            index=index,
            why="",
            light=light_code.encode(truth, floor),
            marks=light_code.marks_of(np.ones_like(moving), moving),
            shots=shots,
        )

    def _measure(
        self, name: str, video: Reconstruction, frame: CodedFrame, estimate: Floats, truth: Floats
    ) -> None:
        """Measure the error of a displayed frame against luminance, and find its worst place."""
        coded = slice(0, self.experiment.camera.coded_slots)
        errors = estimate[coded], truth[coded], video.valid, LogRmse()
        rows, cols = video.valid.shape
        size = max(1, round(_PLACE_SHARE * rows)), max(1, round(_PLACE_SHARE * cols))
        self._bins += error_by_luminance(name, *errors)
        place = worst_place(name, frame.index, *errors, size=size)
        self._places += [] if place is None else [place]

    def write(self, folder: Path) -> dict[str, Any]:
        """Write all pictures below the run folder; return their entries of results.json."""
        last, first = self.experiment.n_frames - 1, self.experiment.methods[0].name
        reasons = {last: "last"}
        if self.worst is not None:
            reasons[self.worst] = f"worst of {first}" if self.worst != last else f"last, and worst of {first}"
        moments = [replace(self._moments[index], why=why) for index, why in reasons.items()]
        viewer = write_viewer(
            folder,
            moments,
            e_cd_m2=LogRmse().e_cd_m2,
            white_cd_m2=self.scorer.scale.white_cd_m2,
            slot_s=self.experiment.timing.slot_s,
        )
        return {
            "viewer": viewer,
            "by_luminance": self._bins,
            "worst_places": self._places,
            "pictures": [
                *still_pictures(folder, moments[0], e_cd_m2=LogRmse().e_cd_m2),
                *captured_pictures(folder, moments[0], self.saturation_dn),
            ],
        }
