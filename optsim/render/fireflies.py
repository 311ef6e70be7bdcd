"""Fireflies: pixels lit by one random path in hundreds. A pilot finds them and traces them to their cause.

Such a path brings far more light than the others of its pixel. It meets by chance a lamp that cannot be
sampled directly: through glass, in a mirror, or off a small bright spot on a wall. The sampler is keyed by
(pixel, sample, seed), so the path is traced again, bitwise the same. It is cut short after 1, 2, ...
segments, and traced with one lamp bright at a time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from optsim.core.errors import BackendError, ConfigError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Doubles, Floats, Ints, View
from optsim.render.backend import activate
from optsim.render.plan import seed_of
from optsim.render.stage import RenderStage
from optsim.scene.bands import mono
from optsim.scene.scene import SKY, Scene

# A pixel is flagged if the variance of one sample over the squared mean exceeds this; median pixels of the
# shipped scenes have 0.1 to 4. No source: at 50, a pixel takes 5000 samples for an error of 10 %.
BOUND = 50.0
# With a larger share of visible fireflies a scene is unfit for rendering. No source: the shipped scenes stay
# 20 times below.
MOST_SHARE = 0.01
# Share of white added to the mean in the test for visible fireflies, as in all error targets.
_FLOOR = 0.01
# With n samples the ratio is at most n, so this must be well above the bound.
_SAMPLES = 256
_VIEW = View(rows=90, cols=120, samples_per_pitch=1, tan_half_width=0.32)
# Samples a launch, and the number of flagged pixels traced back.
_BLOCK = 16
_MOST_PLACES = 256
# Factor of the other lamps while one is tested: not 0, so that they are still sampled as often.
_DIM = 1e-9
COLUMNS = ("light of lamp", "bounces", "pixels", "worst ratio", "at row", "col", "W m^-2 sr^-1")
_MOST_ROWS = 6
_CHANGES = {
    "static": "nothing changes with time",
    "lamps": "only lamps change with time",
    "movers": "objects move",
    "camera": "the camera moves",
}


@dataclass(frozen=True, eq=False)
class Firefly:
    """A flagged pixel, and the origin of its brightest path's light.

    Parameters
    ----------
    row, col : int
        Position in the pilot's grid.
    ratio : float
        Variance of one sample over the squared mean.
    radiance_w_m2_sr : float
        Mean.
    path_share : float
        Share of the brightest path in the pixel's light.
    bounces : int
        Surfaces between lamp and camera for most of this path's light; 0: the lamp is seen directly.
    lamp : str
        Lamp of most of its light; ``sky`` for the sky.
    """

    row: int
    col: int
    ratio: float
    radiance_w_m2_sr: float
    path_share: float
    bounces: int
    lamp: str


@dataclass(frozen=True, eq=False)
class Pilot:
    """Result of a scene's pilot.

    Parameters
    ----------
    movers : bool
        Whether movers were included, at time 0.
    rows, cols, samples : int
        Grid, and paths a pixel.
    bound : float
        Bound on the variance over the squared mean.
    median : float
        Median ratio of the pixels with light.
    n_flagged : int
        Pixels above the bound.
    n_visible : int
        Those still above it with 1 % of white added to their mean, as in all error targets; the others are
        nearly black.
    fireflies : tuple of Firefly
        The worst flagged pixels, at most 256, the most visible first.
    """

    movers: bool
    rows: int
    cols: int
    samples: int
    bound: float
    median: float
    n_flagged: int
    n_visible: int
    fireflies: tuple[Firefly, ...]

    @property
    def flagged_share(self) -> float:
        """Share of all pixels that is flagged."""
        return self.n_flagged / (self.rows * self.cols)

    @property
    def visible_share(self) -> float:
        """Share of all pixels with visible fireflies."""
        return self.n_visible / (self.rows * self.cols)

    def causes(self) -> list[tuple[str, int, int]]:
        """Lamp, bounces, and the number of ``fireflies`` they cause, the most frequent first."""
        counted = Counter((one.lamp, one.bounces) for one in self.fireflies)
        return [(lamp, bounces, n) for (lamp, bounces), n in counted.most_common()]

    def text(self) -> str:
        """Summarise the result in a sentence."""
        found = (
            f"{'with' if self.movers else 'without'} movers: in {self.n_flagged} of "
            f"{self.rows * self.cols} pixels ({self.flagged_share:.2%}) the variance of one sample is over "
            f"{self.bound:g} times the squared mean (the median pixel: {self.median:.2g}), visibly so in "
            f"{self.n_visible} ({self.visible_share:.2%})"
        )
        if not self.fireflies:
            return found
        lamp, bounces, n = self.causes()[0]
        return f"{found}; in {n} of the worst {len(self.fireflies)}: {way(lamp, bounces)}"

    def by_cause(self) -> list[tuple[str, int, int, float, int, int, float]]:
        """Table for users, with ``COLUMNS``: one row a cause, with its most visible firefly."""
        found: list[tuple[str, int, int, float, int, int, float]] = []
        for lamp, bounces, n in self.causes()[:_MOST_ROWS]:
            one = next(f for f in self.fireflies if (f.lamp, f.bounces) == (lamp, bounces))
            found.append((lamp, bounces, n, one.ratio, one.row, one.col, one.radiance_w_m2_sr))
        return found


def way(lamp: str, bounces: int) -> str:
    """Describe the path of light, for users."""
    if bounces == 0:
        return f"lamp {lamp!r} seen directly, smaller than a pixel"
    return f"light of lamp {lamp!r} after {bounces} {'bounce' if bounces == 1 else 'bounces'}"


def headline(scene: Scene) -> str:
    """Name the scene and its kind of change."""
    return f"{scene.name}, variation {scene.variation}: {_CHANGES[scene.kind_of_change()]}."


def record(scene: Scene, found: tuple[Pilot, ...]) -> dict[str, Any]:
    """Convert pilots to JSON values; ``fit`` if none has too many visible fireflies."""
    pilots: list[dict[str, Any]] = []
    for one in found:
        causes = [dict(zip(("lamp", "bounces", "pixels"), cause, strict=True)) for cause in one.causes()]
        shares = {"flagged_share": one.flagged_share, "visible_share": one.visible_share}
        pilots.append({**asdict(one), **shares, "causes": causes})
    return {
        "scene": scene.name,
        "variation": scene.variation,
        "kind_of_change": scene.kind_of_change(),
        "fit": all(one.visible_share <= MOST_SHARE for one in found),
        "most_share": MOST_SHARE,
        "pilots": pilots,
    }


def pilot(
    scene: Scene,
    *,
    view: View = _VIEW,
    samples: int = _SAMPLES,
    bound: float = BOUND,
    seed: int = 0,
    backend: str | None = None,
    progress: Progress = silent,
) -> tuple[Pilot, ...]:
    """Render a scene coarsely without movers and, if it has any, with them at time 0; flag fireflies."""
    if not 0 < bound < samples:
        raise ConfigError(
            f"pilot: got a bound of {bound:g} for {samples} samples, expected it below, as no pixel can show "
            "more than its number of samples; cure: more samples"
        )
    report = activate(backend)
    if report.preview:
        raise BackendError(
            f"the firefly pilot traces single paths, which {report.variant} can't; cure: see optsim doctor"
        )
    sides = (False, True) if scene.singles() else (False,)
    number, total = seed_of(seed, "fireflies"), len(sides) * samples
    found: list[Pilot] = []
    for index, movers in enumerate(sides):

        def step(done: int, before: int = index * samples) -> None:
            progress("pilot", before + done, total)

        values = all_paths(RenderStage(scene, view, movers=movers), samples, number, step)
        found.append(_judged(scene, view, values, bound, number, movers=movers))
    return tuple(found)


def relative_variance(values: Floats, floor_w_m2_sr: float = 0.0) -> Doubles:
    """Variance of one sample over the squared mean, pixel by pixel."""
    exact = values.astype(np.float64)
    mean = exact.mean(axis=1)
    lit = mean > 0
    return np.where(lit, exact.var(axis=1, ddof=1) / np.where(lit, mean + floor_w_m2_sr, 1.0) ** 2, 0.0)


def all_paths(stage: RenderStage, samples: int, seed: int, step: Callable[[int], None]) -> Floats:
    """Radiance of every path of every pixel, (n, sample); ``step`` gets the number of samples done."""
    n = stage.view.rows * stage.view.cols
    values = np.empty((n, samples), np.float32)
    for first in range(0, samples, _BLOCK):
        numbers = np.arange(first, min(first + _BLOCK, samples))
        pixels = np.repeat(np.arange(n), len(numbers))
        values[:, numbers] = _single(stage, pixels, np.tile(numbers, n), seed).reshape(n, -1)
        step(int(numbers[-1]) + 1)
    return values


def origins(
    scene: Scene, view: View, pixels: Ints, numbers: Ints, seed: int, *, movers: bool
) -> tuple[Doubles, dict[str, Doubles]]:
    """Trace paths again, cut short and lamp by lamp, to split their radiance by bounces and by lamp."""

    def again(changed: Scene) -> Doubles:
        return _single(RenderStage(changed, view, movers=movers), pixels, numbers, seed)

    # A path of n segments has n - 1 surfaces between lamp and camera.
    up_to = [again(scene.model_copy(update={"max_depth": n})) for n in range(1, scene.max_depth + 1)]
    by_lamp = {name: again(_only_bright(scene, name)) for name in scene.lit()}
    return np.diff(up_to, axis=0, prepend=0.0), by_lamp


def _single(stage: RenderStage, pixels: Ints, numbers: Ints, seed: int) -> Doubles:
    return stage.paths(pixels, np.ones(len(pixels), np.int64), np.full(len(pixels), seed), numbers)


def _only_bright(scene: Scene, name: str) -> Scene:
    """Dim all other lamps: unlike ``only_lamps`` this keeps the lamp that each path samples."""
    lamps = {
        key: lamp
        if key == name
        else lamp.model_copy(update={"radiance_w_m2_sr": mono(lamp.radiance_w_m2_sr) * _DIM})
        for key, lamp in scene.lamps.items()
    }
    sky = scene.sky if scene.sky is None or name == SKY else scene.sky.dimmed(_DIM)
    return scene.model_copy(update={"lamps": lamps, "sky": sky})


def _judged(scene: Scene, view: View, values: Floats, bound: float, seed: int, *, movers: bool) -> Pilot:
    ratio = relative_variance(values)
    visible = relative_variance(values, _FLOOR * scene.white_w_m2_sr)
    flagged = np.flatnonzero(ratio > bound)
    worst = flagged[np.argsort(-visible[flagged], kind="stable")][:_MOST_PLACES]
    brightest = values[worst].argmax(axis=1)
    fireflies: list[Firefly] = []
    if len(worst):
        by_bounces, by_lamp = origins(scene, view, worst, brightest, seed, movers=movers)
        lamps, bounces = list(by_lamp), by_bounces.argmax(axis=0)
        chosen = np.argmax([by_lamp[name] for name in lamps], axis=0)
        mean = values[worst].mean(axis=1, dtype=np.float64)
        share = values[worst, brightest] / (mean * values.shape[1])
        fireflies = [
            Firefly(
                *divmod(int(pixel), view.cols),
                ratio=float(ratio[pixel]),
                radiance_w_m2_sr=float(mean[i]),
                path_share=float(share[i]),
                bounces=int(bounces[i]),
                lamp=lamps[int(chosen[i])],
            )
            for i, pixel in enumerate(worst)
        ]
    return Pilot(
        movers=movers,
        rows=view.rows,
        cols=view.cols,
        samples=values.shape[1],
        bound=bound,
        median=float(np.median(ratio[ratio > 0])) if (ratio > 0).any() else 0.0,
        n_flagged=len(flagged),
        n_visible=int((visible > bound).sum()),
        fireflies=tuple(fireflies),
    )
