"""Every imperfection of the camera by name: its ideal, nominal and pessimistic state.

Nominal is the hardware as in its data sheet. A switch changes fields of parts; values set by hand in the same
table override it. Pessimistic values have no source unless the part or the hardware states one: they are this
project's judgement of a bad specimen.

Shot noise has no switch: it belongs to the light, and only more light reduces it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from optsim.camera.camera import CodedCamera
from optsim.core.config import Part, Table
from optsim.core.errors import ConfigError, unknown_name

_SHARP = {"spherical_waves": 0.0, "coma_waves": 0.0, "astigmatism_waves": 0.0, "curvature_waves": 0.0}
_TWICE = {"spherical_waves": 0.14, "coma_waves": 0.278, "astigmatism_waves": 0.278, "curvature_waves": 0.278}
STATES = ("ideal", "nominal", "pessimistic")
# Common words for a switch, accepted as hints.
_OFF = {"off", "none", "no", "false", "0", "disabled", "perfect", "skip", "skipped"}
_ON = {"on", "yes", "true", "1", "enabled", "default", "normal", "real"}
Changes = Mapping[str, Mapping[str, Any]]
ITSELF = "camera"
"""Stands for the camera where parts are named."""


@dataclass(frozen=True)
class Effect:
    """An imperfection that can be switched.

    Parameters
    ----------
    what : str
        Short description.
    ideal, pessimistic : mapping
        Part -> field -> value; :data:`ITSELF` is the part of the camera's own fields.
    in_scene : bool
        Whether it acts where light is rendered, so that its size depends on the scene
        (``experiment/focus.py``, ``experiment/truth.py``).
    drifts : bool
        Whether it arises after the calibration, unknown to decoders (``Experiment.drift``). The values are
        then added to the camera's. Ideal and nominal cameras stay as calibrated.
    counts : mapping
        Part -> fields whose drift counts as this effect, beside those of ``pessimistic``.
    """

    what: str
    ideal: Changes
    pessimistic: Changes
    in_scene: bool = False
    drifts: bool = False
    counts: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])


ALL: dict[str, Effect] = {
    "contrast": Effect(
        "light that a dark pixel lets through",
        {
            "modulator": {"depolarised_share": 0.0, "gap_reflectivity": 0.0},
            # Perfect polarisers: the cube may leak and shade as it does.
            "splitter": {"cleanup_contrast": 1e12, "placement": "collimated"},
        },
        {"modulator": {"depolarised_share": 0.09, "gap_reflectivity": 0.1}},
    ),
    "response": Effect(
        "response time of the liquid crystal, with its history",
        {"modulator": {"tau_on_s": 0.0, "tau_off_s": 0.0}},
        {"modulator": {"tau_on_s": 1.0e-3, "tau_off_s": 1.4e-3}},
    ),
    # Differences of the drive change white, at the top of its sine, by half a percent of the light at most.
    # Ripple of the light is not modelled, neither from slot to slot nor within one.
    "fields": Effect(
        "colour fields and polarities that are driven differently",
        {"modulator": {"field_drive": (1.0, 1.0, 1.0), "polarity_drive": 0.0}},
        {"modulator": {"field_drive": (1.03, 1.0, 0.97), "polarity_drive": 0.03}},
    ),
    "row_scan": Effect(
        "rows that are written one after the other",
        {"modulator": {"scan_s": 0.0}},
        {"modulator": {"scan_s": 1.7e-3}},
    ),
    "sync": Effect(
        "a panel that is late on the shutter's clock, or early, with jitter",
        {"modulator": {"delay_s": 0.0, "jitter_s": 0.0}},
        {"modulator": {"delay_s": 0.5e-3, "jitter_s": 0.12e-3}},
    ),
    "fringing": Effect(
        "fringing fields between panel pixels",
        {"modulator": {"fringing_px": 0.0}},
        {"modulator": {"fringing_px": 0.24}},
    ),
    "panel_uniformity": Effect(
        "reflectivity that varies over the panel, and stuck pixels",
        {"modulator": {"nonuniformity_rms": 0.0, "stuck_share": 0.0}},
        {"modulator": {"nonuniformity_rms": 0.05, "stuck_share": 1e-4}},
    ),
    "splitter_shading": Effect(
        "splitter that passes less at the ends of the rows",
        {"splitter": {"acceptance_rad": 1.0}},
        {"splitter": {"acceptance_rad": 0.02}},
    ),
    # No source for 50 nm: at 450 and 650 nm four times the leak that the nominal coating adds.
    "splitter_colour": Effect(
        "splitter that leaks more, and passes less, far from 550 nm; nothing in 550 nm",
        {"splitter": {"chromatic_m": 1.0}},
        {"splitter": {"chromatic_m": 50e-9}},
    ),
    "polarised_scene": Effect(
        "light that gloss polarised, seen through the splitter",
        {"splitter": {"scene_light": "unpolarised"}},
        {"splitter": {"scene_light": "polarised"}},
        in_scene=True,
    ),
    "vignetting": Effect(
        "vignetting of the objective, natural and by its mounts",
        {"objective": {"natural_vignetting": False, "clipped_share": 0.0}},
        {"objective": {"clipped_share": 0.2}},
    ),
    # 0.1 dioptres, 7 m taken for 4 m, is a focus set by eye; 3 % is a cheap wide-angle lens: no source.
    "depth_of_field": Effect(
        "defocus by depth, of a thin lens",
        {"objective": {"focus_m": "everywhere"}},
        {"objective": {"defocus_per_m": 0.1}},
        in_scene=True,
    ),
    "objective_distortion": Effect(
        "distortion of the objective",
        {"objective": {"distortion": 0.0}},
        {"objective": {"distortion": -0.03}},
        in_scene=True,
    ),
    "objective_blur": Effect(
        "diffraction and aberrations of the objective, over the field",
        {"objective": {"aberration_m": 0.0, "diffraction": False, "wavefront": _SHARP}},
        {"objective": {"aberration_m": 4e-6, "wavefront": _TWICE}},
    ),
    "relay_blur": Effect(
        "diffraction and aberrations of the relay, over the field",
        {"relay": {"aberration_m": 0.0, "diffraction": False, "wavefront": _SHARP}},
        {"relay": {"aberration_m": 4e-6, "wavefront": _TWICE}},
    ),
    "objective_glare": Effect(
        "veiling glare of the objective",
        {"objective": {"glare_share": 0.0}},
        {"objective": {"glare_share": 0.01}},
    ),
    "relay_glare": Effect(
        "veiling glare of the relay",
        {"relay": {"glare_share": 0.0}},
        {"relay": {"glare_share": 0.01}},
    ),
    "ghost": Effect(
        "light that comes back mirrored and out of focus",
        {"relay": {"ghost_share": 0.0}},
        {"relay": {"ghost_share": 0.01}},
    ),
    "distortion": Effect(
        "distortion and keystone of the relay",
        {"relay": {"distortion": 0.0, "keystone_y": 0.0, "keystone_x": 0.0}},
        {"relay": {"distortion": -0.01, "keystone_y": 0.002}},
    ),
    # The bench measures it with the pixel map; later motion is an experiment's drift. No source for any: a
    # CCD pixel each way, the most that reading the centre of three allows, a millimetre in a metre, lenses
    # within 0.3 % of their focal length, and a blur of a CCD pixel at f/8. Smaller rather than larger, since
    # the prototype's image just fits its CCD.
    "alignment": Effect(
        "panel imaged onto the CCD shifted, turned, at another scale and out of focus",
        {
            "relay": {
                "shift_y_px": 0.0,
                "shift_x_px": 0.0,
                "rotation_rad": 0.0,
                "magnification_error": 0.0,
                "defocus_m": 0.0,
            }
        },
        {
            "relay": {
                "shift_y_px": 1.0,
                "shift_x_px": 1.0,
                "rotation_rad": 1e-3,
                "magnification_error": -3e-3,
                "defocus_m": 36e-6,
            }
        },
    ),
    # The bench's own map error is in every calibration; this is later motion. 0.4 CCD pixels: no source.
    "misregistration": Effect(
        "panel that moved, turned or went out of focus on the CCD since it was calibrated",
        {},
        {"relay": {"shift_x_px": 0.4}},
        drifts=True,
        counts={
            "relay": (
                "shift_y_px",
                "rotation_rad",
                "magnification_error",
                "keystone_y",
                "keystone_x",
                "distortion",
                "defocus_m",
            )
        },
    ),
    # A twentieth of the exponent is 8 % of a density of a quarter; no source.
    "grey_curve": Effect(
        "grey levels of the panel that changed since it was calibrated; shipped schemes show none",
        {},
        {"modulator": {"drive_exponent": 0.05}},
        drifts=True,
    ),
    "lost_fields": Effect(
        "slots lost to the CCD's readout, if it cannot overlap the next exposure",
        {ITSELF: {"overlap": True}},
        {ITSELF: {"overlap": False}},
    ),
    "lateral_colour": Effect(
        "image of the relay that is larger in red light than in blue; nothing in 550 nm",
        {"relay": {"lateral_colour": 0.0}},
        {"relay": {"lateral_colour": 1.2e-3}},
    ),
    "pixel_response": Effect(
        "CCD pixels that respond differently, in light and in the dark",
        {"sensor": {"prnu": 0.0, "dsnu_e": 0.0}},
        {"sensor": {"prnu": 0.016, "dsnu_e": 3.0}},
    ),
    "smear": Effect(
        "light that gets under the shield while the CCD is read out",
        {"sensor": {"smear_share": 0.0}},
        {"sensor": {"smear_share": 1e-2}},
    ),
    "dark_current": Effect(
        "dark current: electrons without light",
        {"sensor": {"dark_current_e_s": 0.0}},
        {"sensor": {"dark_current_e_s": 10.0}},
    ),
    "bend": Effect(
        "response that bends below the full well",
        {"sensor": {"bend_at_full_well": 0.0}},
        {"sensor": {"bend_at_full_well": 0.06}},
    ),
    # 15 e-: no source.
    "read_noise": Effect(
        "noise of the CCD's output, without any light",
        {"sensor": {"read_noise_e": 0.0}},
        {"sensor": {"read_noise_e": 15.0}},
    ),
    # 16 bits are the finest that frames hold. Two fewer than nominal have a source for both sensors: 12 in
    # the published simulation of the ICX674, 10 in a camera with the IMX174 (Grasshopper3 Technical
    # Reference).
    "quantisation": Effect(
        "rounding to whole digital numbers; ideal: 16 bits",
        {"sensor": {"finer_bits": 8}},
        {"sensor": {"finer_bits": -2}},
    ),
}


def switched(switches: Mapping[str, object]) -> dict[str, dict[str, Any]]:
    """Fields of parts changed by a table of switches."""
    changes: dict[str, dict[str, Any]] = {}
    for name, state in switches.items():
        if name != "all" and name not in ALL:
            raise unknown_name("camera.effects", name, ["all", *ALL])
        if state not in STATES:
            got = str(state).lower() if isinstance(state, bool) else str(state)
            meant = "ideal" if got.lower() in _OFF else "nominal" if got.lower() in _ON else None
            error = unknown_name(f"state of camera.effects.{name}", got, STATES, meant)
            raise ConfigError(f"{error} ideal switches an effect off, nominal is the hardware as it is.")
    for name, effect in ALL.items():
        state = switches.get(name, switches.get("all", "nominal"))
        chosen = {"ideal": effect.ideal, "pessimistic": effect.pessimistic}.get(str(state), {})
        for part, fields in () if effect.drifts else chosen.items():
            changes.setdefault(part, {}).update(fields)
    return changes


def drifted(camera: CodedCamera, switches: Mapping[str, object]) -> Table:
    """Return the changes after the calibration, as ``drift``; switches as checked before."""
    drift: dict[str, dict[str, Any]] = {}
    for name, effect in ALL.items():
        if effect.drifts and switches.get(name, switches.get("all")) == "pessimistic":
            for part, fields in effect.pessimistic.items():
                for key, more in fields.items():
                    drift.setdefault(part, {})[key] = getattr(getattr(camera, part), key) + more
    return drift


def with_effects(camera: CodedCamera, switches: Mapping[str, object]) -> CodedCamera:
    """Return a camera with effects switched; arguments as of :func:`switched`."""
    return changed(camera, switched(switches))


def changed(camera: CodedCamera, changes: Changes) -> CodedCamera:
    """Return a camera with other values in fields of its parts, and in its own."""
    parts = {
        part: _updated(getattr(camera, part), fields) for part, fields in changes.items() if part != ITSELF
    }
    return camera.model_copy(update={**parts, **changes.get(ITSELF, {})})


def _updated(part: Part, fields: Mapping[str, Any]) -> Part:
    """Return a part with other fields; a table changes the existing part."""
    values = {
        name: _updated(getattr(part, name), cast("Mapping[str, Any]", value))
        if isinstance(value, Mapping)
        else value
        for name, value in fields.items()
    }
    return part.model_copy(update=values)
