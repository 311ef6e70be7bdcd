"""HDR merge of a radiance wedge over four decades, against the wedge itself."""

from __future__ import annotations

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.coding import HdrMosaic
from optsim.core.quantities import CodedFrame, Floats
from optsim.decoding import HdrMerge
from optsim.optics.panel import PanelResponse

CLAIM = (
    "the HDR merge of four mosaic frames gives back a wedge of four decades, saturation and noise included"
)
ORACLE = (
    "the wedge's own irradiance; frames made here with numpy from the counted open slots, a leak of 1 %, "
    "5-tap optical crosstalk, Poisson and Gaussian noise, 14 bits, and a clip at 15 770 e-"
)
SOURCE = (
    "S. K. Nayar and T. Mitsunaga, High dynamic range imaging: spatially varying pixel exposures, CVPR 2000"
)
TOLERANCE = 5e-3
REASON = (
    "The darkest decade, 14 400 pixels of 35 to 350 e- over four frames, has a standard error of 0.1 %. "
    "Four of them, and 0.1 % for choosing samples by their own noise near the clip."
)
FILES = (
    "optsim/decoding/frame_merge.py",
    "optsim/decoding/hdr_merge.py",
    "optsim/decoding/joint_merge.py",
    "optsim/decoding/neighbour_pooling.py",
    "optsim/decoding/hidden_light.py",
    "optsim/calibration/glare.py",
    "optsim/decoding/partial.py",
    "optsim/coding/hdr_mosaic.py",
    "optsim/coding/periodic.py",
    "optsim/calibration/calibration.py",
    "optsim/calibration/demixed.py",
    "optsim/optics/motion.py",
    "optsim/optics/neighbourhoods.py",
    "optsim/optics/stray_light.py",
    "optsim/optics/panel.py",
    "optsim/optics/relaxation.py",
)

_SLOTS, _ROWS, _COLS = 36, 240, 240
_OPEN = (1, 3, 11, 36)
_LEAK, _SIDE = 0.01, 0.01
_DARK_END = 4.5e-3
_ELECTRONS = 35 / 52 / _DARK_END  # per slot and W m^-2: 35 e- over the four exposures at the dark end
_READ_E, _DN_PER_E, _BLACK = 5.0, 1.039, 200.0
_FULL_WELL_E = 15_770.0


def measure() -> float:
    return _worst_decade(_LEAK)


def perturbed() -> float:
    """With weights that know nothing of the light that a dark panel leaks."""
    return _worst_decade(0.0)


def _worst_decade(believed_leak: float) -> float:
    wedge = _DARK_END * 10 ** (4 * np.arange(_COLS) / (_COLS - 1))
    truth = np.broadcast_to(wedge, (_ROWS, _COLS))
    frames = _frames(truth)
    *_, found = HdrMerge(threshold_sigma=6).decode(frames, _calibration(believed_leak))
    if not (found.valid.all() and not found.interpolated.any()):
        return 1.0
    ratio = found.irradiance_w_m2[0] / truth
    decades = ratio.reshape(_ROWS, 4, _COLS // 4).mean(axis=(0, 2)) - 1
    return float(decades[np.abs(decades).argmax()])


def _frames(truth: np.ndarray) -> list[CodedFrame]:
    rng = np.random.default_rng(2000)
    scheme = HdrMosaic(open_slots=_OPEN)
    state = scheme.init(_calibration(_LEAK), rng)
    v, u = np.mgrid[:_ROWS, :_COLS]
    frames: list[CodedFrame] = []
    for f in range(4):
        code, state = scheme.next(f, [], state)
        exposure = np.array(_OPEN, float)[(2 * v + u + f) % 4]
        signal = (_LEAK * _SLOTS + (1 - _LEAK) * exposure) * truth
        around = np.pad(signal, 1, mode="edge")
        sides = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
        light = (1 - 4 * _SIDE) * signal + _SIDE * sides
        electrons = np.minimum(rng.poisson(light * _ELECTRONS), _FULL_WELL_E)
        electrons = electrons + rng.normal(0, _READ_E, truth.shape)
        dn = np.rint(np.clip(electrons * _DN_PER_E + _BLACK, 0, 16_383)).astype(np.uint16)
        frames.append(CodedFrame(f, dn, code))
    return frames


def _calibration(leak: float) -> Calibration:
    rows, cols = np.mgrid[:_ROWS, :_COLS].astype(np.int64)

    def flat(value: float) -> Floats:
        return np.full((_ROWS, _COLS), value, np.float32)

    kernel = np.array([[0, _SIDE, 0], [_SIDE, 1 - 4 * _SIDE, _SIDE], [0, _SIDE, 0]], np.float32)
    clip = min(_FULL_WELL_E * _DN_PER_E + _BLACK, 16_383.0)
    return Calibration(
        source="ideal",
        slot_s=1 / 180,
        slots_per_frame=_SLOTS,
        coded_slots=_SLOTS,
        ccd_shape=(_ROWS, _COLS),
        response=PanelResponse(tau_on_s=0.0, tau_off_s=0.0, leak=leak),
        centre_row=rows,
        centre_col=cols,
        valid=np.ones((_ROWS, _COLS), np.bool_),
        responsivity_dn=flat(_ELECTRONS * _DN_PER_E),
        black_dn=flat(_BLACK),
        saturation_dn=flat(clip - 4 * _READ_E * _DN_PER_E),
        read_noise_dn=_READ_E * _DN_PER_E,
        dn_per_e=_DN_PER_E,
        crosstalk=np.ascontiguousarray(np.broadcast_to(kernel, (_ROWS, _COLS, *kernel.shape))),
        gain_uncertainty=0.0,
        leak_uncertainty=0.0,
        map_residual_px=0.0,
    )
