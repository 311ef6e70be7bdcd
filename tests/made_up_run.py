"""A made-up run for tests of reports: a made-up contest, scored and drawn by the real rooms."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optsim import metrics, report
from optsim.core.quantities import Reconstruction
from optsim.metrics import (
    LogRmse,
    MaskTally,
    PhotometricScale,
    ScoreBoard,
    error_by_luminance,
    judge_claims,
    mask_agreement,
    oracle_moving,
    pair_records,
    pixel_errors,
    pooled_mask_records,
    tally_pair,
    worst_place,
)
from optsim.report import light_code

METHODS = {
    "adaptive": "motion-adaptive coding, union decoder",
    "normal": "all slots open",
    "hdr_mosaic": "four densities, merged",
    "random": "random exposure, sparse decoder",
}
# Relative noise where it moves and where it is static: a made-up contest with a clear order.
NOISE = {
    "adaptive": (0.055, 0.021),
    "normal": (0.5, 0.06),
    "hdr_mosaic": (0.35, 0.02),
    "random": (0.05, 0.09),
}
SLOTS = 12
E_CD_M2 = LogRmse().e_cd_m2
FLOOR = light_code.floor_of(E_CD_M2)


def truth_frame(index: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """A dim textured room with a bright window and a disc that moves: irradiance (slot, v, u), W/m^2."""
    v, u = np.indices((rows, cols)) / rows
    still = 2e-3 * (1 + 0.6 * np.sin(40 * u) * np.sin(31 * v)) * (0.4 + v)
    outside = (v > 0.12) & (v < 0.5) & (u > 0.12) & (u < 0.5)
    still = np.where(outside, 3.0 * (1.2 + np.sin(70 * u)), still)
    frames = []
    for slot in range(SLOTS):
        at = 0.75 + 0.1 * np.sin((index * SLOTS + slot) / 9)
        disc = (u - at) ** 2 + (v - 0.62) ** 2 < 0.02
        frames.append(np.where(disc, 0.02 * (1.5 + np.sin(60 * (u - at))), still))
    return np.asarray(frames, np.float32), outside


def as_json(rows: Sequence[metrics.Record]) -> list[dict[str, Any]]:
    return [row.as_json() for row in rows]


def make_results(folder: Path, rows: int, cols: int, n_frames: int) -> dict[str, Any]:
    """Results of a made-up run, scored and drawn by the real rooms."""
    rng = np.random.default_rng(7)
    scale = PhotometricScale(white_w_m2_sr=0.5, irradiance_per_radiance=0.02)
    board = ScoreBoard(metrics.HEADLINE_METRICS, scale, 1, SLOTS)
    tallies, ceiling, masks, marked, shots, rivals = [], [], [], [], {}, []
    bins, places = [], []
    previous = None
    for index in range(n_frames):
        reference, outside = truth_frame(index, rows, cols)
        moving = oracle_moving(reference, previous, 0.0)
        previous = reference
        half = (reference * rng.normal(0, 0.004, reference.shape)).astype(np.float32)
        ceiling.append(board.tally_noise(index, reference, half, moving))
        errors = {}
        for name in METHODS:
            sigma = np.where(moving, *NOISE[name]) * (1.5 if index < 2 else 1)
            estimate = np.maximum(reference * (1 + sigma * rng.normal(size=reference.shape)), 0)
            if name == "normal":
                estimate = np.minimum(estimate, 0.03)
            valid = np.ones((rows, cols), bool)
            valid[:2, : cols // 4] = name != "random"
            mask = moving if name != "adaptive" else np.roll(moving, 2, axis=1)
            r = Reconstruction(index, estimate.astype(np.float32), valid, ~valid, mask & (name == "adaptive"))
            tallies.append(board.tally(name, r, reference, moving))
            errors[name] = pixel_errors(
                metrics.HEADLINE_METRICS, scale, r.irradiance_w_m2, reference, valid, SLOTS
            )
            if name == "adaptive":
                agreement = mask_agreement(r.moving, moving)
                marked.append(MaskTally(name, index, agreement))
                masks.append(
                    {
                        "method": name,
                        "frame": index,
                        "precision": agreement.precision,
                        "recall": agreement.recall,
                        "iou": agreement.iou,
                    }
                )
            levels = (rng.random((SLOTS, rows, cols)) < 0.1).astype(np.uint8) * 255
            dn = np.clip(rng.normal(reference.mean(0) * 4e5, 30), 0, 16383).repeat(3, 0).repeat(3, 1)
            estimate = scale.luminance_cd_m2(r.irradiance_w_m2)
            shots[name] = report.ViewedFrame(
                light_code.encode(estimate, FLOOR),
                light_code.marks_of(valid, np.asarray(r.moving)),
                np.full_like(levels, 255) if name == "normal" else levels,
                dn.astype(np.uint16),
            )
            if index == n_frames - 1:
                errors_of = estimate, scale.luminance_cd_m2(reference), valid, LogRmse()
                bins += error_by_luminance(name, *errors_of)
                places.append(worst_place(name, index, *errors_of, size=(rows // 6, cols // 6)))
        rivals += [
            tally_pair(name, index, errors["adaptive"], errors[name], moving, outside)
            for name in METHODS
            if name != "adaptive"
        ]
    beside = pair_records(metrics.HEADLINE_METRICS, rivals, SLOTS, 1)
    light = light_code.encode(scale.luminance_cd_m2(reference), FLOOR)
    marks = light_code.marks_of(np.ones_like(moving), moving)
    moments = [report.Moment(n_frames - 1, "last", light, marks, shots)]
    moments.append(report.Moment(n_frames - 2, "worst of adaptive", light[::-1], marks, shots))
    about = {"e_cd_m2": E_CD_M2, "white_cd_m2": scale.white_cd_m2, "slot_s": 1 / 180}
    viewer = report.write_viewer(folder, moments, **about)
    pictures = report.still_pictures(folder, moments[0], e_cd_m2=E_CD_M2)
    pictures += report.captured_pictures(folder, moments[0], 16000.0)
    scores = board.records(tallies)
    return {
        "schema_version": 2,
        "title": "A made-up run <of & for> tests",
        "experiment": {
            "name": "synthetic",
            "camera": {"latency_frames": 1},
            "methods": [{"name": "adaptive"}],
        },
        "command": "optsim run synthetic --seed 7",
        "finished_utc": "2026-01-02T03:04:05",
        "versions": {"optsim": "0.1.0", "numpy": "2.4.6"},
        "run_key": "0123456789",
        "commit": None,
        "exported_truth": False,
        "resumed": {"captured": 0, "scored": 0},
        "backend": "llvm_ad_mono, 2 cores",
        "seeds": {"experiment": 7},
        "timings": [
            {
                "stage": s,
                "wall_s": w,
                "cpu_s": 1.9 * w,
                "peak_rss_mb": 812.5,
                "peak_is_of_this_stage": s != "render",
            }
            for s, w in (
                ("render", 95.3),
                ("calibrate", 4.25),
                ("capture", 21.0),
                ("decode", 61.4),
                ("score", 7.7),
            )
        ],
        "light_rule": {
            "statement": "The interior's 90th percentile, all-on, reaches 80 % of measured saturation.",
            "nd_transmission": 0.3712,
            "wanted_transmission": 0.3712,
            "percentile_dn": 12441.0,
            "saturation_dn": 15551.0,
        },
        "photons": [
            {
                "method": m,
                "mean_e": 5000.5 + i,
                "dark_e": 210.25,
                "saturated_share": 0.03125,
                "negative_light": i,
            }
            for i, m in enumerate(METHODS)
        ],
        "ledgers": [
            {
                "name": "mid-grey",
                "radiance_w_m2_sr": 0.09,
                "rows": [
                    {
                        "element": "objective f/4",
                        "transmission": 0.9,
                        "irradiance_w_m2": 1.23e-3,
                        "source": "data sheet",
                    },
                    {
                        "element": "panel",
                        "transmission": 0.65,
                        "irradiance_w_m2": 8.0e-4,
                        "source": "no source",
                    },
                ],
            }
        ],
        "geometry": {
            "panel_px": [rows, cols],
            "ratio": 3.0,
            "margin_px": 14,
            "fits": True,
            "pitch_m": 9.5e-6,
        },
        "latency": {
            "frames": 1,
            "smallest_physical": 3,
            "hypothetical": True,
            "details": {"readout_s": 0.069, "transfer_s": 0.0118},
        },
        "scene": {
            "name": "synthetic",
            "variation": "main",
            "description": "a dim room, a bright window, a moving disc",
            "light": "unpolarised: no material of the scene polarises",
            "wavelength_nm": 550.0,
            "white_w_m2_sr": 0.5,
            "white_cd_m2": scale.white_cd_m2,
            "window_interior_ratio_before_glare": 21500.0,
            "window_interior_ratio_after_glare": 2040.0,
        },
        "methods": METHODS,
        "calibrations": {},
        "calibration_files": [],
        "scores": as_json(scores),
        "coverage": as_json(board.coverage(tallies)),
        "frame_series": as_json(board.frame_series([*tallies, *ceiling])),
        "slot_series": as_json(board.slot_series(tallies)),
        "class_series": [],
        "temporal": [],
        "readings": [],
        "uncertainty": [
            {
                "method": m,
                "region": region,
                "phase": "steady",
                "n": n,
                "within_one": 0.6125 if n else None,
                "within_two": 0.93,
                "rms": 1.2375,
            }
            for m, region, n in (("hdr_mosaic", "all", 100), ("normal", "moving", 0))
        ],
        "masks": masks,
        "pooled_masks": as_json(pooled_mask_records(marked, latency_frames=1)),
        "noise_ceiling": as_json(board.records(ceiling)),
        "pairs": as_json(beside),
        "claims": as_json(judge_claims([beside])),
        "evidence": [
            {
                "effect": "pu21",
                "what": "PU21 encoding of the scores",
                "validated": True,
                "why": "",
                "claim": "encodes as its authors do",
                "oracle": "published numbers",
                "source": "doi:10.1109/PCS50896.2021.9477471",
                "measured": 2.0e-5,
                "tolerance": 6e-5,
                "reason": "four digits are published",
            },
            {
                "effect": "lens_psf",
                "what": "blur of each lens group",
                "validated": False,
                "why": "no validation yet",
                "claim": None,
                "oracle": None,
                "source": None,
                "measured": None,
                "tolerance": None,
                "reason": None,
            },
        ],
        "plan": {
            "tolerance": 0.1,
            "bound": 0.0321,
            "choices": [
                {
                    "skip": "moving_tails",
                    "what": "far light in lines",
                    "saves": "12 to 0.75 s a frame",
                    "skipped": True,
                    "bound": 0.0321,
                },
                {"skip": "time", "what": "later slots", "saves": "", "skipped": False, "bound": 0.0},
            ],
        },
        "not_modelled": ["twist of the nematic panel", "row scan of the panel"],
        "reconstruct_s": {"adaptive": 31.4, "normal": 0.4, "hdr_mosaic": 0.7, "random": 29.0},
        "pictures": as_json(pictures),
        "viewer": viewer.as_json(),
        "by_luminance": as_json(bins),
        "worst_places": as_json(places),
    }
