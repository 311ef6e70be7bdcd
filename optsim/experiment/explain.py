"""Preview of an experiment before rendering: geometry, photons, latency, imperfections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, cast

from optsim.core.config import flat
from optsim.core.console import table
from optsim.optics.radiometry import photons_per_joule

if TYPE_CHECKING:
    from optsim.camera.camera import CodedCamera
    from optsim.camera.effect_sizes import EffectSize
    from optsim.camera.probe import Probe
    from optsim.camera.skip import Skipping
    from optsim.experiment.focus import Focus

Row = tuple[str, object, str]
_QUANTITY = ("quantity", "value", "unit")
# Reflectance of a mid-grey card (the usual 18 % of photography), relative to the scene's declared white.
MID_GREY = 0.18
# Instants of a slot after which more hardly help, and the error by one instant for a grey and a white bar, in
# a frame's noise, under random exposures (tests/test_effects.py): n instants divide it by n, or more.
FINE_INSTANTS, BAR_SIZES = 12, (0.06, 0.3)


def explanation(name_or_path: str, assignments: Sequence[str]) -> dict[str, Any]:
    """Band, geometry, focus, photons, latency, effects and skips of an experiment.

    Returns
    -------
    dict
        JSON-able; ``geometry.fits`` states whether it can be run. If not, ``misfit`` gives reason and cure,
        and effects and skips are left out.
    """
    from optsim.camera.effect_sizes import effect_sizes
    from optsim.camera.effects import changed
    from optsim.camera.probe import PLAIN, drifted_as_far, make_probe, shrunk
    from optsim.camera.skip import leave_out
    from optsim.core.errors import GeometryError
    from optsim.experiment.densities import densities, mosaics
    from optsim.experiment.experiment import load_experiment
    from optsim.experiment.truth import describe_truth, given, scene_light
    from optsim.metrics import first_steady

    misfit = None
    try:
        experiment = load_experiment(name_or_path, assignments)
    except GeometryError as error:
        misfit = str(error)
        experiment = load_experiment(name_or_path, assignments, check_geometry=False)
    camera = experiment.camera
    truth, light = describe_truth(experiment), scene_light(experiment)
    skipping = probe = None
    found: list[EffectSize] = []
    if not misfit:
        facts = given(experiment)
        skipping = leave_out(facts, experiment.tolerance)
        probe = make_probe(changed(skipping.camera, PLAIN), facts.light, experiment.schemes)
        in_scene = scene_effects(probe, truth.focus, polarised=light.azimuth_rad is not None)
        drift = drifted_as_far(camera, experiment.at_work(), shrunk(camera))
        found = sorted([*effect_sizes(probe, drift), *in_scene], key=_unknown_last)
    latency = camera.smallest_latency_frames()
    levels = {"mid-grey": MID_GREY * truth.white_w_m2_sr, "white": truth.white_w_m2_sr}
    return {
        "experiment": experiment.name,
        "truth": f"{truth.name} ({truth.variation}): {truth.description}",
        "light": light.why,
        "band": band_record(camera),
        "geometry": {**asdict(camera.geometry()), "fits": camera.geometry().fits},
        "misfit": misfit,
        "focus": None if truth.focus is None else truth.focus.record(),
        "latency": {
            **asdict(latency),
            "chosen_frames": camera.latency_frames,
            "hypothetical": camera.latency_frames < latency.frames,
            "n_frames": experiment.n_frames,
            "first_steady": first_steady(camera.latency_frames),
            "coded_slots": camera.coded_slots,
            "slots_per_frame": camera.slots_per_frame,
        },
        "ledger": {
            name: {"radiance_w_m2_sr": level, "rows": [asdict(row) for row in camera.ledger(level)]}
            for name, level in levels.items()
        },
        "contrast": camera.contrast if math.isfinite(camera.contrast) else None,
        "contrast_budget": contrast_budget(camera),
        "calibrations": {m.name: str(experiment.choice_of(m)) for m in experiment.methods},
        "densities": {name: densities(camera, each) for name, each in mosaics(experiment).items()},
        "drift": experiment.drift,
        "drift_per_frame": experiment.drift_per_frame,
        "noise_e": probe.noise_e if probe else None,
        "effects": [asdict(each) for each in found],
        "plan": plan_record(skipping) if skipping else None,
        "not_planned": not_planned(1 if experiment.source else experiment.render.instants_per_slot),
    }


def too_short(n_frames: int, latency_frames: int) -> str:
    """Warn that an experiment ends before the steady phase; empty otherwise."""
    from optsim.metrics import first_steady

    steady = first_steady(latency_frames)
    if n_frames > steady:
        return ""
    return f"{n_frames} coded frames end before the steady phase: take {steady + 1} or more (n_frames)"


def scene_effects(probe: Probe, focus: Focus | None, *, polarised: bool) -> list[EffectSize]:
    """Estimate the effects that act during rendering, as far as they are known before."""
    from optsim.camera.effect_sizes import EffectSize, size_of_defocus
    from optsim.camera.effects import ALL

    blur_px = 0.0 if focus is None or focus.choice == "everywhere" else max(focus.near_px, focus.far_px)
    corner_px = focus.corner_px if focus else 0.0
    what = {name: ALL[name].what for name in ("depth_of_field", "objective_distortion", "polarised_scene")}
    if blur_px:
        what["depth_of_field"] += f": {blur_px:.2g} panel pixels at most, here everywhere"
    if corner_px:
        what["objective_distortion"] += f": {corner_px:.2g} panel pixels in the corners"
    rendered = {"objective_distortion": bool(corner_px), "polarised_scene": polarised}
    return [
        replace(size_of_defocus(probe, blur_px), what=what["depth_of_field"]),
        *(EffectSize(name, what[name], None if there else 0.0) for name, there in rendered.items()),
    ]


def not_planned(instants_per_slot: int) -> str:
    """Explain that motion within an instant of the truth is unknown before a render."""
    if instants_per_slot >= FINE_INSTANTS:
        return ""
    grey, white = (size / instants_per_slot for size in BAR_SIZES)
    return (
        f"not planned, since only a render tells how fast things move: with {instants_per_slot} truth instant"
        f"{'s' * (instants_per_slot > 1)} a slot a bar that moves 3 pixels a slot errs by up to {grey:.2g} "
        f"of a frame's noise where it is grey, {white:.2g} where it is white; raise render.instants_per_slot"
    )


def _unknown_last(each: EffectSize) -> tuple[bool, float]:
    return each.size is None, -(each.size or 0.0)


def band_record(camera: CodedCamera) -> dict[str, float]:
    """Collect the numbers of the parts that depend on the wavelength, on axis."""
    wavelength_m = camera.wavelength_m
    return {
        "wavelength_nm": camera.wavelength_nm,
        "photons_per_joule": photons_per_joule(wavelength_m),
        "quantum_efficiency": camera.sensor.efficiency_at(wavelength_m),
        "white_retardance_in_half_waves": camera.modulator.white_rad(wavelength_m) / math.pi,
        "white_over_that_of_a_half_wave": camera.panel_response.white,
        "splitter_leak_over_that_at_550_nm": camera.splitter.growth_of_leak(wavelength_m),
    }


def contrast_budget(camera: CodedCamera) -> list[dict[str, Any]]:
    """List the leaks of a dark panel: on axis, and at the ends of its rows."""
    import numpy as np

    from optsim.camera.parts import leak_budget

    end_m = camera.panel_cols / 2 * camera.modulator.pitch_m
    f_number, x_m = camera.objective.working_f_number, np.array([0.0, end_m])
    budget = leak_budget(camera.splitter, camera.modulator, f_number, x_m, camera.wavelength_m)
    return [
        {"source": source, "leak_on_axis": float(leaks[0]), "leak_at_row_ends": float(leaks[1])}
        for source, leaks in budget.items()
    ]


def plan_record(skipping: Skipping) -> dict[str, Any]:
    """Turn the plan into the record of ``--json`` and of a run's results."""
    return {
        "tolerance": skipping.tolerance,
        "bound": skipping.bound,
        "choices": [asdict(choice) for choice in skipping.choices],
    }


