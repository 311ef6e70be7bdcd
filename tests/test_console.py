"""Progress where nobody watches: lines of a log, not too many of them."""

import io
import os
import subprocess
import sys

import pytest
from rich.console import Console

from optsim.core import console


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr(console.people, "print", lines.append)
    return lines


def test_a_log_gets_a_line_now_and_then_and_at_the_end(
    monkeypatch: pytest.MonkeyPatch, said: list[str]
) -> None:
    now = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with console.progress_bars() as progress:
        for done in range(1, 41):
            progress("movers", done, 40)
            now[0] += 1.0
        progress("movers", 40, 40)
        progress("decode", 1, 2)
    assert said == [
        *(f"movers: {done} of 40" for done in (1, 11, 21, 31, 40)),
        "decode: 1 of 2",
    ]


def test_who_wants_no_remarks_gets_none(said: list[str]) -> None:
    with console.progress_bars(quiet=True) as progress:
        progress("movers", 1, 1)
    assert not said


def test_brackets_and_colons_are_text_in_lines_and_tables(capsys: pytest.CaptureFixture[str]) -> None:
    for console_ in (console.page, console.people):
        console_.print("interior pu21_psnr [banding_glare, peak=256] in runs[a]:100:")
        console_.print(console.table("of [b]", ("what [c]",), [("one [d]",)]))
    for text in capsys.readouterr():
        assert "[banding_glare, peak=256] in runs[a]:100:" in text
        assert all(f"[{letter}]" in text for letter in "bcd")


@pytest.mark.parametrize("columns", ["0", "1", "-5", "x"])
def test_help_is_whole_where_a_shell_states_no_width_of_use(columns: str) -> None:
    words = [sys.executable, "-m", "optsim", "dataset", "--help"]
    said = [
        subprocess.run(words, env=os.environ | {"COLUMNS": each}, capture_output=True, text=True, check=True)
        for each in ("80", columns)
    ]
    assert said[1].stdout.split() == said[0].stdout.split() != []


def test_a_narrow_table_folds_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    words = [f"{letter * 9}" for letter in "abcdef"]
    narrow = io.StringIO()
    Console(file=narrow, width=40).print(console.table("", words, [words]))
    assert all(narrow.getvalue().count(word[0]) >= 18 for word in words)
