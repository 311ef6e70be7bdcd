"""The report page: every number is that of results.json, it needs no network, and it can be made again."""

from __future__ import annotations

import copy
import html
import re
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from optsim import metrics, report
from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.files import read_json, write_json
from optsim.core.quantities import Reconstruction
from optsim.experiment.evidence import NOT_MODELLED
from optsim.metrics import (
    MaskTally,
    PhotometricScale,
    ScoreBoard,
    judge_claims,
    mask_agreement,
    oracle_moving,
    pair_records,
    pixel_errors,
    pooled_mask_records,
    tally_pair,
)
from optsim.report import headline, plots, words
from optsim.report import html as html_report
from optsim.report.pictures import (
    ToneCurve,
    captured_picture,
    error_picture,
    mask_legend,
    mask_picture,
    start_picture,
)
from optsim.report.sheet import half_moving

METHODS = {
    "adaptive": "motion-adaptive coding, union decoder",
    "normal": "all slots open",
    "hdr_mosaic": "four densities, merged",
    "random": "random exposure, sparse decoder",
}
# Relative noise where it moves and where it is static: a made-up contest with a clear order.
NOISE = {
    "adaptive": (0.055, 0.021),
    "normal": (0.5, 0.06),
    "hdr_mosaic": (0.35, 0.02),
    "random": (0.05, 0.09),
}
SLOTS = 12