def show(record: dict[str, Any]) -> list[object]:
    """Turn a preview into tables for a terminal."""
    latency = cast("dict[str, Any]", record["latency"])
    items: list[object] = [
        cast("str", record["truth"]).replace("; ", "\n  "),
        f"light of the scene: {record['light']}",
        table("band", _QUANTITY, _band_rows(record["band"])),
        table("geometry", _QUANTITY, _geometry_rows(record["geometry"])),
        table("latency", _QUANTITY, _latency_rows(latency)),
        f"  ({latency['sources']})",
    ]
    if latency["hypothetical"]:
        items.append(
            f"latency of {latency['chosen_frames']} is hypothetical: the smallest physical one is "
            f"{latency['frames']} frames"
        )
    if not latency["keeps_up"]:
        items.append(
            f"frames every {latency['period_s'] * 1e3:.3g} ms are hypothetical: this CCD takes "
            f"{latency['readout_s'] * 1e3:.3g} ms to read one; raise camera.slots_per_frame"
        )
    if short := too_short(latency["n_frames"], latency["chosen_frames"]):
        items.append(short)
    known = cast("dict[str, str]", record["calibrations"])
    items.append("calibration of " + ", ".join(f"{name}: {operator}" for name, operator in known.items()))
    if record["drift"]:
        now = [
            f"{key} {value:g}" if isinstance(value, float) else f"{key} {value}"
            for key, value in flat(record["drift"]).items()
        ]
        items.append(f"after calibration, unknown to decoders, the camera has: {', '.join(now)}")
    if record["drift_per_frame"]:
        rates = [f"{key} {value}" for key, value in flat(record["drift_per_frame"]).items()]
        items.append(f"from frame to frame, unknown to decoders, the camera changes by: {', '.join(rates)}")
    for name, ledger in cast("dict[str, dict[str, Any]]", record["ledger"]).items():
        rows = cast("list[dict[str, Any]]", ledger["rows"])
        items.append(
            table(
                f"photon ledger, {name} ({ledger['radiance_w_m2_sr']:.4g} W m^-2 sr^-1), all-on, no density",
                tuple(rows[0]),
                [tuple(row.values()) for row in rows],
            )
        )
    contrast = "infinite" if record["contrast"] is None else f"{record['contrast']:.3g}"
    rows = [
        tuple(f"{x:.2g}" if isinstance(x, float) else x for x in r.values())
        for r in record["contrast_budget"]
    ]
    items.append(
        table(
            f"contrast of splitter, polarisers and panel: {contrast} on axis; light that a dark panel "
            "passes, over that of a bright one",
            ("source, all else perfect", "on axis", "at the ends of the rows"),
            rows,
        )
    )
    items += _density_tables(record["densities"])
    if record["plan"]:
        items += _what_matters(record)
        items += [record["not_planned"]] if record["not_planned"] else []
    else:
        items.append(f"the geometry does not fit, so this experiment cannot be run: {record['misfit']}")
    return items


