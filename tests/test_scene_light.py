"""Lamps: closed form of a flicker against integration, its energy, groups of lamps, lamps switched off."""

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from optsim.core.config import build
from optsim.core.errors import ConfigError, ValueCheckError
from optsim.scene.lamps import Lamp, Pwm, Sine
from optsim.scene.scene import Scene

RECTANGLE = {"center_m": (0, 0, 2), "edge_u_m": (1, 0, 0), "edge_v_m": (0, -1, 0), "radiance_w_m2_sr": 3.0}


def lamp(flicker=None, **keys):
    return Lamp(**RECTANGLE, flicker=flicker, **keys)


def room(**lamps):
    pose = {"position_m": (0, 0, 0), "target_m": (0, 1, 0)}
    return Scene(name="x", white_w_m2_sr=1.0, camera=pose, materials={}, lamps=lamps)


def sine_by_gauss(flicker, start_s, stop_s):
    """Mean of the definition by 20-point Gauss-Legendre on panels of at most a quarter period."""
    count = int(np.ceil((stop_s - start_s) * flicker.frequency_hz * 4)) or 1
    node, weight = np.polynomial.legendre.leggauss(20)
    panel = (np.arange(count)[:, None] + (node + 1) / 2) / count
    phase = flicker.frequency_hz * (start_s + (stop_s - start_s) * panel) + flicker.phase_turns
    return 1 + flicker.depth * float((np.sin(2 * np.pi * (phase % 1)) @ weight).sum()) / (2 * count)


def pwm_by_fractions(flicker, start_s, stop_s):
    """Mean of the definition in exact arithmetic, pulse by pulse."""
    f, phase, duty = (Fraction(v) for v in (flicker.frequency_hz, flicker.phase_turns, flicker.duty))
    low, high = f * Fraction(start_s) + phase, f * Fraction(stop_s) + phase
    lit = sum(
        max(Fraction(0), min(high, turn + duty) - max(low, Fraction(turn)))
        for turn in range(low.__floor__(), high.__floor__() + 1)
    )
    return float(lit / duty / (high - low))


LENGTHS_S = [1e-9, 1e-6, 1e-4, 1 / 180, 0.1, 3.0]


@pytest.mark.parametrize("length_s", LENGTHS_S)
def test_gain_is_the_mean_of_the_flicker(length_s):
    rng = np.random.default_rng(1)
    for _ in range(60):
        start = float(rng.uniform(-2, 5))
        stop = start + length_s * float(rng.uniform(0.5, 1.5))
        frequency, phase = float(rng.uniform(20, 400)), float(rng.uniform(-1, 2))
        sine = Sine(frequency_hz=frequency, depth=float(rng.uniform(0, 1)), phase_turns=phase)
        # A start of some seconds is known to 1e-15 s, hence a phase to 1e-12 turns.
        assert lamp(sine).gain(start, stop) == pytest.approx(sine_by_gauss(sine, start, stop), abs=1e-9)
        pwm = Pwm(frequency_hz=frequency, duty=float(rng.uniform(0.02, 1)), phase_turns=phase)
        # An edge within the interval is known to 1e-15 s of its length.
        tolerance = 1e-9 + 1e-14 / length_s / pwm.duty
        assert lamp(pwm).gain(start, stop) == pytest.approx(pwm_by_fractions(pwm, start, stop), abs=tolerance)


@pytest.mark.parametrize("flicker", [Sine(frequency_hz=100, depth=0.7), Pwm(frequency_hz=90, duty=0.3)])
def test_gain_agrees_with_brute_sampling_of_instants(flicker):
    """The instants themselves (an interval without length), sampled densely."""
    source, count = lamp(flicker), 20000
    instants = [source.gain(t, t) for t in 0.011 + (np.arange(count) + 0.5) / count * 0.0234]
    # Each of at most 5 edges is missed by half a step of height 1/0.3.
    assert source.gain(0.011, 0.0344) == pytest.approx(np.mean(instants), abs=5 / 0.3 / count)


def test_a_very_short_interval_sees_the_instant_and_a_very_long_one_the_mean():
    rng = np.random.default_rng(2)
    for flicker in (Sine(frequency_hz=120, depth=1.0, phase_turns=0.2), Pwm(frequency_hz=120, duty=0.4)):
        source = lamp(flicker)
        for start in rng.uniform(0, 10, 200):
            instant = source.gain(start, start)
            assert source.gain(start, start + 1e-12) == pytest.approx(instant, abs=1e-2)
            # Not quite so short, relative to the numbers that hold the time: full accuracy.
            assert source.gain(start, np.nextafter(start, 99)) == pytest.approx(instant, abs=1e-9)
            assert source.gain(start, start + 1e6) == pytest.approx(1, abs=1e-8)


