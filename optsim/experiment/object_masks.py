"""Masks of visible movers, for comparison with the oracle's, which include shadows and bounce light."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from optsim.core.cache import Cache, hash_of
from optsim.core.code_hash import hash_files
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, Doubles, View
from optsim.experiment.experiment import Experiment
from optsim.experiment.truth import chosen_scene
from optsim.scene import Scene

_KIND = "object masks, one chief ray a panel pixel, middles of slots"
# Entries of old code must not be used.
_CODE = ("optsim/experiment/object_masks.py", "optsim/render/*.py", "optsim/scene/*.py")


def object_masks(
    experiment: Experiment,
    *,
    cache: Cache | None = None,
    backend: str | None = None,
    progress: Progress = silent,
) -> Bools | None:
    """Find the panel pixels that show a mover during a coded frame or the one before; without shadows.

    A pixel counts if the chief ray through its centre meets a mover first, even one at rest, in the middle
    of any slot; as ``moving`` in an export of passes.
    """
    if experiment.scene is None:
        return None
    scene, view, timing = chosen_scene(experiment), experiment.camera.view, experiment.timing
    if not scene.singles():
        return None
    pitch = view.samples_per_pitch
    # Chief rays: defocus does not move an object.
    pixels = replace(
        view,
        rows=view.rows // pitch,
        cols=view.cols // pitch,
        samples_per_pitch=1,
        aperture_m=0.0,
        focus_m=None,
    )
    starts_s: Doubles = np.arange(timing.n_slots, dtype=np.float64) * timing.slot_s
    times_s = (starts_s + timing.slot_s / 2).reshape(experiment.n_frames, -1)
    key = hash_of(_KIND, hash_files(_CODE), scene.model_dump(mode="json"), asdict(pixels), times_s.tolist())
    kept = (cache or Cache()).get(key, lambda: {"frames": _seen(scene, pixels, times_s, backend, progress)})
    frames = np.asarray(kept["frames"])
    masks = frames.copy()
    masks[1:] |= frames[:-1]
    return masks


def _seen(scene: Scene, pixels: View, times_s: Doubles, backend: str | None, progress: Progress) -> Bools:
    """Pixels that show a mover at any of a frame's times, (frame, slot): array (frame, v, u)."""
    from optsim.render.backend import activate
    from optsim.render.gbuffer import ObjectIds, camera_to_world, first_objects, sample_rays
    from optsim.render.stage import RenderStage

    activate(backend)
    stage, rays = RenderStage(scene, pixels), sample_rays(pixels)
    ids = ObjectIds(scene, stage.loaded)
    found = np.zeros((len(times_s), len(rays)), np.bool_)
    for done, ((frame, _), time_s) in enumerate(np.ndenumerate(times_s), start=1):
        pose = scene.camera.at(float(time_s))
        stage.pose(float(time_s))
        directions = np.einsum("nj,kj->nk", rays, camera_to_world(pose)[:3, :3])
        _, *place = first_objects(stage, pose, directions)
        found[frame] |= ids.moving[ids.of(*place)]
        progress("object masks", done, times_s.size)
    return found.reshape(-1, pixels.rows, pixels.cols)
