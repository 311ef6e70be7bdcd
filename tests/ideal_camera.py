"""A camera that is exactly what its calibration says, for tests of schemes and decoders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import CodedFrame, ExposureCode, Floats, PanelState
from optsim.optics.panel import PanelResponse

SLOTS = 36
BLACK_DN = 64.0
KERNEL = np.array([[0.002, 0.01, 0.002], [0.01, 0.952, 0.01], [0.002, 0.01, 0.002]], np.float32)


def ideal_calibration(
    rows: int, cols: int, *, leak: float = 0.0, tau_s: float = 0.0, **changes: Any
) -> Calibration:
    """1 W m^-2 all-on gives 9720 electrons, one DN each; saturation at 15 000 DN."""
    row, col = np.mgrid[:rows, :cols].astype(np.int64)

    def flat(value: float) -> Floats:
        return np.full((rows, cols), value, np.float32)

    fields: dict[str, Any] = {
        "source": "ideal",
        "slot_s": 1 / 180,
        "slots_per_frame": SLOTS,
        "coded_slots": SLOTS,
        "ccd_shape": (rows, cols),
        "response": PanelResponse(tau_on_s=tau_s, tau_off_s=2 * tau_s, leak=leak),
        "centre_row": row,
        "centre_col": col,
        "valid": np.ones((rows, cols), np.bool_),
        "responsivity_dn": flat(270),
        "black_dn": flat(BLACK_DN),
        "saturation_dn": flat(15_000),
        "read_noise_dn": 3.0,
        "dn_per_e": 1.0,
        "crosstalk": np.ones((1, 1), np.float32),
        "gain_uncertainty": 0.0,
        "leak_uncertainty": 0.0,
        "map_residual_px": 0.0,
    }
    fields |= changes
    return Calibration(**{**fields, "crosstalk": everywhere(fields["crosstalk"], rows, cols)})


def everywhere(kernel: Floats, rows: int, cols: int) -> Floats:
    """The same crosstalk kernel, (k, k), at every panel pixel."""
    return np.ascontiguousarray(np.broadcast_to(kernel, (rows, cols, *kernel.shape)), np.float32)


def expose(
    calibration: Calibration,
    light: Floats,
    index: int,
    code: ExposureCode,
    panel: PanelState | None,
    rng: np.random.Generator | None,
) -> tuple[CodedFrame, PanelState]:
    """One frame of slot irradiances (slot, v, u); without noise if there is no generator."""
    weights, panel = calibration.weights(code, panel)
    signal = calibration.spread((weights * light).sum(axis=0)[None].astype(np.float32))[0]
    dn = signal * calibration.responsivity_dn
    if rng is not None:
        dn = rng.poisson(dn / calibration.dn_per_e) * calibration.dn_per_e
        dn = dn + rng.normal(0, calibration.read_noise_dn, dn.shape)
    counts = np.rint(np.clip(dn + calibration.black_dn, 0, 16_383)).astype(np.uint16)
    return CodedFrame(index, counts, code), panel


def film(
    calibration: Calibration,
    scheme: Any,
    lights: Sequence[Floats],
    rng: np.random.Generator | None,
    latency: int = 1,
) -> list[CodedFrame]:
    """Run a scheme over frames of slot irradiances."""
    state = scheme.init(calibration, np.random.default_rng(5))
    panel: PanelState | None = None
    frames: list[CodedFrame] = []
    for index, light in enumerate(lights):
        code, state = scheme.next(index, frames[: max(0, index - latency + 1)], state)
        frame, panel = expose(calibration, light, index, code, panel, rng)
        frames.append(frame)
    return frames


def crossing(n: int, rows: int = 32, cols: int = 40) -> list[Floats]:
    """A dim wall with a bright bar that crosses it, in n frames."""
    light = np.full((n * SLOTS, rows, cols), 0.2, np.float32)
    u = np.arange(cols)
    for slot in range(n * SLOTS):
        light[slot, 8:20] += np.clip(1 - np.abs(u - 6 - 0.15 * slot) / 4, 0, 1).astype(np.float32)
    return list(light.reshape(n, SLOTS, rows, cols))


def still_light(image: Floats) -> Floats:
    """The same irradiance in every slot."""
    return np.broadcast_to(image.astype(np.float32), (SLOTS, *image.shape))
