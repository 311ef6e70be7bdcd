"""The animation: reconstruction beside truth, as an animated WebP that needs no player."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.files import atomic, write_png8
from optsim.core.quantities import Bytes, Floats
from optsim.report.pictures import ToneCurve
from optsim.report.schema import Picture

MAX_BYTES = 1_500_000
_GAP = 8


def animate(
    folder: Path,
    pairs: Iterable[tuple[Floats, Floats]],
    tone: ToneCurve,
    *,
    method: str,
    instant_s: float,
    frame_ms: int = 66,
    width: int = 320,
) -> Picture:
    """Write the animation and its first frame below ``folder/assets``.

    Parameters
    ----------
    folder : Path
        Run folder.
    pairs : iterable of (estimate, reference)
        Luminance of shape (v, u), cd/m^2, in order of time; taken one by one.
    tone : ToneCurve
        The run's one tone curve.
    method : str
        Method of the reconstruction on the left.
    instant_s : float
        Scene time between two pairs, s.
    frame_ms : int
        Time a frame is shown, ms.
    width : int
        Width of each half, pixels.

    Returns
    -------
    Picture
        The animation, with ``still`` for people who want no motion.

    Raises
    ------
    ValueCheckError
        When there is no frame, or the file stays above 1.5 MB at the lowest quality.
    """
    from PIL import Image

    strips = [_strip(tone.apply(estimate), tone.apply(reference), width) for estimate, reference in pairs]
    if not strips:
        raise ValueCheckError("animation: got no frames, expected at least one")
    name, still = "assets/moving.webp", "assets/moving_still.png"
    images = [Image.fromarray(strip) for strip in strips]
    for quality in (80, 60, 40, 20, 5):
        with atomic(folder / name) as temporary:
            images[0].save(
                temporary,
                format="WEBP",
                save_all=True,
                append_images=images[1:],
                duration=frame_ms,
                loop=0,
                quality=quality,
                method=2,
            )
        if (folder / name).stat().st_size <= MAX_BYTES:
            break
    else:
        (folder / name).unlink()
        raise ValueCheckError(
            f"animation of {len(strips)} frames exceeds {MAX_BYTES} bytes; show fewer frames"
        )
    write_png8(folder / still, strips[0])
    slower = frame_ms / 1000 / instant_s
    return Picture(
        file=name,
        still=still,
        caption=f"Left: reconstruction of {method}. Right: truth. {len(strips)} instants, "
        f"{slower:.3g} times slower than life; {tone.caption}; compressed, for looking only.",
        section="moving",
        group="",
        label=f"{method} beside truth",
        width=strips[0].shape[1],
        height=strips[0].shape[0],
    )


def _strip(left: Bytes, right: Bytes, width: int) -> Bytes:
    """Two grey images side by side, each resized to a width."""
    from PIL import Image

    height = round(left.shape[0] * width / left.shape[1])
    resample = Image.Resampling.NEAREST if width >= left.shape[1] else Image.Resampling.BOX
    halves = [np.asarray(Image.fromarray(half).resize((width, height), resample)) for half in (left, right)]
    return np.concatenate([halves[0], np.full((height, _GAP), 128, np.uint8), halves[1]], axis=1)
