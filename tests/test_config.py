"""Quantity strings, unknown keys, overrides: what a user sees when an experiment is wrong."""

from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from optsim.config import Part, build, override, parse_quantity
from optsim.errors import ConfigError


class Lens(Part):
    kind: Literal["lens"] = "lens"
    focal_length_m: float = 12.5e-3
    tilt_rad: float = 0.0
    count: int = 1


class Camera(Part):
    lens: Lens = Lens()


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("focal_length_m", "12.5 mm", 0.0125),
        ("pitch_m", "20um", 20e-6),
        ("slot_s", "5.5 ms", 5.5e-3),
        ("rate_hz", "180 Hz", 180.0),
        ("tilt_rad", "0.5 deg", 0.008726646259971648),
        ("full_well_e", "15.77 ke-", 15770.0),
    ],
)
def test_quantities_become_si(key: str, text: str, value: float) -> None:
    assert parse_quantity(key, text) == pytest.approx(value, rel=1e-12)


@given(st.floats(min_value=-1e12, max_value=1e12, allow_nan=False))
def test_any_number_of_millimetres(number: float) -> None:
    assert parse_quantity("x_m", f"{number!r} mm") == number * 1e-3


@pytest.mark.parametrize("text", ["12.5 s", "mm", "12,5 mm", "", "1 2 mm", "e mm"])
def test_wrong_quantities_name_key_and_cure(text: str) -> None:
    with pytest.raises(ConfigError, match=r"focal_length_m.*write for example"):
        parse_quantity("focal_length_m", text)


def test_unknown_key_names_the_nearest() -> None:
    with pytest.raises(
        ConfigError, match=r"lens\.focal_lenght_m: unknown key; did you mean 'focal_length_m'"
    ):
        build(Camera, {"lens": {"focal_lenght_m": 0.01}}, where="test.toml")


def test_all_problems_are_listed_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        build(Camera, {"lens": {"focal_length_m": "1 s", "count": "many"}, "lnes": 3}, where="test.toml")
    message = str(caught.value)
    assert "unit 's'" in message
    assert "lnes: unknown key" in message


def test_infinite_numbers_are_refused() -> None:
    with pytest.raises(ConfigError, match="focal_length_m"):
        build(Lens, {"focal_length_m": float("inf")}, where="x")


def test_override_sets_nested_keys_without_touching_the_source() -> None:
    table = {"lens": {"count": 1}, "methods": [{"name": "a"}]}
    changed = override(table, ["lens.count=3", "lens.focal_length_m='25 mm'", "methods.0.name=b"])
    assert changed == {"lens": {"count": 3, "focal_length_m": "25 mm"}, "methods": [{"name": "b"}]}
    assert table == {"lens": {"count": 1}, "methods": [{"name": "a"}]}


@pytest.mark.parametrize("bad", ["lens.count", "=3", "lens.count.deep=3"])
def test_bad_overrides(bad: str) -> None:
    with pytest.raises(ConfigError, match="--set"):
        override({"lens": {"count": 1}}, [bad])


class Shelf(Part):
    lenses: tuple[Lens, ...] = Field(min_length=1)


def test_a_list_with_a_wrong_item_is_not_called_too_short() -> None:
    with pytest.raises(ConfigError) as caught:
        build(Shelf, {"lenses": [{"count": "many"}]}, where="x")
    assert "lenses.0.count" in str(caught.value)
    assert "at least 1 item" not in str(caught.value)
    with pytest.raises(ConfigError, match="at least 1 item"):
        build(Shelf, {"lenses": []}, where="x")
