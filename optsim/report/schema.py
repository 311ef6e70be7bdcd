"""What results.json holds: the single source of every number in a report (``schema_version`` 2).

A missing number is null, never NaN or infinity. Shares are 0..1; times, lengths and light are SI with the
unit in the name. Sections that a run cannot fill are empty lists or null, and the report says so.
"""

from __future__ import annotations

from typing import Any, Literal, NotRequired

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from optsim.core.errors import ValueCheckError
from optsim.metrics.claims import Verdict
from optsim.metrics.pairs import PairRecord

SCHEMA_VERSION = 2
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Scalar = str | int | float | bool | None
Cell = Scalar | list[Scalar]
Region = Literal["all", "moving", "static"]
Phase = Literal["warm-up", "merging", "steady"]
Section = Literal["compare", "crops", "moving", "capture", "errors"]


@with_config(_STRICT)
class StageTime(TypedDict):
    """One stage of the run."""

    stage: str
    wall_s: float
    cpu_s: float
    peak_rss_mb: float
    peak_is_of_this_stage: bool


@with_config(_STRICT)
class Resumed(TypedDict):
    """Coded frames of all methods that an interrupted run had left."""

    captured: int
    scored: int


@with_config(_STRICT)
class LightRule(TypedDict):
    """The fixed light rule and what it decided, the same for all methods."""

    statement: str
    nd_transmission: float
    wanted_transmission: float
    percentile_dn: float
    saturation_dn: float


@with_config(_STRICT)
class Photons(TypedDict):
    """Light that a method used: mean and 5th percentile of photoelectrons a CCD pixel and coded frame.

    ``negative_light``: CCD pixels, over all frames, whose unbiased light fell below zero and was clipped.
    """

    method: str
    mean_e: float
    dark_e: float
    saturated_share: float
    negative_light: int


@with_config(_STRICT)
class Ledger(TypedDict):
    """One photon ledger: rows as ``dataclasses.asdict`` of the camera's rows, all with the same keys."""

    name: str
    radiance_w_m2_sr: float
    rows: list[dict[str, Cell]]


@with_config(_STRICT)
class Latency(TypedDict):
    """Latency of the loop in coded frames."""

    frames: int
    smallest_physical: int
    hypothetical: bool
    details: NotRequired[dict[str, Cell]]


@with_config(_STRICT)
class SceneFacts(TypedDict):
    """What was looked at; ratios are 95th percentile of the window over 5th of the interior."""

    name: str
    variation: str
    description: str
    light: str
    wavelength_nm: float
    white_w_m2_sr: float
    white_cd_m2: float
    window_interior_ratio_before_glare: float | None
    window_interior_ratio_after_glare: float | None


@with_config(_STRICT)
class PlanChoice(TypedDict):
    """Whether one thing was left out; ``bound`` is the most that a frame errs, rms, relative to its noise."""

    skip: str
    what: str
    saves: str
    skipped: bool
    bound: float


@with_config(_STRICT)
class Plan(TypedDict):
    """What was left out of the camera's model, and what that costs at most, relative to a frame's noise."""

    tolerance: float
    bound: float
    choices: list[PlanChoice]


@with_config(_STRICT)
class Score(TypedDict):
    """One pooled score, as :class:`optsim.metrics.ScoreBoard` makes it."""

    method: str
    metric: str
    unit: str
    region: Region
    phase: Phase
    value: float | None
    flag: str
    n: int
    higher_is_better: bool
    clamped_share: float


@with_config(_STRICT)
class Coverage(TypedDict):
    """Share of a region that a method was scored on, and of that the share filled from neighbours."""

    method: str
    region: Region
    phase: Phase
    valid: float
    interpolated: float


@with_config(_STRICT)
class Series(TypedDict):
    """A score against coded frame or slot."""

    method: str
    metric: str
    unit: str
    region: Region
    x: list[int]
    values: list[float | None]


@with_config(_STRICT)
class Uncertainty(TypedDict):
    """Errors over the standard deviations that a method states: shares within one and two, and rms."""

    method: str
    region: Region
    phase: Phase
    n: int
    within_one: float | None
    within_two: float | None
    rms: float | None


