"""The hypothesis registered before anything was measured, and its verdict."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TypedDict

from optsim.metrics.log_error import LogRmse
from optsim.metrics.pu21 import Pu21Psnr
from optsim.metrics.scoring import TRUTH_NOISE, Region, ScoreRecord

BOUND_DB = 0.3
_OF_WHAT = "in the steady phase, by the experiment's calibration"


class Verdict(TypedDict):
    """One registered claim: ``margin`` is how far it is from failing, in ``unit``; None if not measurable."""

    claim: str
    metric: str
    region: Region
    measured: str
    margin: float | None
    unit: str
    passed: bool | None


def judge_hypothesis(
    records: Sequence[ScoreRecord],
    *,
    adaptive: str = "adaptive",
    random: str = "random",
    hdr_mosaic: str = "hdr_mosaic",
    no_rivals: Collection[str] = (),
) -> list[Verdict]:
    """Judge the three registered claims on the steady phase: a failure is published, not tuned away.

    Parameters
    ----------
    records : sequence of ScoreRecord
        From :meth:`optsim.metrics.ScoreBoard.records`.
    adaptive, random, hdr_mosaic : str
        Names of the methods that the claims speak of.
    no_rivals : collection of str
        Methods that code as the adaptive one does and decode otherwise: it need not beat itself.
    """
    return [
        _near(records, "moving", adaptive, random, "full random exposure where it moves"),
        _near(records, "static", adaptive, hdr_mosaic, "the HDR mosaic where it is static"),
        _best(records, adaptive, no_rivals),
    ]


def _near(records: Sequence[ScoreRecord], region: Region, ours: str, theirs: str, words: str) -> Verdict:
    metric = Pu21Psnr()
    values = _values(records, metric.name, region)
    margin = None
    measured = f"not measured: both methods need a score {_OF_WHAT}"
    if ours in values and theirs in values:
        difference = values[ours] - values[theirs]
        margin = difference + BOUND_DB
        measured = f"{difference:+.2f} dB ({values[ours]:.2f} against {values[theirs]:.2f})"
    return {
        "claim": f"adaptive is within {BOUND_DB} dB of {words}",
        "metric": metric.name,
        "region": region,
        "measured": measured,
        "margin": margin,
        "unit": metric.unit,
        "passed": None if margin is None else margin >= 0,
    }


def _best(records: Sequence[ScoreRecord], ours: str, no_rivals: Collection[str]) -> Verdict:
    metric = LogRmse()
    values = _values(records, metric.name, "all")
    others = {name: value for name, value in values.items() if name not in {ours, *no_rivals}}
    margin = None
    measured = f"not measured: it needs scores of at least two methods {_OF_WHAT}"
    if ours in values and others:
        rival = min(others, key=others.__getitem__)
        margin = others[rival] - values[ours]
        measured = f"{-margin:+.3f} stops ({values[ours]:.3f} against {others[rival]:.3f} of {rival})"
    return {
        "claim": "adaptive has the smallest error overall, in stops",
        "metric": metric.name,
        "region": "all",
        "measured": measured,
        "margin": margin,
        "unit": metric.unit,
        "passed": None if margin is None else margin > 0,
    }


def _values(records: Sequence[ScoreRecord], metric: str, region: Region) -> dict[str, float]:
    return {
        r["method"]: r["value"]
        for r in records
        if r["metric"] == metric
        and r["region"] == region
        and r["phase"] == "steady"
        and r["value"] is not None
        and r["method"] != TRUTH_NOISE
    }
