"""One sequence of a data set: truth with all passes, then coded frames and reconstructions of each scheme.

::

    truth/slot000000.exr ... manifest.json passes.png
    light_on_panel/slot000000.exr  target/000000.exr  operator.npz
    seed1/calibration.npz experiment.json light.json checksums.json
    seed1/frames/SCHEME/000000.png  codes/SCHEME/000000.exr  masks/SCHEME/000000.png
    seed1/expected/SCHEME/000000.exr  weights/SCHEME/000000.exr  transmission/SCHEME/000000.exr
    seed1/reconstructions/SCHEME/000000.exr
"""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path

from optsim.core.config import Table, build
from optsim.core.files import write_json
from optsim.dataset.coded_arrays import write_explained, write_light
from optsim.dataset.export import export_passes
from optsim.dataset.spec import DatasetSpec, SequencePlan
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import capture, decode, planned, set_light
from optsim.experiment.run_folder import (
    write_calibrations,
    write_checksums,
    write_frames,
    write_reconstruction,
)
from optsim.experiment.truth import render_truth
from optsim.tasks import tell


def make_sequence(folder: Path, spec: Table, sequence: Table) -> None:
    """Fill a sequence's folder; results of an earlier attempt are kept."""
    chosen = build(DatasetSpec, spec, where="data set")
    plan = SequencePlan(**sequence)
    first, noise = chosen.experiment_of(plan, chosen.seeds[0]), chosen.noise.of(plan.split)
    alone = (noise.share or first.render.static_error) if noise.independent else None
    export_passes(first, folder / "truth", half=chosen.half, noise_share=alone, progress=tell)
    for seed in chosen.seeds if chosen.schemes else ():
        place = folder / f"seed{seed}"
        if not (place / "light.json").is_file():
            shutil.rmtree(place, ignore_errors=True)
            experiment, draws = chosen.experiment_of(plan, seed), chosen.draws_of(plan, seed)
            _take(experiment, place, chosen, draws=draws, slot_error=alone)


def _take(
    experiment: Experiment, folder: Path, spec: DatasetSpec, *, draws: int, slot_error: float | None
) -> None:
    """Calibrate, take the coded frames of all schemes with what explains them, and decode if requested."""
    modelled, _ = planned(experiment)
    tell("calibration", 0, 1)
    known = calibrate_all(modelled)
    tell("calibration", 1, 1)
    experiment.check_methods(known)
    radiance = render_truth(experiment, slot_error=slot_error, progress=tell)
    camera, light = set_light(modelled, radiance, known[modelled.calibration_choice])
    truth = camera.form_image(radiance)
    # The laboratory keeps the set's seed, so that one calibration serves all sequences of a camera.
    drawn = modelled.model_copy(update={"seed": draws})
    frames = capture(drawn, camera, truth, known, tell)
    write_calibrations(experiment, folder, known)
    write_frames(folder, frames)
    write_light(folder.parent, camera, truth, modelled.n_frames, half=spec.half)
    for method in modelled.methods:
        calibration = known[modelled.choice_of(method)]
        write_explained(folder, method.name, camera, truth, calibration, frames[method.name])
    if spec.reconstruct:
        for decoded in decode(modelled, frames, known):
            for name, video in decoded.videos.items():
                write_reconstruction(folder, name, video, camera.irradiance_per_radiance)
            tell("decode", decoded.index + 1, modelled.n_frames)
    write_checksums(folder)
    write_json(folder / "experiment.json", experiment.model_dump(mode="json"))
    # Last: its presence marks the rest as complete.
    facts = {"irradiance_per_radiance": camera.irradiance_per_radiance, "gain_e_dn": camera.sensor.step_e}
    facts["draws"] = draws
    write_json(folder / "light.json", {**asdict(light), **facts})
