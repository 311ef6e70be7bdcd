"""The report page: every number is that of results.json, it needs no network, and it can be made again."""

from __future__ import annotations

import copy
import html
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from made_up_run import METHODS, make_results

from optsim import report
from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.files import read_json, write_json
from optsim.experiment.evidence import NOT_MODELLED
from optsim.report import headline, plots, verdict, words
from optsim.report import html as html_report
from optsim.report.pictures import ToneCurve, binned, captured_picture, error_picture, exposed


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    write_json(folder / "results.json", make_results(folder, 36, 48, 8))
    return folder


@pytest.fixture(scope="module")
def page(run_folder: Path) -> str:
    return report.write_report(run_folder, read_json(run_folder / "results.json")).read_text()


@pytest.fixture
def results(run_folder: Path) -> dict[str, Any]:
    return read_json(run_folder / "results.json")


@pytest.fixture
def lean(results: dict[str, Any]) -> dict[str, Any]:
    """Results without what takes long to draw."""
    return {**results, "frame_series": [], "slot_series": []}


class Cells(HTMLParser):
    """Collects text and attributes of all elements that carry the exact number, and every address."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[tuple[dict[str, str | None], str]] = []
        self.addresses: list[str] = []
        self._open: tuple[dict[str, str | None], str] | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        table = dict(attrs)
        self.addresses += [str(table[k]) for k in ("src", "href", "srcset") if table.get(k)]
        if "data-value" in table:
            self._open = (table, "")

    def handle_data(self, text: str) -> None:
        if self._open:
            self._open = (self._open[0], self._open[1] + text)

    def handle_endtag(self, tag: str) -> None:
        if self._open and tag in {"td", "dd", "b"}:
            self.cells.append((self._open[0], self._open[1].strip()))
            self._open = None


def parsed(page: str) -> Cells:
    parser = Cells()
    parser.feed(page)
    return parser


def test_every_score_in_the_page_is_that_of_the_results(results: dict[str, Any], page: str) -> None:
    shown = [(a, text) for a, text in parsed(page).cells if "data-metric" in a]
    expected = {
        (s["method"], s["metric"], s["region"], s["value"]): words.score(s["value"], s["unit"])
        for s in results["scores"]
    }
    found = {
        (a["data-method"], a["data-metric"], a["data-region"], float(str(a["data-value"]))): text
        for a, text in shown
    }
    assert found == expected
    for (
        a,
        text,
    ) in shown:  # and by itself, not by our own way of writing: two decimals of a dB, three of a stop
        decimals = 3 if "stops" in str(a["data-metric"]) else 2
        assert float(text.replace("−", "-")) == pytest.approx(
            float(str(a["data-value"])), abs=0.51 * 10**-decimals
        )
        assert len(text.partition(".")[2]) == decimals
    assert len(shown) == len(results["scores"]) == 4 * 3 * 3 * 3  # methods, metrics, regions, phases


def test_other_exact_numbers_agree_with_their_text(page: str) -> None:
    plain = [(float(str(a["data-value"])), t) for a, t in parsed(page).cells if "data-metric" not in a]
    assert len(plain) > 40
    for value, text in plain:
        digits = float(re.sub(r"[^0-9.\-]", "", text.replace("−", "-").split("e⁻")[0]) or "nan")
        # shown as itself, in per cent, in milliseconds or in minutes: two digits are always right
        nearest = min(abs(digits - value * f) / max(abs(value * f), 0.01) for f in (1, 100, 1000, 1 / 60))
        assert nearest < 0.15, (value, text)


def test_best_is_marked_by_direction(results: dict[str, Any], page: str) -> None:
    best = [a for a, _ in parsed(page).cells if "best" in str(a.get("class")) and "data-metric" in a]
    assert len(best) == 3 * 3 * 3
    for a in best:
        rivals = [
            s
            for s in results["scores"]
            if (s["metric"], s["region"]) == (a["data-metric"], a["data-region"]) and s["value"] is not None
        ]
        of_phase = [
            s
            for s in rivals
            if any(r["phase"] == s["phase"] and r["value"] == float(str(a["data-value"])) for r in rivals)
        ]
        pick = max if of_phase[0]["higher_is_better"] else min
        assert pick(s["value"] for s in of_phase) == float(str(a["data-value"]))


def test_page_is_finite_self_contained_and_repeatable(
    run_folder: Path, results: dict[str, Any], page: str
) -> None:
    assert report.write_report(run_folder, results).read_text() == page
    text = html.unescape(re.sub(r"<style>.*?</style>|<script.*?</script>|<[^>]+>", " ", page, flags=re.S))
    assert not re.search(r"\b(nan|inf|infinity|none|null|undefined)\b", text, flags=re.I)
    addresses = parsed(page).addresses
    places = [address.removeprefix("#") for address in addresses if address.startswith("#")]
    assert len(places) >= 8
    assert all(f'id="{place}"' in page for place in places)
    files = [address for address in addresses if not address.startswith("#")]
    assert len(files) > 5
    for address in files:
        assert not re.match(r"(https?:)?//", address)
        assert (run_folder / address).is_file(), address
    assert "A made-up run &lt;of &amp; for&gt; tests" in page, "titles are escaped"
    assert not re.search(r"url\(|@import|fetch\(|https?://", page)


def test_first_screen_names_the_winners_and_their_lead(results: dict[str, Any], page: str) -> None:
    everywhere, moving, static = verdict.verdict(report.check_results(results), "steady")
    assert [line.row.region for line in (everywhere, moving, static)] == ["all", "moving", "static"]
    assert [line.winners for line in (everywhere, moving, static)] == [
        ("adaptive",),
        ("random",),
        ("hdr_mosaic",),
    ]
    assert everywhere.certain
    # The lead is a mean over the steady frames, from 5 on at latency 1, with Student's interval.
    frames = {
        s["method"]: s["values"][5:]
        for s in results["frame_series"]
        if s["region"] == "moving" and s["metric"].startswith("PU21")
    }
    gains = np.subtract(frames["random"], frames["adaptive"])
    (lead, *_) = headline.leads(report.check_results(results), moving.row, "steady")
    assert (lead.best, lead.other, lead.mean) == ("random", "adaptive", pytest.approx(gains.mean()))
    assert f"is best, {gains.mean():.2f}" in page


def test_intervals_are_student_s() -> None:
    # t of 97.5 % at 3 degrees of freedom is 3.182446, from tables.
    values = [1.0, 2.0, 3.0, 4.0]
    assert headline.half_width(values) == pytest.approx(3.182446 * np.std(values, ddof=1) / 2, rel=1e-6)
    assert headline.half_width(values[:2]) is None


def test_methods_that_cannot_be_told_apart_are_said_to_be(results: dict[str, Any]) -> None:
    told = copy.deepcopy(results)
    for series in told["frame_series"]:
        level, wave = {"adaptive": (1, 0.0), "random": (1, 0.5)}.get(series["method"], (5, 0.0))
        series["values"] = [level + wave * (-1) ** k for k in range(len(series["values"]))]
    line = verdict.verdict(report.check_results(told), "steady")[0]
    assert set(line.winners) == {"adaptive", "random"}
    assert not line.certain
    assert "not told apart" in line.text


def test_faults_name_the_worst_place_and_open_the_viewer_there(results: dict[str, Any]) -> None:
    record = report.check_results(results)
    faults = verdict.faults(record, "steady")
    place = next(p for p in results["worst_places"] if p["method"] == "adaptive")
    first = faults[0]
    assert f"rows {place['row']} to {place['row'] + place['height'] - 1}" in first.text
    show = json.loads(first.show)
    assert (show["frame"], show["slot"], show["left"], show["right"]) == (7, place["slot"], "adaptive", "")
    assert show["box"] == [place["row"], place["col"], place["height"], place["width"]]
    # It errs more where it moves, and what it saturates has no place.
    assert any(f.text.startswith("Where it moves it errs") for f in faults)
    assert any("saturate" in f.text and not f.show for f in faults)
    assert verdict.state(record, frame=0) == "", "a frame that is not among the pictures"


def test_a_camera_that_drifted_is_named(run_folder: Path, lean: dict[str, Any], page: str) -> None:
    assert "camera drifted" not in page
    drift = {"relay": {"shift_x_px": 0.4, "shift_y_px": -0.2}}
    told = {**lean, "experiment": {**lean["experiment"], "drift": drift}}
    page = report.write_report(run_folder, told).read_text()
    assert re.search(r"camera drifted.*: relay.shift_x_px = 0.4, relay.shift_y_px = -0.2\.", page)


def test_what_methods_know_of_the_camera_is_told_where_they_differ(
    run_folder: Path, lean: dict[str, Any]
) -> None:
    alike = dict.fromkeys(METHODS, "bench")
    told = {**lean, "calibrations": alike}
    assert "different calibrations" not in report.write_report(run_folder, told).read_text()
    told["calibrations"] = {**alike, "normal": "ideal", "random": "ideal"}
    told["experiment"] = {**lean["experiment"], "calibration": "true"}
    page = report.write_report(run_folder, told).read_text()
    said = r"calibrations: bench: adaptive, hdr_mosaic; ideal: normal, random\..* experiment, true\."
    assert re.search(said, page)


def test_sections_come_in_order(page: str) -> None:
    order = re.findall(r'<(?:section|details)[^>]* id="(\w+)"', page)
    wanted = "verdict viewer errors more scores claims run ledger geometry plan ceiling evidence reproduce"
    assert order == wanted.split()
    contents = re.findall(r'href="#(\w+)"', page.split('class="toc"')[1].split("</nav>")[0])
    assert contents == [name for name in order if name in contents]
    assert len(contents) >= 8
    assert "1 of 2 modelled effects are validated" in page
    assert "hypothetical" in page
    assert "cannot be certified by this truth" in page
    assert "optsim run synthetic --seed 7" in page
    assert page.count("unvalidated") == 1


def test_uncertainties_are_told_where_a_method_states_them(
    run_folder: Path, lean: dict[str, Any], page: str
) -> None:
    table = page.split('id="uncertainty"')[1].split("</table>")[0]
    assert re.findall(r"<td[^>]*>([^<]*)</td>", table) == ["hdr_mosaic", "all", "61.3 %", "93.0 %", "1.238"]
    silent = {**lean, "uncertainty": []}
    assert 'id="uncertainty"' not in report.write_report(run_folder, silent).read_text()


def test_masks_are_told_by_phase_and_a_dash_where_they_have_no_meaning(
    run_folder: Path, lean: dict[str, Any]
) -> None:
    row = {"method": "adaptive", "phase": "steady", "moves": 0.05, "marked": 0.125}
    shares = {"precision": 0.3, "recall": 0.75, "iou": 0.2727}
    still = {"method": "late", "phase": "steady", "moves": 0.0, "marked": 0.0}
    nothing = dict.fromkeys(shares)
    told = {**lean, "pooled_masks": [row | shares, still | nothing]}
    page = report.write_report(run_folder, told).read_text()
    table = page.split("Motion mask against the oracle</h3>")[1].split("</table>")[0]
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", table)
    assert cells[:7] == ["adaptive", "steady", "5.0 %", "12.5 %", "30.0 %", "75.0 %", "27.3 %"]
    assert cells[7:] == ["late", "steady", "0.0 %", "0.0 %", "–", "–", "–"]
    for share in (float("nan"), "none"):
        with pytest.raises(ValueCheckError, match=r"pooled_masks\.0\.iou"):
            report.check_results({**told, "pooled_masks": [row | shares | {"iou": share}]})
    without = {**lean, "pooled_masks": []}
    assert 'id="masks"' not in report.write_report(run_folder, without).read_text()


def test_a_run_without_extras_still_reports(run_folder: Path, results: dict[str, Any]) -> None:
    """Short footage run: no steady phase, no noise ceiling, no masks, no claims."""
    bare = copy.deepcopy(results)
    bare["scores"] = [s for s in bare["scores"] if s["phase"] == "warm-up"]
    for key in (
        "pictures",
        "by_luminance",
        "worst_places",
        "masks",
        "noise_ceiling",
        "claims",
        "pairs",
        "slot_series",
        "photons",
        "ledgers",
    ):
        bare[key] = []
    bare["scores"][0]["value"], bare["scores"][0]["flag"] = None, "empty"
    page = report.write_report(run_folder, bare).read_text()
    assert "too short to reach the steady phase" in page
    assert "what it can certify is unknown" in page
    bare["scores"] = bare["coverage"] = bare["frame_series"] = []
    assert "No scores in this run" in report.write_report(run_folder, bare).read_text()


def test_schema_refuses_with_the_place(tmp_path: Path, results: dict[str, Any]) -> None:
    broken = copy.deepcopy(results)
    broken["scores"][3]["value"] = float("nan")
    broken["surprise"] = 1
    del broken["command"]
    with pytest.raises(ValueCheckError, match=r"3 problems") as error:
        report.write_report(tmp_path, broken)
    for place in (r"scores\.3\.value", "surprise", "command: Field required"):
        assert re.search(place, str(error.value))
    with pytest.raises(StorageError, match="missing; cure"):
        report.write_report(tmp_path, results)
    assert not (tmp_path / "report.html").exists()


def test_results_are_written_as_they_were_read(results: dict[str, Any]) -> None:
    assert report.check_results(results).as_json() == results


def test_tone_curve_is_one_monotone_curve() -> None:
    tone = ToneCurve(knee_cd_m2=2.0, peak_cd_m2=2000.0)
    luminance = np.array([-1.0, 0.0, 2.0, 200.0, 2000.0, 1e9], np.float32)
    expected = 255 * np.log1p([0, 0, 1, 100, 1000, 1000]) / np.log1p(1000)
    assert np.array_equal(tone.apply(luminance), np.rint(expected).astype(np.uint8))


def test_exposed_pictures_follow_the_curve_of_srgb() -> None:
    share = np.array([-1.0, 0.0, 0.002, 0.18, 0.5, 1.0, 9.0], np.float32)
    # Of IEC 61966-2-1: 12.92 x below 0.0031308, 18 % is 118, a half 188.
    assert exposed(7 * share, 7.0).tolist() == [0, 0, 7, 118, 188, 255, 255]


def test_error_picture_is_signed_and_symmetric() -> None:
    truth = np.full((1, 5), 100.0, np.float32)
    estimate = truth * np.array([[0.01, 0.5, 1.0, 2.0, 100.0]], np.float32)
    valid = np.ones((1, 5), bool)
    image = error_picture(estimate, truth, valid, e_cd_m2=1e-6, limit_stops=2.0).astype(int)
    assert tuple(image[0, 0]) == (0x08, 0x30, 0x6B)  # two stops too dark, or more
    assert tuple(image[0, 2]) == (0xF4, 0xF3, 0xEF)
    assert tuple(image[0, 4]) == (0x6E, 0x14, 0x14)
    # one stop is half-way along its side: between the second and third anchor from the middle
    assert tuple(image[0, 1]) == (108, 160, 212), "too dark is blue"
    assert tuple(image[0, 3]) == (223, 126, 92), "too bright is red"
    unknown = error_picture(estimate, truth, ~valid, e_cd_m2=1e-6, limit_stops=2.0)
    assert set(unknown[0, :, 0].tolist()) <= {0x8A, 0x70}


def test_large_frames_are_averaged() -> None:
    dn = np.arange(35, dtype=np.uint16).reshape(5, 7)
    assert binned(dn, 2).tolist() == [[4, 6, 8], [18, 20, 22]]
    assert binned(dn, 1).tolist() == dn.tolist()


def test_captured_pictures_mark_saturation() -> None:
    captured = captured_picture(np.array([[0, 4000, 16000]], np.uint16), 16000.0)
    assert captured[0].tolist() == [[0, 0, 0], [136, 136, 136], [0xFF, 0x7A, 0x1A]]  # 255 * 0.25 ** (1/2.2)


def test_plots_break_at_missing_values_and_take_the_colours_of_the_page() -> None:
    line: plots.Line = ("a & b", "s0", [0, 1, 2, 3], [1.0, None, 2.0, 3.0])
    other: plots.Line = ("other", "s1", [0, 1, 2, 3], [1.0, 1.0, 2.0, 4.0])
    bands = [(-0.5, 1.5, "early"), (9.0, 10.0, "never")]
    svg = plots.line_plot([line, other], title="t <1>", x_label="frame", y_label="dB", bands=bands)
    root = ElementTree.fromstring(
        str(svg).replace("<svg", '<svg xmlns:xlink="http://www.w3.org/1999/xlink"', 1)
    )
    path, *_ = re.findall(r'd="([^"]+)" style="fill: none; stroke: var\(--s0\)', svg)
    assert path.count("M") == 2, "a missing value breaks the line"
    texts = [text.text for text in root.iter("text")]
    assert texts.index("other") < texts.index("a & b"), "labels are in the order of last values"
    assert "early" in texts
    assert "never" not in texts
    assert root.get("aria-label") == "t <1>"
    assert not re.search("#[0-9a-f]{6}", svg), "no colour of its own: light and dark pages differ"
    assert plots.line_plot([line, other], title="t <1>", x_label="frame", y_label="dB", bands=bands) == svg
    nothing: plots.Line = ("x", "s0", [0], [None])
    assert "no values" in plots.line_plot([nothing], title="t", x_label="x", y_label="y")


def test_colours_of_plots_are_those_of_the_style_sheet() -> None:
    sheet = (html_report.TEMPLATES / "report.css").read_text(encoding="utf-8")
    for name, colour in plots.COLOURS.items():
        assert f"--{name}: light-dark({colour}," in sheet


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("pitch_m", 9.5e-6, "9.5 µm"),
        ("readout_s", 0.069, "69 ms"),
        ("saturation_dn", 15551.4, "15\u2009551 DN"),
        ("fits", True, "yes"),
        ("panel_px", [500, 600], "500 px × 600 px"),
        ("ratio", 2.88, "2.88"),
        ("energy_j_m2", -2.5e-7, "−2.5 × 10⁻⁷ J/m²"),
        ("missing", None, "–"),
    ],
)
def test_quantities_in_words(key: str, value: object, text: str) -> None:
    assert words.quantity(key, value) == text


def test_shares_never_round_a_missing_part_away() -> None:
    assert [words.share(x) for x in (1.0, 0.99999, 0.998, 0.0, None)] == [
        "100.0 %",
        "> 99.9 %",
        "99.8 %",
        "0.0 %",
        "–",
    ]


def test_the_manual_says_what_is_not_modelled() -> None:
    manual = " ".join((Path(__file__).parents[1] / "docs" / "limits.md").read_text(encoding="utf-8").split())
    for item in NOT_MODELLED:
        assert item in manual, f"the manual's list lacks: {item}"
