import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import PanelState
from optsim.optics.panel import (
    WEIGHT_ERROR,
    PanelResponse,
    mean_intensity,
    settled_retardance,
    settled_weight,
    slot_weights,
)

SLOT_S = 1 / 180


def panel(retardance, level=0):
    return PanelState(retardance, np.full(retardance.shape, level, np.uint8))


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
    weights, end = slot_weights(levels, panel(start), response, SLOT_S)
    for v, u in np.ndindex(3, 4):
        expected, gamma = ode_weights(levels[:, v, u], float(start[v, u]), response, SLOT_S)
        # The stated error, plus float32 rounding of the retardance carried through 36 slots.
        np.testing.assert_allclose(weights[:, v, u], expected, rtol=0, atol=WEIGHT_ERROR + 1e-6)
        assert end.retardance_rad[v, u] == pytest.approx(gamma, abs=3e-6)


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


@pytest.mark.parametrize("side", [100, 400])  # all pixels at a time, and by the compiled loop
def test_the_stated_error_of_weights_holds(side):
    response = PanelResponse(tau_on_s=5e-3, tau_off_s=1e-4, leak=0)
    start = np.random.default_rng(2).uniform(0, np.pi, (side, side)).astype(np.float32)
    worst = 0.0
    for level in (0, 60, 128, 200, 255):
        levels = np.full((1, side, side), level, np.uint8)
        target = float(settled_retardance(levels[0, :1, :1], response)[0, 0])
        rising = mean_intensity(start, target, SLOT_S, 5e-3)
        falling = mean_intensity(start, target, SLOT_S, 1e-4)
        weights, _ = slot_weights(levels, panel(start), response, SLOT_S)
        worst = max(worst, np.abs(weights[0] - np.where(start < target, rising, falling)).max())
    assert worst <= WEIGHT_ERROR
    assert worst > WEIGHT_ERROR / 3  # a bound, not a wish: the error is really of that order


@pytest.mark.parametrize("tau_slots", [1, 100])
def test_slow_panels_are_as_exact(tau_slots):
    tau_s = tau_slots * SLOT_S
    response = PanelResponse(tau_on_s=tau_s, tau_off_s=tau_s, leak=0, field_drive=(1.9,))
    start = np.random.default_rng(3).uniform(0, 2 * np.pi, (400, 300)).astype(np.float32)
    levels = np.full((1, 400, 300), 255, np.uint8)
    expected = mean_intensity(start, 1.9 * np.pi, SLOT_S, tau_s)
    weights, _ = slot_weights(levels, panel(start), response, SLOT_S)
    np.testing.assert_allclose(weights[0], expected, rtol=0, atol=WEIGHT_ERROR)


def test_late_rows_and_unequal_fields_agree_with_an_ode_solver_and_are_remembered_across_frames():
    """Row v turns to a level ``delay + scan (v + 1/2) / rows`` after its slot began, driven as its field."""
    rows, cols = 4, 3
    response = PanelResponse(
        tau_on_s=0.5e-3, tau_off_s=1e-3, leak=0.01, field_drive=(1.0, 0.9, 1.04), delay_s=0.4e-3, scan_s=3e-3
    )
    levels = np.random.default_rng(5).choice([0, 100, 255], (10, rows, cols)).astype(np.uint8)
    before = PanelState(np.full((rows, cols), 1.0, np.float32), np.full((rows, cols), 100, np.uint8), 4)
    n_sub = 5
    whole, end = slot_weights(levels, before, response, SLOT_S, n_sub)
    first, between = slot_weights(levels[:4], before, response, SLOT_S, n_sub)
    then, last = slot_weights(levels[4:], between, response, SLOT_S, n_sub)
    np.testing.assert_array_equal(np.concatenate([first, then]), whole)
    np.testing.assert_array_equal(last.retardance_rad, end.retardance_rad)
    assert last.slots_displayed == end.slots_displayed == 14
    curve = np.pi * (np.arange(256) / 255) ** 1.2
    for v, u in np.ndindex(rows, cols):
        delay = 0.4e-3 + 3e-3 * (v + 0.5) / rows
        told = [100, *levels[:, v, u]]
        # Changes of the target, as times and values; fields are counted from when the panel was switched on.
        times = [-delay, *(k * SLOT_S + delay for k in range(10)), 10 * SLOT_S]
        targets = [curve[level] * (1.0, 0.9, 1.04)[(4 + k - 1) % 3] for k, level in enumerate(told)]
        gamma, collected, knots = 1.0, [0.0], [0.0]
        for k, target in enumerate(targets):
            start, stop = max(times[k], 0.0), times[k + 1]
            ticks = [t for t in np.arange(1, 50) * SLOT_S / n_sub if start < t < stop] + [stop]
            tau = response.tau_on_s if gamma < target else response.tau_off_s

            def rate(_, state, target=target, tau=tau):
                return [(target - state[0]) / tau, np.sin(state[0] / 2) ** 2]

            path = solve_ivp(
                rate, (start, stop), [gamma, collected[-1]], t_eval=ticks, rtol=1e-10, atol=1e-13
            ).y
            gamma = path[0, -1]
            knots += ticks
            collected += list(path[1])
        at = np.interp(np.arange(51) * SLOT_S / n_sub, knots, collected)
        expected = 0.01 + 0.99 * np.diff(at) / (SLOT_S / n_sub)
        np.testing.assert_allclose(whole[:, v, u], expected, atol=5e-6)
    prompt, _ = slot_weights(levels, before, response.model_copy(update={"scan_s": 0.0}), SLOT_S, n_sub)
    assert np.abs(prompt - whole).max() > 0.1


