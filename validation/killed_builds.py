"""Kill builds of a data set at random moments; nothing may be lost, half made or different afterwards.

A small build of three sequences runs in a process of its own. At a random moment either the whole build or
one of its workers gets SIGKILL. A killed build is started again, in the same folder. After the last kill the
build ends undisturbed. Then ``verify`` must find no fault, and every file must equal that of a build never
disturbed.

Run: ``python -m validation.killed_builds [KILLS] [SEED]``.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from optsim.dataset import open_dataset
from optsim.dataset.reading import MANIFEST
from optsim.dataset.verify import verify

_PRESET = Path(__file__).parents[1] / "optsim" / "presets" / "demo.toml"
# 16 x 12 panel pixels; too small for calibration images.
_SMALL = """[render]
static_error = 0.3
change_error = 0.5
moving_error = 0.8
interpolation_error = 0.3
[camera]
panel_rows = 12
panel_cols = 16
sensor = { rows = 44, cols = 56 }
objective = { focal_length_m = '0.3333 mm' }
"""
_SPEC = """name = "killed"
experiment = "./small.toml"
schemes = ["adaptive", "hdr_mosaic"]
reconstruct = true
[scenes]
wheel = ["main", "0:2"]
"""


def main(kills: int = 50, seed: int = 1) -> int:
    """Run it; return the exit code."""
    luck, killed = random.Random(seed), Counter[str]()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        text = _PRESET.read_text().replace("[camera]\n", _SMALL)
        (folder / "small.toml").write_text(text.replace('calibration = "bench"', 'calibration = "ideal"'))
        (folder / "spec.toml").write_text(_SPEC)
        start = time.monotonic()
        _finish(_start(folder, "calm"), folder)
        calm_s = time.monotonic() - start
        print(f"undisturbed: {calm_s:.1f} s", flush=True)
        round_ = 0
        while killed["worker"] + killed["build"] < kills:
            out, round_ = f"killed{round_}", round_ + 1
            build = _start(folder, out)
            while killed["worker"] + killed["build"] < kills:
                with suppress(subprocess.TimeoutExpired):
                    build.wait(luck.uniform(0.05, 0.7) * calm_s)
                if build.poll() is not None:
                    if build.returncode == 0:
                        break
                    # A sequence whose workers died three times is put aside; the next build makes it.
                    killed["put aside"] += 1
                    build = _start(folder, out)
                    continue
                killed[_kill(build, luck)] += 1
                print(dict(killed), flush=True)
                if build.poll() is not None:
                    build = _start(folder, out)
            if build.wait():
                _finish(_start(folder, out), folder)
            faults = verify(open_dataset(folder / out))
            same = (folder / out / MANIFEST).read_text() == (folder / "calm" / MANIFEST).read_text()
            left = list((folder / out).rglob(".*.part*"))
            print(f"{dict(killed)}: faults {faults}, half files {left}, same files: {same}", flush=True)
            if faults or left or not same:
                return 1
    return 0


def _start(folder: Path, out: str) -> subprocess.Popen[bytes]:
    """Start a build in a process group of its own."""
    command = [sys.executable, "-m", "optsim", "dataset", "build", str(folder / "spec.toml")]
    # A cache of its own, so that the renders are disturbed too.
    environment = {**os.environ, "OPTSIM_CACHE": str(folder / f"cache-{out}")}
    with (folder / "said.txt").open("wb") as said:
        return subprocess.Popen(
            [*command, "--workers", "2", "--out", str(folder / out)],
            env=environment,
            start_new_session=True,
            stdout=said,
            stderr=said,
        )


def _kill(build: subprocess.Popen[bytes], luck: random.Random) -> str:
    """Kill a worker or the whole build; return which."""
    workers = _workers(build.pid)
    if workers and luck.random() < 0.5:
        with suppress(ProcessLookupError):
            os.kill(luck.choice(workers), signal.SIGKILL)
        return "worker"
    with suppress(ProcessLookupError):
        os.killpg(build.pid, signal.SIGKILL)
    build.wait()
    return "build"


def _workers(parent: int) -> list[int]:
    """List the processes of the build's group that dask spawned to work."""
    found: list[int] = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal() or int(entry.name) == parent:
            continue
        with suppress(OSError, ProcessLookupError):
            if os.getpgid(int(entry.name)) == parent and b"spawn_main" in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def _finish(build: subprocess.Popen[bytes], folder: Path) -> None:
    if code := build.wait():
        raise SystemExit(f"a build ended with {code}: {(folder / 'said.txt').read_text()[-400:]}")


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
