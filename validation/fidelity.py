"""What each fine approximation is worth: scores with it and without it, under the same noise.

``make fidelity`` writes ``reports/fidelity.md``. A variant of the camera or of a decoder takes the demo, on a
panel of half the size, through the same truth. Photons of both are quantiles of the same random numbers, so
that a cell differs by what the approximation does and by nothing else; two seeds tell what noise leaves of
that. What is found is kept until the code changes, so that a stopped run goes on.
"""

from __future__ import annotations

import platform
import time
import zlib
from collections import abc
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from kept import kept
from numpy.random import PCG64, Generator, SeedSequence

from optsim.calibration import Bench, Calibration, calibrate_from
from optsim.core.files import write_text
from optsim.core.threads import usable_cores
from optsim.decoding import frame_merge
from optsim.experiment import calibrations, loop
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.scoring import score
from optsim.experiment.truth import render_truth
from optsim.report.words import markdown_table

OUT = Path("reports") / "fidelity.md"
KEPT = Path("reports") / "runs" / "fidelity"
SCENES = ("window_room", "half_moving", "night_street")
SEEDS = (1, 2)
# Half the demo's panel before as many degrees, and a truth whose own noise no difference can see.
SMALL = (
    "n_frames=8",
    "camera.panel_rows=60",
    "camera.panel_cols=80",
    "camera.sensor.rows=188",
    "camera.sensor.cols=248",
    "camera.objective.focal_length_m='1.6667 mm'",
    "render.static_error=0.1",
    "render.change_error=0.3",
    "render.moving_error=0.5",
    "render.interpolation_error=0.3",
)
_METRICS = {"PU21-PSNR": "dB", "log-RMSE": "stops"}
_PHASES = ("steady", "merging", "warm-up")


class SameNoise(Generator):
    """Draws photons as quantiles of numbers that don't depend on how many are expected."""

    def poisson(self, lam: Any = 1.0, size: Any = None) -> Any:
        """Cornish and Fisher's quantile: mean, variance and skewness are Poisson's."""
        z = self.standard_normal(np.shape(lam) if size is None else size)
        return np.maximum(np.rint(lam + np.sqrt(lam) * z + (z * z - 1) / 6), 0)


def _stream(seed: int, *purpose: str | int) -> Generator:
    words = [zlib.crc32(p.encode()) if isinstance(p, str) else p for p in purpose]
    return SameNoise(PCG64(SeedSequence([seed, *words])))


def _never(calibration: Any, *_: Any) -> Any:
    return np.zeros(calibration.shape, np.bool_)


# Approximation -> what takes it away, or puts a finer one in its place.
VARIANTS: dict[str, Callable[[], AbstractContextManager[Any]]] = {
    "as it is": nullcontext,
    "fringe_model=mixed": nullcontext,
    "fringe_model=fine": nullcontext,
    "no joint merge": partial(mock.patch.object, frame_merge, "_unsettled", _never),
    "no hidden light": partial(mock.patch.object, frame_merge, "_GLARE_ROUNDS", 0),
}


def main() -> None:
    """Measure what isn't kept yet, and write the table."""
    found: dict[str, list[dict[str, dict[str, Any]]]] = {}
    for scene in SCENES:
        found[scene] = [{name: _measured(scene, seed, name) for name in VARIANTS} for seed in SEEDS]
        write_text(OUT, _page(found))
    print(f"table: {OUT}")


def keys_of(variant: str) -> list[str]:
    return [f"camera.modulator.{variant}"] if "=" in variant else []


def _measured(scene: str, seed: int, variant: str) -> dict[str, Any]:
    experiment = load_experiment("demo", [*SMALL, f"scene.name={scene}", f"seed={seed}", *keys_of(variant)])
    place = KEPT / f"{scene}, {seed}, {variant}.json"
    found = kept(place, experiment, partial(_measure, experiment, variant))
    print(f"{scene}, seed {seed}, {variant}: {found['seconds']:.0f} s", flush=True)
    return found


def _measure(experiment: Experiment, variant: str) -> dict[str, Any]:
    radiance = render_truth(experiment)
    with changed(variant):
        # A first frame loads the compiled loops, whose time is no approximation's.
        loop.run(experiment.model_copy(update={"n_frames": 1}), radiance)
        start = time.process_time()
        result = loop.run(experiment, radiance)
        seconds = time.process_time() - start
        cells = {
            f"{name}, {r.method}, {r.region}, {r.phase}": r.value
            for r in score(result)
            for name in _METRICS
            if r.metric.startswith(name) and r.value is not None
        }
    return {"cells": cells, "seconds": seconds}


