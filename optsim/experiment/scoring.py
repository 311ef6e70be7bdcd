"""Comparison of truth and estimate for a run: references, oracle masks, tallies, facts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optsim import metrics
from optsim.camera.camera import CodedCamera
from optsim.camera.true_calibration import true_calibration
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, Doubles, Floats, IrradianceVideo, RadianceVideo, Reconstruction
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Frames, Result
from optsim.experiment.resume import FrameScores
from optsim.metrics.pairs import PixelErrors
from optsim.metrics.records import MaskScore, PairRecord, Score
from optsim.optics.integrate import cell_means, slot_means
from optsim.optics.readings import brightest, mean_reading
from optsim.report.schema import Photons

# Name of the row of movers' own masks among those of the methods.
OBJECTS = "moving objects"


@dataclass(eq=False)
class Scorer:
    """Scorer of a run, frame by frame; it holds the references of the last two frames and small tallies only.

    Parameters
    ----------
    experiment : Experiment
        Its latency and coded slots determine the phases and the scored slots.
    camera : CodedCamera
        The true camera, behind its neutral density.
    truth : IrradianceVideo
        Light on the modulator.
    radiance : RadianceVideo
        The scene: declared white, and the difference of its two halves.
    """

    experiment: Experiment
    camera: CodedCamera
    truth: IrradianceVideo
    radiance: RadianceVideo
    tallies: list[metrics.FrameTally] = field(default_factory=list[metrics.FrameTally], init=False)
    spreads: list[metrics.UncertaintyTally] = field(
        default_factory=list[metrics.UncertaintyTally], init=False
    )
    pairs: list[metrics.PairTally] = field(default_factory=list[metrics.PairTally], init=False)
    classes: list[metrics.ClassTally] = field(default_factory=list[metrics.ClassTally], init=False)
    _references: dict[int, Floats] = field(default_factory=dict[int, Floats], init=False)
    _noise: dict[int, Floats] = field(default_factory=dict[int, Floats], init=False)
    _moving: dict[int, Bools] = field(default_factory=dict[int, Bools], init=False)

    def __post_init__(self) -> None:
        self.scale = metrics.PhotometricScale(
            white_w_m2_sr=self.radiance.white_w_m2_sr,
            irradiance_per_radiance=self.camera.irradiance_per_radiance,
            wavelength_m=self.camera.wavelength_m,
        )
        self.board = metrics.ScoreBoard(
            metrics=metrics.HEADLINE_METRICS,
            scale=self.scale,
            latency_frames=self.camera.latency_frames,
            coded_slots=self.camera.coded_slots,
        )
        self._ideal_pixel = true_calibration(self.camera, alone=True)
        halves = self.radiance.half_difference
        self._half_difference = None if halves is None else self.camera.form_image(halves)
        outside, step = self.radiance.outside, self.truth.samples_per_pitch
        self._window = (
            np.zeros(self.truth.panel_shape, np.bool_)
            if outside is None
            else cell_means(outside.astype(np.float32), step) > 0
        )

    def reference(self, index: int) -> Floats:
        """Mean irradiance of each slot and pitch cell, array (slot, v, u), W m^-2, shading divided out."""
        if index not in self._references:
            self._references = {k: v for k, v in self._references.items() if k == index - 1}
            self._references[index] = self.camera.reference(self.truth, index)
        return self._references[index]

    def moving(self, index: int) -> Bools:
        """Oracle mask of a frame, array (v, u): the same for all methods."""
        if index not in self._moving:
            # In this order: only the last two are held.
            previous = self.reference(index - 1) if index else None
            reference = self.reference(index)
            frames = [index] if previous is None else [index, index - 1]
            halves = [] if self._half_difference is None else [self._truth_noise(k) for k in frames]
            sigma = self._slot_sigma(reference)
            self._moving[index] = metrics.oracle_moving(reference, previous, sigma, halves)
        return self._moving[index]

    def _truth_noise(self, index: int) -> Floats:
        """Half the difference of the truth's two halves, as the reference: (slot, v, u), W m^-2."""
        if index not in self._noise:
            assert self._half_difference is not None
            self._noise = {k: v for k, v in self._noise.items() if k == index - 1}
            slots = self.experiment.timing.slots_per_frame
            noise = slot_means(self._half_difference, index * slots, slots) / self.truth.shading
            self._noise[index] = noise.astype(np.float32)
        return self._noise[index]

    def _slot_sigma(self, reference: Floats) -> Floats:
        """Predicted noise of one slot's irradiance at weight 1: shot and read noise, W m^-2, (v, u)."""
        pixel = self._ideal_pixel
        signal_dn = pixel.responsivity_dn * np.maximum(reference.mean(axis=0), 0)
        sigma_dn = np.sqrt(pixel.dn_per_e * signal_dn + pixel.read_noise_dn**2)
        return (sigma_dn / pixel.responsivity_dn).astype(np.float32)

    def add(self, videos: dict[str, Reconstruction]) -> FrameScores:
        """Score one coded frame of all methods, on the pixels that all of them hold valid."""
        scored = np.logical_and.reduce([video.valid for video in videos.values()])
        slots = self.camera.coded_slots
        found: FrameScores = self._of_last_phase(videos, scored)
        for method, video in videos.items():
            reference, moving = self.reference(video.index), self.moving(video.index)
            found.append(self.board.tally(method, video, reference, moving, scored))
            spread = metrics.tally_uncertainty(method, video, reference, moving, scored, slots)
            if spread is not None:
                found.append(spread)
        self.recall(found)
        return found

    def _of_last_phase(self, videos: dict[str, Reconstruction], scored: Bools) -> FrameScores:
        """Score content classes, and pairs with the adaptive method, the subject of claims."""
        index = next(iter(videos.values())).index
        phase, slots = self.board.phase(index), self.camera.coded_slots
        if phase != self.board.phase(self.experiment.n_frames - 1):
            return []
        reference, moving = self.reference(index), self.moving(index)
        truth_cd_m2 = self.scale.luminance_cd_m2(reference[:slots])
        truth = metrics.FrameReference(truth_cd_m2, metrics.class_masks(truth_cd_m2, moving))
        found: FrameScores = []
        errors: dict[str, PixelErrors] = {}
        for name, video in videos.items():
            light = video.irradiance_w_m2
            errors[name] = metrics.pixel_errors(
                metrics.sample_metrics(), self.scale, light, reference, video.valid, slots
            )
            frame = metrics.FrameEstimate(truth, self.scale.luminance_cd_m2(light[:slots]), scored)
            found.append(metrics.tally_classes(name, index, metrics.every_metric(), errors[name], frame))
        if phase == "steady" and metrics.ADAPTIVE in videos:
            found += [
                metrics.tally_pair(name, index, errors[metrics.ADAPTIVE], theirs, moving, self._window)
                for name, theirs in errors.items()
                if name != metrics.ADAPTIVE
            ]
        return found

    def recall(self, scores: FrameScores) -> None:
        """Add the scores of a coded frame that was scored before."""
        self.tallies += [each for each in scores if isinstance(each, metrics.FrameTally)]
        self.spreads += [each for each in scores if isinstance(each, metrics.UncertaintyTally)]
        self.pairs += [each for each in scores if isinstance(each, metrics.PairTally)]
        self.classes += [each for each in scores if isinstance(each, metrics.ClassTally)]

    def noise_ceiling(self, progress: Progress = silent) -> list[Score]:
        """Score the truth's own Monte-Carlo noise on up to two steady frames: the best certifiable score."""
        if self._half_difference is None:
            return []
        steady = [k for k in range(self.experiment.n_frames) if self.board.phase(k) == "steady"]
        chosen = sorted({steady[0], steady[-1]}) if steady else [self.experiment.n_frames - 1]
        tallies: list[metrics.FrameTally] = []
        for done, index in enumerate(chosen):
            reference, moving = self.reference(index), self.moving(index)
            tallies.append(self.board.tally_noise(index, reference, self._truth_noise(index), moving))
            progress("noise ceiling", done + 1, len(chosen))
        return self.board.records(tallies)

    def results(self) -> dict[str, Any]:
        """Scores, coverage and series of everything added, in the form of results.json."""
        pairs = self.pair_records()
        return {
            "scores": self.board.records(self.tallies),
            "coverage": self.board.coverage(self.tallies),
            "frame_series": self.board.frame_series(self.tallies),
            "slot_series": self.board.slot_series(self.tallies),
            "class_series": metrics.class_series(metrics.every_metric(), self.classes),
            "temporal": metrics.temporal_records(
                metrics.HEADLINE_METRICS, self.tallies, self.camera.latency_frames
            ),
            "uncertainty": metrics.uncertainty_records(self.spreads, self.camera.latency_frames),
            "pairs": pairs,
            "claims": metrics.judge_claims([pairs], no_rivals(self.experiment)),
        }

    def pair_records(self) -> list[PairRecord]:
        """Scores of the adaptive method and each other one on their common pixels, steady phase."""
        latency = self.camera.latency_frames
        return metrics.pair_records(metrics.HEADLINE_METRICS, self.pairs, self.camera.coded_slots, latency)

    def masks(self, frames: Frames, objects: Bools | None = None) -> dict[str, Any]:
        """Agreement of each adaptive method's mask, and of movers, with the oracle: by frame and by phase.

        Parameters
        ----------
        frames : dict
            Method name -> its coded frames.
        objects : ndarray of shape (frame, v, u), bool, optional
            Masks of the moving objects, listed beside the methods' under the name :data:`OBJECTS`.
        """
        tallies = [
            metrics.MaskTally(
                method.name,
                frame.index,
                metrics.mask_agreement(frame.code.moving, self.moving(frame.index)),
            )
            for method in self.experiment.methods
            if method.scheme.kind == "motion_adaptive"
            for frame in frames[method.name]
        ]
        if objects is not None and tallies:
            agreements = (metrics.mask_agreement(mask, self.moving(k)) for k, mask in enumerate(objects))
            tallies += [metrics.MaskTally(OBJECTS, k, each) for k, each in enumerate(agreements)]
        rows = [
            MaskScore(
                method=t.method,
                frame=t.index,
                precision=t.agreement.precision,
                recall=t.agreement.recall,
                iou=t.agreement.iou,
            )
            for t in tallies
        ]
        pooled = metrics.pooled_mask_records(tallies, self.camera.latency_frames)
        return {"masks": rows, "pooled_masks": pooled}

    def photons(self, frames: Frames) -> list[Photons]:
        """Photoelectrons that each method uses of a panel pixel, over all frames."""
        pixel = self._ideal_pixel
        rows: list[Photons] = []
        for method in self.experiment.methods:
            name, taken, side = method.name, frames[method.name], self.experiment.choice_of(method).reading_px
            square = pixel.centre_row, pixel.centre_col, side
            raw = np.stack([mean_reading(f.dn, *square)[pixel.valid] for f in taken])
            most = np.stack([brightest(f.dn, *square)[pixel.valid] for f in taken])
            electrons = (raw - pixel.black_dn[pixel.valid]) * side**2 / pixel.dn_per_e
            rows.append(
                Photons(
                    method=name,
                    mean_e=float(electrons.mean(dtype=np.float64)),
                    dark_e=float(np.percentile(electrons, 5)),
                    saturated_share=float((most >= pixel.saturation_dn[pixel.valid]).mean()),
                    negative_light=sum(f.negative_light for f in taken),
                )
            )
        return rows

    def window_ratio(self, *, glare: bool) -> float | None:
        """95th percentile of the window over the 5th of the interior, on the panel, at time 0."""
        if self.radiance.outside is None or not self.radiance.outside.any():
            return None
        camera = self.camera if glare else self.camera.without_glare()
        step = self.truth.samples_per_pitch
        image: Doubles = cell_means(camera.form_image(self.radiance).load(0).start, step)
        seen = cell_means(self.radiance.outside.astype(np.float32), step)
        window, interior = image[seen == 1], image[seen == 0]
        dark = float(np.percentile(interior, 5))
        return float(np.percentile(window, 95)) / dark if window.size and dark > 0 else None


def no_rivals(experiment: Experiment) -> list[str]:
    """Methods that claims leave out: same code as the adaptive one, or another calibration."""
    by_name = {m.name: m for m in experiment.methods}
    ours = (
        experiment.choice_of(by_name[metrics.ADAPTIVE])
        if metrics.ADAPTIVE in by_name
        else experiment.calibration_choice
    )
    return [
        m.name
        for m in experiment.methods
        if m.scheme.kind == "motion_adaptive" or experiment.choice_of(m) != ours
    ]


def score(result: Result) -> metrics.Scores:
    """Score a run in memory."""
    scorer = scorer_of(result)
    return metrics.Scores(scorer.board.records(scorer.tallies))


def scorer_of(result: Result) -> Scorer:
    """Return a scorer with a run in memory: its scores, pairs and masks."""
    scorer = Scorer(result.experiment, result.camera, result.truth, result.radiance)
    for index in range(result.experiment.n_frames):
        scorer.add({name: video[index] for name, video in result.reconstructions.items()})
    return scorer