@with_config(_STRICT)
class MaskScore(TypedDict):
    """The motion mask of a method, or of moving objects, against the oracle in one coded frame."""

    method: str
    frame: int
    precision: float | None
    recall: float | None
    iou: float | None


@with_config(_STRICT)
class PooledMask(TypedDict):
    """Motion masks of a method, or of moving objects, against the oracle: all pixels of a phase together.

    ``moves`` and ``marked`` are shares of all panel pixels. ``precision`` is null where nothing is marked,
    ``recall`` where nothing moves, ``iou`` where both are so.
    """

    method: str
    phase: Phase
    moves: float
    marked: float
    precision: float | None
    recall: float | None
    iou: float | None


@with_config(_STRICT)
class EvidenceRow(TypedDict):
    """State of one modelled effect, as ``optsim.experiment.evidence.status`` gives it."""

    effect: str
    what: str
    validated: bool
    why: str
    claim: str | None
    oracle: str | None
    source: str | None
    measured: float | None
    tolerance: float | None
    reason: str | None


@with_config(_STRICT)
class ColourScale(TypedDict):
    """A labelled colour bar: CSS colours from low to high, evenly spaced."""

    colours: list[str]
    ticks: list[str]
    unit: str


@with_config(_STRICT)
class LegendEntry(TypedDict):
    """One colour of a picture and what it means."""

    colour: str
    meaning: str


@with_config(_STRICT)
class Picture(TypedDict):
    """An image file below the run folder, and where it belongs."""

    file: str
    caption: str
    section: Section
    group: str
    label: str
    width: int
    height: int
    still: NotRequired[str]
    scale: NotRequired[ColourScale]
    legend: NotRequired[list[LegendEntry]]


@with_config(_STRICT)
class CalibrationFile(TypedDict):
    """File of the run's folder that joins the frames of some methods (CCD) with their codes (panel)."""

    calibration: str
    file: str
    sha256: str
    methods: list[str]


@with_config(_STRICT)
class Results(TypedDict):
    """Everything a report is made of."""

    schema_version: Literal[2]
    title: str
    experiment: dict[str, Any]
    command: str
    finished_utc: str
    versions: dict[str, str]
    run_key: NotRequired[str]
    exported_truth: NotRequired[bool]
    backend: str
    seeds: dict[str, int]
    timings: list[StageTime]
    resumed: NotRequired[Resumed]
    light_rule: LightRule
    photons: list[Photons]
    ledgers: list[Ledger]
    geometry: dict[str, Cell]
    latency: Latency
    scene: SceneFacts
    methods: dict[str, str]
    calibrations: NotRequired[dict[str, str]]
    calibration_files: NotRequired[list[CalibrationFile]]
    scores: list[Score]
    coverage: list[Coverage]
    frame_series: list[Series]
    slot_series: list[Series]
    uncertainty: NotRequired[list[Uncertainty]]
    masks: list[MaskScore]
    pooled_masks: NotRequired[list[PooledMask]]
    noise_ceiling: list[Score]
    pairs: list[PairRecord]
    claims: list[Verdict]
    plan: Plan
    evidence: list[EvidenceRow]
    not_modelled: list[str]
    reconstruct_s: dict[str, float]
    pictures: list[Picture]


def check_results(results: object) -> Results:
    """Check a results record against the schema.

    Raises
    ------
    ValueCheckError
        One line a problem: where, what was got, what was expected.
    """
    try:
        return TypeAdapter(Results).validate_python(results)
    except ValidationError as error:
        lines = [
            f"  {'.'.join(map(str, item['loc']))}: {item['msg']}"
            + ("" if item["type"] == "missing" else f"; got {str(item['input'])[:60]!r}")
            for item in error.errors()
        ]
        raise ValueCheckError(
            f"results.json is not of schema version {SCHEMA_VERSION}: {len(lines)} problems\n"
            + "\n".join(lines)
        ) from None
