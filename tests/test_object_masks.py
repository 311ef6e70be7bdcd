"""Masks of movers: the same rays as an export's, and their place beside the methods' masks."""

from pathlib import Path

import numpy as np
import pytest
from small_experiment import SMALL

from optsim.camera.effects import changed
from optsim.core.cache import Cache
from optsim.core.quantities import Bools
from optsim.experiment.experiment import Experiment, SceneChoice, load_experiment
from optsim.experiment.object_masks import object_masks
from optsim.experiment.truth import chosen_scene, truth_view
from optsim.render import PassRenderer, choose_backend


def small(*assignments: str) -> Experiment:
    larger = ["panel_rows=24", "panel_cols=32", "sensor.rows=80", "sensor.cols=104"]
    sizes = [*(f"camera.{each}" for each in larger), "camera.objective.focal_length_m='0.6667 mm'"]
    return load_experiment("demo", [*SMALL, *sizes, "n_frames=2", *assignments])


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    return small("scene.name=half_moving")


@pytest.fixture(scope="module")
def masks(experiment: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Bools:
    found = object_masks(experiment, cache=Cache(tmp_path_factory.mktemp("cache")))
    assert found is not None
    return found


@pytest.mark.slow
def test_a_pixel_counts_if_an_export_shows_a_mover_in_its_middle_then_or_a_frame_before(
    experiment: Experiment, masks: Bools
) -> None:
    """The middle of three fine samples a side is that of their panel pixel."""
    renderer = PassRenderer(chosen_scene(experiment), truth_view(experiment))
    slot_s, slots = experiment.timing.slot_s, experiment.timing.slots_per_frame
    exported = [
        np.logical_or.reduce(
            [
                renderer.at((k * slots + slot + 0.5) * slot_s, slot_s).moving[1::3, 1::3]
                for slot in range(slots)
            ]
        )
        for k in range(2)
    ]
    assert 0 < exported[0].mean() < 1
    assert not np.array_equal(exported[0], exported[1]), "or this tests nothing"
    np.testing.assert_array_equal(masks[0], exported[0])
    np.testing.assert_array_equal(masks[1], exported[1] | exported[0])


@pytest.mark.slow
def test_masks_are_kept_and_belong_to_scene_picture_and_timing(
    experiment: Experiment, masks: Bools, tmp_path: Path
) -> None:
    cache, asked = Cache(tmp_path), []

    def noted(stage: str, done: int, total: int) -> None:
        asked.append((stage, done, total))

    np.testing.assert_array_equal(object_masks(experiment, cache=cache, progress=noted), masks)
    assert asked[-1] == ("object masks", 72, 72)
    asked.clear()
    np.testing.assert_array_equal(object_masks(experiment, cache=cache, progress=noted), masks)
    assert not asked
    others = (
        {"n_frames": 1},
        {"camera": experiment.camera.with_nd(0.5)},
        {"camera": changed(experiment.camera, {"objective": {"focal_length_m": 0.5e-3}})},
        {"scene": SceneChoice(name="half_moving", variation="3")},
    )
    found = [
        object_masks(experiment.model_copy(update=other), cache=cache, progress=noted) for other in others
    ]
    assert len(asked) == 36 + 0 + 72 + 72
    np.testing.assert_array_equal(found[0], masks[:1])
    np.testing.assert_array_equal(found[1], masks)
    assert not np.array_equal(found[2], masks)
    assert not np.array_equal(found[3], masks)


def test_masks_of_other_code_are_found_anew(experiment: Experiment, tmp_path: Path, monkeypatch) -> None:
    short, asked = experiment.model_copy(update={"n_frames": 1}), []
    for code in ("one", "other"):
        monkeypatch.setattr("optsim.experiment.object_masks.hash_files", lambda _, code=code: code)
        object_masks(short, cache=Cache(tmp_path), progress=lambda *said: asked.append(said))
    assert len(asked) == 72


def test_footage_has_none_since_it_tells_of_no_objects(experiment: Experiment, tmp_path: Path) -> None:
    assert object_masks(experiment.model_copy(update={"scene": None}), cache=Cache(tmp_path)) is None
