"""The demo as small and as noisy as a test of its plumbing can bear, and a film for a small panel."""

import numpy as np

from optsim.core.quantities import RadianceVideo
from optsim.experiment.experiment import Experiment
from optsim.footage.made import footage

SMALL = [
    "n_frames=1",
    "camera.panel_rows=12",
    "camera.panel_cols=16",
    "camera.sensor.rows=44",
    "camera.sensor.cols=56",
    "camera.objective.focal_length_m='0.3333 mm'",
    "render.static_error=0.3",
    "render.change_error=0.5",
    "render.moving_error=0.8",
    "render.interpolation_error=0.3",
    "render.slots_per_segment=36",
]

ROWS, COLS = 24, 32  # of the panel that the film is for


def moving_bar(experiment: Experiment, scale: float) -> RadianceVideo:
    """A texture that a bright bar crosses, its radiance scaled."""
    texture = np.random.default_rng(0).uniform(0.02, 0.15, (ROWS // 2, COLS // 2))
    frames = np.repeat(np.kron(texture, np.ones((6, 6)))[None], experiment.timing.n_slots, 0)
    for slot in range(len(frames)):
        frames[slot, 24:42, 10 + slot // 4 : 22 + slot // 4] = 0.3
    scaled = (scale * frames).astype(np.float32)
    return footage(scaled, slot_s=experiment.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4)
