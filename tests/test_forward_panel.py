import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from optsim.errors import ValueCheckError
from optsim.forward.panel import (
    TABLE_ERROR,
    PanelResponse,
    mean_intensity,
    settled_retardance,
    settled_weight,
    slot_weights,
)

SLOT_S = 1 / 180


def ode_weights(levels, start, response, slot_s):
    """Independent: relax by an ODE solver whose second state integrates the intensity."""
    gamma, weights = start, []
    for level in levels:
        target = np.pi * (level / 255) ** response.drive_exponent
        # One time constant holds for the whole slot: an exponential never crosses its target.
        tau = response.tau_on_s if gamma < target else response.tau_off_s

        def rate(_, state, target=target, tau=tau):
            return [(target - state[0]) / tau, np.sin(state[0] / 2) ** 2]

        end = solve_ivp(rate, (0, slot_s), [gamma, 0.0], rtol=1e-10, atol=1e-12, method="DOP853").y[:, -1]
        gamma = end[0]
        weights.append(response.leak + (1 - response.leak) * end[1] / slot_s)
    return np.array(weights), gamma


@pytest.mark.parametrize("leak", [0.0, 0.01])
def test_weights_with_history_agree_with_an_ode_solver(leak):
    rng = np.random.default_rng(1)
    levels = rng.integers(0, 256, (36, 3, 4), dtype=np.uint8)
    levels[:, 0] = rng.integers(0, 2, (36, 4)) * 255
    start = rng.uniform(0, np.pi, (3, 4)).astype(np.float32)
    response = PanelResponse(tau_on_s=0.5e-3, tau_off_s=2.0e-3, leak=leak)
    weights, end = slot_weights(levels, start, response, SLOT_S)
    for v, u in np.ndindex(3, 4):
        expected, gamma = ode_weights(levels[:, v, u], float(start[v, u]), response, SLOT_S)
        # The table's stated error, plus float32 rounding of the retardance carried through 36 slots.
        np.testing.assert_allclose(weights[:, v, u], expected, rtol=0, atol=TABLE_ERROR + 1e-6)
        assert end[v, u] == pytest.approx(gamma, abs=3e-6)


def test_the_closed_form_agrees_with_quadrature():
    for start, target, tau in [
        (0.0, 3.1, 5e-4),
        (3.1, 1.0, 2e-2),
        (1.0, 1.0 + 1e-5, 1e-3),
        (1.0, 1.0009, 1e-3),
        (2.0, 0.0, 1e-5),
    ]:
        knots = [k * tau for k in (1, 5, 20) if k * tau < SLOT_S]
        expected, _ = quad(
            lambda t, s=start, g=target, c=tau: np.sin((g + (s - g) * np.exp(-t / c)) / 2) ** 2,
            0, SLOT_S, points=knots or None, epsabs=1e-14, limit=400,
        )  # fmt: skip
        assert mean_intensity(start, target, SLOT_S, tau) == pytest.approx(expected / SLOT_S, abs=1e-10)


def test_the_stated_table_error_holds_between_nodes():
    response = PanelResponse(tau_on_s=5e-3, tau_off_s=1e-4, leak=0)
    start = np.random.default_rng(2).uniform(0, np.pi, (100, 100)).astype(np.float32)
    worst = 0.0
    for level in (0, 60, 128, 200, 255):
        levels = np.full((1, 100, 100), level, np.uint8)
        target = float(settled_retardance(levels[0, :1, :1], 1.2)[0, 0])
        rising = mean_intensity(start, target, SLOT_S, 5e-3)
        falling = mean_intensity(start, target, SLOT_S, 1e-4)
        weights, _ = slot_weights(levels, start, response, SLOT_S)
        worst = max(worst, np.abs(weights[0] - np.where(start < target, rising, falling)).max())
    assert worst <= TABLE_ERROR
    assert worst > TABLE_ERROR / 30  # a bound, not a wish: the error is really of that order


def test_an_instantaneous_panel_shows_its_levels_at_once():
    levels = np.random.default_rng(3).integers(0, 256, (5, 4, 6), dtype=np.uint8)
    response = PanelResponse(tau_on_s=0, tau_off_s=0, leak=0)
    weights, end = slot_weights(levels, np.full((4, 6), 2.0, np.float32), response, SLOT_S)
    np.testing.assert_allclose(weights, settled_weight(levels, response), atol=1e-6)
    np.testing.assert_allclose(end, settled_retardance(levels[-1], 1.2), atol=1e-6)
    assert weights[levels == 0].max(initial=0) < 1e-9


def test_complementary_codes_add_to_all_on_plus_all_off_only_for_an_instantaneous_panel():
    code = (np.random.default_rng(4).integers(0, 2, (36, 8, 8)) * 255).astype(np.uint8)
    dark = np.zeros((8, 8), np.float32)
    instant = PanelResponse(tau_on_s=0, tau_off_s=0, leak=0.01)
    pair = [slot_weights(c, dark, instant, SLOT_S)[0].sum(axis=0) for c in (code, 255 - code)]
    ends = [slot_weights(np.full_like(code, c), dark, instant, SLOT_S)[0].sum(axis=0) for c in (0, 255)]
    np.testing.assert_allclose(pair[0] + pair[1], ends[0] + ends[1], rtol=1e-5)
    slow = PanelResponse(tau_on_s=0.5e-3, tau_off_s=1e-3, leak=0.01)
    lit = sum(slot_weights(c, dark, slow, SLOT_S)[0].sum(axis=0) for c in (code, 255 - code))
    # tau_off > tau_on: more light leaks after switching off than is lost after switching on.
    assert np.all(np.abs(lit - (ends[0] + ends[1])) > 0.5)


def test_always_on_has_weight_one_after_settling_and_instants_average_to_slots():
    response = PanelResponse()
    on = np.full((3, 2, 2), 255, np.uint8)
    weights, _ = slot_weights(on, np.zeros((2, 2), np.float32), response, SLOT_S)
    assert weights[0].max() < 0.95
    np.testing.assert_allclose(weights[2], 1, atol=1e-5)
    fine, _ = slot_weights(on, np.zeros((2, 2), np.float32), response, SLOT_S, instants_per_slot=4)
    np.testing.assert_allclose(fine.reshape(3, 4, 2, 2).mean(axis=1), weights, atol=2 * TABLE_ERROR)


def test_shapes_that_disagree_are_named():
    with pytest.raises(ValueCheckError, match="different panels"):
        slot_weights(np.zeros((2, 3, 4), np.uint8), np.zeros((4, 3), np.float32), PanelResponse(), SLOT_S)