@contextmanager
def changed(variant: str) -> abc.Generator[None, None, None]:
    """Run the code in a variant, with the same noise; each camera is calibrated by its own bench."""
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(loop, "stream", _stream))
        stack.enter_context(mock.patch.object(calibrations, "bench_calibration", _calibrated))
        stack.enter_context(VARIANTS[variant]())
        yield


def _calibrated(_camera: object, _seed: int, reading_px: int, bench: Callable[[], Bench]) -> Calibration:
    return calibrate_from(bench(), reading_px)


def _page(found: dict[str, list[dict[str, dict[str, Any]]]]) -> str:
    rows: list[list[str]] = []
    for name in list(VARIANTS)[1:]:
        for scene, seeds in found.items():
            cells = [_worst(seeds, name, metric, phase) for metric in _METRICS for phase in _PHASES]
            ratio = sum(s[name]["seconds"] for s in seeds) / sum(s["as it is"]["seconds"] for s in seeds)
            rows.append([name, scene, *cells, f"{ratio - 1:+.0%}"])
    heads = ["variant", "scene", *(f"{phase}, {unit}" for unit in _METRICS.values() for phase in _PHASES)]
    made = f"{datetime.now(UTC).date()}, {len(SEEDS)} seeds, {platform.machine()}, {usable_cores()} cores"
    table = "\n".join(markdown_table([*heads, "CPU time of a run"], rows))
    return _HEAD.format(made=made) + table + "\n" + _DECIDED


def _worst(seeds: list[dict[str, dict[str, Any]]], name: str, metric: str, phase: str) -> str:
    """Largest change of a cell, mean over the seeds, and how far they are from it."""
    gains: dict[str, list[float]] = {}
    for seed in seeds:
        for cell, before in seed["as it is"]["cells"].items():
            if cell.startswith(metric) and cell.endswith(phase) and cell in seed[name]["cells"]:
                gains.setdefault(cell, []).append(seed[name]["cells"][cell] - before)
    cell, changes = max(gains.items(), key=lambda pair: abs(np.mean(pair[1])))
    where = cell.removeprefix(f"{metric}, ").removesuffix(f", {phase}")
    return f"{np.mean(changes):+.3f} ± {np.ptp(changes) / 2:.3f} ({where})"


_HEAD = """# What fine approximations are worth

Written by `make fidelity`: {made}. The demo on a quarter of its pixels, eight frames. Each row is a variant:
the change of the cell (method, region) that changes most, mean over the seeds and how far they are from it.
Photons of both are quantiles of the same random numbers, so only what the variant does differs. Each is
calibrated by its own bench. Less than 0.1 dB does not pay.

"""
_DECIDED = """
## Decided

By these scores, and for what only saves time by CPU time (2026-11-28, two busy cores with AVX-512):

| approximation | worth | costs | verdict |
| --- | --- | --- | --- |
| fringe-field correction | without it 1.8 dB too good or 0.6 too bad | a third of a capture | stays |
| `fine` nodes over `coarse` | at most 0.04 dB, 0.013 of a frame's noise | a fifth of a run | no default |
| joint merge | 0.18 dB steady, 0.35 merging | 155 lines, 0.8 of 10.8 s of decoding | stays |
| hidden light | wins 0.8 dB merging, loses 0.6 steady | 137 lines, 0.4 of 10.8 s | stays |
| Winograd's sums | none: plain taps take 0.8 of their time | 54 lines | gone |
| whole arrays for few numbers | `explain demo` in 2.0 s, not 2.5 (18 compiling) | seven branches | stays |
| LLVM kernel of the pursuit | 24 microseconds a step, not 124 (numba) or 155 (numpy) | 262 lines | stays |

`coarse` moves no cell of `night_street` by more than 0.04 dB, so the 1.8 dB of mixing are no accident of the
closed loop. Joint merge and hidden light act where much saturates, not in `half_moving`. Hidden
light helps the adaptive scheme in `night_street` before it is steady, and misleads the mosaic there after
that: a cure is open. `tests/test_hidden_light.py` has its stops. A capture is that of the demo, 24.5 s of CPU
time with the correction, 16.4 without. Taps were timed on six instants of 64 x 128 samples, half widths of 4
to 12; a step of the pursuit is of 16 signals among 2000 atoms of 64 rows.
"""

if __name__ == "__main__":
    main()