def test_pwm_has_two_levels_whose_shares_are_its_duty():
    source = lamp(Pwm(frequency_hz=10, duty=0.2, phase_turns=0.5))
    levels = np.array([source.gain(t, t) for t in (np.arange(1000) + 0.5) / 10000])
    assert set(levels) == {0.0, 5.0}
    assert levels.mean() == pytest.approx(1)
    # Half a turn ahead: the next pulse starts at 50 ms.
    assert (source.gain(0.0499, 0.0499), source.gain(0.0501, 0.0501)) == (0.0, 5.0)
    assert lamp(Sine(frequency_hz=10, depth=0.5)).gain(0.025, 0.025) == pytest.approx(1.5)


def test_whole_periods_carry_the_stated_mean_whatever_the_start():
    rng = np.random.default_rng(3)
    for periods in (1, 2, 7, 1000):
        for _ in range(50):
            # Powers of two: their periods are exact in binary.
            frequency, start = 2.0 ** rng.integers(3, 9), float(rng.uniform(0, 1))
            for flicker in (
                Sine(frequency_hz=frequency, depth=0.9, phase_turns=float(rng.random())),
                Pwm(
                    frequency_hz=frequency, duty=float(rng.uniform(0.05, 1)), phase_turns=float(rng.random())
                ),
            ):
                gain = lamp(flicker).gain(start, start + periods / frequency)
                assert gain == pytest.approx(1, abs=1e-11)


def test_gains_of_neighbouring_intervals_add_up():
    rng = np.random.default_rng(4)
    for flicker in (Sine(frequency_hz=100), Pwm(frequency_hz=100, duty=0.15, phase_turns=0.7)):
        edges = np.sort(rng.uniform(0, 0.2, 30))
        parts = [lamp(flicker).gain(a, b) * (b - a) for a, b in pairwise(edges)]
        whole = lamp(flicker).gain(edges[0], edges[-1]) * (edges[-1] - edges[0])
        assert sum(parts) == pytest.approx(whole, rel=1e-11)


def test_a_steady_lamp_has_gain_one_and_time_runs_forward():
    assert lamp().gain(3.0, 3.5) == 1.0
    with pytest.raises(ValueCheckError, match="ends first"):
        lamp().gain(1.0, 0.5)


def test_lamps_that_flicker_alike_are_one_group_and_the_steady_come_first():
    tube, led = Sine(frequency_hz=100, depth=0.4), Pwm(frequency_hz=120, duty=0.5)
    scene = room(
        a=lamp(tube),
        b=lamp(),
        c=lamp(led),
        d=lamp(tube),
        e=lamp(),
        f=lamp(lit=False),
        g=lamp(tube, lit=False),
    )
    groups = scene.light_groups()
    assert list(groups.values()) == [("b", "e"), ("a", "d"), ("c",)]
    assert next(iter(groups)) == "steady"
    for names in groups.values():
        assert len({scene.lamps[name].gain(0.001, 0.0023) for name in names}) == 1
    # A number apart is a group apart.
    close = room(a=lamp(tube), b=lamp(tube.model_copy(update={"phase_turns": 1e-15})))
    assert len(close.light_groups()) == 2


def test_only_lamps_switches_the_others_off_and_keeps_them():
    scene = room(a=lamp(), b=lamp(), c=lamp(lit=False))
    one = scene.only_lamps(["b"])
    assert [one.lamps[name].lit for name in "abc"] == [False, True, False]
    assert list(one.light_groups().values()) == [("b",)]
    assert one.lamps["a"].model_copy(update={"lit": True}) == scene.lamps["a"]
    assert scene.lamps["a"].lit, "the scene itself is as it was"
    assert scene.only_lamps(scene.light_groups()["steady"]) == scene
    with pytest.raises(ConfigError, match="did you mean 'a'"):
        scene.only_lamps(["aa"])
    with pytest.raises(ConfigError, match="at least one"):
        scene.only_lamps([])


@pytest.mark.parametrize(
    ("flicker", "message"),
    [
        ({"kind": "sine", "frequency_hz": 0}, "frequency_hz"),
        ({"kind": "sine", "frequency_hz": 100, "depth": 1.5}, "depth"),
        ({"kind": "pwm", "frequency_hz": 100, "duty": 0}, "duty"),
        ({"kind": "pwm", "frequency_hz": 100, "depth": 0.5}, "depth"),
        ({"kind": "square", "frequency_hz": 100}, "pwm"),
        ({"frequency_hz": 100}, "kind"),
    ],
)
def test_bad_flicker_is_named(flicker, message):
    with pytest.raises(ConfigError, match=message):
        build(Lamp, RECTANGLE | {"flicker": flicker}, where="lamp")


def test_a_scene_without_light_is_refused():
    with pytest.raises(ValueError, match="no lamp is lit"):
        room(a=lamp(lit=False))
    with pytest.raises(ValueError, match="lamps"):
        room()


def test_everything_that_decides_the_light_is_in_the_dump():
    plain = room(a=lamp()).model_dump(mode="json")
    for other in (lamp(Sine(frequency_hz=100)), lamp(Pwm(frequency_hz=100))):
        assert room(a=other).model_dump(mode="json") != plain
    both = room(a=lamp(), b=lamp())
    assert both.only_lamps("a").model_dump(mode="json") != both.model_dump(mode="json")
