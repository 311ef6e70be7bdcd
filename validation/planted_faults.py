"""Proof that the regression gate catches four planted faults, and does not catch another seed.

``make planted-faults`` (minutes) records a small film with each fault in turn and compares it with the sound
code. The page is ``reports/planted_faults.md``. Faults are of the code: calibration, camera and decoder all
have them, settings do not. Each has a process and a cache of its own, for none to find a sound part.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.parts.ccd import Ccd
from optsim.camera.parts.relay import Relay
from optsim.core.files import write_text
from optsim.core.quantities import RadianceVideo, Reconstruction
from optsim.decoding import HdrMerge
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import run
from optsim.experiment.readings import bench_readings
from optsim.experiment.resume import run_key
from optsim.experiment.run_folder import versions
from optsim.experiment.scoring import scorer_of
from optsim.footage.made import footage
from optsim.metrics import ALL, class_series
from optsim.metrics.tolerances import READING
from optsim.report.baseline import (
    FORMAT,
    Facts,
    Run,
    Scored,
    last_phase,
    read_baseline,
    reading_facts,
    write_baseline,
)
from optsim.report.comparison import Comparison, compare
from optsim.report.comparison_text import cells, detectable_lines, headline, ranked
from optsim.report.words import markdown_table

OUT = Path("reports") / "planted_faults.md"
RUNS = Path("reports") / "runs" / "planted_faults"
ROWS, COLS, FRAMES = 24, 32, 4
WIDER, NOISIER = 1.05, 1.03
# Noise of a share of the stated uncertainty that costs still pixels of this film 0.2 dB, as measured.
WORSE = 0.068


def worse_decoder(decode: Any, _: Path) -> Any:
    """Add noise that costs still pixels about 0.2 dB."""

    def noisy(self: Any, frames: Iterable[Any], calibration: Any) -> Iterator[Reconstruction]:
        for video in decode(self, frames, calibration):
            # The same in all slots: a mosaic has no error from slot to slot, and gets none.
            drawn = np.random.default_rng(video.index).standard_normal(video.valid.shape)
            light = video.irradiance_w_m2 + WORSE * drawn * video.uncertainty_w_m2
            yield replace(video, irradiance_w_m2=np.maximum(light, 0).astype(np.float32))

    return noisy


def wider_psf(psf: Any, _: Path) -> Any:
    """Stretch the relay's PSF, as if its cells were smaller."""

    def wide(self: Any, f_number: float, cell_m: float, *rest: Any) -> Any:
        return psf(self, f_number, cell_m / WIDER, *rest)

    return wide


def noisier(digitise: Any, _: Path) -> Any:
    """Raise all temporal noise of a frame."""

    def noisy(self: Any, expected_e: Any, exposure_s: float, serial_number: int, rng: Any) -> Any:
        dn, negative = digitise(self, expected_e, exposure_s, serial_number, rng)
        mean = self.signal_e(expected_e, exposure_s, serial_number) / self.step_e + self.zero_dn
        raised = np.clip(np.rint(mean + NOISIER * (dn - mean)), 0, self.max_dn).astype(np.uint16)
        return np.where(dn < self.max_dn, raised, dn), negative

    return noisy


def shifted_code(expose: Any, _: Path) -> Any:
    """Show each code one slot late, and report it as commanded."""

    def late(self: Any, truth: Any, index: int, code: Any, panel: Any, rng: Any) -> Any:
        shown = replace(code, levels=np.roll(code.levels, 1, axis=0))
        frame, after = expose(self, truth, index, shown, panel, rng)
        return replace(frame, code=code), after

    return late


@dataclass(frozen=True)
class Fault:
    """A fault: what to replace, by what, and the method, calibration and seeds that it is looked for with."""

    owner: Any
    name: str
    make: Callable[[Any, Path], Any]
    method: str = "hdr_mosaic"
    calibration: str = "true"
    seeds: int = 4


FAULTS = {
    "the decoder of the mosaic worse by 0.2 dB": Fault(HdrMerge, "decode", worse_decoder),
    "the relay's PSF 5 % wider": Fault(Relay, "psf", wider_psf),
    # The bench measures noise far better than any score of a film.
    "temporal noise 3 % higher": Fault(Ccd, "digitise", noisier, calibration="bench"),
    # A mosaic has no code within a frame that could be late, and random codes scatter more from seed to seed.
    "the code one slot late": Fault(CodedCamera, "expose", shifted_code, method="random", seeds=8),
}


def experiment(seed: int, method: str, calibration: str) -> Experiment:
    """One method on a small panel."""
    return load_experiment(
        "demo",
        [
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={3 * ROWS + 8}",
            f"camera.sensor.cols={3 * COLS + 8}",
            f"calibration={calibration}",
        ],
        seed=seed,
        n_frames=FRAMES,
        name="film",
    ).only([method])


