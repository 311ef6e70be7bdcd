"""Score rows of results.json, and their common terms: regions, phases, areas.

A missing number is None, never NaN or infinity. Shares are 0..1.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from optsim.metrics.classes import Class

Region = Literal["all", "moving", "static"]
REGIONS: tuple[Region, ...] = ("all", "moving", "static")
Phase = Literal["warm-up", "merging", "steady"]
PHASES: tuple[Phase, ...] = ("warm-up", "merging", "steady")
Area = Literal["room", "window"]
AREAS: tuple[Area, ...] = ("room", "window")


class Record(BaseModel):
    """Part of results.json: frozen, no unknown keys, read by attribute."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def as_json(self) -> dict[str, Any]:
        """Return its content for a JSON file; a key that was not stated is absent."""
        return self.model_dump(mode="json", exclude_unset=True)


class Score(Record):
    """One pooled score; ``value`` is None where ``flag`` says why, or has flag "identical" at zero error.

    ``low`` and ``high`` bound it with 95 % by the scatter of coded frames (Student), None for a single frame.
    """

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
    low: float | None = None
    high: float | None = None

    @property
    def half(self) -> float | None:
        """Half of the interval."""
        return None if self.low is None or self.high is None else (self.high - self.low) / 2


class Coverage(Record):
    """Share of a region that a method holds valid, and of that the share filled from neighbours."""

    method: str
    region: Region
    phase: Phase
    valid: float
    interpolated: float


class Series(Record):
    """A score against coded frame or slot: ``x`` is the index, ``values`` may hold None."""

    method: str
    metric: str
    unit: str
    region: Region
    x: list[int]
    values: list[float | None]


class ClassSeries(Record):
    """Scores of a content class against coded frame; ``scored`` is the share of the class in each frame."""

    method: str
    metric: str
    unit: str
    higher_is_better: bool
    region: Class
    x: list[int]
    values: list[float | None]
    scored: list[float | None]


class Temporal(Record):
    """Scores of single slots: mean, the level that the worst 5 % of slots miss, the worst and its place."""

    method: str
    metric: str
    unit: str
    region: Region
    phase: Phase
    mean: float
    worst_twentieth: float
    worst: float
    worst_frame: int
    worst_slot: int


class Reading(Record):
    """One number of the calibration that set the light; it has one right value."""

    name: str
    value: float
    unit: str


class Uncertainty(Record):
    """Errors over the standard deviations that a method states: shares within one and two, and rms."""

    method: str
    region: Region
    phase: Phase
    n: int
    within_one: float | None
    within_two: float | None
    rms: float | None


class MaskScore(Record):
    """The motion mask of a method, or of moving objects, against the oracle in one coded frame."""

    method: str
    frame: int
    precision: float | None
    recall: float | None
    iou: float | None


class PooledMask(Record):
    """Motion masks of a method, or of moving objects, against the oracle: all pixels of a phase together.

    ``moves`` and ``marked`` are shares of all panel pixels. ``precision`` is None without marked pixels,
    ``recall`` without moving ones, ``iou`` without either.
    """

    method: str
    phase: Phase
    moves: float
    marked: float
    precision: float | None
    recall: float | None
    iou: float | None


class PairRecord(Record):
    """Scores of a pair in the steady phase; ``excluded`` is the share of pixels invalid in either."""

    rival: str
    metric: str
    unit: str
    higher_is_better: bool
    area: Area
    region: Region
    ours: float | None
    theirs: float | None
    excluded: float
    ours_of_all: float | None
    theirs_of_all: float | None


class Verdict(Record):
    """One claim in one area: the rival that decides, the adaptive method's advantage over it, its interval.

    ``advantage`` is a mean over draws; ``low`` and ``high`` bound it, None for a single draw. They hold for
    all ``rivals`` together. ``superior`` says whether it is ahead of all, ``registered`` how many draws were
    to be taken. ``excluded`` is the share of pixels invalid in either of the pair; ``advantage_of_all`` is
    the same on all pixels.
    """

    claim: str
    metric: str
    unit: str
    region: Region
    area: Area
    rival: str | None
    verdict: Literal["holds", "fails", "undecided"]
    advantage: float | None
    low: float | None
    high: float | None
    margin: float
    draws: int
    excluded: float | None
    advantage_of_all: float | None
    superior: Literal["holds", "fails", "undecided"] = "undecided"
    rivals: int = 1
    registered: int = 6

    @property
    def said(self) -> str:
        """The verdict in words, with superiority; too few draws are said before what they found."""
        found = "undecided at these seeds" if self.verdict == "undecided" else self.verdict
        if self.verdict == "holds" or (self.verdict, self.superior) == ("undecided", "fails"):
            ahead = {"holds": "superior", "fails": "not superior", "undecided": "superiority undecided"}
            found += f", {ahead[self.superior]}"
        if self.draws < self.registered:
            return f"too few draws ({self.draws} of {self.registered}): {found}"
        return found
