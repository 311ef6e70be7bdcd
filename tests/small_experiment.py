"""Overrides that make the demo as small and as noisy as a test of its plumbing can bear."""

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
