"""Schema of results.json: the single source of every number in a report (``schema_version`` 2).

A missing number is null, never NaN or infinity. Shares are 0..1; times, lengths and light are SI with the
unit in the name. Sections that a run cannot fill are empty lists or null, and the report says so.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, ValidationError

from optsim.core.errors import ValueCheckError
from optsim.metrics.error_maps import LuminanceBin, Place
from optsim.metrics.records import (
    ClassSeries,
    Coverage,
    MaskScore,
    PairRecord,
    PooledMask,
    Reading,
    Record,
    Score,
    Series,
    Temporal,
    Uncertainty,
    Verdict,
)

SCHEMA_VERSION = 2
RESULTS = "results.json"
"""Name of the file in a run's folder."""

Scalar = str | int | float | bool | None
Cell = Scalar | list[Scalar]
Section = Literal["compare", "capture", "errors"]


class StageTime(Record):
    """One stage of the run."""

    stage: str
    wall_s: float
    cpu_s: float
    peak_rss_mb: float
    peak_is_of_this_stage: bool


class Resumed(Record):
    """Coded frames of all methods that an interrupted run stored."""

    captured: int
    scored: int


class LightRecord(Record):
    """The fixed light rule and its result, the same for all methods."""

    statement: str
    nd_transmission: float
    wanted_transmission: float
    percentile_dn: float
    saturation_dn: float


class Photons(Record):
    """Light of a method: mean and 5th percentile of photoelectrons a CCD pixel and coded frame.

    ``negative_light``: CCD pixels, over all frames, whose unbiased light was below zero and was clipped.
    """

    method: str
    mean_e: float
    dark_e: float
    saturated_share: float
    negative_light: int


class Ledger(Record):
    """One photon ledger: rows as ``dataclasses.asdict`` of the camera's rows, all with the same keys."""

    name: str
    radiance_w_m2_sr: float
    rows: list[dict[str, Cell]]


class Latency(Record):
    """Latency of the loop in coded frames."""

    frames: int
    smallest_physical: int
    hypothetical: bool
    details: dict[str, Cell]


class SceneFacts(Record):
    """Facts on the scene; ratios are 95th percentile of the window over 5th of the interior."""

    name: str
    variation: str
    description: str
    light: str
    wavelength_nm: float
    white_w_m2_sr: float
    white_cd_m2: float
    window_interior_ratio_before_glare: float | None
    window_interior_ratio_after_glare: float | None


class PlanChoice(Record):
    """Whether one effect is skipped; ``bound`` is the largest rms error of a frame, relative to its noise."""

    skip: str
    what: str
    saves: str
    skipped: bool
    bound: float


class SkipPlan(Record):
    """Effects skipped in the camera's model, and their largest error, relative to a frame's noise."""

    tolerance: float
    bound: float
    choices: list[PlanChoice]


class EvidenceRow(Record):
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


class LegendEntry(Record):
    """One colour of an image and its meaning."""

    colour: str
    meaning: str


class Picture(Record):
    """An image file below the run folder, and its place in the report."""

    file: str
    caption: str
    section: Section
    group: str
    label: str
    width: int
    height: int
    legend: list[LegendEntry] = Field(default_factory=list[LegendEntry])


class ViewerFrame(Record):
    """A coded frame in the viewer: scripts below the run folder, of the truth and of each method."""

    index: int
    why: str
    truth: str
    methods: dict[str, str]


class Viewer(Record):
    """Light of the coded frames that the page shows; the files hold codes c of 16 bits.

    Luminance is ``floor_cd_m2 * (2 ** (c / steps_per_stop) - 1)``, off by at most ``largest_error`` of
    luminance plus floor. ``start_white_cd_m2`` is displayed as white at first.
    """

    rows: int
    cols: int
    slots: int
    slot_s: float
    steps_per_stop: int
    floor_cd_m2: float
    largest_error: float
    e_cd_m2: float
    white_cd_m2: float
    start_white_cd_m2: float
    frames: list[ViewerFrame]


class CalibrationFile(Record):
    """File in the run's folder that relates the frames of some methods (CCD) to their codes (panel)."""

    calibration: str
    file: str
    sha256: str
    methods: list[str]


class Results(Record):
    """All content of a report."""

    schema_version: Literal[2]
    title: str
    experiment: dict[str, Any]
    command: str
    finished_utc: str
    versions: dict[str, str]
    run_key: str
    commit: str | None
    exported_truth: bool
    backend: str
    seeds: dict[str, int]
    timings: list[StageTime]
    resumed: Resumed
    light_rule: LightRecord
    photons: list[Photons]
    ledgers: list[Ledger]
    geometry: dict[str, Cell]
    latency: Latency
    scene: SceneFacts
    methods: dict[str, str]
    calibrations: dict[str, str]
    calibration_files: list[CalibrationFile]
    scores: list[Score]
    coverage: list[Coverage]
    frame_series: list[Series]
    slot_series: list[Series]
    class_series: list[ClassSeries]
    temporal: list[Temporal]
    readings: list[Reading]
    uncertainty: list[Uncertainty]
    masks: list[MaskScore]
    pooled_masks: list[PooledMask]
    noise_ceiling: list[Score]
    pairs: list[PairRecord]
    claims: list[Verdict]
    plan: SkipPlan
    evidence: list[EvidenceRow]
    not_modelled: list[str]
    reconstruct_s: dict[str, float]
    pictures: list[Picture]
    viewer: Viewer
    by_luminance: list[LuminanceBin]
    worst_places: list[Place]

    @property
    def files(self) -> list[str]:
        """Files below the run folder that the page shows."""
        found = [picture.file for picture in self.pictures]
        for frame in self.viewer.frames:
            found += [frame.truth, *frame.methods.values()]
        return found


def check_results(results: object, where: object = RESULTS) -> Results:
    """Check a results record, which lies at ``where``, against the schema.

    Raises
    ------
    ValueCheckError
        One line a problem: place, value found, value expected.
    """
    try:
        return Results.model_validate(results)
    except ValidationError as error:
        lines = [
            f"  {'.'.join(map(str, item['loc']))}: {item['msg']}"
            + ("" if item["type"] == "missing" else f"; got {str(item['input'])[:60]!r}")
            for item in error.errors()
        ]
        raise ValueCheckError(
            f"{where} is not of schema version {SCHEMA_VERSION}: {len(lines)} problems\n" + "\n".join(lines)
        ) from None
