"""Metrics: truth and estimate meet here and only here.

Every metric takes luminance in cd/m^2, (slot, v, u), float32, and streams: ``sum_errors`` a frame,
``finish`` at the end. To add one, write its file and name an instance in :data:`ALL`.
"""

from optsim.metrics.hypothesis import judge_hypothesis
from optsim.metrics.log_error import LogRmse
from optsim.metrics.metric import Metric
from optsim.metrics.oracle import (
    MaskAgreement,
    MaskTally,
    mask_agreement,
    oracle_moving,
    pooled_agreement,
    pooled_mask_records,
)
from optsim.metrics.photometry import PhotometricScale, luminous_efficacy_lm_w
from optsim.metrics.psnr import Psnr
from optsim.metrics.pu21 import Pu21Psnr
from optsim.metrics.scoring import TRUTH_NOISE, FrameTally, ScoreBoard, first_steady, phase_of
from optsim.metrics.uncertainty import UncertaintyTally, tally_uncertainty, uncertainty_records

ALL: tuple[Metric, ...] = (Pu21Psnr(), LogRmse(), Psnr())

__all__ = [
    "ALL",
    "TRUTH_NOISE",
    "FrameTally",
    "LogRmse",
    "MaskAgreement",
    "MaskTally",
    "Metric",
    "PhotometricScale",
    "Psnr",
    "Pu21Psnr",
    "ScoreBoard",
    "UncertaintyTally",
    "first_steady",
    "judge_hypothesis",
    "luminous_efficacy_lm_w",
    "mask_agreement",
    "oracle_moving",
    "phase_of",
    "pooled_agreement",
    "pooled_mask_records",
    "tally_uncertainty",
    "uncertainty_records",
]
