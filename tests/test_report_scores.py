"""Scores on the report page: their intervals, the content classes, and the verdicts of claims."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_run import METHODS, make_results

from optsim import report
from optsim.metrics import LogRmse, Pu21Psnr

# Student's t of 97.5 % at 3 degrees of freedom, from tables.
T_OF_FOUR = 3.182446


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def results(run_folder: Path) -> dict[str, Any]:
    return make_results(run_folder, 18, 24, 8)


@pytest.fixture(scope="module")
def lean(results: dict[str, Any]) -> dict[str, Any]:
    """Results without what takes long to draw."""
    return {**results, "frame_series": [], "slot_series": []}


def cells(page: str) -> list[tuple[str, str]]:
    """Title and text of each cell of the tables of scores."""
    tables = "".join(re.findall(r'<table class="scores".*?</table>', page, flags=re.S))
    found = re.findall(r'<td class="n" title="([^"]*)">(.*?)</td>', tables, flags=re.S)
    return [(title, re.sub(r"<[^>]+>", "", text)) for title, text in found]


def test_each_score_stands_beside_its_interval(run_folder: Path, lean: dict[str, Any]) -> None:
    shown = cells(report.write_report(run_folder, lean).read_text())
    assert len(shown) == len(lean["scores"])
    wanted = []
    for s in lean["scores"]:
        digits = 3 if s["unit"] == "stops" else 2
        value, low, high = (f"{s[key]:.{digits}f}" for key in ("value", "low", "high"))
        half = f"{(s['high'] - s['low']) / 2:.{digits}f}"
        wanted.append((f"{low} to {high}".replace("-", "−"), f"{value} ± {half}".replace("-", "−")))
    assert sorted(shown) == sorted(wanted)
    assert len({text for _, text in shown}) > 50


def series(method: str, metric: Any, region: str, values: list[float | None]) -> dict[str, Any]:
    return {
        "method": method,
        "metric": metric.name,
        "unit": metric.unit,
        "higher_is_better": metric.higher_is_better,
        "region": region,
        "x": [4, 5, 6, 7],
        "values": values,
        "scored": [1.0] * 4,
    }


def test_content_classes_fold_away_with_means_and_intervals(run_folder: Path, lean: dict[str, Any]) -> None:
    assert 'id="classes"' not in report.write_report(run_folder, lean).read_text()
    told = {
        **lean,
        "class_series": [
            series("adaptive", LogRmse(), "dark", [0.1, 0.2, 0.3, 0.4]),
            series("random", LogRmse(), "dark", [0.5, None, None, None]),
            series("adaptive", Pu21Psnr(), "rim", [31.0, 32.0, 33.0, 34.0]),
            series("random", Pu21Psnr(), "rim", [30.0, 31.0, 32.0, 34.0]),
        ],
    }
    page = report.write_report(run_folder, told).read_text()
    folded = page.split('<details id="classes">')[1].split("</details>")[0]
    assert "coded frames 4 to 7" in folded
    rows = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, flags=re.S) for row in folded.split("<tr")[1:]]
    plain = [[re.sub(r"<[^>]+>", "", cell).strip() for cell in row] for row in rows]
    half = T_OF_FOUR * np.std([1, 2, 3, 4], ddof=1) / 2
    assert plain == [
        ["relative error, stops ↓", *METHODS],
        ["darkest third", f"0.250 ± {half / 10:.3f}", "–", "–", "0.500"],
        ["quality as seen (PSNR), dB ↑", *METHODS],
        [
            "rim of what moves",
            f"32.50 ± {half:.2f}",
            "–",
            "–",
            f"31.75 ± {T_OF_FOUR * np.std([0, 1, 2, 4], ddof=1) / 2:.2f}",
        ],
    ]
    assert re.findall(r'class="value best" data-value="([0-9.]+)"', folded) == ["0.25", "32.5"]


def test_a_claim_that_one_run_cannot_decide_says_so(run_folder: Path, lean: dict[str, Any]) -> None:
    page = report.write_report(run_folder, lean).read_text()
    said = "too few draws (1 of 6): undecided at these seeds"
    assert {claim["draws"] for claim in lean["claims"]} <= {0, 1}
    assert page.count(f'<span class="chip warn">{said}</span>') == sum(c["draws"] for c in lean["claims"]) > 0
    first = {**lean["claims"][0], "verdict": "holds", "superior": "fails", "draws": 6}
    page = report.write_report(run_folder, {**lean, "claims": [first, *lean["claims"][1:]]}).read_text()
    assert "claims: holds, not superior (1), too few draws" in page
    assert '<span class="chip good">holds, not superior</span>' in page
    few = {**first, "draws": 4}
    page = report.write_report(run_folder, {**lean, "claims": [few, *lean["claims"][1:]]}).read_text()
    assert '<span class="chip warn">too few draws (4 of 6): holds, not superior</span>' in page
