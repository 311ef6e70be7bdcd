"""Names of an export's channels: each array lands under the name that users read it by."""

from pathlib import Path

import numpy as np

from optsim.core.files import read_exr, write_exr
from optsim.core.quantities import Passes
from optsim.dataset.channels import channels_of

ROWS, COLS = 4, 6


def plane(value: float, *more: float) -> np.ndarray:
    """Array (y, x) or (y, x, n) of one value each."""
    values = np.array([value, *more], np.float32) if more else np.float32(value)
    return np.broadcast_to(values, (ROWS, COLS, *np.shape(values))).copy()


def mask(row: int) -> np.ndarray:
    return np.repeat(np.arange(ROWS)[:, None] == row, COLS, axis=1)


def test_every_channel_of_a_slot_is_under_its_own_name(tmp_path: Path) -> None:
    """A surface 3 m deep and 3.5 m away, facing (0.6, 0, -0.8), that goes 1 down and 2 to the right."""
    passes = Passes(
        times_s=(0.0, 0.1, 0.2),
        depth_m=plane(3.0),
        distance_m=plane(3.5),
        normal=plane(0.6, 0.0, -0.8),
        albedo=plane(0.25),
        ids=np.full((ROWS, COLS), 7, np.uint32),
        parts=np.full((ROWS, COLS), 9, np.uint32),
        moving=mask(0),
        flow_forward_px=plane(1.0, 2.0),
        flow_backward_px=plane(-1.5, -2.5),
        occluded_forward=mask(1),
        occluded_backward=mask(2),
        id_table={7: "mover/card"},
        part_table={9: (7, "mover/card_red")},
        intrinsics_px=np.eye(3),
        radial_k1=0.0,
        camera_to_world=np.repeat(np.eye(4)[None], 3, axis=0),
        object_poses={},
        extents={},
    )
    write_exr(tmp_path / "a.exr", channels_of(passes, plane(5.0), plane(0.125)), attributes={})
    found, _ = read_exr(tmp_path / "a.exr")
    constant = {
        "Y": 5.0,
        "Y.sigma": 0.125,
        "Z": 3.0,
        "distance": 3.5,
        "N.X": 0.6,
        "N.Y": 0.0,
        "N.Z": -0.8,
        "albedo": 0.25,
        "id": 7,
        "part": 9,
        "flow.forward.row": 1.0,
        "flow.forward.col": 2.0,
        "flow.backward.row": -1.5,
        "flow.backward.col": -2.5,
    }
    rows = {"moving": 0, "occluded.forward": 1, "occluded.backward": 2}
    assert found.keys() == constant.keys() | rows.keys()
    for name, value in constant.items():
        np.testing.assert_array_equal(found[name], np.float32(value), name)
    for name, row in rows.items():
        np.testing.assert_array_equal(found[name], mask(row), name)
