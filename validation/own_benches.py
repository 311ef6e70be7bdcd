"""How often a calibration's intervals hold on benches of the virtual laboratory, small and made fast.

    python validation/own_benches.py [BENCHES] [DRAWS OF NOISE A CAMERA]

Each camera has misalignments, blur and a panel of its own, drawn. Its images without noise are made once,
and taken with as many draws of noise. Prints a row a quantity: the share of the 95 % intervals that hold, and
mean and rms of the deviation over the standard error.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from optsim.calibration import Bench
from optsim.calibration.estimate import measure_calibration
from optsim.camera.camera import CodedCamera
from optsim.camera.hardware.cameras import demo
from optsim.camera.laboratory import ALL_FRAMES, FEW_FRAMES, Frames, measure_bench
from optsim.experiment import calibration_record as records

PANEL, CCD = (48, 64), (160, 208)


def changed(camera: CodedCamera, part: str, **values: Any) -> CodedCamera:
    """Give a part of a camera other values."""
    return camera.model_copy(update={part: getattr(camera, part).model_copy(update=values)})


def drawn(rng: np.random.Generator) -> CodedCamera:
    """Draw a camera of the demo's kind."""
    camera = demo().model_copy(
        update={
            "panel_rows": PANEL[0],
            "panel_cols": PANEL[1],
            "serial_number": int(rng.integers(1, 2**31)),
        }
    )
    camera = changed(camera, "sensor", rows=CCD[0], cols=CCD[1])
    camera = changed(
        camera,
        "relay",
        shift_y_px=rng.uniform(-3, 3),
        shift_x_px=rng.uniform(-3, 3),
        rotation_rad=rng.uniform(-8e-3, 8e-3),
        magnification_error=rng.uniform(-0.01, 0.01),
        keystone_y=rng.uniform(-5e-3, 5e-3),
        keystone_x=rng.uniform(-5e-3, 5e-3),
        distortion=rng.uniform(-0.01, 0.01),
        defocus_m=rng.uniform(-50e-6, 50e-6),
    )
    return changed(
        camera,
        "modulator",
        delay_s=rng.uniform(0.1e-3, 0.5e-3),
        scan_s=rng.uniform(0, 1.5e-3) * camera.modulator.rows / PANEL[0] / 12,
        tau_on_s=rng.uniform(0.3e-3, 0.8e-3),
        tau_off_s=rng.uniform(0.6e-3, 1.4e-3),
        drive_exponent=rng.uniform(0.9, 1.5),
        depolarised_share=camera.modulator.depolarised_share * rng.uniform(0.5, 2),
    )


def benches(camera: CodedCamera, draws: int, frames: Frames, seed: int) -> Iterator[Bench]:
    """Take a camera's bench with several draws of noise; its images without noise are made once."""
    clean: list[Any] = []
    plain = CodedCamera.expected_electrons
    for draw in range(draws):
        again = iter(list(clean))

        def expected(*args: Any, draw: int = draw, again: Iterator[Any] = again) -> Any:
            if draw:
                return next(again)
            clean.append(plain(*args))
            return clean[-1]

        with mock.patch.object(CodedCamera, "expected_electrons", expected):
            yield measure_bench(camera, np.random.default_rng([seed, draw]), frames)


def tally(n_benches: int, draws: int) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Give deviations over standard errors by quantity, and shares held of fields by name."""
    rng = np.random.default_rng(11)
    # The truth of a camera is worked out once for all its benches.
    for name in ("true_calibration", "light_places"):
        setattr(records, name, lru_cache(maxsize=2)(getattr(records, name)))
    off: dict[str, list[float]] = {}
    fields: dict[str, list[float]] = {}
    for number in range(n_benches // draws):
        camera = drawn(rng)
        for bench in benches(camera, draws, (FEW_FRAMES, ALL_FRAMES)[number % 2], number):
            measured = measure_calibration(bench)
            plain = records.calibration_record(measured, bench, Path())
            record = records.with_truth(plain, measured, bench, camera, "drawn")
            for each in record.quantities:
                if each.holds is not None and each.true is not None and each.standard_error:
                    off.setdefault(each.key, []).append((each.value - each.true) / each.standard_error)
            for each in record.score.coverage if record.score else ():
                fields.setdefault(each.what, []).append(each.held)
    return off, fields


if __name__ == "__main__":
    counts = [int(each) for each in sys.argv[1:]]
    deviations, shares = tally(*(counts + [30, 10][len(counts) :]))
    for name, z in deviations.items():
        held, rms = np.mean(np.abs(z) <= 1.96), np.sqrt(np.mean(np.square(z)))
        print(f"{name:22} {len(z):4} held {held:.3f}  mean {np.mean(z):+.2f}  rms {rms:.2f}")
    for name, held in shares.items():
        print(f"{name:22} {len(held):4} held {np.mean(held):.3f}  worst {min(held):.3f}")
