"""Exposures of a mosaic after the panel's leak and response."""

from __future__ import annotations

from typing import TypedDict

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.coding import HdrMosaic, MotionAdaptive
from optsim.core.quantities import PanelState
from optsim.experiment.experiment import Experiment
from optsim.optics.panel import slot_weights


class Density(TypedDict):
    """One exposure: slots that the code opens, and their effect in slots of a fully open panel."""

    commanded_slots: int
    effective_slots: float


def mosaics(experiment: Experiment) -> dict[str, HdrMosaic]:
    """Mosaics of an experiment's methods, by the names of those methods."""
    found: dict[str, HdrMosaic] = {}
    for method in experiment.methods:
        scheme = method.scheme.static if isinstance(method.scheme, MotionAdaptive) else method.scheme
        if isinstance(scheme, HdrMosaic):
            found[method.name] = scheme
    return found


def densities(camera: CodedCamera, mosaic: HdrMosaic) -> list[Density]:
    """Exposures of a mosaic by a camera's panel on its axis, the shortest first; without fringing."""
    # Means over a tile's pixels and a round of frames, after another round: a pixel's earlier code matters.
    tiles = mosaic.tiles(camera.slots_per_frame, camera.coded_slots, np.random.default_rng(0))
    panel: PanelState | None = None
    exposures: dict[int, list[float]] = {}
    for frame in (*tiles, *tiles):
        weights, panel = slot_weights(frame, panel, camera.panel_response, camera.slot_s)
        opened = (frame[: camera.coded_slots] > 0).sum(axis=0)
        exposure = weights[: camera.coded_slots].sum(axis=0, dtype=np.float64)
        for slots in np.unique(opened):
            exposures.setdefault(int(slots), []).append(float(exposure[opened == slots].mean()))
    return [
        {"commanded_slots": slots, "effective_slots": float(np.mean(found[len(found) // 2 :]))}
        for slots, found in sorted(exposures.items())
    ]