def truth_frame(index: int, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """A dim textured room with a bright window and a disc that moves: irradiance (slot, v, u), W/m^2."""
    v, u = np.indices((rows, cols)) / rows
    still = 2e-3 * (1 + 0.6 * np.sin(40 * u) * np.sin(31 * v)) * (0.4 + v)
    outside = (v > 0.12) & (v < 0.5) & (u > 0.12) & (u < 0.5)
    still = np.where(outside, 3.0 * (1.2 + np.sin(70 * u)), still)
    frames = []
    for slot in range(SLOTS):
        at = 0.75 + 0.1 * np.sin((index * SLOTS + slot) / 9)
        disc = (u - at) ** 2 + (v - 0.62) ** 2 < 0.02
        frames.append(np.where(disc, 0.02 * (1.5 + np.sin(60 * (u - at))), still))
    return np.asarray(frames, np.float32), outside


def as_json(rows: Sequence[metrics.Record]) -> list[dict[str, Any]]:
    return [row.as_json() for row in rows]


def make_results(folder: Path, rows: int, cols: int, n_frames: int) -> dict[str, Any]:
    """Results of a made-up run, scored and drawn by the real rooms."""
    rng = np.random.default_rng(7)
    scale = PhotometricScale(white_w_m2_sr=0.5, irradiance_per_radiance=0.02)
    board = ScoreBoard(metrics.ALL, scale, 1, SLOTS)
    tallies, ceiling, masks, marked, shots, pairs, rivals = [], [], [], [], {}, [], []
    previous = None
    for index in range(n_frames):
        reference, outside = truth_frame(index, rows, cols)
        moving = oracle_moving(reference, previous, 0.0)
        previous = reference
        half = (reference * rng.normal(0, 0.004, reference.shape)).astype(np.float32)
        ceiling.append(board.tally_noise(index, reference, half, moving))
        errors = {}
        for name in METHODS:
            sigma = np.where(moving, *NOISE[name]) * (1.5 if index < 2 else 1)
            estimate = np.maximum(reference * (1 + sigma * rng.normal(size=reference.shape)), 0)
            if name == "normal":
                estimate = np.minimum(estimate, 0.03)
            valid = np.ones((rows, cols), bool)
            valid[:2, : cols // 4] = name != "random"
            mask = moving if name != "adaptive" else np.roll(moving, 2, axis=1)
            r = Reconstruction(index, estimate.astype(np.float32), valid, ~valid, mask & (name == "adaptive"))
            tallies.append(board.tally(name, r, reference, moving))
            errors[name] = pixel_errors(metrics.ALL, scale, r.irradiance_w_m2, reference, valid, SLOTS)
            if name == "adaptive":
                agreement = mask_agreement(r.moving, moving)
                marked.append(MaskTally(name, index, agreement))
                masks.append(
                    {
                        "method": name,
                        "frame": index,
                        "precision": agreement.precision,
                        "recall": agreement.recall,
                        "iou": agreement.iou,
                    }
                )
                if index >= n_frames - 2:
                    lum = scale.luminance_cd_m2(r.irradiance_w_m2), scale.luminance_cd_m2(reference)
                    pairs += list(zip(*lum, strict=True))
            levels = (rng.random((SLOTS, rows, cols)) < 0.1).astype(np.uint8) * 255
            dn = np.clip(rng.normal(reference.mean(0) * 4e5, 30), 0, 16383).repeat(3, 0).repeat(3, 1)
            shots[name] = report.Shot(
                scale.luminance_cd_m2(r.irradiance_w_m2),
                valid,
                np.asarray(r.moving),
                dn.astype(np.uint16),
                np.full_like(levels, 255) if name == "normal" else levels,
            )
        rivals += [
            tally_pair(name, index, errors["adaptive"], errors[name], moving, outside)
            for name in METHODS
            if name != "adaptive"
        ]
    beside = pair_records(metrics.ALL, rivals, SLOTS, 1)
    luminance = scale.luminance_cd_m2(reference)
    tone = report.tone_curve_for(luminance)
    crops = report.choose_crops(luminance[5], moving, outside, size=(rows // 4, cols // 4))
    moment = report.Moment(n_frames - 1, 5, luminance, moving, 16000.0, shots)
    pictures = report.render_pictures(folder, moment, tone, crops, e_cd_m2=0.01)
    pictures.append(report.animate(folder, pairs, tone, method="adaptive", instant_s=1 / 180))
    scores = board.records(tallies)
    return {
        "schema_version": 2,
        "title": "A made-up run <of & for> tests",
        "experiment": {
            "name": "synthetic",
            "camera": {"latency_frames": 1},
            "methods": [{"name": "adaptive"}],
        },
        "command": "optsim run synthetic --seed 7",
        "finished_utc": "2026-01-02T03:04:05",
        "versions": {"optsim": "0.1.0", "numpy": "2.4.6"},
        "backend": "llvm_ad_mono, 2 cores",
        "seeds": {"experiment": 7},
        "timings": [
            {
                "stage": s,
                "wall_s": w,
                "cpu_s": 1.9 * w,
                "peak_rss_mb": 812.5,
                "peak_is_of_this_stage": s != "render",
            }
            for s, w in (
                ("render", 95.3),
                ("calibrate", 4.25),
                ("capture", 21.0),
                ("decode", 61.4),
                ("score", 7.7),
            )
        ],
        "light_rule": {
            "statement": "The interior's 90th percentile, all-on, reaches 80 % of measured saturation.",
            "nd_transmission": 0.3712,
            "wanted_transmission": 0.3712,
            "percentile_dn": 12441.0,
            "saturation_dn": 15551.0,
        },
        "photons": [
            {
                "method": m,
                "mean_e": 5000.5 + i,
                "dark_e": 210.25,
                "saturated_share": 0.03125,
                "negative_light": i,
            }
            for i, m in enumerate(METHODS)
        ],
        "ledgers": [
            {
                "name": "mid-grey",
                "radiance_w_m2_sr": 0.09,
                "rows": [
                    {
                        "element": "objective f/4",
                        "transmission": 0.9,
                        "irradiance_w_m2": 1.23e-3,
                        "source": "data sheet",
                    },
                    {
                        "element": "panel",
                        "transmission": 0.65,
                        "irradiance_w_m2": 8.0e-4,
                        "source": "no source",
                    },
                ],
            }
        ],
        "geometry": {
            "panel_px": [rows, cols],
            "ratio": 3.0,
            "margin_px": 14,
            "fits": True,
            "pitch_m": 9.5e-6,
        },
        "latency": {
            "frames": 1,
            "smallest_physical": 3,
            "hypothetical": True,
            "details": {"readout_s": 0.069, "transfer_s": 0.0118},
        },
        "scene": {
            "name": "synthetic",
            "variation": "main",
            "description": "a dim room, a bright window, a moving disc",
            "light": "unpolarised: no material of the scene polarises",
            "wavelength_nm": 550.0,
            "white_w_m2_sr": 0.5,
            "white_cd_m2": scale.white_cd_m2,
            "window_interior_ratio_before_glare": 21500.0,
            "window_interior_ratio_after_glare": 2040.0,
        },
        "methods": METHODS,
        "scores": as_json(scores),
        "coverage": as_json(board.coverage(tallies)),
        "frame_series": as_json(board.frame_series([*tallies, *ceiling])),
        "slot_series": as_json(board.slot_series(tallies)),
        "uncertainty": [
            {
                "method": m,
                "region": region,
                "phase": "steady",
                "n": n,
                "within_one": 0.6125 if n else None,
                "within_two": 0.93,
                "rms": 1.2375,
            }
            for m, region, n in (("hdr_mosaic", "all", 100), ("normal", "moving", 0))
        ],
        "masks": masks,
        "pooled_masks": as_json(pooled_mask_records(marked, latency_frames=1)),
        "noise_ceiling": as_json(board.records(ceiling)),
        "pairs": as_json(beside),
        "claims": as_json(judge_claims([beside])),
        "evidence": [
            {
                "effect": "pu21",
                "what": "PU21 encoding of the scores",
                "validated": True,
                "why": "",
                "claim": "encodes as its authors do",
                "oracle": "published numbers",
                "source": "doi:10.1109/PCS50896.2021.9477471",
                "measured": 2.0e-5,
                "tolerance": 6e-5,
                "reason": "four digits are published",
            },
            {
                "effect": "lens_psf",
                "what": "blur of each lens group",
                "validated": False,
                "why": "no validation yet",
                "claim": None,
                "oracle": None,
                "source": None,
                "measured": None,
                "tolerance": None,
                "reason": None,
            },
        ],
        "plan": {
            "tolerance": 0.1,
            "bound": 0.0321,
            "choices": [
                {
                    "skip": "moving_tails",
                    "what": "far light in lines",
                    "saves": "12 to 0.75 s a frame",
                    "skipped": True,
                    "bound": 0.0321,
                },
                {"skip": "time", "what": "later slots", "saves": "", "skipped": False, "bound": 0.0},
            ],
        },
        "not_modelled": ["twist of the nematic panel", "row scan of the panel"],
        "reconstruct_s": {"adaptive": 31.4, "normal": 0.4, "hdr_mosaic": 0.7, "random": 29.0},
        "pictures": as_json(pictures),
    }


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    write_json(folder / "results.json", make_results(folder, 36, 48, 7))
    return folder


@pytest.fixture
def results(run_folder: Path) -> dict[str, Any]:
    return read_json(run_folder / "results.json")


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


def test_every_score_in_the_page_is_that_of_the_results(run_folder: Path, results: dict[str, Any]) -> None:
    page = report.write_report(run_folder, results).read_text()
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


def test_other_exact_numbers_agree_with_their_text(run_folder: Path, results: dict[str, Any]) -> None:
    page = report.write_report(run_folder, results).read_text()
    plain = [(float(str(a["data-value"])), t) for a, t in parsed(page).cells if "data-metric" not in a]
    assert len(plain) > 40
    for value, text in plain:
        digits = float(re.sub(r"[^0-9.\-]", "", text.replace("−", "-").split("e⁻")[0]) or "nan")
        # shown as itself, in per cent, in milliseconds or in minutes: two digits are always right
        nearest = min(abs(digits - value * f) / max(abs(value * f), 0.01) for f in (1, 100, 1000, 1 / 60))
        assert nearest < 0.15, (value, text)


def test_best_is_marked_by_direction(run_folder: Path, results: dict[str, Any]) -> None:
    page = report.write_report(run_folder, results).read_text()
    best = [a for a, _ in parsed(page).cells if "best" in str(a.get("class"))]
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


def test_page_is_finite_self_contained_and_repeatable(run_folder: Path, results: dict[str, Any]) -> None:
    path = report.write_report(run_folder, results)
    page = path.read_text()
    assert report.write_report(run_folder, results).read_text() == page
    text = html.unescape(re.sub(r"<style>.*?</style>|<script>.*?</script>|<[^>]+>", " ", page, flags=re.S))
    assert not re.search(r"\b(nan|inf|infinity|none|null|undefined)\b", text, flags=re.I)
    addresses = parsed(page).addresses
    assert len(addresses) > 20
    for address in addresses:
        assert not re.match(r"(https?:)?//", address)
        assert (run_folder / address).is_file(), address
    assert "A made-up run &lt;of &amp; for&gt; tests" in page, "titles are escaped"
    assert not re.search(r"url\(|@import|fetch\(|https?://", page)


def test_first_screen_names_the_winners_and_their_lead(run_folder: Path, results: dict[str, Any]) -> None:
    moving, static, everywhere = headline.cards(report.check_results(results), "steady")
    assert [moving.ranked[0][0].method, static.ranked[0][0].method] == ["random", "hdr_mosaic"]
    assert everywhere.ranked[0][0].method == "adaptive"
    steady = {
        (s["method"], s["region"]): s["value"]
        for s in results["scores"]
        if s["phase"] == "steady" and s["metric"].startswith("PU21")
    }
    assert moving.lead == pytest.approx(steady["random", "moving"] - steady["adaptive", "moving"], abs=1e-12)
    assert moving.position(moving.ranked[0][1]) == 1
    assert moving.position(moving.ranked[-1][1]) == 0


def test_a_camera_that_drifted_is_named(run_folder: Path, results: dict[str, Any]) -> None:
    assert "camera drifted" not in report.write_report(run_folder, results).read_text()
    drift = {"relay": {"shift_x_px": 0.4, "shift_y_px": -0.2}}
    told = {**results, "experiment": {**results["experiment"], "drift": drift}}
    page = report.write_report(run_folder, told).read_text()
    assert re.search(r"camera drifted.*: relay.shift_x_px = 0.4, relay.shift_y_px = -0.2\.", page)


def test_what_methods_know_of_the_camera_is_told_where_they_differ(
    run_folder: Path, results: dict[str, Any]
) -> None:
    alike = dict.fromkeys(METHODS, "bench")
    told = {**results, "calibrations": alike}
    assert "different calibrations" not in report.write_report(run_folder, told).read_text()
    told["calibrations"] = {**alike, "normal": "ideal", "random": "ideal"}
    told["experiment"] = {**results["experiment"], "calibration": "true"}
    page = report.write_report(run_folder, told).read_text()
    said = r"calibrations: bench: adaptive, hdr_mosaic; ideal: normal, random\..* experiment, true\."
    assert re.search(said, page)


def test_sections_come_in_order(run_folder: Path, results: dict[str, Any]) -> None:
    page = report.write_report(run_folder, results).read_text()
    order = re.findall(r'<section[^>]* id="(\w+)"', page)
    wanted = "headline crops moving capture errors ledger geometry plan ceiling evidence reproduce"
    assert order == wanted.split()
    assert "hypothetical" in page
    assert "cannot be certified by this truth" in page
    assert "optsim run synthetic --seed 7" in page
    assert page.count("unvalidated") == 1


def test_uncertainties_are_told_where_a_method_states_them(run_folder: Path, results: dict[str, Any]) -> None:
    page = report.write_report(run_folder, results).read_text()
    table = page.split('id="uncertainty"')[1].split("</table>")[0]
    assert re.findall(r"<td[^>]*>([^<]*)</td>", table) == ["hdr_mosaic", "all", "61.3 %", "93.0 %", "1.238"]
    # Runs from before this version say nothing of them.
    older = {key: value for key, value in results.items() if key != "uncertainty"}
    assert 'id="uncertainty"' not in report.write_report(run_folder, older).read_text()


def test_masks_are_told_by_phase_and_a_dash_where_they_have_no_meaning(
    run_folder: Path, results: dict[str, Any]
) -> None:
    row = {"method": "adaptive", "phase": "steady", "moves": 0.05, "marked": 0.125}
    shares = {"precision": 0.3, "recall": 0.75, "iou": 0.2727}
    still = {"method": "late", "phase": "steady", "moves": 0.0, "marked": 0.0}
    nothing = dict.fromkeys(shares)
    told = {**results, "pooled_masks": [row | shares, still | nothing]}
    page = report.write_report(run_folder, told).read_text()
    table = page.split("Motion mask against the oracle</h3>")[1].split("</table>")[0]
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", table)
    assert cells[:7] == ["adaptive", "steady", "5.0 %", "12.5 %", "30.0 %", "75.0 %", "27.3 %"]
    assert cells[7:] == ["late", "steady", "0.0 %", "0.0 %", "–", "–", "–"]
    for share in (float("nan"), "none"):
        with pytest.raises(ValueCheckError, match=r"pooled_masks\.0\.iou"):
            report.check_results({**told, "pooled_masks": [row | shares | {"iou": share}]})
    # Runs from before this version have the masks frame by frame only.
    older = {key: value for key, value in results.items() if key != "pooled_masks"}
    assert 'id="masks"' not in report.write_report(run_folder, older).read_text()


def test_a_run_without_extras_still_reports(tmp_path: Path, results: dict[str, Any]) -> None:
    """Short footage run: no steady phase, no noise ceiling, no masks, no pictures, no claims."""
    bare = copy.deepcopy(results)
    bare["scores"] = [s for s in bare["scores"] if s["phase"] == "warm-up"]
    for key in ("pictures", "masks", "noise_ceiling", "claims", "pairs", "slot_series", "photons", "ledgers"):
        bare[key] = []
    bare["scores"][0]["value"], bare["scores"][0]["flag"] = None, "empty"
    page = report.write_report(tmp_path, bare).read_text()
    assert "too short to reach the steady phase" in page
    assert "what it can certify is unknown" in page
    bare["scores"] = bare["coverage"] = bare["frame_series"] = []
    assert "No scores in this run" in report.write_report(tmp_path, bare).read_text()


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
    # Of an earlier version, too: what it did not state stays absent.
    older = {key: value for key, value in results.items() if key not in ("uncertainty", "pooled_masks")}
    del older["latency"]["details"]
    for record in (results, older):
        assert report.check_results(record).as_json() == record


def test_results_are_read_by_key_as_before_with_a_warning(results: dict[str, Any]) -> None:
    found = report.check_results(results)
    with pytest.warns(DeprecationWarning, match=r"record\['scores'\] is record.scores now"):
        scores = found["scores"]
    assert scores is found.scores
    with pytest.raises(KeyError):
        found["as_json"]


def test_moving_picture_is_small_and_complete(run_folder: Path, results: dict[str, Any]) -> None:
    from PIL import Image

    (film,) = (p for p in results["pictures"] if p["section"] == "moving")
    assert (run_folder / film["file"]).stat().st_size < 1_500_000
    with Image.open(run_folder / film["file"]) as image:
        assert image.n_frames == 2 * SLOTS
        assert image.size == (film["width"], film["height"]) == (648, 240)
    assert "11.9 times slower" in film["caption"]  # 66 ms shown for each 1/180 s
    with pytest.raises(ValueCheckError, match="no frames"):
        report.animate(run_folder, [], ToneCurve(knee_cd_m2=1, peak_cd_m2=10), method="x", instant_s=1)


def test_tone_curve_is_one_monotone_curve() -> None:
    tone = ToneCurve(knee_cd_m2=2.0, peak_cd_m2=2000.0)
    luminance = np.array([-1.0, 0.0, 2.0, 200.0, 2000.0, 1e9], np.float32)
    expected = 255 * np.log1p([0, 0, 1, 100, 1000, 1000]) / np.log1p(1000)
    assert np.array_equal(tone.apply(luminance), np.rint(expected).astype(np.uint8))
    assert "knee 2 cd/m²" in tone.caption
    assert "2\u2009000 cd/m²" in tone.caption


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


def test_mask_picture_has_four_kinds() -> None:
    mask, oracle = np.array([[1, 0, 1, 0]], bool), np.array([[1, 1, 0, 0]], bool)
    image = mask_picture(mask, oracle, np.zeros((1, 4), np.uint8))
    hues = [int(entry.colour[1:3], 16) for entry in mask_legend()[:3]]
    assert image[0, :3, 0].tolist() == [round(0.8 * h) for h in hues]
    assert image[0, 3].tolist() == [20, 20, 20]


def test_start_and_capture_pictures() -> None:
    levels = np.zeros((4, 1, 3), np.uint8)
    levels[0, 0, 0] = levels[3, 0, 1] = 255
    image = start_picture(levels)
    assert tuple(image[0, 0]) == (0x22, 0x11, 0x50)
    assert tuple(image[0, 1]) == (0xFC, 0xF3, 0xBD)
    assert image[0, 2, 0] == image[0, 2, 1] == image[0, 2, 2], "never open: grey"
    captured = captured_picture(np.array([[0, 4000, 16000]], np.uint16), 16000.0)
    assert captured[0].tolist() == [[0, 0, 0], [136, 136, 136], [0xFF, 0x7A, 0x1A]]  # 255 * 0.25 ** (1/2.2)


def test_crops_find_motion_window_and_texture() -> None:
    reference, outside = truth_frame(2, 60, 80)
    oracle = oracle_moving(reference, None, 0.0)
    crops = {c.name: c for c in report.choose_crops(reference[0] * 3e4, oracle, outside, size=(15, 20))}
    assert crops["what moves"].of(oracle).mean() > 0.7
    assert crops["the window"].of(outside).all()
    assert not crops["interior texture"].of(outside | oracle).any()
    with pytest.raises(ValueCheckError, match="do not fit"):
        report.choose_crops(reference[0], oracle, outside, size=(61, 20))


def test_the_code_is_shown_where_a_camera_that_tells_motion_has_both() -> None:
    mask = np.zeros((60, 80), np.bool_)
    mask[10:50, 30:70] = True

    def shot(moving: Any) -> report.Shot:
        light = np.ones((2, 60, 80), np.float32)
        return report.Shot(light, mask, moving, np.ones((2, 2), np.uint16), np.ones((2, 60, 80), np.uint8))

    still, whole, oracle = np.zeros_like(mask), np.ones_like(mask), np.roll(mask, (5, 9), axis=(0, 1))
    for shots, seen in (({"a": whole, "b": mask}, mask), ({"a": whole, "c": still}, oracle)):
        every = {name: shot(moving) for name, moving in shots.items()}
        moment = report.Moment(0, 0, np.ones((2, 60, 80), np.float32), oracle, 1.0, every)
        crop = half_moving(moment, (16, 20))
        assert crop.of(seen).mean() == pytest.approx(0.5)
        assert crop.of(seen).shape == (16, 20)
        assert seen is oracle or crop.of(oracle).mean() != pytest.approx(0.5)


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
