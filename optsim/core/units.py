"""Quantity strings such as ``"12.5 mm"``, read by the unit suffix of a key's name; weights of luminance."""

from __future__ import annotations

import re

REC709_Y = (0.2126, 0.7152, 0.0722)
"""Luminance of linear R, G and B with the primaries and white of ITU-R BT.709-6, item 3.2, and of sRGB."""

# SI suffix of a field name -> factors of the units accepted there, its own first.
_UNITS: dict[str, dict[str, float]] = {
    # Rates and inverse lengths first: they end like a time and a length.
    "_per_m": {"1/m": 1.0, "dpt": 1.0, "dioptres": 1.0},
    "_e_s": {"e-/s": 1.0, "e/s": 1.0},
    "_m_s": {"m/s": 1.0, "km/h": 1 / 3.6, "mm/s": 1e-3},
    "_rad_s": {"rad/s": 1.0, "deg/s": 0.017453292519943295},
    "_m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "µm": 1e-6, "nm": 1e-9},
    "_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "_hz": {"Hz": 1.0, "kHz": 1e3, "fps": 1.0},
    "_rad": {"rad": 1.0, "deg": 0.017453292519943295, "mrad": 1e-3},
    "_e": {"e": 1.0, "ke-": 1e3, "e-": 1.0},
    "_c": {"°C": 1.0, "C": 1.0},
}
# Units that are only shown: such a key accepts plain numbers only.
_SHOWN_ONLY = {
    "_w_m2_sr": "W m^-2 sr^-1",
    "_px": "pixels",
    "_dn": "digital numbers",
    "_k": "kelvin",
    "_slots": "slots",
    "_frames": "coded frames",
    "_sigma": "standard deviations",
    "_waves": "waves of 550 nm, rms",
    "_share": "share of 1",
}
_QUANTITY = re.compile(r"^\s*([-+0-9.eE]+?)\s*([A-Za-zµ°%][-A-Za-zµ°/]*)\s*$")


def units_of(key: str) -> dict[str, float]:
    """Units accepted at a key with their SI factors; none for a key without a unit."""
    suffix = next((s for s in _UNITS if key.endswith(s)), None)
    return _UNITS[suffix] if suffix else {}


def unit_of(key: str) -> str:
    """Name a key's unit, with an example of another one that is accepted; empty where it has none."""
    own, *others = units_of(key) or [
        next((unit for end, unit in _SHOWN_ONLY.items() if key.endswith(end)), "")
    ]
    return f"{own} (a text such as '1 {others[0]}' works too)" if others else own


def parse_quantity(key: str, text: str) -> float:
    """Turn a quantity string into SI.

    Parameters
    ----------
    key : str
        Field name; its suffix (``_m``, ``_s``, ...) says the dimension.
    text : str
        Number and unit.

    Returns
    -------
    float
        The value in SI.

    Raises
    ------
    ValueError
        When the text is no quantity, or its unit is unknown or of another dimension. The message leaves the
        whole key to the caller.
    """
    units = units_of(key)
    if not units:
        raise ValueError("expected a plain number (this key has no unit)")
    # Two letters look like the micro sign: the sign itself, and the Greek letter.
    match = _QUANTITY.match(text.replace("\u03bc", "\u00b5"))
    cure = f"write for example {key} = '1 {next(iter(units))}'; units accepted: {', '.join(units)}"
    if not match:
        raise ValueError(f"expected a number with a unit; {cure}")
    number, unit = match.groups()
    # Case matters in SI: a capital turns milli into mega.
    if unit not in units:
        known = any(unit in other for other in _UNITS.values())
        raise ValueError(
            f"the unit {unit!r} is {'of another dimension than this key' if known else 'unknown'}; {cure}"
        )
    try:
        return float(number) * units[unit]
    except ValueError:
        raise ValueError(f"{number!r} is not a number; {cure}") from None