def _density_tables(found: dict[str, list[dict[str, Any]]]) -> list[object]:
    """One table for all methods whose mosaics have the same exposures."""
    names: dict[tuple[tuple[Any, ...], ...], list[str]] = {}
    for name, rows in found.items():
        names.setdefault(tuple(tuple(row.values()) for row in rows), []).append(name)
    return [
        table(
            f"exposures of the mosaic ({', '.join(which)}), in slots of a panel held open; leak and "
            "transitions of the panel are what they are more or less",
            ("commanded", "effective", "effective over commanded"),
            [(commanded, made, made / commanded) for commanded, made in rows],
        )
        for rows, which in names.items()
    ]


def _band_rows(band: dict[str, float]) -> list[Row]:
    return [
        ("wavelength", band["wavelength_nm"], "nm"),
        ("photons a joule", band["photons_per_joule"], "J^-1"),
        ("quantum efficiency", band["quantum_efficiency"], "e- a photon"),
        ("retardance of the panel's white", band["white_retardance_in_half_waves"], "half waves"),
        ("light of this white", band["white_over_that_of_a_half_wave"], "of that at half a wave"),
        ("leak of the splitter", band["splitter_leak_over_that_at_550_nm"], "of that at 550 nm"),
    ]


def _geometry_rows(geometry: dict[str, Any]) -> list[Row]:
    def both(name: str) -> str:
        return f"{geometry[name.format('rows')]:.4g} x {geometry[name.format('cols')]:.4g}"

    return [
        ("panel pixels used", both("panel_{}"), "rows x columns"),
        ("panel pixels there are", both("modulator_{}"), "rows x columns"),
        ("most that would fit", both("largest_panel_{}"), "rows x columns"),
        ("CCD pixels", both("ccd_{}"), "rows x columns"),
        ("image of the used panel", both("footprint_{}_px"), "CCD pixels"),
        ("margin on the narrower side", both("margin_{}_px"), "CCD pixels"),
        ("ratio", f"{geometry['ratio']:.4g}", "CCD pixels a panel pixel"),
        (
            "centre-pixel error repeats after",
            f"{geometry['moire_period_px'] or 0:.4g}",
            "panel pixels (0: aligned)",
        ),
        ("cone that the relay's stop passes", f"{geometry['relay_accepts']:.4g}", "share"),
        ("fits", "yes" if geometry["fits"] else "no", ""),
    ]