@pytest.mark.parametrize("change", [{"delay_s": 4e-3, "scan_s": 2e-3}, {"delay_s": -SLOT_S}])
def test_a_turn_more_than_a_slot_off_is_refused(change):
    off = PanelResponse(**change)
    with pytest.raises(ValueCheckError, match="delay_s"):
        slot_weights(np.zeros((1, 2, 2), np.uint8), panel(np.zeros((2, 2), np.float32)), off, SLOT_S)


def test_a_panel_early_by_a_time_is_late_by_the_rest_of_a_slot_with_the_code_a_slot_before():
    levels = np.random.default_rng(8).choice([0, 100, 255], (6, 3, 4)).astype(np.uint8)
    early_s, fields = 0.7e-3, (1.0, 0.9, 1.04)
    gamma = np.random.default_rng(9).uniform(0, 3, (3, 4)).astype(np.float32)
    early = PanelResponse(leak=0.01, delay_s=-early_s, field_drive=fields)
    late = PanelResponse(leak=0.01, delay_s=SLOT_S - early_s, field_drive=fields)
    found, after = slot_weights(levels, PanelState(gamma, levels[2], 6), early, SLOT_S, 4)
    # The panel shows the first slot already when the frame begins, whatever it showed before.
    begun = PanelState(gamma, levels[0], 7)
    expected, end = slot_weights(np.roll(levels, -1, axis=0), begun, late, SLOT_S, 4)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(after.retardance_rad, end.retardance_rad)
    np.testing.assert_array_equal(after.levels, levels[0])
    assert after.slots_displayed == 12
    # Repeated, it has the light of one that is on time, shifted: twelve instants of a frame of 24 later.
    on_time = PanelResponse(leak=0.01, delay_s=0.0)
    moved = PanelResponse(leak=0.01, delay_s=-SLOT_S / 4)
    whole, cycled = (slot_weights(levels, None, each, SLOT_S, 4)[0] for each in (on_time, moved))
    np.testing.assert_allclose(cycled[:-1], whole[1:], atol=2e-6)


def test_a_leak_of_its_own_for_each_column():
    levels = np.zeros((2, 3, 4), np.uint8)
    leaks = np.array([0.0, 0.01, 0.02, 0.5])
    start = panel(np.zeros((3, 4), np.float32))
    weights, _ = slot_weights(levels, start, PanelResponse(), SLOT_S, leak=leaks)
    np.testing.assert_allclose(weights, np.broadcast_to(leaks, (2, 3, 4)), atol=1e-7)


def test_an_instantaneous_panel_shows_its_levels_at_once():
    levels = np.random.default_rng(3).integers(0, 256, (5, 4, 6), dtype=np.uint8)
    response = PanelResponse(tau_on_s=0, tau_off_s=0, leak=0)
    weights, end = slot_weights(levels, panel(np.full((4, 6), 2.0, np.float32)), response, SLOT_S)
    np.testing.assert_allclose(weights, settled_weight(levels, response), atol=1e-6)
    np.testing.assert_allclose(end.retardance_rad, settled_retardance(levels[-1], response), atol=1e-6)
    assert weights[levels == 0].max(initial=0) < 1e-9


def test_complementary_codes_add_to_all_on_plus_all_off_only_for_an_instantaneous_panel():
    code = (np.random.default_rng(4).integers(0, 2, (36, 8, 8)) * 255).astype(np.uint8)
    dark = panel(np.zeros((8, 8), np.float32))
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
    weights, _ = slot_weights(on, panel(np.zeros((2, 2), np.float32)), response, SLOT_S)
    assert weights[0].max() < 0.95
    np.testing.assert_allclose(weights[2], 1, atol=1e-5)
    fine, _ = slot_weights(on, panel(np.zeros((2, 2), np.float32)), response, SLOT_S, instants_per_slot=4)
    np.testing.assert_allclose(fine.reshape(3, 4, 2, 2).mean(axis=1), weights, atol=2 * WEIGHT_ERROR)


def test_shapes_that_disagree_are_named():
    with pytest.raises(ValueCheckError, match="different panels"):
        slot_weights(
            np.zeros((2, 3, 4), np.uint8), panel(np.zeros((4, 3), np.float32)), PanelResponse(), SLOT_S
        )
