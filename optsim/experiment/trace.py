"""Trace of one CCD pixel in one exposure: radiance, code, effective code, electrons by origin, DN."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.core.console import table
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bytes, Doubles, IrradianceVideo, RadianceVideo
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Shot, planned, set_light, shots
from optsim.experiment.signal_breakdown import (
    NEAR_PX,
    ORIGINS,
    count_electrons,
    light_paths,
    look_at,
    read_out,
    seen_per_slot,
)
from optsim.experiment.truth import render_truth
from optsim.metrics import first_steady, phase_of
from optsim.optics.fringing import border_shares, fine_image_adjoint
from optsim.report.trace_record import Contributor, SignalShare, Slots, Trace, open_slots, sentences

_SOURCES = 12
NOTES = (
    "Blur and veiling glare of the objective act before the panel: light that they bring to a panel pixel is "
    "part of its irradiance and counts for that panel pixel.",
    "Under fringing fields a panel pixel rules over the rim of its neighbours too: light counts for the "
    "panel pixel whose drive let it through; what a rim passes more or less than a mix of those that rule "
    "over it counts for them in proportion.",
    "The own panel pixel's share of ghost and veil counts for these, not for the pixel.",
    "Clip, bend and noise act on the sum of the origins; smear is added behind the full well.",
)


@dataclass(frozen=True)
class TracedPixel:
    """The CCD pixel, coded frame and method to trace."""

    y: int
    x: int
    frame: int
    method: str


def choose_pixel(
    experiment: Experiment, pixel: str, frame: int | None = None, method: str | None = None
) -> TracedPixel:
    """Parse the target of a trace before anything is rendered.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    pixel : str
        Row and column of a CCD pixel, ``y,x``.
    frame : int, optional
        Coded frame; by default the first one of the steady phase, or the last one where there is none.
    method : str, optional
        By default the first one.

    Raises
    ------
    ConfigError
        For a pixel off the CCD, a frame outside the experiment, or an unknown method.
    """
    match = re.fullmatch(r"\s*(-?[0-9]+)\s*,\s*(-?[0-9]+)\s*", pixel)
    if match is None:
        raise ConfigError(
            f"--pixel: got {pixel!r}, expected y,x: row and column of a CCD pixel as whole numbers; "
            "write for example --pixel 180,240"
        )
    y, x = int(match[1]), int(match[2])
    ccd, n_frames = experiment.camera.sensor, experiment.n_frames
    if not (0 <= y < ccd.rows and 0 <= x < ccd.cols):
        raise ConfigError(
            f"--pixel: got row {y}, column {x}, expected rows 0 to {ccd.rows - 1} (camera.sensor.rows) and "
            f"columns 0 to {ccd.cols - 1} (camera.sensor.cols); choose a pixel on the CCD"
        )
    if frame is None:
        latency = experiment.camera.latency_frames
        frame = min(first_steady(latency), n_frames - 1)
    if not 0 <= frame < n_frames:
        raise ConfigError(
            f"--frame: got {frame}, expected 0 to {n_frames - 1}; choose one of these, or take more frames "
            "with --set n_frames=N"
        )
    names = [each.name for each in experiment.methods]
    if method is not None and method not in names:
        raise unknown_name("--method", method, names)
    return TracedPixel(y, x, frame, method or names[0])


def trace_experiment(
    experiment: Experiment, traced: TracedPixel, *, backend: str | None = None, progress: Progress = silent
) -> Trace:
    """Trace a pixel: truth, calibration, light and loop equal those of a run, with one method's loop alone.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    traced : TracedPixel
        From :func:`choose_pixel`.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Called after each finished unit.
    """
    radiance = render_truth(experiment, backend=backend, progress=progress)
    progress("laboratory", 0, 1)
    method = next(each for each in experiment.methods if each.name == traced.method)
    modelled = planned(experiment)[0].model_copy(update={"methods": (method,)})
    calibrations = calibrate_all(modelled)
    progress("laboratory", 1, 1)
    camera, _ = set_light(modelled, radiance, calibrations[modelled.calibration_choice])
    truth = camera.form_image(radiance)
    taken = shots(modelled, method, camera, truth, calibrations[modelled.choice_of(method)])
    for index in range(traced.frame):
        next(taken)
        progress("capture", index + 1, traced.frame + 1)
    shot = next(taken)
    progress("capture", traced.frame + 1, traced.frame + 1)
    if modelled.drift_per_frame:
        camera = modelled.at_work(traced.frame).with_nd(camera.objective.nd_transmission)
    return trace_pixel(experiment, camera, radiance, truth, shot, traced)


def trace_pixel(
    experiment: Experiment,
    camera: CodedCamera,
    radiance: RadianceVideo,
    truth: IrradianceVideo,
    shot: Shot,
    traced: TracedPixel,
) -> Trace:
    """Trace a pixel of a frame already taken."""
    code, pitch = shot.frame.code, truth.samples_per_pitch
    paths = light_paths(camera, traced.y, traced.x, pitch)
    even = fine_image_adjoint(paths[0], border_shares(camera.modulator.fringing_px, pitch))
    target = look_at(camera, traced.y, traced.x, pitch, even)
    own = (target.v, target.u)
    counted = count_electrons(camera, truth, traced.frame, code, shot.before, paths, own)
    expected, _ = camera.expected_electrons(truth, traced.frame, code, shot.before)
    reading = read_out(camera, expected, traced.y, traced.x, int(shot.frame.dn[traced.y, traced.x]))
    whole_e = {name: float(by_slot.sum()) for name, by_slot in counted.by_slot.items()}
    whole_e["smear"] = reading.smear_e
    total_e = sum(whole_e.values())
    slots = camera.slots_per_frame
    seen = np.stack([_on_own_pixel(paths[0], own, pitch), paths.sum(axis=0)])
    scene, light = (seen_per_slot(video, traced.frame * slots, slots, seen) for video in (radiance, truth))
    return Trace(
        experiment=experiment.name,
        fingerprint=experiment.fingerprint(),
        method=traced.method,
        frame=traced.frame,
        phase=phase_of(traced.frame, camera.latency_frames),
        y=traced.y,
        x=traced.x,
        nd_transmission=camera.objective.nd_transmission,
        irradiance_per_radiance=camera.irradiance_per_radiance,
        target=target,
        slots=Slots(
            own_radiance_w_m2_sr=_column(scene[0]),
            own_irradiance_w_m2=_column(light[0]),
            radiance_w_m2_sr=_column(scene[1]),
            irradiance_w_m2=_column(light[1]),
            level=_levels(code.levels, own),
            weight=tuple(counted.weight.tolist()),
            shutter_open=tuple(slot < camera.coded_slots for slot in range(slots)),
            origins_e={name: tuple(by_slot.tolist()) for name, by_slot in counted.by_slot.items()},
        ),
        origins=tuple(
            SignalShare(n, ORIGINS[n], e, e / total_e if total_e else 0.0) for n, e in whole_e.items()
        ),
        reading=reading,
        sources=_sources(counted.by_pixel, even, code.levels, own, total_e),
        neighbourhood_e=_neighbourhood(counted.by_pixel, own),
        notes=NOTES,
    )


def show(trace: Trace) -> list[object]:
    """Turn a trace into a few lines and tables for a terminal."""
    items: list[object] = [
        *sentences(trace),
        table(
            "electrons by origin",
            ("origin", "electrons", "%", "what"),
            [(o.name, o.electrons_e, 100 * o.share, o.meaning) for o in trace.origins],
        ),
    ]
    if trace.sources:
        rows = [(s.dv, s.du, s.electrons_e, 100 * s.share, open_slots(s.level)) for s in trace.sources]
        columns = ("dv", "du", "electrons", "%", "open slots")
        items.append(table("other panel pixels that give most, without ghost and veil", columns, rows))
    return items


def _on_own_pixel(direct: Doubles, own: tuple[int, int], pitch: int) -> Doubles:
    """Part of the direct path from the own panel pixel; a uniform weight on it where there is none."""
    cells = np.zeros(direct.shape)
    v, u = own
    cells[v * pitch : (v + 1) * pitch, u * pitch : (u + 1) * pitch] = 1
    seen = cells * direct
    return seen if seen.sum() > 0 else cells


def _sources(
    by_pixel: Doubles, even: Doubles, levels: Bytes, own: tuple[int, int], total_e: float
) -> tuple[Contributor, ...]:
    others = by_pixel.copy()
    others[own] = 0
    found: list[Contributor] = []
    for at in np.argsort(-others.ravel(), kind="stable")[:_SOURCES]:
        v, u = divmod(int(at), others.shape[1])
        if others[v, u] > 0:
            share = float(others[v, u] / total_e)
            even_share = float(even[v, u] / even.sum())
            offset = (v - own[0], u - own[1])
            found.append(
                Contributor(v, u, *offset, float(others[v, u]), share, even_share, _levels(levels, (v, u)))
            )
    return tuple(found)


def _neighbourhood(by_pixel: Doubles, own: tuple[int, int]) -> tuple[tuple[float | None, ...], ...]:
    v, u = own
    around = np.pad(by_pixel, NEAR_PX, constant_values=np.nan)[
        v : v + 2 * NEAR_PX + 1, u : u + 2 * NEAR_PX + 1
    ]
    return tuple(_column(row) for row in around)


def _levels(levels: Bytes, pixel: tuple[int, int]) -> tuple[int, ...]:
    return tuple(int(level) for level in levels[:, *pixel])


def _column(values: Doubles) -> tuple[float | None, ...]:
    """Values for JSON: NaN, which means none, as null."""
    return tuple(None if np.isnan(value) else float(value) for value in values)
