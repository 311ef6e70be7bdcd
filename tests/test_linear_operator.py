# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false, reportOperatorIssue=false
"""A calibration as an operator for solvers from elsewhere."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ideal_camera import KERNEL, SLOTS, expose, ideal_calibration
from test_docs import OF_A_FRAME, blocks

from optsim.calibration import Glare, linear_operator
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import ExposureCode

ROWS, COLS = 9, 13


def _code(rng: np.random.Generator) -> ExposureCode:
    levels = rng.integers(0, 256, (SLOTS, ROWS, COLS)).astype(np.uint8)
    return ExposureCode(levels, np.ones((ROWS, COLS), np.bool_))


@pytest.mark.parametrize("reach", [0, 2])
@pytest.mark.parametrize("glare", [Glare(), Glare(0.03, 0.02, 3.0, (0.02, 0.01, 0.0, 0.0))])
def test_the_adjoint_is_the_transpose(reach: int, glare: Glare) -> None:
    rng = np.random.default_rng(1)
    size = 2 * reach + 1
    responsivity = rng.uniform(100, 300, (ROWS, COLS)).astype(np.float32)
    kernels = rng.random((ROWS, COLS, size, size)).astype(np.float32)
    calibration = replace(
        ideal_calibration(ROWS, COLS, leak=0.02, tau_s=1e-3, glare=glare, responsivity_dn=responsivity),
        crosstalk=kernels / kernels.sum(axis=(2, 3), keepdims=True),
    )
    operator = linear_operator(calibration, _code(rng))
    video, signal = rng.random(operator.shape[1]), rng.random(operator.shape[0])
    assert np.vdot(signal, operator @ video) == pytest.approx(np.vdot(operator.H @ signal, video), rel=1e-5)


def test_it_is_what_a_frame_measures() -> None:
    rng = np.random.default_rng(2)
    calibration = ideal_calibration(ROWS, COLS, leak=0.02, tau_s=1e-3, crosstalk=KERNEL)
    code = _code(rng)
    light = rng.uniform(0.1, 1, (SLOTS, ROWS, COLS)).astype(np.float32)
    frame, _ = expose(calibration, light, 0, code, None, None)
    signal = linear_operator(calibration, code) @ light.ravel()
    rounding = 0.5 / calibration.responsivity_dn.ravel()
    assert np.all(np.abs(signal - calibration.observe(frame).signal.ravel()) <= rounding * 1.01)
    # After a dark frame the panel opens later than after a cycle of the same code.
    after_dark = linear_operator(calibration, code, calibration.panel_at_rest()) @ light.ravel()
    assert np.all(after_dark <= signal)
    assert np.any(after_dark < signal - 1e-4)


def test_a_solver_from_elsewhere_takes_it_as_the_manual_says() -> None:
    rng = np.random.default_rng(3)
    calibration = ideal_calibration(ROWS, COLS, crosstalk=KERNEL)
    code, light = _code(rng), rng.uniform(0.2, 0.8, (SLOTS, ROWS, COLS)).astype(np.float32)
    frame, _ = expose(calibration, light, 0, code, None, None)
    (manual,) = [text for page, text in blocks("python") if page == OF_A_FRAME]
    there: dict[str, Any] = {"calibration": calibration, "frame": frame}
    exec(manual, there)
    again, _ = expose(calibration, there["video"], 0, code, None, None)
    np.testing.assert_allclose(again.dn, frame.dn, rtol=0.02)


def test_a_code_of_another_panel_is_refused() -> None:
    code = ExposureCode(np.zeros((SLOTS, 3, 3), np.uint8), np.zeros((3, 3), np.bool_))
    with pytest.raises(ValueCheckError, match="code: got levels of shape"):
        linear_operator(ideal_calibration(ROWS, COLS), code)
