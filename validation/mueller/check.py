"""Mueller matrices of splitter and panel against Jones calculus, and against what matter can do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from optsim.camera.hardware import lcr720
from optsim.camera.parts import Splitter
from optsim.core.quantities import Doubles
from optsim.optics.mueller import depolariser, mirror, polariser, retarder_45, turned

CLAIM = (
    "polarisers, retarders, mirror, depolariser and panel at any angle are what Jones calculus says; "
    "polarisers obey Malus's law; splitter and panel are realisable and make no light, nor do both ports "
    "of the splitter"
)
ORACLE = (
    "Mueller matrices as Kronecker products of Jones matrices, an ideal depolariser as the mean over Pauli "
    "matrices; Malus's law by hand; eigenvalues of the coherency matrix; numpy only"
)
SOURCE = (
    "Chipman, Lam and Young, Polarized Light and Optical Systems (2018), ch. 5 and 6 (signs, too); S. R. "
    "Cloude, Optik 75, 26 (1986)"
)
TOLERANCE = 1e-11
REASON = (
    "Float64: matrices to 1e-15. Eigenvalues of pure states are zero but for rounding, which is that of "
    "the factors while the trace that it is told of may be 1e-3 of theirs, for crossed polarisers."
)
FILES = ("optsim/optics/mueller.py", "optsim/camera/parts/modulator.py", "optsim/camera/parts/splitter.py")

_ANGLES = np.linspace(-np.pi, np.pi, 13)
_RETARDANCES = (0.0, 0.4, np.pi / 2, 2.0, np.pi, 4.0)
_POWERS = ((1.0, 0.0), (0.95, 0.001), (0.03, 0.99), (0.5, 0.5), (0.9, 0.0009))
_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
# S3 is the power of right-handed light less that of left-handed, (1, -i) being right-handed.
_STOKES = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, -1j, 1j, 0]])


def measure() -> float:
    """Find the largest deviation of all, absolute: matrices are of the order of one."""
    return max(_by_jones(1), _malus(1), _unrealisable(1), _ports(1), key=abs)


def perturbed() -> float:
    """Break each, return the least: an angle's sign, crossed for along, a flip, a port's leak left out."""
    return min(_by_jones(-1), _malus(-1), _unrealisable(-1), _ports(-1), key=abs)


def _mueller(jones: Doubles) -> Doubles:
    return (_STOKES @ np.kron(jones, jones.conj()) @ np.linalg.inv(_STOKES)).real


def _at(jones: Doubles, angle: float) -> Doubles:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ jones @ turn.T


def _retarder(retardance: float, angle: float) -> Doubles:
    return _at(np.diag(np.exp([-0.5j * retardance, 0.5j * retardance])), angle)


def _mixed() -> Doubles:
    return np.mean([_mueller(each) for each in _PAULI], axis=0)


def _worst(pairs: Iterator[tuple[Doubles, Doubles]]) -> float:
    errors = np.concatenate([(found - expected).ravel() for found, expected in pairs])
    return float(errors[np.abs(errors).argmax()])


def _by_jones(sign: int) -> float:
    panel = lcr720()

    def pairs() -> Iterator[tuple[Doubles, Doubles]]:
        flip = np.diag([1.0, -1.0])
        yield mirror(), _mueller(flip)
        for share in (0.0, 0.0137, 0.3, 1.0):
            yield depolariser(share), (1 - share) * np.eye(4) + share * _mixed()
        for retardance in _RETARDANCES:
            yield retarder_45(retardance), _mueller(_retarder(retardance, np.pi / 4))
            kept = 0.0137 * _mixed() @ _mueller(flip) + (1 - 0.0137) * _mueller(
                flip @ _retarder(retardance, np.pi / 4)
            )
            yield panel.mueller(retardance), 0.70 * kept + 0.08 * 0.05 * _mixed()
            for angle in _ANGLES:
                jones = _retarder(retardance, np.pi / 4 + angle)
                yield turned(retarder_45(retardance), sign * angle), _mueller(jones)
        for powers in _POWERS:
            jones = np.diag(np.sqrt(powers))
            yield polariser(*powers), _mueller(jones)
            # All angles together: one matrix for each ray.
            expected = np.array([_mueller(_at(jones, angle)) for angle in _ANGLES])
            yield turned(polariser(*powers), sign * _ANGLES), expected

    return _worst(pairs())


def _malus(sign: int) -> float:
    """Unpolarised light through a polariser and another one, turned, each of finite contrast."""

    def pairs() -> Iterator[tuple[Doubles, Doubles]]:
        for p, s in _POWERS:
            first, second = polariser(p, s), polariser(0.9, 0.002)
            # Wrong: the second is crossed with what it should be along.
            second = second if sign > 0 else turned(second, np.pi / 2)
            found = (turned(second, _ANGLES) @ first)[:, 0, 0]
            along, across = (p * 0.9 + s * 0.002) / 2, (p * 0.002 + s * 0.9) / 2
            yield found, along * np.cos(_ANGLES) ** 2 + across * np.sin(_ANGLES) ** 2

    return _worst(pairs())


def _passive() -> Doubles:
    """Matrices of splitter and panel, alone and one behind the other, for rays at many angles."""
    panel, made = lcr720(), []
    for cube in (Splitter(placement="converging", acceptance_rad=0.01), Splitter()):
        rays = cube.rays(np.linspace(-20e-3, 20e-3, 9), 1.4)
        into, out = (each(rays).reshape(-1, 4, 4) for each in (cube.inbound, cube.outbound))
        made += [into, out, *(out @ panel.mueller(gamma) @ into for gamma in _RETARDANCES)]
    return np.concatenate([*made, [panel.mueller(gamma) for gamma in _RETARDANCES]])


def _unrealisable(sign: int) -> float:
    """Most negative eigenvalue of a coherency matrix over its trace, or gain over one of any state."""
    # Wrong: a mirror that turns the 45-degree axis over, but not the handedness.
    matrices = _passive() @ np.diag([1, 1, -1, -1.0] if sign > 0 else [1, 1, -1, 1.0])
    basis = np.array([np.kron(a, b.conj()) for a in _PAULI for b in _PAULI]).reshape(4, 4, 4, 4)
    coherency = np.einsum("nij,ijkl->nkl", matrices, basis) / 4
    values = np.linalg.eigvalsh(coherency)
    gain = matrices[:, 0, 0] + np.linalg.norm(matrices[:, 0, 1:], axis=1) - 1
    return float(max(0.0, -(values[:, 0] / values.sum(axis=1)).min(), gain.max()))


def _ports(sign: int) -> float:
    """Power of p and of s, transmitted and reflected, over what came in; polarisers and faces left out."""
    cube = Splitter(cleanup_transmission=1.0, cleanup_contrast=1.0, face_transmission=1.0)
    most = 0.0
    for wavelength_m in (430e-9, 550e-9, 670e-9):
        rays = cube.rays(np.linspace(-40e-3, 40e-3, 41), 6.0)
        into, out = cube.inbound(rays, wavelength_m), cube.outbound(rays, wavelength_m)
        # Wrong: the other port of a coating without what it leaks off its angle.
        if sign < 0:
            into = polariser(np.full(into.shape[:-2], 0.95), 0.001)
        for light in (np.array([1, 1, 0, 0]), np.array([1, -1, 0, 0])):
            most = max(most, float(((into + out) @ light)[..., 0].max()) - 1)
    return most