def _latency_rows(latency: dict[str, Any]) -> list[Row]:
    steps = ("readout", "transfer", "computation", "display", "slack", "period")
    return [
        ("chosen", latency["chosen_frames"], "coded frames"),
        ("smallest physical one", latency["frames"], "coded frames"),
        ("coded slots", latency["coded_slots"], f"of {latency['slots_per_frame']} in a period"),
        ("steady from", latency["first_steady"], f"of frames 0 to {latency['n_frames'] - 1}"),
        *((step, latency[f"{step}_s"], "s") for step in steps),
    ]


def _unknown(effect: str) -> str:
    """Say why an effect's size is unknown."""
    from optsim.camera.effects import ALL

    if effect not in ALL:
        return "not predicted"
    return "needs a render" if ALL[effect].in_scene else "every pixel clips"


def _what_matters(record: dict[str, Any]) -> list[object]:
    """Table of effects and plan."""
    effects, plan = cast("list[dict[str, Any]]", record["effects"]), cast("dict[str, Any]", record["plan"])
    noise_e = cast("dict[str, tuple[float, float]]", record["noise_e"])
    noises = "; ".join(f"{name} {all_e:.3g} ({light_e:.3g})" for name, (all_e, light_e) in noise_e.items())
    return [
        table(
            "what each imperfection changes in a frame, rms, in units of the frame's noise, for the method "
            "of which it is largest. Predicted on a small made scene, good to a factor of three. Noise, e-, "
            f"and what of it is the light's own: {noises}",
            ("effect", "size in noise", "of", "what it is"),
            [
                (
                    row["effect"],
                    _unknown(row["effect"]) if row["size"] is None else row["size"],
                    row["scheme"] or "",
                    row["what"],
                )
                for row in effects
            ],
        ),
        table(
            f"what is left out: at most {plan['bound']:.2g} of a frame's noise (tolerance "
            f"{plan['tolerance']:g})",
            ("what", "left out", "error in noise", "what it is", "saves"),
            [(c["skip"], c["skipped"], c["bound"], c["what"], c["saves"]) for c in plan["choices"]],
        ),
    ]
