"""First look at the images of a bench, before anything is fitted: is each what the manifest says."""

from __future__ import annotations

import numpy as np

from optsim.calibration.bench import Bench
from optsim.core.errors import BenchError
from optsim.core.quantities import Floats, Words

# Every third row and column: all patches are seen at a sixth of the cost.
_STRIDE = 3
# Excess of a frame's difference over read noise, as a share of the signal's mean square and in units of the
# read noise's: shot noise and a source that drifts by 10 % stay below.
_MOST_SHARE, _MOST_READ = 0.05, 3.0
# Share of the flats' light at which a panel is not off.
_NOT_OFF = 0.5


def check_images(bench: Bench) -> None:
    """Refuse a frame that differs from the others of its set by more than noise, and an off that is lit."""
    darks = _thinned(bench.darks)
    black: Floats = np.median(darks, axis=0)
    read_variance = float(np.median(np.mean(np.diff(darks, axis=0) ** 2, axis=(1, 2)))) / 2
    for name, dn in (("darks", bench.darks), *((name, group.dn) for name, group in bench.groups())):
        if len(dn) < 2:
            continue
        frames = _thinned(dn) - black
        typical = np.median(frames, axis=0) if len(dn) > 2 else frames[:1]
        # Against the median frame the noise of two frames is nearly that of one.
        excess = np.mean((frames - typical) ** 2, axis=(1, 2)) / (1 if len(dn) > 2 else 2) - read_variance
        worst = int(excess.argmax())
        signal = float(np.mean(frames**2))
        if excess[worst] > _MOST_SHARE * signal + _MOST_READ * max(read_variance, 1 / 12):
            others = "the other frames of its set" if len(dn) > 2 else "the set's other frame"
            off_dn = np.sqrt(excess[worst])
            raise BenchError(
                f"{bench.where(name, worst)}: got {off_dn:.3g} DN rms off {others}, "
                "expected noise alone; cure: exchange the file, or take the set again"
            )
    lit, dark = (
        float(np.median((_thinned(shot.dn) - black).mean(axis=0).clip(0))) / shot.irradiance_w_m2
        for shot in (max(bench.flats, key=lambda shot: shot.irradiance_w_m2), bench.off)
    )
    if dark > _NOT_OFF * lit > 0:
        raise BenchError(
            f"{bench.where('off')}: got {dark / lit:.2g} of the light that flats have, expected a panel that "
            "is darker when off; cure: exchange the file, or correct level and irradiance_w_m2"
        )


def _thinned(dn: Words) -> Floats:
    return dn[:, ::_STRIDE, ::_STRIDE].astype(np.float32)
