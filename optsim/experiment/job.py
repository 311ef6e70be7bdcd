"""A whole experiment on disk: check, calibrate, render, capture, decode, score, report; one new folder a run.

Frames are streamed one by one, so that memory does not grow with the length of the experiment.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.laboratory import check_panel
from optsim.camera.true_calibration import check_stored, ideal_calibration
from optsim.core.cache import Cache
from optsim.core.errors import StorageError
from optsim.core.files import writable_folder, write_exr, write_json
from optsim.core.folder_claims import claimed
from optsim.core.progress import Progress, silent
from optsim.core.quantities import RadianceVideo
from optsim.core.stopwatch import Stopwatch
from optsim.experiment import evidence
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.explain import MID_GREY, plan_record
from optsim.experiment.figures import SHOWN_LAST, Figures
from optsim.experiment.loop import LightLevel, capture, decode, planned, set_light
from optsim.experiment.object_masks import object_masks
from optsim.experiment.readings import bench_readings
from optsim.experiment.resume import UNFINISHED, cached_scores, keep_scores, n_shots, unfinished
from optsim.experiment.run_folder import (
    RESULTS,
    commit,
    results_key,
    run_folder,
    stated,
    versions,
    write_calibrations,
    write_checksums,
    write_frames,
    write_reconstruction,
)
from optsim.experiment.scoring import Scorer
from optsim.experiment.truth import check_truth, describe_truth, render_truth, renderer, scene_light
from optsim.report import write_report
from optsim.report.schema import (
    SCHEMA_VERSION,
    Latency,
    Ledger,
    LightRecord,
    Results,
    Resumed,
    SceneFacts,
    SkipPlan,
    StageTime,
)


def check(experiment: Experiment, folder: Path | None, backend: str | None) -> dict[str, Any]:
    """Check before any long work for obstacles to a run: backend, scene, disk space."""
    check_truth(experiment)
    if any(choice.operator == "bench" for choice in experiment.calibration_choices):
        check_panel(experiment.camera)
    check_stored(experiment.calibration_choices, experiment.camera)
    experiment.check_methods(
        {
            choice: ideal_calibration(experiment.camera, choice.reading_px)
            for choice in experiment.calibration_choices
        }
    )
    view, timing = experiment.camera.view, experiment.timing
    if experiment.source is not None:
        images = timing.n_slots
    else:
        # Two halves of key poses, and about as much again for the movers' own pixels; the flow will set the
        # distance of key poses, 9 slots is a guess.
        images = 4 * (timing.n_slots // (experiment.render.slots_per_segment or 9) + 2)
    truth_mb = images * view.rows * view.cols * 4 / 1e6
    panel = experiment.camera.panel_rows * experiment.camera.panel_cols
    run_mb = (len(experiment.save_reconstructions) + 1) * timing.n_slots * panel * 2 / 1e6 + 50
    # Frames, and once more with the panel's state until the run is done.
    sensor = experiment.camera.sensor
    a_frame = 2 * sensor.rows * sensor.cols * 2 + panel * 5
    run_mb += experiment.n_frames * len(experiment.methods) * a_frame / 1e6
    needs = {"truth in the cache": (truth_mb, Cache().folder)}
    if folder is not None:
        needs["run folder"] = (run_mb, folder)
    for what, (need_mb, place) in needs.items():
        existing = writable_folder(place, what, "set OPTSIM_CACHE or --out")
        free_mb = shutil.disk_usage(existing).free / 1e6
        if need_mb > free_mb:
            raise StorageError(
                f"not enough disk for the {what} at {place}: needs about {need_mb:.0f} MB, free are "
                f"{free_mb:.0f} MB. Cure: free some, 'optsim cache clear', or set OPTSIM_CACHE or --out"
            )
    return {
        "backend": renderer(experiment, backend)[0],
        "disk_needed_mb": {what: round(mb) for what, (mb, _) in needs.items()},
    }


def execute(
    experiment: Experiment,
    folder: Path,
    *,
    command: str = "",
    backend: str | None = None,
    export_truth: bool = False,
    progress: Progress = silent,
) -> Results:
    """Run an experiment into a folder."""
    with claimed(folder):
        run_folder(experiment, folder)
        return _execute(experiment, folder, command, backend, export_truth, progress)


def _execute(
    experiment: Experiment,
    folder: Path,
    command: str,
    backend: str | None,
    export_truth: bool,
    progress: Progress,
) -> Results:
    watch = Stopwatch()
    resolved = experiment.model_dump(mode="json")
    chosen, why = renderer(experiment, backend)
    # Hash the code now: edits during a run are not part of it.
    key = results_key(experiment, chosen)
    # Let a bench or a decoder refuse before the long work.
    with watch.stage("plan"):
        modelled, plan = planned(experiment)
    with watch.stage("calibrate"):
        progress("laboratory", 0, 1)
        calibrations = calibrate_all(modelled)
        progress("laboratory", 1, 1)
    experiment.check_methods(calibrations)
    with stated(folder, experiment), watch.stage("render"):
        radiance = render_truth(experiment, backend=backend, progress=progress)
    calibration_files = write_calibrations(experiment, folder, calibrations)
    objects = None
    if any(method.scheme.kind == "motion_adaptive" for method in experiment.methods):
        with watch.stage("object masks"):
            objects = object_masks(experiment, backend=backend, progress=progress)
    cache = unfinished(folder, key)
    experiment, names = modelled, [method.name for method in experiment.methods]
    captured = n_shots(cache, names)
    with watch.stage("capture"):
        camera, light = set_light(experiment, radiance, calibrations[experiment.calibration_choice])
        truth = camera.form_image(radiance)
        frames = capture(experiment, camera, truth, calibrations, progress, cache)
        write_frames(folder, frames)
        write_checksums(folder)
    scorer = Scorer(experiment, camera, truth, radiance)
    saturation_dn = float(np.median(calibrations[experiment.calibration_choice].saturation_dn))
    figures = Figures(experiment, scorer, saturation_dn)
    decode_s = dict.fromkeys(names, 0.0)
    # A report shows the last frame, and the worst one of those scored.
    scored = cached_scores(cache, names)[: max(0, experiment.n_frames - SHOWN_LAST)]
    for scores in scored:
        scorer.recall(scores)
    again = () if figures.worst is None else (figures.worst,)
    with watch.stage("decode and score"):
        progress("decode", len(scored), experiment.n_frames)
        for decoded in decode(experiment, frames, calibrations, first=len(scored), again=again):
            if decoded.index < len(scored):
                figures.add(decoded.index, decoded.videos, frames)
                continue
            scores = scorer.add(decoded.videos)
            figures.add(decoded.index, decoded.videos, frames)
            for name, video in decoded.videos.items():
                decode_s[name] += decoded.seconds[name]
                if name in experiment.save_reconstructions:
                    write_reconstruction(folder, name, video, camera.irradiance_per_radiance)
            keep_scores(cache, names, decoded.index, scores)
            progress("decode", decoded.index + 1, experiment.n_frames)
    with watch.stage("noise ceiling"):
        ceiling = scorer.noise_ceiling(progress)
    if export_truth:
        export_radiance(radiance, folder / "truth", experiment, progress)
    with watch.stage("pictures"):
        shown = figures.write(folder)
    origin = describe_truth(experiment, Cache())
    results = Results(
        schema_version=SCHEMA_VERSION,
        title=experiment.name,
        experiment=resolved,
        command=command,
        finished_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
        run_key=key,
        commit=commit(),
        exported_truth=export_truth,
        backend=f"{chosen}: {why}",
        seeds={"experiment": experiment.seed, "camera serial number": camera.serial_number},
        timings=[StageTime.model_validate(stage) for stage in watch.stages],
        resumed=Resumed(captured=captured, scored=len(scored)),
        light_rule=_light(experiment, light),
        photons=scorer.photons(frames),
        ledgers=_ledgers(camera, radiance.white_w_m2_sr),
        geometry={**asdict(camera.geometry()), "fits": camera.geometry().fits},
        latency=_latency(experiment),
        scene=SceneFacts(
            name=origin.name,
            variation=origin.variation,
            description=origin.description,
            light=scene_light(experiment, preview=chosen.startswith("scalar")).why,
            wavelength_nm=camera.wavelength_nm,
            white_w_m2_sr=radiance.white_w_m2_sr,
            white_cd_m2=scorer.scale.white_cd_m2,
            window_interior_ratio_before_glare=scorer.window_ratio(glare=False),
            window_interior_ratio_after_glare=scorer.window_ratio(glare=True),
        ),
        methods={
            m.name: f"{m.scheme.kind}, decoded by {m.decoder.kind}, calibration: {experiment.choice_of(m)}"
            for m in experiment.methods
        },
        calibrations={m.name: str(experiment.choice_of(m)) for m in experiment.methods},
        calibration_files=calibration_files,
        **scorer.results(),
        readings=bench_readings(calibrations[experiment.calibration_choice]),
        plan=SkipPlan.model_validate(plan_record(plan)),
        **scorer.masks(frames, objects),
        noise_ceiling=ceiling,
        evidence=evidence.status(),
        not_modelled=list(evidence.NOT_MODELLED),
        reconstruct_s={name: round(seconds, 3) for name, seconds in decode_s.items()},
        **shown,
    )
    write_checksums(folder)
    write_json(folder / RESULTS, results.as_json())
    write_report(folder, results)
    shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    return results


def summary(results: Results) -> str:
    """Steady-phase scores as a few lines for the terminal."""
    steady = [r for r in results.scores if r.phase == "steady" and r.value is not None]
    if not steady:
        return f"{results.title}: too short to reach the steady phase; the report shows the phases it has"
    names = list(results.methods)
    lines = [f"{results.title}: steady phase", f"{'':46}" + "".join(f"{name:>12}" for name in names)]
    for metric, region in dict.fromkeys((r.metric, r.region) for r in steady):
        values = {r.method: r.value for r in steady if (r.metric, r.region) == (metric, region)}
        cells = "".join(f"{values[n]:12.2f}" if n in values else f"{'-':>12}" for n in names)
        lines.append(f"{region:<8}{metric:<38.38}{cells}")
    return "\n".join(lines)


def export_radiance(
    radiance: RadianceVideo, folder: Path, experiment: Experiment, progress: Progress = silent
) -> None:
    """Write the truth as one OpenEXR a coded frame: mean radiance a slot and panel pixel, float32."""
    from optsim.optics.integrate import slot_means

    slots, seen_nm = experiment.timing.slots_per_frame, experiment.camera.wavelength_nm
    for index in range(experiment.n_frames):
        means = slot_means(radiance, index * slots, slots)
        write_exr(
            folder / f"{index:06d}.exr",
            {f"slot{slot:02d}": means[slot] for slot in range(slots)},
            attributes={"unit": "W m^-2 sr^-1", "axes": "slot, v, u", "frame": index, "band_nm": seen_nm},
        )
        progress("export truth", index + 1, experiment.n_frames)


def _ledgers(camera: CodedCamera, white_w_m2_sr: float) -> list[Ledger]:
    """Photon ledgers of the scene's declared white and of a mid-grey (18 %) of it."""
    return [
        Ledger(name=name, radiance_w_m2_sr=level, rows=[asdict(row) for row in camera.ledger(level)])
        for name, level in (("white", white_w_m2_sr), ("mid-grey", MID_GREY * white_w_m2_sr))
    ]


def _light(experiment: Experiment, light: LightLevel) -> LightRecord:
    return LightRecord(
        statement=(
            f"the interior's {experiment.light.percentile:g}th percentile under the all-on code reaches "
            f"{experiment.light.saturation_share:.0%} of measured saturation"
        ),
        nd_transmission=light.nd_transmission,
        wanted_transmission=light.wanted_transmission,
        percentile_dn=light.percentile_dn,
        saturation_dn=light.saturation_dn,
    )


def _latency(experiment: Experiment) -> Latency:
    report = asdict(experiment.camera.smallest_latency_frames())
    smallest = report.pop("frames")
    chosen = experiment.camera.latency_frames
    return Latency(
        frames=chosen,
        smallest_physical=smallest,
        hypothetical=chosen < smallest,
        details=report,
    )
