"""What cameras are drawn within: limits of each parameter, how its changes lie between them, and mounts."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, get_args

from numpy.random import Generator

from optsim.core.config import Table, read_toml
from optsim.core.errors import ConfigError, unknown_name
from optsim.study.folder import STUDY, read_study
from optsim.study.parameters import ALL
from optsim.study.tolerance_rows import limits_of

MACHINING = "machining"
"""Name of the shipped sheet: a bad specimen's change of every parameter, both ways."""
Distribution = Literal["uniform", "normal", "truncated"]
_DISTRIBUTIONS: tuple[Distribution, ...] = get_args(Distribution)
# Standard deviation of a normal one over half of what lies between the limits.
_SIGMA = 0.5
_ENDS = {"minus": -1, "plus": 1}


@dataclass(frozen=True)
class Sheet:
    """A tolerance sheet to draw cameras within."""

    # Parameter -> largest change down and up, both positive, in the unit of its keys.
    limits: dict[str, tuple[float, float]]
    # Parameter -> how its changes lie about the middle of its limits, where not evenly.
    distributions: dict[str, Distribution] = field(default_factory=dict[str, Distribution])
    # Mount -> parameters that one draw moves together.
    mounts: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    of: str = ""  # What the limits are of, where that is known.

    def draw(self, rng: Generator) -> dict[str, float]:
        """Draw the changes of a camera, in the units of their keys."""
        mounts = {name: names for names in self.mounts.values() for name in names}
        shares: dict[tuple[str, ...], float] = {}
        changes: dict[str, float] = {}
        for name, (down, up) in self.limits.items():
            together = mounts.get(name, (name,))
            if together not in shares:
                shares[together] = _share(self.distributions.get(name, "uniform"), rng)
            changes[name] = (up - down) / 2 + shares[together] * (up + down) / 2
        return changes


def _share(distribution: Distribution, rng: Generator) -> float:
    """Draw where a change lies between its limits, -1 and 1."""
    if distribution == "uniform":
        return float(rng.uniform(-1, 1))
    while True:
        share = float(rng.normal(0, _SIGMA))
        if distribution == "normal" or abs(share) <= 1:
            return share


def read_sheet(name_or_path: str) -> Sheet:
    """Read a tolerance sheet: the shipped one, a finished tolerance study, or a TOML file.

    A TOML file has a table a parameter, in the units of ``optsim tolerance``: ``[shift_x] plus = 0.3`` and,
    unless it is the same, ``minus = 0.2``; ``distribution = "normal"``; and ``[mounts.relay] parameters =
    ["shift_x", "tilt"]``. A parameter that goes one way has one limit.

    Raises
    ------
    ConfigError, StorageError
        For what the sheet says wrongly, or a missing file.
    """
    path = Path(name_or_path).expanduser()
    if name_or_path == MACHINING:
        return Sheet({name: each.bad_specimen for name, each in ALL.items()})
    if path.is_dir() or path.name == STUDY:
        study = read_study(path, "tolerance")
        methods = ", ".join(dict.fromkeys(row["method"] for row in study["rows"] if row["method"]))
        plan = study["plan"]
        of = f"drifts that cost {methods} {plan['loss_db']:g} dB of PU21-PSNR ({', '.join(plan['regions'])})"
        return Sheet(limits_of(study["rows"]), of=of)
    limits: dict[str, tuple[float, float]] = {}
    distributions: dict[str, Distribution] = {}
    table = read_toml(path)
    mounts = table.pop("mounts", {})
    for name, said in table.items():
        if name not in ALL:
            raise unknown_name(f"parameter in {path}", name, ALL)
        held = cast("Table", said) if isinstance(said, dict) else {"plus": said}
        if "distribution" in held:
            distributions[name] = _distribution(f"{path}: {name}", held)
        limits[name] = _limits(f"{path}: {name}", name, held)
    if not limits:
        raise ConfigError(f"{path}: got no parameter, expected tables such as [shift_x] with plus = 0.3")
    return Sheet(limits, distributions, _mounts(f"{path}: mounts", mounts, limits, distributions))


def _limits(where: str, name: str, held: Table) -> tuple[float, float]:
    """Check the limits of a parameter, and return them in the unit of its keys."""
    unit, signs = ALL[name].unit, ALL[name].signs
    for end, value in held.items():
        if end == "distribution":
            if value == "normal" and len(signs) == 1:
                raise ConfigError(
                    f"{where}.distribution: got 'normal', which goes beyond 0, expected uniform or truncated "
                    f"of {name}, which goes one way; fix: write truncated"
                )
            continue
        if end not in _ENDS:
            raise unknown_name(f"key of {where}", end, (*_ENDS, "distribution"))
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < 0:
            raise ConfigError(
                f"{where}.{end}: got {value!r}, expected a size in {unit}, 0 or more; "
                "fix: write how far it goes down as minus and up as plus, both without a sign"
            )
        if _ENDS[end] not in signs:
            direction, other = ("up", "plus") if 1 in signs else ("down", "minus")
            raise ConfigError(
                f"{where}.{end}: got {value!r}, expected {other} alone, since {name} goes {direction} only; "
                f"fix: leave {end} out"
            )
    given = [held[end] for end in _ENDS if end in held]
    if not given:
        raise ConfigError(f"{where}: got no limit, expected plus in {unit}; fix: write plus = 0.3")
    ends = (float(held.get(end, given[0])) if sign in signs else 0.0 for end, sign in _ENDS.items())
    down, up = (end * ALL[name].per_unit for end in ends)
    return down, up


def _distribution(where: str, held: Table) -> Distribution:
    if held["distribution"] not in _DISTRIBUTIONS:
        raise unknown_name(f"distribution of {where}", str(held["distribution"]), _DISTRIBUTIONS)
    return held["distribution"]


def _mounts(
    where: str, said: Any, limits: dict[str, tuple[float, float]], distributions: dict[str, Distribution]
) -> dict[str, tuple[str, ...]]:
    """Check the mounts of a sheet; their distribution becomes that of their parameters."""
    found: dict[str, tuple[str, ...]] = {}
    tables: dict[str, Any] = cast("Table", said) if isinstance(said, dict) else {"": said}
    for mount, got in tables.items():
        held: Table = cast("Table", got) if isinstance(got, dict) else {}
        names = cast("list[object]", given) if isinstance(given := held.get("parameters"), list) else []
        if len(names) < 2 or set(held) - {"parameters", "distribution"}:
            raise ConfigError(
                f"{where}.{mount}: got {got!r}, expected parameters, two or more, and distribution; "
                'fix: write parameters = ["shift_x", "tilt"]'
            )
        distribution: Distribution = "uniform"
        if "distribution" in held:
            distribution = _distribution(f"{where}.{mount}", held)
        moved = [str(name) for name in names]
        for name in moved:
            if name not in limits:
                raise unknown_name(f"parameter in {where}.{mount}", name, limits)
            if any(name in others for others in found.values()) or moved.count(name) > 1:
                raise ConfigError(f"{where}.{mount}: got {name} twice, expected one mount of it; fix: choose")
            if name in distributions or len(ALL[name].signs) == 1:
                why = "a distribution of its own" if name in distributions else "one way to go"
                raise ConfigError(
                    f"{where}.{mount}: got {name}, which has {why}, expected parameters that the mount moves "
                    "both ways by its own distribution; fix: take it out"
                )
        found[mount] = tuple(moved)
        distributions.update(dict.fromkeys(moved, distribution))
    return found
