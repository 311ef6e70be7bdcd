"""Speed of data-set builds: a sequence, two workers, and the forecast of ``--plan``.

Sequences are 36 slots of flying_solids for the demo's camera, with all passes, in numbered variations.

- ``dataset.sequence``: sequences an hour of a process that already made one, as a worker of a build is. The
  peer makes each in a process of its own, as a loop of ``optsim render --passes`` does. The conditions state
  the share of time spent outside the renderer.
- ``dataset.two_workers``: two workers with a core each, against one worker with one core; beside it, one
  worker with all cores.
- ``dataset.plan_error``: relative error of the forecast time against the build that follows. The peer is the
  largest error that users accept, 30 %.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from optsim.core.progress import Progress, silent
from optsim.core.threads import CORES
from optsim.dataset import build_dataset, forecast
from optsim.dataset.export import export_passes
from optsim.dataset.spec import DatasetSpec
from optsim.tasks import default_workers

_SCENE, _OTHER = "flying_solids", "window_room"
_WARM, _ALONE = 2, 2  # Sequences measured after the first, and sequences of a process each.
_ALLOWED_ERROR = 0.3


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Measure one record.

    Parameters
    ----------
    name : str
        ``dataset.sequence``, ``dataset.two_workers`` or ``dataset.plan_error``.
    progress : Progress
        Told of each piece of work.
    """
    records = {
        "dataset.sequence": _sequence,
        "dataset.two_workers": _two_workers,
        "dataset.plan_error": _plan_error,
    }
    with tempfile.TemporaryDirectory() as folder:
        return {"name": name} | records[name](Path(folder), progress)


def _spec(**scenes: int) -> DatasetSpec:
    """Truth alone of some numbered variations of scenes."""
    numbers = {scene: tuple(str(number) for number in range(count)) for scene, count in scenes.items()}
    return DatasetSpec(name="bench", scenes=numbers)


def _sequence(folder: Path, progress: Progress) -> dict[str, Any]:
    total = 1 + _WARM + _ALONE
    seconds: list[float] = []
    outside: list[float] = []
    spec = _spec(**{_SCENE: 1 + _WARM})
    with _cache(folder / "cache"), _rendering_clock() as rendering:
        for number, plan in enumerate(spec.sequences()):
            before, start = rendering(), time.perf_counter()
            export_passes(spec.experiment_of(plan, 1), folder / str(number))
            seconds.append(time.perf_counter() - start)
            outside.append(1 - (rendering() - before) / seconds[-1])
            progress("sequences", number + 1, total)
    alone: list[float] = []
    for number in range(1, 1 + _ALONE):
        setting = f"scene.variation={number}"
        command = ["render", "demo", "--set", f"scene.name={_SCENE}", "--set", setting, "--set", "n_frames=1"]
        place = str(folder / f"alone{number}")
        alone.append(_run([*command, "--passes", "--out", place], folder / f"cache{number}"))
        progress("sequences", len(seconds) + number, total)
    warm, each = sum(seconds[1:]) / _WARM, sum(alone) / _ALONE
    return {
        "value": 3600 / warm,
        "unit": "sequences/h",
        "peer": "a process for each",
        "peer_value": 3600 / each,
        "ratio": each / warm,
        "conditions": {
            "sequence": f"36 slots of {_SCENE}, demo's camera, all passes, {CORES} cores",
            "seconds": seconds,
            "share_outside_the_renderer": outside,
            "seconds_in_own_process": alone,
        },
    }


def _two_workers(folder: Path, progress: Progress) -> dict[str, Any]:
    spec = folder / "bench.toml"
    spec.write_text(f'name = "bench"\n[scenes]\n{_SCENE} = ["0:4"]\n')
    ways = {"two workers": (2, 1), "one worker, one core": (1, 1), "one worker, all cores": (1, CORES)}
    seconds: dict[str, float] = {}
    for done, (way, (workers, threads)) in enumerate(ways.items()):
        place = folder / str(done)
        command = ["dataset", "build", str(spec), "--workers", str(workers), "--out", str(place / "out")]
        seconds[way] = _run(command, place / "cache", threads if workers == 1 else CORES)
        progress("builds", done + 1, len(ways))
    two, one, both = seconds.values()
    return {
        "value": 4 * 3600 / two,
        "unit": "sequences/h",
        "peer": "one worker, one core",
        "peer_value": 4 * 3600 / one,
        "ratio": one / two,
        "conditions": {
            "build": f"4 sequences of {_SCENE}, truth alone, start-up included",
            "seconds": seconds,
            "ratio_to_one_worker_with_all_cores": both / two,
        },
    }


def _plan_error(folder: Path, progress: Progress) -> dict[str, Any]:
    spec = _spec(**{_SCENE: 5, _OTHER: 4})
    with _cache(folder / "cache"):
        said = forecast(spec, folder / "out", progress=progress)
        start = time.perf_counter()
        build_dataset(spec, folder / "out", progress=progress)
        took = time.perf_counter() - start
    forecast_s = said.wall_s(default_workers())
    error = abs(forecast_s / took - 1)
    disk_mb = sum(path.stat().st_size for path in (folder / "out").rglob("*") if path.is_file()) / 1e6
    return {
        "value": error,
        "unit": "share of the time",
        "peer": "accepted error",
        "peer_value": _ALLOWED_ERROR,
        "ratio": _ALLOWED_ERROR / error,
        "conditions": {
            "forecast_s": forecast_s,
            "took_s": took,
            "forecast_mb": said.disk_mb,
            "took_mb": disk_mb,
            "sequences": f"{said.to_do} after a pilot of {said.measured}",
        },
    }


def _run(arguments: list[str], cache: Path, threads: int = CORES) -> float:
    """Seconds of a command in a process and with a cache of its own."""
    environment = {**os.environ, "OPTSIM_CACHE": str(cache), "OPTSIM_THREADS": str(threads)}
    start = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "optsim", *arguments], env=environment, check=True, capture_output=True
    )
    return time.perf_counter() - start


@contextmanager
def _cache(folder: Path) -> Generator[None]:
    with mock.patch.dict(os.environ, {"OPTSIM_CACHE": str(folder)}):
        yield


@contextmanager
def _rendering_clock() -> Generator[Callable[[], float]]:
    """Measure the seconds spent in the renderer by an export of passes."""
    from optsim.dataset import export
    from optsim.render import PassRenderer

    spent = 0.0

    def timed(call: Callable[..., Any]) -> Callable[..., Any]:
        def inner(*arguments: Any, **keywords: Any) -> Any:
            nonlocal spent
            start = time.perf_counter()
            try:
                return call(*arguments, **keywords)
            finally:
                spent += time.perf_counter() - start

        return inner

    with (
        mock.patch.object(export, "render_truth", timed(export.render_truth)),
        mock.patch.object(PassRenderer, "at", timed(PassRenderer.at)),
    ):
        yield lambda: spent
