"""Record of a trace of one CCD pixel: the content of trace.json, in the order of the light path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class OwnPixel:
    """The panel pixel that a CCD pixel belongs to.

    Parameters
    ----------
    v, u : int
        Row and column on the panel.
    relation : str
        ``picked``: this CCD pixel is the panel pixel's readout pixel in the pixel map. ``most light``:
        another one is, but this CCD pixel receives more light from the panel pixel than from any other, all
        open under uniform light. ``outside``: no panel pixel is imaged here, and this is the nearest one.
    offset_v_px, offset_u_px : float
        Centre of the CCD pixel minus the image of the panel pixel's centre, panel pixels.
    share : float
        Share of this CCD pixel's light from the panel pixel, all open under uniform light, without ghost
        and veil.
    stuck : bool
        Whether the panel pixel is stuck.
    """

    v: int
    u: int
    relation: str
    offset_v_px: float
    offset_u_px: float
    share: float
    stuck: bool


@dataclass(frozen=True)
class Slots:
    """Light, code and electrons in each slot of the exposure; each column has one entry a slot.

    Parameters
    ----------
    own_radiance_w_m2_sr, own_irradiance_w_m2 : tuple of float or None
        Radiance of the scene, and irradiance on the modulator, mean over the part of the own panel pixel that
        the CCD pixel receives; over the whole panel pixel where it receives nothing of it.
    radiance_w_m2_sr, irradiance_w_m2 : tuple of float or None
        The same over the whole panel, weighted by the light that arrives when all is open: the
        relay operator's row, ghost and veil included. None where nothing can arrive.
    level : tuple of int
        Commanded level of the own panel pixel, 0 to 255.
    weight : tuple of float
        Its effective weight, fully on and settled as 1; leak and history included.
    shutter_open : tuple of bool
        Whether the shutter was open.
    origins_e : dict
        Origin -> electrons that it added in each slot; smear comes later and is not included.
    """

    own_radiance_w_m2_sr: tuple[float | None, ...]
    own_irradiance_w_m2: tuple[float | None, ...]
    radiance_w_m2_sr: tuple[float | None, ...]
    irradiance_w_m2: tuple[float | None, ...]
    level: tuple[int, ...]
    weight: tuple[float, ...]
    shutter_open: tuple[bool, ...]
    origins_e: dict[str, tuple[float, ...]]


@dataclass(frozen=True)
class SignalShare:
    """Electrons of one origin.

    Parameters
    ----------
    name, meaning : str
        Name and definition.
    electrons_e : float
        Expected electrons of the frame.
    share : float
        Share of all expected electrons, smear included; 0 where there are none.
    """

    name: str
    meaning: str
    electrons_e: float
    share: float


@dataclass(frozen=True)
class Contributor:
    """Another panel pixel whose light reaches this CCD pixel.

    Parameters
    ----------
    v, u, dv, du : int
        Its place on the panel, and its offset from the own panel pixel.
    electrons_e : float
        Expected electrons from it, without ghost and veil.
    share : float
        Share of all expected electrons.
    even_share : float
        Its share of this CCD pixel's light, all open under uniform light.
    level : tuple of int
        Its commanded level in each slot.
    """

    v: int
    u: int
    dv: int
    du: int
    electrons_e: float
    share: float
    even_share: float
    level: tuple[int, ...]


@dataclass(frozen=True)
class ConvertedReading:
    """Conversion of expected electrons to the digital number; losses are means over the shot noise.

    Parameters
    ----------
    collected_e : float
        Expected electrons before any clip, as the camera computes them.
    lost_at_well_e, smear_e, lost_to_bend_e, dsnu_e : float
        Electrons cut off by the full well, added by smear, removed by the non-linearity, and added by the
        fixed dark pattern.
    signal_e, gain_e, black_dn : float
        Remaining electrons, electrons a digital number, and the black level.
    shot_noise_e, smear_noise_e, read_noise_e, quantisation_noise_e : float
        Standard deviations; for shot noise the part that passes full well and non-linearity.
    sigma_dn, expected_dn : float
        Standard deviation of all noise, and the mean digital number.
    clipped : str
        ``no``, ``at the full well`` or ``by the converter``.
    drawn_dn : int
        The digital number in the frame that a run writes.
    """

    collected_e: float
    lost_at_well_e: float
    smear_e: float
    lost_to_bend_e: float
    dsnu_e: float
    signal_e: float
    gain_e: float
    black_dn: float
    shot_noise_e: float
    smear_noise_e: float
    read_noise_e: float
    quantisation_noise_e: float
    sigma_dn: float
    expected_dn: float
    clipped: str
    drawn_dn: int


@dataclass(frozen=True)
class Trace:
    """One CCD pixel in one exposure, from radiance to digital number.

    Parameters
    ----------
    experiment, fingerprint, method : str
        The run of the trace.
    frame : int
        Coded frame, from 0.
    phase : str
        Phase of the frame: warm-up, merging or steady.
    y, x : int
        The CCD pixel.
    nd_transmission, irradiance_per_radiance : float
        Neutral density of the light rule, and modulator irradiance on axis per radiance behind it.
    target : Target
        The panel pixel that it belongs to.
    slots : Slots
        Slot by slot.
    origins : tuple of Origin
        Origins of its electrons; together ``reading.collected_e + reading.smear_e``, up to the
        rounding of float32 light and weights, below 1e-6 of the whole.
    reading : Reading
        From electrons to the digital number.
    sources : tuple of Source
        Other panel pixels that contribute most, in falling order.
    neighbourhood_e : tuple of tuple of float or None
        Electrons from the panel pixels up to 5 away, without ghost and veil; None beyond the panel's edge.
    notes : tuple of str
        Hints for reading it.
    """

    experiment: str
    fingerprint: str
    method: str
    frame: int
    phase: str
    y: int
    x: int
    nd_transmission: float
    irradiance_per_radiance: float
    target: OwnPixel
    slots: Slots
    origins: tuple[SignalShare, ...]
    reading: ConvertedReading
    sources: tuple[Contributor, ...]
    neighbourhood_e: tuple[tuple[float | None, ...], ...]
    notes: tuple[str, ...]


_RELATIONS = {
    "picked": "is the one that decoders read for panel pixel",
    "most light": "is read by no decoder; it looks most at panel pixel",
    "outside": "lies outside the panel's image, where only glare arrives; the nearest is panel pixel",
}


def open_slots(level: Sequence[int]) -> int:
    """Count the slots in which a panel pixel is commanded to be open."""
    return sum(each > 0 for each in level)


def sentences(trace: Trace) -> tuple[str, str, str]:
    """Describe in three sentences the traced pixel, its panel pixel, and its digital number."""
    target, reading = trace.target, trace.reading
    commanded = f"commanded open in {open_slots(trace.slots.level)} of {len(trace.slots.level)} slots"
    stuck = " and standing still" if target.stuck else ""
    away = round((reading.drawn_dn - reading.expected_dn) / reading.sigma_dn, 1) + 0.0  # never -0.0
    clipped = "" if reading.clipped == "no" else f", clipped {reading.clipped}"
    return (
        f"{trace.experiment}, method {trace.method}, coded frame {trace.frame} ({trace.phase}), "
        f"CCD pixel ({trace.y}, {trace.x})",
        f"The CCD pixel {_RELATIONS[target.relation]} ({target.v}, {target.u}), {commanded}{stuck}.",
        f"Expected {reading.expected_dn:.1f} DN with a noise of {reading.sigma_dn:.1f} DN{clipped}; "
        f"drawn {reading.drawn_dn} DN, {away:+.1f} sigma.",
    )
