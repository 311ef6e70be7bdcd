"""Figures of a run: all methods in one coded frame, and one method in motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from optsim.core.quantities import Bools, CodedFrame, Floats, Reconstruction
from optsim.experiment.experiment import Experiment
from optsim.experiment.scoring import Scorer
from optsim.metrics import LogRmse
from optsim.optics.integrate import cell_means
from optsim.report.animation import animate
from optsim.report.pictures import tone_curve_for
from optsim.report.schema import Picture
from optsim.report.sheet import Moment, Shot, choose_crops, render_pictures

MOVING_FRAMES = 2
"""Coded frames of the film: the last ones."""
# Share of the panel's height and width: large enough to show the place, small enough to show pixels.
_CROP_SHARE = 0.3


@dataclass(eq=False)
class Figures:
    """Collector of frames during decoding, which writes all figures at the end.

    It shows the last coded frame, which is in the steady phase if any is.
    """

    experiment: Experiment
    scorer: Scorer
    saturation_dn: float
    _shots: dict[str, Shot] = field(default_factory=dict[str, Shot], init=False)
    _moving: list[tuple[Floats, Floats]] = field(default_factory=list[tuple[Floats, Floats]], init=False)

    def add(self, name: str, video: Reconstruction, frame: CodedFrame) -> None:
        """Store the parts of one reconstruction that the figures need."""
        scale = self.scorer.scale
        last = self.experiment.n_frames - 1
        if name == self.experiment.methods[0].name and video.index > last - MOVING_FRAMES:
            reference = self.scorer.reference(video.index)
            self._moving += [
                (
                    scale.luminance_cd_m2(video.irradiance_w_m2[slot]),
                    scale.luminance_cd_m2(np.maximum(reference[slot], 0)),
                )
                for slot in range(self.experiment.camera.coded_slots)
            ]
        if video.index == last:
            self._shots[name] = Shot(
                estimate_cd_m2=scale.luminance_cd_m2(video.irradiance_w_m2),
                valid=video.valid,
                moving=frame.code.moving,
                dn=frame.dn,
                levels=frame.code.levels,
            )

    def write(self, folder: Path) -> list[Picture]:
        """Write all figures below the run folder and describe them for results.json."""
        index = self.experiment.n_frames - 1
        slot = self.experiment.camera.coded_slots // 2
        reference = self.scorer.scale.luminance_cd_m2(np.maximum(self.scorer.reference(index), 0))
        oracle = self.scorer.moving(index)
        tone = tone_curve_for(reference[slot])
        rows, cols = oracle.shape
        crops = choose_crops(
            reference[slot],
            oracle,
            self._outside(),
            size=(max(8, round(_CROP_SHARE * rows)), max(8, round(_CROP_SHARE * cols))),
        )
        moment = Moment(
            index=index,
            slot=slot,
            reference_cd_m2=reference,
            oracle=oracle,
            saturation_dn=self.saturation_dn,
            shots=self._shots,
        )
        pictures = render_pictures(folder, moment, tone, crops, e_cd_m2=LogRmse().e_cd_m2)
        timing = self.experiment.timing
        pictures.append(
            animate(
                folder,
                self._moving,
                tone,
                method=self.experiment.methods[0].name,
                instant_s=timing.slot_s,
            )
        )
        return pictures

    def _outside(self) -> Bools | None:
        outside = self.scorer.radiance.outside
        if outside is None:
            return None
        step = self.scorer.truth.samples_per_pitch
        return cell_means(outside.astype(np.float32), step) == 1
