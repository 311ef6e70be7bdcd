"""Claims registered before their measurement, and their verdicts from several draws.

Registered 2026-11-30, before any draw of this form. The older forms named the rivals of the first two claims.

1. Where pixels move, no rival is better than the adaptive scheme by more than 0.3 dB.
2. Where pixels are static, no rival is better by more than 0.3 dB.
3. No rival has a smaller error of the logarithm, over everything, by more than 0.01 stops (the tie band).

Rivals are all other schemes of the run; of figure 4, where ``make claims`` measures. Each is judged in the
steady phase on the pixels that both methods of its own pair hold valid, for the room and the bright outside
separately. A draw is a run with its own seed (bench, codes, photons) at its own phase of the motion. The
draws give a Student interval of 95 % of each advantage, all rivals together (Bonferroni).

A claim *holds* when all intervals keep the bound, *fails* when one lies wholly beyond it, and is *undecided*
otherwise. Where all intervals lie above 0 the adaptive scheme is *superior* as well; it is not where one lies
wholly below. Fewer than six draws are *too few*, whatever their finding, which is said. A failure is
published, and nothing is tuned to avoid it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from optsim.metrics.log_error import LogRmse
from optsim.metrics.pairs import advantage
from optsim.metrics.pu21 import Pu21Psnr
from optsim.metrics.records import AREAS, Area, PairRecord, Region, Verdict
from optsim.metrics.student import half_width

ADAPTIVE = "adaptive"
"""Name of the method that the claims are about."""
LEAST_DRAWS = 6


@dataclass(frozen=True)
class Claim:
    """The adaptive scheme is at most ``margin`` (in the metric's unit) behind any rival."""

    words: str
    metric: str
    unit: str
    region: Region
    margin: float


CLAIMS = (
    Claim("adaptive is within 0.3 dB of the best rival where it moves", Pu21Psnr().name, "dB", "moving", 0.3),
    Claim(
        "adaptive is within 0.3 dB of the best rival where it is static", Pu21Psnr().name, "dB", "static", 0.3
    ),
    Claim("no rival has a smaller error, in stops", LogRmse().name, "stops", "all", 0.01),
)


@dataclass(frozen=True)
class _Rival:
    """Result of the draws for one rival."""

    name: str
    mean: float
    low: float | None
    high: float | None
    draws: int
    excluded: float
    mean_of_all: float | None


def judge_claims(draws: Sequence[Sequence[PairRecord]], no_rivals: Collection[str] = ()) -> list[Verdict]:
    """Judge the registered claims from the pairs of several independent runs.

    Parameters
    ----------
    draws : sequence of sequence of PairRecord
        Pairs of each run, from :func:`optsim.metrics.pair_records`.
    no_rivals : collection of str
        Methods that share the adaptive one's code but not its decoder, or have another calibration.

    Returns
    -------
    list of Verdict
        One for each claim and area in which any draw has a score; one without a score where none has.
    """
    records = [r for draw in draws for r in draw]
    areas: tuple[Area, ...] = tuple(a for a in AREAS if any(r.area == a for r in records)) or AREAS[:1]
    rivals = [r for r in records if r.rival not in no_rivals]
    found: list[Verdict] = []
    for claim in CLAIMS:
        judged = [_judge(claim, area, rivals) for area in areas]
        found += [v for v in judged if v.rival is not None] or judged[:1]
    return found


def _judge(claim: Claim, area: Area, records: Sequence[PairRecord]) -> Verdict:
    wanted = claim.metric, claim.region, area
    of_claim: dict[str, list[PairRecord]] = {}
    for r in records:
        if (r.metric, r.region, r.area) == wanted:
            of_claim.setdefault(r.rival, []).append(r)
    judged = [_rival(name, found, len(of_claim)) for name, found in of_claim.items()]
    rivals = [rival for rival in judged if rival is not None]
    found = _finding(rivals, -claim.margin)
    deciding = min(rivals, key=lambda rival: _worst(rival, fails=found == "fails"), default=None)
    return Verdict(
        claim=claim.words,
        metric=claim.metric,
        unit=claim.unit,
        region=claim.region,
        area=area,
        rival=deciding.name if deciding else None,
        verdict=found,
        superior=_finding(rivals, 0.0),
        rivals=max(1, len(of_claim)),
        registered=LEAST_DRAWS,
        advantage=deciding.mean if deciding else None,
        low=deciding.low if deciding else None,
        high=deciding.high if deciding else None,
        margin=claim.margin,
        draws=deciding.draws if deciding else 0,
        excluded=deciding.excluded if deciding else None,
        advantage_of_all=deciding.mean_of_all if deciding else None,
    )


def _rival(name: str, records: Sequence[PairRecord], n_rivals: int) -> _Rival | None:
    """Mean advantage over a rival and its interval; None where no draw has a score of it."""
    found = [value for r in records if (value := advantage(r)) is not None]
    of_all = [value for r in records if (value := advantage(r, of_all=True)) is not None]
    if not found:
        return None
    mean, low, high = float(np.mean(found)), None, None
    if (half := half_width(found, n_rivals)) is not None:
        low, high = mean - half, mean + half
    excluded = float(np.mean([r.excluded for r in records]))
    return _Rival(name, mean, low, high, len(found), excluded, float(np.mean(of_all)) if of_all else None)


def _worst(rival: _Rival, *, fails: bool) -> float:
    """Return the end of an interval that decides: the upper where a claim fails, else the lower."""
    end = rival.high if fails else rival.low
    return rival.mean if end is None else end


def _finding(rivals: Sequence[_Rival], bound: float) -> Literal["holds", "fails", "undecided"]:
    """Say whether the advantage over every rival is at least a bound."""
    judged = [(r.low, r.high) for r in rivals if r.low is not None and r.high is not None]
    if any(high < bound for _, high in judged):
        return "fails"
    whole = len(judged) == len(rivals) > 0
    return "holds" if whole and all(low >= bound for low, _ in judged) else "undecided"


def measured(verdict: Verdict) -> str:
    """Describe a measurement: the advantage over the rival that decides, its interval, and its basis."""
    if verdict.advantage is None:
        return "not measured: it needs the steady phase of both methods"
    digits, unit = (2, "dB") if verdict.unit == "dB" else (3, verdict.unit)
    said = f"{verdict.advantage:+.{digits}f} {unit} over {verdict.rival}"
    if verdict.low is not None and verdict.high is not None:
        together = f" for {verdict.rivals} rivals together (Bonferroni)" if verdict.rivals > 1 else ""
        ends = f"{verdict.low:+.{digits}f} to {verdict.high:+.{digits}f}"
        said += f" ({ends}, {verdict.draws} draws, 95 %{together})"
    else:
        said += f" in one draw of the {verdict.registered} that a verdict takes"
    if verdict.excluded:
        said += f"; without {verdict.excluded:.1%} of pixels that one of both gives up"
        if verdict.advantage_of_all is not None:
            said += f", {verdict.advantage_of_all:+.{digits}f} with them"
    return said
