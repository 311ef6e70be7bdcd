"""Metrics: the only place where truth and estimate are compared.

Metrics take luminance in cd/m^2, (slot, v, u), float32. One of samples (:class:`Metric`) is streamed:
``sum_errors`` for each frame, ``finish`` at the end. One of frames (:class:`FrameMetric`) scores a whole one.
To add one, write its file and add an instance to its list, which makes it one of :data:`ALL`.
"""

from optsim.core.extensions import METRICS, offered_of
from optsim.metrics.after_gain import AfterGainPsnr
from optsim.metrics.claims import ADAPTIVE, judge_claims, measured
from optsim.metrics.class_scores import ClassTally, class_series, tally_classes
from optsim.metrics.classes import CLASSES, class_masks
from optsim.metrics.error_maps import LuminanceBin, Place, error_by_luminance, worst_place
from optsim.metrics.frame_difference import FrameDifferencePsnr
from optsim.metrics.frame_metric import FrameEstimate, FrameMetric, FrameReference
from optsim.metrics.log_error import LogRmse
from optsim.metrics.metric import Metric
from optsim.metrics.ms_ssim import Pu21MsSsim
from optsim.metrics.mu_law import MuLawPsnr
from optsim.metrics.oracle import (
    MaskAgreement,
    MaskTally,
    mask_agreement,
    oracle_moving,
    pooled_agreement,
    pooled_mask_records,
)
from optsim.metrics.pairs import PairTally, pair_records, pixel_errors, tally_pair
from optsim.metrics.photometry import PhotometricScale, luminous_efficacy_lm_w
from optsim.metrics.psnr import Psnr
from optsim.metrics.pu21 import Pu21Psnr
from optsim.metrics.records import PHASES, MaskScore, PairRecord, Record, Score, Verdict
from optsim.metrics.relative_error import RelMse
from optsim.metrics.score_table import Scores
from optsim.metrics.scoring import TRUTH_NOISE, FrameTally, ScoreBoard, first_steady, phase_of
from optsim.metrics.smape import Smape
from optsim.metrics.ssim import Pu21Ssim
from optsim.metrics.temporal import temporal_records
from optsim.metrics.uncertainty import UncertaintyTally, tally_uncertainty, uncertainty_records

HEADLINE_METRICS: tuple[Metric, ...] = (Pu21Psnr(), LogRmse(), Psnr())
"""Metrics of the score board: of all frames, slots and phases. The others score classes of the last phase."""
SAMPLE_METRICS: tuple[Metric, ...] = (*HEADLINE_METRICS, MuLawPsnr(), RelMse(), Smape())
FRAME_METRICS: tuple[FrameMetric, ...] = (Pu21Ssim(), Pu21MsSsim(), FrameDifferencePsnr(), AfterGainPsnr())
ALL: tuple[Metric | FrameMetric, ...] = (*SAMPLE_METRICS, *FRAME_METRICS)


def sample_metrics() -> tuple[Metric, ...]:
    """Return the metrics of samples, with those that other packages offer."""
    return (*SAMPLE_METRICS, *(each.model_validate({}) for each in offered_of(METRICS, Metric)))


def every_metric() -> tuple[Metric | FrameMetric, ...]:
    """Return all metrics, those of samples first, with those that other packages offer."""
    frames = (each.model_validate({}) for each in offered_of(METRICS, FrameMetric))
    return (*sample_metrics(), *FRAME_METRICS, *frames)


__all__ = [
    "ADAPTIVE",
    "ALL",
    "CLASSES",
    "FRAME_METRICS",
    "HEADLINE_METRICS",
    "PHASES",
    "SAMPLE_METRICS",
    "TRUTH_NOISE",
    "AfterGainPsnr",
    "ClassTally",
    "FrameDifferencePsnr",
    "FrameEstimate",
    "FrameMetric",
    "FrameReference",
    "FrameTally",
    "LogRmse",
    "LuminanceBin",
    "MaskAgreement",
    "MaskScore",
    "MaskTally",
    "Metric",
    "MuLawPsnr",
    "PairRecord",
    "PairTally",
    "PhotometricScale",
    "Place",
    "Psnr",
    "Pu21MsSsim",
    "Pu21Psnr",
    "Pu21Ssim",
    "Record",
    "RelMse",
    "Score",
    "ScoreBoard",
    "Scores",
    "Smape",
    "UncertaintyTally",
    "Verdict",
    "class_masks",
    "class_series",
    "error_by_luminance",
    "every_metric",
    "first_steady",
    "judge_claims",
    "luminous_efficacy_lm_w",
    "mask_agreement",
    "measured",
    "oracle_moving",
    "pair_records",
    "phase_of",
    "pixel_errors",
    "pooled_agreement",
    "pooled_mask_records",
    "sample_metrics",
    "tally_classes",
    "tally_pair",
    "tally_uncertainty",
    "temporal_records",
    "uncertainty_records",
    "worst_place",
]
