"""The sensor's statistics by the reference implementation of EMVA 1288, on images of a simulated bench.

Run as a program it prints what is behind the one number of the evidence: ``check.py`` the table of true,
expected and found values; ``check.py breaks`` what the check says of sensors broken on purpose;
``check.py spread 24`` how far benches of other noise and other sensors of the kind scatter.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the checks are files, not a package

from optsim.camera.hardware import icx674, imx174
from optsim.camera.parts import Ccd
from optsim.core.errors import StorageError
from validation.emva1288.bench import LEVELS, camera_of, take_bench
from validation.emva1288.expected import expected, saturation_photons
from validation.environments import reference_python

CLAIM = (
    "on bench images of two sensors the reference implementation of EMVA 1288 finds the quantum efficiency, "
    "gain, dark noise, PRNU, DSNU, saturation capacity and saturated level that their data sheets imply"
)
ORACLE = (
    "package emva1288 1.0.2 (release 4.0 of the standard), run as a separate program on image files; what it "
    "must find on a sensor that bends and clips, by sums over the Poisson distribution; numpy and scipy only"
)
SOURCE = "EMVA Standard 1288, release 4.0 Linear, sections 6 to 8; package emva1288 1.0.2"
TOLERANCE = 1.0
REASON = (
    "In units of what each quantity is allowed, below: four standard errors of its own. One false alarm "
    "in a thousand seeds for the worst of fourteen; the seed is fixed. PRNU that acts after the shot "
    "noise is not seen here, since averages over pixels don't change: that, and white noise, are held by "
    "tests/test_sensor_ccd.py."
)
FILES = (
    "optsim/camera/parts/*.py",
    "optsim/camera/hardware/sensors.py",
    "optsim/camera/camera.py",
    "optsim/optics/radiometry.py",
)

_SEED = 7
_SENSORS = {"icx674": icx674(), "imx174": imx174()}
# Relative standard error of each result, and a known bias: standard deviation and mean of 24 benches by
# 'check.py spread 24', where noise and serial number differ. The random part is also what theory says: PRNU
# 1 / sqrt(2 x 480 000 pixels) = 1.0e-3, a little more for what 50 frames leave of shot noise. The bias, zero
# unless stated: the variance of the ICX674 has a flat peak (0.3 % over 6 % of the signal), so noise decides
# which level the package takes for saturation, mostly the one below the true peak; with it moves the end of
# the range to which it fits the gain, and that gain is in all that is stated in electrons. The IMX174 bends
# less: its peak is where it clips, always the same level, and its capacity is as sure as its QE.
_ERROR_AND_BIAS = {
    "icx674": {
        "QE": (8.5e-4, 6e-4),
        "K_dn_e": (9.4e-4, 7e-4),
        "sigma_d_e": (1.35e-3, 8e-4),
        "PRNU": (1.25e-3, 0.0),
        "DSNU_e": (2.6e-3, 9e-4),
        "capacity_e": (1.57e-2, 1.1e-2),
        "saturated_dn": (6.6e-7, 0.0),
    },
    "imx174": {
        "QE": (4.0e-4, 0.0),
        "K_dn_e": (4.0e-4, 0.0),
        "sigma_d_e": (1.2e-3, 0.0),
        "PRNU": (1.15e-3, 0.0),
        "DSNU_e": (1.35e-3, 0.0),
        "capacity_e": (4.0e-4, 0.0),
        "saturated_dn": (2.4e-7, 0.0),
    },
}
# Light 5 % short of Poisson noise: electrons come in packets of 0.95, all else is as on the data sheet.
_PACKET = 0.95
_IN_PACKETS = ("quantum_efficiency", "full_well_e", "read_noise_e", "dark_current_e_s", "dsnu_e", "gain_e")

Pairs = dict[str, tuple[float, float]]


def measure() -> float:
    """Deviation over its allowance, of the worst quantity of either sensor."""
    return _worst({})


def perturbed() -> float:
    """With light 5 % short of Poisson noise."""
    return _worst(dict.fromkeys(_IN_PACKETS, 1 / _PACKET))


def _worst(factors: dict[str, float]) -> float:
    ratios = [r for kind in _SENSORS for r in _ratios(kind, _bench(kind, factors, _SEED)).values()]
    return max(ratios, key=abs)


def _allowed(kind: str, quantity: str) -> float:
    error, bias = _ERROR_AND_BIAS[kind][quantity]
    return 4 * error + bias


def _ratios(kind: str, pairs: Pairs) -> dict[str, float]:
    # NaN is how the package says that a variance came out below zero: nothing of the quantity is there. As
    # NaN it would pass every comparison.
    shares = {q: 0.0 if np.isnan(found) else found / value for q, (value, found) in pairs.items()}
    return {q: float(share - 1) / _allowed(kind, q) for q, share in shares.items()}


def _bench(kind: str, factors: dict[str, float], seed: int) -> Pairs:
    """Take a bench; return the expected and the found value of each quantity.

    ``factors`` make the sensor on the bench another one than the data sheet says; lamp and expectation are
    the data sheet's. ``seed`` is that of the noise, and the sensor's serial number.
    """
    sheet = _SENSORS[kind]
    camera = camera_of(sheet, seed)
    lamp = (camera.dark_e, camera.exposure_s)
    photons = LEVELS * sheet.full_well_e / sheet.quantum_efficiency
    half = saturation_photons(camera.sensor, photons, *lamp) / 2
    truth = expected(camera.sensor, photons, half, *lamp)
    built = sheet.model_copy(update={name: getattr(sheet, name) * f for name, f in factors.items()})
    with tempfile.TemporaryDirectory() as folder:
        results = _by_reference(
            take_bench(Path(folder), camera_of(built, seed), photons, half, sheet.pitch_m**2, seed)
        )
    return {name: (value, results[name]) for name, value in truth.items()}


def _by_reference(descriptor: Path) -> dict[str, float]:
    program = str(Path(__file__).with_name("reference.py"))
    # -I: neither variables nor folders of this environment reach that one.
    command = [str(reference_python("emva1288")), "-I", program, str(descriptor)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise StorageError(f"the reference implementation of EMVA 1288 failed: {done.stderr.strip()[-600:]}")
    return json.loads(done.stdout)["results"]


# -- what is behind the one number ------------------------------------------------------------------------


def print_table() -> None:
    for kind, sheet in _SENSORS.items():
        print(f"{kind:14s}{'data sheet':>12s}{'expected':>12s}{'found':>12s}{'95 % +-':>10s}", end="")
        print(f"{'deviation':>11s}{'allowed':>10s}   (the last three relative)")
        pairs, true = _bench(kind, {}, _SEED), _data_sheet(sheet)
        for name, (value, found) in pairs.items():
            interval = 1.96 * _ERROR_AND_BIAS[kind][name][0]
            print(f"{name:14s}{true[name]:12.6g}{value:12.6g}{found:12.6g}{interval:10.1e}", end="")
            print(f"{found / value - 1:+11.1e}{_allowed(kind, name):10.1e}")


def _data_sheet(sensor: Ccd) -> dict[str, float]:
    """Return the physical numbers; capacity and saturated level are those of the well, which clips first."""
    full = sensor.full_well_e
    return {
        "QE": sensor.quantum_efficiency,
        "K_dn_e": 1 / sensor.gain_e,
        "sigma_d_e": sensor.read_noise_e,
        "PRNU": sensor.prnu,
        "DSNU_e": sensor.dsnu_e,
        "capacity_e": full,
        "saturated_dn": full * (1 - sensor.bend_at_full_well) / sensor.gain_e + sensor.black_dn,
    }


def print_breaks() -> None:
    breaks: dict[str, dict[str, float]] = {
        "none": {},
        "light 5 % short of Poisson": dict.fromkeys(_IN_PACKETS, 1 / _PACKET),
        "QE 2 % high": {"quantum_efficiency": 1.02},
        "QE 0.5 % high": {"quantum_efficiency": 1.005},
        "gain 2 % high": {"gain_e": 1.02},
        "read noise 10 % high": {"read_noise_e": 1.1},
        "read noise 1 % high": {"read_noise_e": 1.01},
        "PRNU 10 % high": {"prnu": 1.1},
        "PRNU 1 % high": {"prnu": 1.01},
        "no DSNU": {"dsnu_e": 0.0},
        "DSNU 5 % high": {"dsnu_e": 1.05},
        "well 2 % low": {"full_well_e": 0.98},
        "no bend": {"bend_at_full_well": 0.0},
        "bend a quarter less": {"bend_at_full_well": 0.75},
        "pitch 1 % high": {"pitch_m": 1.01},
        "black level 1 DN high": {"black_dn": 1.0625},
    }
    for name, factors in breaks.items():
        print(f"{name}")
        for kind in _SENSORS:
            ratios = _ratios(kind, _bench(kind, factors, _SEED))
            over = {q: f"{r:+.3g}" for q, r in ratios.items() if abs(r) > 1}
            print(f"  {kind}: {over or 'all within'}")


def print_spread(benches: int) -> None:
    for kind in _SENSORS:
        runs = [_bench(kind, {}, 100 + i) for i in range(benches)]
        print(f"{kind}: relative deviation over {benches} benches, standard deviation and mean")
        for name in runs[0]:
            deviations = np.array([run[name][1] / run[name][0] - 1 for run in runs])
            print(f"  {name:14s}{deviations.std(ddof=1):.2e}  {deviations.mean():+.1e}")


if __name__ == "__main__":
    if sys.argv[1:] == ["breaks"]:
        print_breaks()
    elif sys.argv[1:2] == ["spread"]:
        print_spread(int(sys.argv[2]))
    else:
        print_table()
