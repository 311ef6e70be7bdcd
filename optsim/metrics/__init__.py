"""Metrics: the only place where truth and estimate are compared.

Every metric takes luminance in cd/m^2, (slot, v, u), float32, and is streamed: ``sum_errors`` for each frame,
``finish`` at the end. To add one, write its file and add an instance to :data:`ALL`.
"""

from optsim.metrics.claims import ADAPTIVE, judge_claims, measured
from optsim.metrics.error_maps import LuminanceBin, Place, error_by_luminance, worst_place
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
from optsim.metrics.pairs import PairTally, pair_records, pixel_errors, tally_pair
from optsim.metrics.photometry import PhotometricScale, luminous_efficacy_lm_w
from optsim.metrics.psnr import Psnr
from optsim.metrics.pu21 import Pu21Psnr
from optsim.metrics.records import PHASES, MaskScore, PairRecord, Record, Score, Verdict
from optsim.metrics.score_table import Scores
from optsim.metrics.scoring import TRUTH_NOISE, FrameTally, ScoreBoard, first_steady, phase_of
from optsim.metrics.uncertainty import UncertaintyTally, tally_uncertainty, uncertainty_records

ALL: tuple[Metric, ...] = (Pu21Psnr(), LogRmse(), Psnr())

__all__ = [
    "ADAPTIVE",
    "ALL",
    "PHASES",
    "TRUTH_NOISE",
    "FrameTally",
    "LogRmse",
    "LuminanceBin",
    "MaskAgreement",
    "MaskScore",
    "MaskTally",
    "Metric",
    "PairRecord",
    "PairTally",
    "PhotometricScale",
    "Place",
    "Psnr",
    "Pu21Psnr",
    "Record",
    "Score",
    "ScoreBoard",
    "Scores",
    "UncertaintyTally",
    "Verdict",
    "error_by_luminance",
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
    "tally_pair",
    "tally_uncertainty",
    "uncertainty_records",
    "worst_place",
]
