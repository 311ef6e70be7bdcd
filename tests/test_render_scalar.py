"""The scalar fallback answers through the same interface, in a process of its own."""

import subprocess
import sys

CODE = """
import numpy as np
from pathlib import Path
import sys
from optsim.core.cache import Cache
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, render_truth
from optsim.scene import load_scene
settings, cache = RenderSettings(slots_per_segment=2), Cache(Path(sys.argv[1]))
video = render_truth(load_scene("window_room"), View(18, 24, 3, 0.32), Timing(1 / 180, 2, 1), settings,
                     cache=cache, backend="scalar_rgb")
image = video.load(1).instant(0)
assert image.shape == (18, 24) and np.isfinite(image).all()
window, room = image[video.outside], image[~video.outside]
assert np.median(window) > 10 * np.median(room)
assert video.half_difference.load(0).start.std() > 0
"""


def test_scalar_preview(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", CODE, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
