# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false, reportCallIssue=false
"""A calibration as a linear operator, for solvers and networks from elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import ExposureCode, Floats, PanelState

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator


def linear_operator(
    calibration: Calibration, code: ExposureCode, panel: PanelState | None = None
) -> LinearOperator:
    """Return the operator from the light of a frame's slots to its coded image, with its adjoint.

    ``operator @ video.ravel()`` is what :meth:`Calibration.observe` estimates of a frame, ``signal.ravel()``,
    W m^-2 slots, without noise and saturation. ``operator.H @ signal.ravel()`` is the adjoint.

    Parameters
    ----------
    calibration : Calibration
        The camera as measured.
    code : ExposureCode
        Drive levels of one coded frame.
    panel : PanelState, optional
        The panel when the frame starts, as :meth:`Calibration.weights` returns it for the frame before.
        None at the start of an experiment.

    Returns
    -------
    scipy.sparse.linalg.LinearOperator of shape (v u, slot v u), float32

    Raises
    ------
    ValueCheckError
        When the code is of another panel or number of slots.
    """
    from scipy.sparse.linalg import LinearOperator

    weights = calibration.weights(code, panel)[0]
    shape = calibration.shape

    def forward(video: Floats) -> Floats:
        light = np.einsum("tvu,tvu->vu", weights, video.reshape(weights.shape).astype(np.float32))
        return calibration.mix(light).ravel()

    def adjoint(signal: Floats) -> Floats:
        return (weights * calibration.mix_adjoint(signal.reshape(shape).astype(np.float32))).ravel()

    size = (weights[0].size, weights.size)
    return LinearOperator(shape=size, matvec=forward, rmatvec=adjoint, dtype=np.float32)
