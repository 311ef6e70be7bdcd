"""Clips of moving leaves: where things are, what motion blurs, what hides what, and how varied they are."""

import numpy as np
import pytest

from optsim.scene import dead_leaves as module
from optsim.scene.dead_leaves import dead_leaves

STILL = np.zeros(7)


def ground(**changes):
    """The leaf that fills the picture, with a texel a pixel."""
    leaves = np.zeros(1, module._LEAF)
    leaf = leaves[0]
    leaf["aspect"], leaf["parallax"], leaf["texel"], leaf["gain"] = 1, 1, 1, 1
    for name, value in changes.items():
        leaf[name] = value
    return leaves


def filmed(leaves, textures, camera=STILL, slots=8, size=32):
    """Slot means of given leaves; leaf n carries texture n."""
    rng = np.random.default_rng(0)
    sizes = np.array([each.shape for each in textures])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
    texels = np.concatenate([each.ravel() for each in textures]).astype(np.float32)
    clip = np.zeros((slots, size, size), np.float32)
    module._draw(clip, leaves, camera, texels, starts, sizes, rng.uniform(-0.5, 0.5, (module._SHIFTS, 2)))
    return clip


def waves(period):
    """Upright waves of contrast 1, an array of 64 x 64."""
    return np.tile(0.5 + 0.5 * np.sin(2 * np.pi * np.arange(64) / period), (64, 1)).astype(np.float32)


def wave_of(picture, period):
    """Complex amplitude of the waves of a period along x."""
    turns = np.exp(-2j * np.pi * (np.arange(picture.shape[1]) + 0.5) / period)
    return 4 * (picture.mean(axis=0) * turns).mean()


@pytest.mark.parametrize(("leaf", "camera"), [(0.0, 0.0), (1.5, 0.0), (0.0, 1.5), (1.5, -0.5)])
def test_texture_moves_by_its_velocity_and_blurs_by_its_path(leaf, camera):
    moved = STILL.copy()
    moved[1] = camera
    clip = filmed(ground(vx=leaf), [waves(16)], moved)
    found = np.array([wave_of(picture, 16) for picture in clip])
    speed = leaf + camera
    steps = np.angle(found[1:] / found[:-1])
    np.testing.assert_allclose(steps, -2 * np.pi * speed / 16, atol=0.02)
    # A box a pixel wide, one as long as the path of four poses, and the texels' own interpolation.
    poses = (np.arange(4) + 0.5) / 4 * speed
    path = np.abs(np.exp(2j * np.pi * poses / 16).mean())
    wanted = np.sinc(1 / 16) * path * np.sinc(1 / 16) ** 2
    np.testing.assert_allclose(np.abs(found), wanted, rtol=0.02)


def test_the_front_leaf_hides_and_its_edge_is_where_it_should_be():
    leaves = np.concatenate([ground(radius=8.0, power=2.0, vy=1.0), ground()])
    textures = [np.full((32, 32), 1.0), np.full((32, 32), 0.25)]
    clip = filmed(leaves, textures)
    assert clip.min() == pytest.approx(0.25)
    assert clip.max() == pytest.approx(1.0)
    covered = (clip - 0.25).sum(axis=(1, 2)) / 0.75
    np.testing.assert_allclose(covered, np.pi * 8**2, rtol=0.02)
    centre = ((clip - 0.25) * (np.arange(32) + 0.5)[:, None]).sum(axis=(1, 2)) / (clip - 0.25).sum(
        axis=(1, 2)
    )
    # The middle of the clip is time 0, at which it is in the middle of the picture.
    np.testing.assert_allclose(centre, 16 + np.arange(8) + 0.5 - 4, atol=0.1)


def test_a_turning_leaf_turns_about_its_centre():
    bar = ground(radius=8.0, aspect=4.0, power=16.0, turn=0.1, angle=0.3)
    clip = filmed(np.concatenate([bar, ground()]), [np.ones((32, 32)), np.zeros((32, 32))])
    y, x = np.indices((32, 32)) - 15.5
    angles = []
    for picture in clip:
        total = picture.sum()
        assert abs((picture * x).sum() / total) < 0.1
        moments = [(picture * each).sum() / total for each in (x * x, y * y, x * y)]
        angles.append(0.5 * np.arctan2(2 * moments[2], moments[0] - moments[1]))
    times = np.arange(8) + 0.5 - 4
    np.testing.assert_allclose(angles, 0.3 + 0.1 * times, atol=0.02)


def textures():
    rng = np.random.default_rng(3)
    return [rng.random((64, 64)).astype(np.float32), waves(16)]


def test_a_seed_is_a_clip():
    one, again, other = (dead_leaves(textures(), np.random.default_rng(seed), size=24) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).mean() > 0.01
    assert one.shape == (36, 24, 24)
    assert one.dtype == np.float32


def test_clips_are_light_from_the_still_to_the_fast():
    clips = [dead_leaves(textures(), np.random.default_rng(seed), size=24) for seed in range(40)]
    assert min(float(clip.min()) for clip in clips) >= 0
    assert max(float(clip.max()) for clip in clips) <= 1.0001
    # Change over the clip in relation to the contrast of its pictures.
    lively = np.array([clip.std(axis=0).mean() / max(clip.std(axis=(1, 2)).mean(), 1e-3) for clip in clips])
    assert np.quantile(lively, 0.15) < 0.25
    assert np.quantile(lively, 0.85) > 0.6
