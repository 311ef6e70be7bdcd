"""``optsim report``: pages from results.json and assets alone, and one page for several runs."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest
from made_up_run import make_results
from typer.testing import CliRunner

from optsim.app.cli import app
from optsim.app.error_net import guarded
from optsim.core.files import read_json, write_json
from optsim.report import check_results
from optsim.report.index import write_index


def command(*words: object) -> tuple[int, str]:
    """Exit code and output of ``optsim report``."""
    found: list[Any] = []

    def run() -> None:
        found.append(CliRunner().invoke(app, ["report", *map(str, words)], standalone_mode=False))
        if found[0].exception is not None:
            raise found[0].exception

    code = guarded(run)
    return code, found[0].output


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "first"
    results = make_results(folder, 24, 32, 6)
    # Few plots: they take longest.
    results["slot_series"] = []
    write_json(folder / "results.json", results)
    return folder


def another(run_folder: Path, name: str, **changed: object) -> Path:
    folder = run_folder.parent / name
    results = copy.deepcopy(read_json(run_folder / "results.json"))
    write_json(folder / "results.json", {**results, **changed})
    for path in (run_folder / "assets").iterdir():
        (folder / "assets").mkdir(exist_ok=True)
        (folder / "assets" / path.name).write_bytes(path.read_bytes())
    return folder


def test_a_page_is_made_anew_from_results_and_assets_alone(run_folder: Path) -> None:
    code, said = command(run_folder)
    assert code == 0
    page = run_folder / "report.html"
    assert said.strip() == f"Report: {page}"
    first = page.read_bytes()
    page.unlink()
    assert command(run_folder)[0] == 0
    assert page.read_bytes() == first
    assert not (run_folder.parent / "index.html").exists(), "one run needs no list"


def test_several_runs_share_a_page_with_their_history(run_folder: Path, tmp_path: Path) -> None:
    results = read_json(run_folder / "results.json")
    scores = [{**s, "value": s["value"] and 1.5 * s["value"]} for s in results["scores"]]
    later = {"finished_utc": "2026-03-04T05:06:07", "commit": "0123456789", "scores": scores}
    settings = {**results["experiment"], "seed": 9}
    other = another(run_folder, "a later one", **later, experiment=settings)
    records = [(folder, check_results(read_json(folder / "results.json"))) for folder in (other, run_folder)]
    index = write_index(run_folder.parent / "index.html", records)
    page = index.read_text()
    rows = re.findall(r'<tr><td><a href="([^"]+)">([^<]+)</a></td><td>([^<]+)</td>', page)
    assert rows == [
        ("first/report.html", "2026-01-02 03:04", "–"),
        ("a%20later%20one/report.html", "2026-03-04 05:06", "0123456789"),
    ]
    assert "seed = 9" in page
    assert page.count('<svg class="plot"') == 3
    assert ">0123456789<" in page.split("<svg")[1], "the axis has commits"
    values = [float(v) for v in re.findall(r'data-value="([^"]+)"', page)]
    assert values[4:] == pytest.approx([1.5 * v for v in values[:4]])
    assert not re.search(r"https?://", page)


@pytest.mark.parametrize("content", [None, "{", json.dumps({"schema_version": 1})])
def test_what_is_no_run_is_refused_in_one_line(
    run_folder: Path, tmp_path: Path, content: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / "results.json").write_text(content)
    before = (run_folder / "results.json").stat().st_mtime_ns
    (run_folder / "report.html").unlink(missing_ok=True)
    code, _ = command(run_folder, tmp_path)
    assert code == 2
    assert "Traceback" not in capsys.readouterr().err
    assert not (run_folder / "report.html").exists(), "all runs are checked first"
    assert (run_folder / "results.json").stat().st_mtime_ns == before
