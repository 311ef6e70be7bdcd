"""Numbers, key names and tables in readable form; the exact number stays beside each in the page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import cast

_DECIMALS = {"dB": 2, "stops": 3}
# Suffix of a key -> unit, and whether a metric prefix may be put before it.
_SUFFIXES: tuple[tuple[str, str, bool], ...] = (
    ("_per_e", "DN/e⁻", False),
    ("_w_m2_sr", "W m⁻² sr⁻¹", False),
    ("_cd_m2", "cd/m²", False),
    ("_w_m2", "W/m²", False),
    ("_j_m2", "J/m²", False),
    ("_rad", "rad", True),
    ("_hz", "Hz", True),
    ("_px", "px", False),
    ("_dn", "DN", False),
    ("_mb", "MB", False),
    ("_m", "m", True),
    ("_s", "s", True),
    ("_e", "e⁻", False),
)
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def score(value: float | None, unit: str) -> str:
    """Write a score with the decimals that suit its unit; a dash for None."""
    if unit == "share":
        return share(value)
    return "–" if value is None else f"{value:.{_DECIMALS.get(unit, 3)}f}".replace("-", "−")


def share(value: float | None) -> str:
    """Write a share as per cent; never rounds a missing part away."""
    if value is None:
        return "–"
    text = f"{100 * value:.1f} %"
    return "> 99.9 %" if text == "100.0 %" and value < 1 else text


def seconds(value: float) -> str:
    """Write a duration."""
    if value < 1:
        return f"{1000 * value:.0f} ms"
    return f"{value:.1f} s" if value < 120 else f"{value / 60:.1f} min"


def sentence(text: str) -> str:
    """Capitalise the first letter only."""
    return text[:1].upper() + text[1:]


# Beginning of a metric's name -> plain words; the longest that fits counts.
_METRICS = {
    "PU21-PSNR": "quality as seen (PSNR)",
    "log-RMSE": "relative error",
    "PSNR": "quality in linear light (PSNR)",
    "mu-law-PSNR": "quality after a mu-law curve (PSNR)",
    "PU21-SSIM": "structure as seen",
    "PU21-MS-SSIM": "structure as seen, coarse to fine",
    "relMSE": "relative squared error",
    "SMAPE": "symmetric relative error",
    "difference-PSNR": "steadiness from slot to slot (PSNR)",
    "one-gain PU21-PSNR": "quality as seen, one gain forgiven (PSNR)",
    "valid share": "share held valid",
}


def metric(name: str) -> str:
    """Plain words for a metric; its name where there are none."""
    fitting = [start for start in _METRICS if name.lower().startswith(start.lower())]
    return _METRICS[max(fitting, key=len)] if fitting else name


def plus_minus(half: float | None, unit: str) -> str:
    """Half of an interval; empty for None."""
    return "" if half is None else f"± {score(half, unit)}"


def per_cent_of_stops(stops: float) -> str:
    """Relative error of so many stops, in per cent."""
    return f"{100 * (2**stops - 1):.0f} %"


def label(key: str) -> str:
    """Turn a key such as ``margin_px`` into words, without the unit suffix."""
    for suffix, _, _ in _SUFFIXES:
        if key.endswith(suffix):
            key = key.removesuffix(suffix)
            break
    return key.replace("_", " ")


def quantity(key: str, value: object) -> str:
    """Write a value with the unit of its key's suffix."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " × ".join(quantity(key, item) for item in cast("Sequence[object]", value))
    if not isinstance(value, (int, float)):
        return str(value)
    for suffix, unit, prefixed in _SUFFIXES:
        if key.endswith(suffix):
            factor, prefix = _prefix(value) if prefixed else (1.0, "")
            return f"{number(value / factor)} {prefix}{unit}"
    return number(value)


def number(value: float | None) -> str:
    """Write a number with four significant digits or all before the point, and thin spaces in thousands."""
    if value is None:
        return "–"
    if isinstance(value, int) or 1e3 <= abs(value) < 1e7:
        return f"{value:,.0f}".replace(",", "\u2009").replace("-", "−")
    if value and not 1e-3 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.3e}".split("e")
        mantissa = mantissa.rstrip("0").rstrip(".")
        mantissa = mantissa.replace("-", "−")
        return f"{mantissa} × 10{str(int(exponent)).translate(_SUPERSCRIPT)}"
    return f"{value:.4g}".replace("-", "−")


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _prefix(value: float) -> tuple[float, str]:
    if not value or not math.isfinite(value):
        return 1.0, ""
    return next(((f, p) for f, p in _PREFIXES if abs(value) >= f), _PREFIXES[-1])


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown."""
    return ["| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)]