def film(one: Experiment) -> RadianceVideo:
    """Make a dim texture over two decades of light, which a bright bar crosses again and again."""
    rng = np.random.default_rng(0)
    texture = np.kron(rng.uniform(0.02, 0.15, (ROWS // 2, COLS // 2)), np.ones((6, 6)))
    texture *= np.geomspace(0.03, 1, texture.shape[1])
    frames = np.repeat(texture[None], one.timing.n_slots, 0)
    for slot in range(len(frames)):
        bar = (10 + 3 * slot // 2 + np.arange(24)) % texture.shape[1]
        frames[slot, 24:42, bar] = 0.4
    return footage(
        frames.astype(np.float32), slot_s=one.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4
    )


def measure(seeds: Iterable[int], method: str, calibration: str) -> Scored:
    """Run all seeds in memory and take their scores."""
    runs: list[Run] = []
    facts: dict[str, Facts] = {}
    for seed in seeds:
        one = experiment(seed, method, calibration)
        result = run(one, film(one))
        scorer = scorer_of(result)
        series = class_series(ALL, scorer.classes)
        frames, scores = last_phase(series, one.camera.latency_frames)
        facts |= {s.metric: Facts(unit=s.unit, higher_is_better=s.higher_is_better) for s in series}
        readings = bench_readings(result.calibration)
        facts |= {READING + r.name: reading_facts(r) for r in readings}
        values = {READING + r.name: r.value for r in readings}
        runs.append(Run(case=one.name, seed=seed, frames=frames, readings=values, scores=scores))
        print(f"seed {seed}: done", flush=True)
    return Scored(
        format=FORMAT,
        name="film",
        made_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
        metrics=facts,
        experiments={"film": experiment(1, method, calibration).model_dump(mode="json", exclude={"seed"})},
        runs=runs,
    )


def main(words: list[str]) -> int:
    """Measure all and write the page; 1 when a fault is not caught, or another seed is."""
    if words:
        one_side(Path(words[0]), int(words[1]))
        return 0
    found = {
        fault: judged(side("sound", each), side(f"fault{number}", each))
        for number, (fault, each) in enumerate(FAULTS.items())
    }
    first = next(iter(FAULTS.values()))
    other = judged(side("sound", first), side("other_seeds", first))
    write_text(OUT, page(found, other))
    print(f"page: {OUT}")
    caught = all(each.outcome == "regression" for each in found.values())
    return 0 if caught and other.outcome == "pass" else 1


def side(name: str, fault: Fault) -> Scored:
    """Return one side of a comparison, measured in a process of its own unless it is there."""
    key = run_key(experiment(1, fault.method, fault.calibration), versions())[:12]
    path = RUNS / key / f"{name}.{fault.method}.{fault.calibration}.json"
    if not path.exists():
        print(path.stem, flush=True)
        with tempfile.TemporaryDirectory(prefix="optsim-fault-") as cache:
            alone = os.environ | {"OPTSIM_CACHE": cache}
            subprocess.run([sys.executable, __file__, str(path), str(fault.seeds)], check=True, env=alone)
    return read_baseline(path)


def one_side(path: Path, n_seeds: int) -> None:
    """Plant the fault that a file is named after, and measure."""
    name, method, calibration = path.stem.split(".")
    if name.startswith("fault"):
        fault = list(FAULTS.values())[int(name.removeprefix("fault"))]
        setattr(fault.owner, fault.name, fault.make(getattr(fault.owner, fault.name), path.parent))
    first = 101 if name == "other_seeds" else 1
    write_baseline(path, measure(range(first, first + n_seeds), method, calibration))


def judged(before: Scored, after: Scored) -> Comparison:
    return compare(before, after, datetime.now(UTC).isoformat(timespec="seconds"))


def page(found: dict[str, Comparison], other: Comparison) -> str:
    """Write what each fault did."""
    rows = [[fault, _caught(each), *_worst(each)] for fault, each in found.items()]
    rows.append(["other seeds: no fault", _caught(other), *_worst(other)])
    some = next(iter(found.values()))
    return "\n".join(
        [
            _HEAD,
            *markdown_table(
                ("planted", "outcome", "failed rows", "clearest row", "change", "interval"), rows
            ),
            "",
            "Smallest loss that fails with 90 % probability, from the pairs of the first fault:",
            "",
            *(f"- {line}" for line in detectable_lines(some)),
            "",
            *(f"{fault}: {headline(each)}.\n" for fault, each in found.items()),
        ]
    )


def _caught(each: Comparison) -> str:
    return "caught" if each.outcome == "regression" else each.outcome


def _worst(each: Comparison) -> list[str]:
    fails = [d for d in ranked(each.deltas) if d.alarm == "fail"]
    if not fails:
        return ["0", "-", "-", "-"]
    row = cells(fails[0])
    return [str(len(fails)), ", ".join(row[1:5]), row[5], row[6]]


_HEAD = """# Planted faults

Written by `make planted-faults`. Each fault is planted into the code, a method records a small film with
four seeds, and the gate of `optsim compare` judges them against the sound code. Another four seeds are no
fault. The HDR mosaic finds the first three, the third by its bench, and random exposures with eight seeds the
last.
"""

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
