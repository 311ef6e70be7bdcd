# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Rigid bodies that fall and collide: MuJoCo runs them once, and the scene's folder keeps their poses.

Each body is a ball, a box, or the convex hull of its vertices. So is what stands still; quads are plates.
Other movers, lamps and a file of shapes are not met.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.config import Table, build, read_toml
from optsim.core.errors import ConfigError
from optsim.core.foreign import one_line
from optsim.core.quantities import Doubles
from optsim.scene.bodies import Body, bodies
from optsim.scene.keyframed import Keyframed
from optsim.scene.parts import Quad, StillObject
from optsim.scene.populate import GRAVITY_M_S2, Population, drawn_for, with_population
from optsim.scene.scene import load_scene
from optsim.scene.solids import rotated
from optsim.scene.variation import varied

# Longest step, s: of a fall of t it misplaces g t step / 2. A contact is a spring of this frequency, so a
# body at 4 m/s goes 2 mm deep; plates are this thick, m. No source.
_STEP_S = 1e-4
_CONTACT_RAD_S = 2000.0
_PLATE_M = 0.05


def drop(folder: Path, variation: str, duration_s: float, rate_hz: float) -> Table:
    """Let the populations with ``physics`` fall as a variation draws them; return their poses."""
    try:
        import mujoco  # pyright: ignore[reportMissingImports, reportMissingTypeStubs]
    except ImportError:
        raise ConfigError("optsim scene drop: got no MuJoCo; cure: pip install 'optsim[physics]'") from None
    file = folder / "scene.toml"
    table = varied(read_toml(file), variation, str(file))
    scene = load_scene(file, variation, physics=False)
    populations = {
        name: build(Population, stated, where=f"{file}: populate.{name}")
        for name, stated in table.get("populate", {}).items()
    }
    engine: Any = mujoco
    steps = int(np.ceil(1 / (rate_hz * _STEP_S)))
    spec = engine.MjSpec()
    spec.option.timestep, spec.option.gravity = 1 / (rate_hz * steps), (0, 0, -GRAVITY_M_S2)
    thrown: dict[str, tuple[Keyframed, Doubles]] = {}
    for name, body in bodies(scene).items():
        kind, key = name.split("/", 1)
        motion, population = scene.movers.get(key), populations.get(key.rpartition("_")[0])
        if kind == "object":
            _add(engine, spec, spec.worldbody, name, body, np.zeros(3))
        elif isinstance(motion, Keyframed) and population is not None and population.physics:
            points = np.concatenate([item.mesh().vertices_m for item in _items(body)])
            middle: Doubles = (points.min(axis=0) + points.max(axis=0)) / 2
            made = spec.worldbody.add_body(name=name, pos=middle)
            made.add_freejoint()
            geom = _add(engine, spec, made, name, body, middle)
            damping = 2 * _damping(population.restitution) * _CONTACT_RAD_S
            geom.solref, geom.solimp = (-(_CONTACT_RAD_S**2), -damping), (0.99, 0.99, 0.001, 0.5, 2)
            geom.friction, geom.priority = (population.friction, 0.005, 0.0001), 1
            thrown[key] = motion, middle
    if not thrown:
        raise ConfigError(f"{file}: populate: got none with physics = true, expected one; cure: state it")
    try:
        model = spec.compile()
    except Exception as error:
        raise ConfigError(f"{file}: MuJoCo refuses a body: {one_line(error)}") from None
    state, times = engine.MjData(model), np.arange(int(np.ceil(duration_s * rate_hz)) + 1) / rate_hz
    places = {key: model.jnt_qposadr[model.body(f"mover/{key}").jntadr[0]] for key in thrown}
    for key, (motion, _) in thrown.items():
        first = model.jnt_dofadr[model.body(f"mover/{key}").jntadr[0]]
        axis = np.asarray(motion.spin_axis) / np.linalg.norm(motion.spin_axis)
        state.qvel[first : first + 6] = [*motion.velocity_m_s, *(2 * np.pi * motion.spin_hz * axis)]
    found, kinds = np.empty((len(times), model.nq)), engine.mjtWarning
    lost = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
    # Its own handler writes a file into the working folder.
    engine.set_mju_user_warning(_quiet)
    for k in range(len(times)):
        found[k] = state.qpos
        engine.mj_step(model, state, steps)
        if any(state.warning[kind].number for kind in lost):
            # MuJoCo would go on from the first pose.
            raise ConfigError(
                f"{file}: populate: got motion that MuJoCo can't follow from {times[k]:.3g} s on, expected "
                "finite speeds; cure: slower spins, larger bodies, or none that start inside another"
            )
    movers = {
        key: {
            "times_s": times.tolist(),
            "pivot_m": middle.tolist(),
            "positions_m": (found[:, places[key] : places[key] + 3] - middle).tolist(),
            "rotations_wxyz": found[:, places[key] + 3 : places[key] + 7].tolist(),
        }
        for key, (_, middle) in thrown.items()
    }
    drawn = with_population(table, variation, folder, str(file), physics=False)
    return {"made_for": drawn_for(drawn), "engine": f"mujoco {engine.__version__}", "movers": movers}


def _quiet(_message: str) -> None:
    pass


def _damping(restitution: float) -> float:
    """Damping ratio of a spring that pushes only and returns this share of the speed."""
    # T. Schwager and T. Poeschel, Granular Matter 9, 465 (2007), eq. 22 and 23 in one.
    ratio = np.linspace(0.0005, 20, 20_000)
    share = np.exp(-2 * ratio * np.abs(np.arccos(ratio + 0j)) / np.sqrt(np.abs(1 - ratio**2)))
    return float(np.interp(-restitution, -share, ratio))


def _items(body: Body) -> list[StillObject]:
    """Objects that a body is made of, at rest."""
    return [item for part in body.parts.values() for item in getattr(part, "items", [part])]


def _add(engine: Any, spec: Any, owner: Any, name: str, body: Body, middle: Doubles) -> Any:
    """Add a body's shape, around the middle of its owner."""
    item, *more = _items(body)
    points: Doubles = np.concatenate([each.mesh().vertices_m for each in (item, *more)]) - middle
    center, own = (points.min(axis=0) + points.max(axis=0)) / 2, rotated(body.turn_rad)
    kinds, shape = engine.mjtGeom, "" if more else getattr(item, "shape", item.kind)
    if shape in ("ball", "globe"):
        return owner.add_geom(type=kinds.mjGEOM_SPHERE, pos=center, size=[np.ptp(points[:, 2]) / 2, 0, 0])
    if shape in ("box", "slab", "column"):
        turn, sides = np.empty(4), np.ptp(points @ own, axis=0)
        engine.mju_mat2Quat(turn, own.ravel())
        return owner.add_geom(type=kinds.mjGEOM_BOX, pos=center, quat=turn, size=sides / 2)
    if isinstance(item, Quad) and not more:
        normal = np.cross(item.edge_u_m, item.edge_v_m)
        points = np.concatenate([points, points - _PLATE_M * normal / np.linalg.norm(normal)])
    mesh = spec.add_mesh(name=name, inertia=engine.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    mesh.uservert = points.ravel().tolist()
    return owner.add_geom(type=kinds.mjGEOM_MESH, meshname=name)
