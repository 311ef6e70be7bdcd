"""An image sensor by its EMVA 1288 data sheet: the few numbers of one, from a TOML or XML file.

An XML file has an element for each key, with the number as its text; elements may be nested in others.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from pydantic import Field

from optsim.camera.parts import Ccd
from optsim.core.config import Part, Table, build, read_toml
from optsim.core.errors import ConfigError

SUFFIXES = (".toml", ".xml")
_MOST_BYTES = 1 << 20


class DataSheet(Part):
    """Numbers of EMVA Standard 1288 release 4.0 that a sensor's model needs.

    Parameters
    ----------
    name : str
        Name of the sensor.
    rows, cols : int
        Pixels.
    pitch_m : float
        Pixel pitch, m.
    quantum_efficiency : float
        Electrons per photon, 0 to 1, at the wavelength in use.
    saturation_capacity_e : float
        Electrons; taken as the full well, which lies a few percent above.
    dark_noise_e : float
        Temporal dark noise, electrons, without quantisation.
    dark_current_e_s : float
        Electrons a second and pixel.
    dsnu_e : float
        Dark signal non-uniformity, electrons.
    prnu : float
        Photo response non-uniformity, 0 to 1.
    gain_dn_e : float
        System gain K, digital numbers an electron.
    bits : int
        Bits of a digital number.
    readout_s : float
        Time to read out all rows, s.
    black_dn : float
        Offset, digital numbers; it is a setting, which few sheets say.
    linearity_error : float
        Signal that is missing at the saturation capacity, 0 to 0.1.
    """

    name: str = ""
    rows: int
    cols: int
    pitch_m: float
    quantum_efficiency: float
    saturation_capacity_e: float
    dark_noise_e: float
    dark_current_e_s: float
    dsnu_e: float
    prnu: float
    gain_dn_e: float = Field(gt=0)
    bits: int
    readout_s: float
    black_dn: float = 64.0
    linearity_error: float = 0.0


def sensor_of(path: Path) -> Ccd:
    """Read a sensor from a data sheet.

    Raises
    ------
    ConfigError
        When the file is missing or unreadable, a number is missing or wrong, or a key is unknown.
    """
    if path.suffix not in SUFFIXES:
        raise ConfigError(
            f"camera.sensor: got {path}, expected a name or a file of {' or '.join(SUFFIXES)}; cure: "
            "write the data sheet's numbers into one"
        )
    table = read_toml(path) if path.suffix == ".toml" else _elements(path)
    missing = [
        key for key, field in DataSheet.model_fields.items() if field.is_required() and key not in table
    ]
    if missing:
        raise ConfigError(
            f"{path}: {', '.join(missing)}: got none, expected a number each; cure: add what the EMVA "
            "1288 data sheet says"
        )
    sheet = build(DataSheet, table, where=str(path))
    same = ("rows", "cols", "pitch_m", "quantum_efficiency", "dark_current_e_s", "dsnu_e", "prnu", "bits")
    renamed = {
        "full_well_e": sheet.saturation_capacity_e,
        "read_noise_e": sheet.dark_noise_e,
        "gain_e": 1 / sheet.gain_dn_e,
        "bend_at_full_well": sheet.linearity_error,
        "readout_s": sheet.readout_s,
        "black_dn": sheet.black_dn,
    }
    return build(Ccd, {key: getattr(sheet, key) for key in same} | renamed, where=str(path))


def _elements(path: Path) -> Table:
    """Read the leaves of an XML file as keys; numbers as numbers, quantities and names as text."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path}: got more than {_MOST_BYTES >> 20} MB, expected a data sheet")
        text = path.read_bytes()
        if b"<!ENTITY" in text:
            raise ConfigError(f"{path}: got entities, expected plain XML; cure: write their text out")
        leaves = [each for each in ElementTree.fromstring(text).iter() if not len(each)]
    except (OSError, ElementTree.ParseError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(f"{path} cannot be read as XML: {reason}; cure: name a data sheet") from None
    found: Table = {}
    for leaf in leaves:
        key, said = leaf.tag.rpartition("}")[2], (leaf.text or "").strip()
        if key in found:
            raise ConfigError(f"{path}: {key}: got it twice, expected one number; cure: drop one")
        try:
            number = float(said)
            found[key] = int(number) if number.is_integer() else number
        except ValueError:
            found[key] = said
    return found
