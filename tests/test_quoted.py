"""Figures that README, manual and reports quote are those of the files that a measurement wrote."""

import re
from pathlib import Path

import pytest
from programs import program

ROOT = Path(__file__).parent.parent
quoted = program("quoted")


@pytest.mark.parametrize("name", quoted.PROSE)
def test_quoted_figures_are_those_of_their_files(name: str) -> None:
    prose = (ROOT / name).read_text(encoding="utf-8")
    assert quoted.filled(prose) == prose


@pytest.mark.parametrize("name", ["README.md", "docs/evidence.md", "reports/measured.md"])
def test_pages_that_quote_are_covered(name: str) -> None:
    assert name in quoted.PROSE
    assert "<!--= " in (ROOT / name).read_text(encoding="utf-8")


def test_a_figure_that_differs_is_seen_and_put_right() -> None:
    prose = (ROOT / "README.md").read_text(encoding="utf-8")
    changed = re.sub(r"(<!--= .*? -->).*?(<!--/-->)", r"\g<1>another\g<2>", prose, count=1)
    assert changed != prose
    assert quoted.filled(changed) == prose


def test_a_figure_that_no_file_has_is_named() -> None:
    with pytest.raises(KeyError, match="no 'nowhere'"):
        quoted.filled("<!--= claims.nowhere:+.2f -->1<!--/-->")
