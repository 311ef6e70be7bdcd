"""The viewer of a report: its encoding to the bit, and in a headless browser what a person does with it."""

from __future__ import annotations

import base64
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import MISSING, Browser, browser
from made_up_run import METHODS, SLOTS, make_results

from optsim import report
from optsim.core.files import read_json, write_json
from optsim.report import light_code, shown

ROWS, COLS, LAST = 36, 48, 5
SECTIONS = ("compare", "errors", "capture")
LUMINANCE = np.array([0.0, -3.0, 1e-4, 0.01, 0.5, 100.0, 1e4, 2e5], np.float32)


def unpacked(text: str, shape: tuple[int, int, int], levels: bool) -> tuple[np.ndarray, ...]:
    """Undo the packing as the viewer does, by sums instead of differences."""
    stream = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    n, pixels = int(np.prod(shape)), shape[1] * shape[2]
    steps = stream[:n].astype(np.int64) + 256 * stream[n : 2 * n].astype(np.int64)
    steps = np.where(steps % 2, -(steps + 1) // 2, steps // 2)
    light = np.cumsum(steps.reshape(shape), axis=0).astype(np.uint16)
    marks = stream[2 * n : 2 * n + pixels].reshape(shape[1:])
    rest = stream[2 * n + pixels :]
    assert rest.size == (n if levels else 0)
    return light, marks, np.bitwise_xor.accumulate(rest.reshape(shape), axis=0) if levels else rest


@pytest.mark.parametrize("steps", [256, 128, 64, 32, 16])
def test_light_comes_back_within_the_stated_error(steps: int) -> None:
    rng = np.random.default_rng(2)
    light = np.concatenate([LUMINANCE, 10 ** rng.uniform(-5, 5, 2000).astype(np.float32)])
    codes = light_code.coarser(light_code.encode(light, 0.00125), steps)
    back = light_code.decode(codes, 0.00125, steps)
    truth = np.maximum(light, 0).astype(np.float64)
    share = np.abs(back - truth) / (truth + 0.00125)
    # Beside it single precision rounds.
    assert 0.9 < share.max() / light_code.largest_error(steps) < 1.001
    assert codes[:2].tolist() == [0, 0], "no light and less are none"


def test_packing_loses_nothing() -> None:
    rng = np.random.default_rng(3)
    light = rng.integers(0, 32768, (4, 5, 6)).astype(np.uint16)
    levels = rng.integers(0, 256, (4, 5, 6)).astype(np.uint8)
    valid, moving = rng.random((2, 5, 6)) < 0.5
    marks = light_code.marks_of(valid, moving)
    for code in (levels, None):
        found = unpacked(light_code.pack(light, marks, code), light.shape, code is not None)
        np.testing.assert_array_equal(found[0], light)
        np.testing.assert_array_equal(found[1] & 1, valid)
        np.testing.assert_array_equal(found[1] >> 1, moving)
        if code is not None:
            np.testing.assert_array_equal(found[2], levels)


def test_large_videos_get_coarser_steps_then_fewer_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(4)
    light = rng.integers(0, 4096, (4, 30, 40)).astype(np.uint16)
    marks = np.ones((30, 40), np.uint8)
    shot = report.ViewedFrame(light, marks, np.zeros((4, 30, 40), np.uint8), np.ones((3, 3), np.uint16))
    moments = [report.Moment(k, "", light, marks, {"one": shot}) for k in (9, 4)]
    about = {"e_cd_m2": 0.01, "white_cd_m2": 100.0, "slot_s": 0.005}
    found, written = [], [1e8]
    for share in (1, 0.9, 0.5):
        most = int(share * written[0])
        monkeypatch.setattr(shown, "MAX_BYTES", most)
        folder = tmp_path / str(most)
        viewer = report.write_viewer(folder, moments, **about)
        written.append(sum(path.stat().st_size for path in folder.rglob("*.js")))
        written[0] = written[1]
        found.append((viewer.steps_per_stop, [frame.index for frame in viewer.frames]))
        assert written[-1] < most + 1000
        assert viewer.largest_error == light_code.largest_error(viewer.steps_per_stop)
    (finest, both), (coarse, still_both), (_, one) = found
    assert (finest, both) == (256, [9, 4])
    assert coarse < 256
    assert still_both == [9, 4]
    assert one == [9]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    results = make_results(folder, ROWS, COLS, LAST + 1)
    write_json(folder / "results.json", results)
    report.write_report(folder, results)
    return folder


def test_stills_show_the_middle_slot_and_its_error(folder: Path) -> None:
    from PIL import Image

    pictures = read_json(folder / "results.json")["pictures"]
    shown_of = {section: [p["label"] for p in pictures if p["section"] == section] for section in SECTIONS}
    assert shown_of == {"compare": ["truth", *METHODS], "errors": [*METHODS], "capture": [*METHODS]}
    luminance, viewer = stored(folder, "random")
    file = next(p["file"] for p in pictures if (p["section"], p["label"]) == ("compare", "random"))
    grey = expected_grey(luminance[SLOTS // 2], viewer["start_white_cd_m2"])
    with Image.open(folder / file) as image:
        assert np.abs(np.asarray(image).astype(int) - grey).max() <= 1


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    if MISSING:
        pytest.skip(MISSING)
    with browser() as opened:
        yield opened


@pytest.fixture
def page(window: Browser, folder: Path) -> Browser:
    """The report at 1400 pixels, drawn, with the focus in its viewer."""
    window.size(1400, 900)
    window.open(folder / "report.html")
    wait_until(window, "document.getElementById('view').dataset.drawn")
    window.execute("document.getElementById('view').focus()")
    window.errors()
    return window


def wait_until(window: Browser, condition: str) -> None:
    until = time.monotonic() + 30
    while not window.execute(f"return {condition}"):
        assert time.monotonic() < until, f"never came: {condition}"
        time.sleep(0.05)


def settled(window: Browser, act: Any) -> np.ndarray:
    """Act, wait for the next drawing, and read the canvas, (y, x, RGB)."""
    before = window.execute("return document.getElementById('view').dataset.drawn")
    act()
    wait_until(window, f"document.getElementById('view').dataset.drawn !== '{before}'")
    return pixels(window)


def pixels(window: Browser) -> np.ndarray:
    text = window.execute("return document.querySelector('#view canvas').toDataURL('image/png')")
    from io import BytesIO

    from PIL import Image

    return np.asarray(Image.open(BytesIO(base64.b64decode(text.partition(",")[2]))).convert("RGB"))


def cells(image: np.ndarray) -> np.ndarray:
    """Colours in the middle of each panel pixel of a fitted picture, (v, u, RGB)."""
    height, width = image.shape[:2]
    zoom = min(height / ROWS, width / COLS)
    top, left = (height - ROWS * zoom) / 2, (width - COLS * zoom) / 2
    v = (top + (np.arange(ROWS) + 0.5) * zoom).astype(int)
    u = (left + (np.arange(COLS) + 0.5) * zoom).astype(int)
    return image[np.ix_(v, u)]


def stored(folder: Path, name: str, frame: int = LAST) -> tuple[np.ndarray, dict[str, Any]]:
    """Luminance of a method, or of the truth, "", from its file, and the viewer's record."""
    viewer = read_json(folder / "results.json")["viewer"]
    of_frame = next(each for each in viewer["frames"] if each["index"] == frame)
    file = of_frame["methods"][name] if name else of_frame["truth"]
    text = (folder / file).read_text().split('","')[1].rpartition('"')[0]
    light, _, _ = unpacked(text, (SLOTS, ROWS, COLS), bool(name))
    return light_code.decode(light, viewer["floor_cd_m2"], viewer["steps_per_stop"]), viewer


def expected_grey(luminance: np.ndarray, white: float) -> np.ndarray:
    from optsim.report.pictures import exposed

    return exposed(luminance.astype(np.float32), white).astype(int)


def test_pixels_are_the_measured_ones_at_the_stated_exposure(page: Browser, folder: Path) -> None:
    for key, name in (("l", "adaptive"), ("r", "")):
        luminance, viewer = stored(folder, name)
        found = cells(settled(page, lambda k=key: page.keys(k))).astype(int)
        assert (found[..., 0] == found[..., 2]).all()
        grey = expected_grey(luminance[SLOTS // 2], viewer["start_white_cd_m2"])
        assert np.abs(found[..., 0] - grey).max() <= 1
    assert len(np.unique(grey)) > 50
    # Two presses are one stop: twice the light.
    found = cells(settled(page, lambda: page.keys("\ue013\ue013")))
    grey = expected_grey(luminance[SLOTS // 2], viewer["start_white_cd_m2"] / 2)
    assert np.abs(found[..., 0].astype(int) - grey).max() <= 1
    assert not page.errors()


def test_the_slider_moves_the_boundary(page: Browser, folder: Path) -> None:
    both = cells(settled(page, lambda: page.keys("s")))
    left, right = (cells(settled(page, lambda k=k: page.keys(k))) for k in "lr")
    half = COLS // 2
    assert (both[:, : half - 1] == left[:, : half - 1]).all()
    assert (both[:, half + 1 :] == right[:, half + 1 :]).all()
    settled(page, lambda: page.keys("s"))
    box = page.execute("return document.querySelector('#view canvas').getBoundingClientRect().toJSON()")
    middle, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 3
    moved = cells(settled(page, lambda: page.drag((middle, y), (box["x"] + 0.8 * box["width"], y))))
    at = int(0.8 * COLS)
    assert (moved[:, : at - 1] == left[:, : at - 1]).all()
    assert (moved[:, at + 2 :] == right[:, at + 2 :]).all()
    script = "const e = document.getElementById('cut'); e.value = 10; e.dispatchEvent(new Event('input'))"
    moved = cells(settled(page, lambda: page.execute(script)))
    assert (moved[:, 6:] == right[:, 6:]).all()
    assert (left != right).any()
    assert not page.errors()


def test_the_difference_is_the_error_in_stops(page: Browser, folder: Path) -> None:
    settled(page, lambda: page.keys("4"))
    shades = cells(settled(page, lambda: page.keys("d"))).astype(int)
    (ours, viewer), (truth, _) = stored(folder, "random"), stored(folder, "")
    slot, e = SLOTS // 2, viewer["e_cd_m2"]
    error = np.log2((ours[slot] + e) / (truth[slot] + e))
    # Too bright is redder, too dark bluer, and 0 the page's light grey; chequered is the corner given up.
    red_over_blue = shades[..., 0] - shades[..., 2]
    assert red_over_blue[3:][error[3:] > 0.1].min() > 0 > red_over_blue[3:][error[3:] < -0.1].max()
    chequer = shades[:2, : COLS // 4]
    assert set(chequer[..., 0].ravel().tolist()) == {112, 138}
    assert page.execute("return !document.getElementById('scale').hidden")
    ticks = page.execute("return [...document.querySelectorAll('#ticks span')].map((t) => t.textContent)")
    assert ticks == ["−2", "−1", "0", "+1", "+2"]
    wider = "const e = document.getElementById('limit'); e.value = '4'; e.dispatchEvent(new Event('change'))"
    paler = cells(settled(page, lambda: page.execute(wider))).astype(int)
    assert np.abs(paler[..., 0] - paler[..., 2]).sum() < np.abs(red_over_blue).sum()


def test_keys_slots_frames_methods_and_marks(page: Browser, folder: Path) -> None:
    settled(page, lambda: page.keys("l"))
    one = settled(page, lambda: page.keys("\ue014"))  # right
    said = page.execute("return document.getElementById('slot-text').textContent")
    assert said == f"{SLOTS // 2 + 1} of {SLOTS - 1}"
    luminance, viewer = stored(folder, "adaptive")
    grey = expected_grey(luminance[SLOTS // 2 + 1], viewer["start_white_cd_m2"])
    assert np.abs(cells(one)[..., 0].astype(int) - grey).max() <= 1
    settled(page, lambda: page.keys("3"))
    assert page.execute("return document.getElementById('left').value") == list(METHODS)[2]
    settled(page, lambda: page.keys("x"))
    assert page.execute("return document.getElementById('left').value") == ""
    plain = settled(page, lambda: page.keys("4"))
    marked = settled(page, lambda: page.keys("m"))
    assert (marked != plain).any(axis=2).mean() > 0.01, "the oracle's moving pixels have a colour"
    assert page.execute("return document.querySelectorAll('#legend li').length") == 3
    settled(page, lambda: page.keys("n"))
    assert page.execute("return document.getElementById('frame').value") == str(LAST - 1)
    zoomed = settled(page, lambda: page.keys("+++"))
    blocks = zoomed[: zoomed.shape[0] // 2]
    assert page.execute("return parseFloat(document.getElementById('zoom-text').textContent)") > 3
    assert (blocks[:, 1:] == blocks[:, :-1]).all(axis=2).mean() > 0.9, "pixels, not a blur"
    settled(page, lambda: page.keys("f"))
    before = page.execute("return document.getElementById('slot').value")
    page.keys("p")
    wait_until(page, f"document.getElementById('slot').value !== '{before}'")
    page.keys("p")
    assert not page.errors()


def test_a_click_shows_the_worst_place(page: Browser) -> None:
    state = "return ['frame', 'slot', 'left', 'right'].map((id) => document.getElementById(id).value)"
    shown_at = "JSON.parse(document.querySelector('[data-show]').dataset.show)"
    wanted = page.execute(f"return {shown_at}")
    settled(page, lambda: page.execute("document.querySelector('[data-show]').click()"))
    assert page.execute(state) == [str(wanted["frame"]), str(wanted["slot"]), wanted["left"], ""]
    pressed = "return document.querySelector('[data-view][aria-pressed=true]').dataset.view"
    assert page.execute(pressed) == "difference"
    wait_until(page, "document.querySelector('#view canvas').getBoundingClientRect().top < 300")


def test_a_link_unfolds_its_part(page: Browser) -> None:
    assert not page.execute("return document.getElementById('evidence').open")
    page.execute("document.querySelector('.toc a[href=\"#evidence\"]').click()")
    wait_until(page, "document.getElementById('evidence').open")


@pytest.mark.parametrize("width", [390, 1400])
@pytest.mark.parametrize("dark", [False, True])
def test_nothing_overflows_and_the_console_is_silent(
    window: Browser, folder: Path, width: int, dark: bool
) -> None:
    window.size(width, 844, dark=dark)
    window.open(folder / "report.html")
    wait_until(window, "document.getElementById('view').dataset.drawn")
    for unfolded in (False, True):
        fold = (
            f"document.querySelectorAll('details').forEach((each) => (each.open = {str(unfolded).lower()}))"
        )
        window.execute(fold)
        assert window.execute("return document.documentElement.scrollWidth") == width
    wide = """
        const scrolls = (e) => e && (e.matches('.scroll, .toc') || scrolls(e.parentElement));
        const outside = (e) => e.getBoundingClientRect().right > innerWidth + 1;
        const wide = [...document.querySelectorAll('main *')].filter((e) => outside(e) && !scrolls(e));
        return wide.map((e) => e.outerHTML.slice(0, 99));
    """
    assert window.execute(wide) == []
    ink, paper = window.execute(
        "const s = getComputedStyle(document.body); return [s.color, s.backgroundColor]"
    )
    assert (brightness(paper) < brightness(ink)) == dark
    assert not window.errors()


def brightness(colour: str) -> int:
    return sum(int(each) for each in colour.partition("(")[2].rstrip(")").split(",")[:3])


def test_a_missing_file_is_named(window: Browser, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_bytes((folder / "report.html").read_bytes())
    window.size(1400, 900)
    window.open(tmp_path / "report.html")
    wait_until(window, "document.getElementById('readout').textContent.includes('is missing')")
