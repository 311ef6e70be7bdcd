"""Adaptive sampling by wavelets, with what a real single-pixel camera measured.

``single_pixel_measured.py PATH ...`` prints the PSNR of pictures from all coefficients that were measured,
and from few of them. Fetch the files ``Jaszczak_{Haar,LeGall}_4_128x128.mat`` from GitHub's nducros/SPIRIT,
folder ``data``. Their licence is CC BY-SA 4.0, so they aren't stored here. Source: F. Rousset et al., IEEE
Trans. Comput. Imaging 3, 36 (2017), doi:10.1109/TCI.2016.2637079.

Found for Haar and LeGall, in dB to the CCD's picture: 22.60 and 22.30 from all 4096, 21.63 and 21.46 from
640, 19.60 and 19.67 from 328. The finest scale was not measured.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.io import loadmat
from scipy.ndimage import affine_transform, zoom

from optsim.core.quantities import Doubles
from optsim.report.words import markdown_table

# Taps of low and high pass, times the root of 2, and the place of their first.
_FILTERS = {"Haar": ([1, 1], [-1, 1], 0), "LeGall": ([0.5, 1, 0.5], [-0.25, -0.5, 1.5, -0.5, -0.25], -1)}
# Of the details of each scale, the coarsest first.
_SHARES = (1.0, 1.0, 1.0), (1.0, 0.5, 0.1), (1.0, 0.3, 0.05), (1.0, 0.2, 0.03), (0.7, 0.15, 0.005), (0, 0, 0)


def _synthesis(n: int, wavelet: str) -> Doubles:
    """One level of a periodic wavelet synthesis, as a matrix: coarse coefficients first."""
    low, high, at = _FILTERS[wavelet]
    taps = [np.pad(each, (0, n - len(each))) / np.sqrt(2) for each in (low, high)]
    return np.stack([np.roll(each, 2 * k + at) for each in taps for k in range(n // 2)], axis=1)


def picture(coefficients: Doubles, coarse: int, wavelet: str) -> Doubles:
    """Synthesise a picture from its wavelet coefficients; the coarsest are ``coarse`` to a side."""
    image, n = coefficients.copy(), 2 * coarse
    while n <= len(image):
        level = _synthesis(n, wavelet)
        image[:n, :n] = level @ image[:n, :n] @ level.T
        n *= 2
    return image


def adaptive_scan(measured: Doubles, coarse: int, wavelet: str, shares: Sequence[float]) -> Doubles:
    """Keep the coarsest coefficients, and of each finer scale the share predicted to be largest; else 0.

    Predicted from the picture so far, enlarged (adaptive basis scan, Rousset et al.).
    """
    kept, n = np.zeros_like(measured), coarse
    kept[:n, :n] = measured[:n, :n]
    for share in shares:
        analysis = np.linalg.inv(_synthesis(2 * n, wavelet))
        so_far = picture(kept[:n, :n], coarse, wavelet)
        larger = np.asarray(zoom(so_far, 2, order=3, mode="nearest", grid_mode=True), np.float64)
        expected = abs(analysis @ larger @ analysis.T)
        expected[:n, :n] = -1
        chosen = np.unravel_index(
            np.argsort(-expected, axis=None)[: round(3 * n * n * share)], expected.shape
        )
        kept[chosen] = measured[chosen]
        n *= 2
    return kept


def real_psnr(image: Doubles, to_ccd: Doubles, ccd: Doubles) -> float:
    """PSNR in dB of a picture against the CCD's, after the file's registration and the best gain and offset.

    ``to_ccd`` maps (x, y, 1) of MATLAB's pixels, counted from 1.
    """
    back = np.linalg.inv(to_ccd)[1::-1, [1, 0, 2]]  # rows first
    shift = back[:, 2] + back[:, :2].sum(axis=1) - 1
    there = np.asarray(affine_transform(image, back[:, :2], shift, order=1), np.float64).ravel()
    fit = np.polynomial.Polynomial.fit(there, ccd.ravel(), 1)
    return float(10 * np.log10(ccd.max() ** 2 / np.mean((fit(there) - ccd.ravel()) ** 2)))


def main(paths: list[str]) -> None:
    """Print how few of the coefficients that a single-pixel camera measured make a picture as good."""
    for path in paths:
        found = cast("dict[str, Any]", loadmat(path))
        measured, wavelet = found["W"].astype(np.float64), str(found["wav"][0])
        coarse, held = len(measured) >> int(found["J"][0, 0]), np.count_nonzero(measured)
        # MATLAB's object of the registration: the first nine numbers that end in 0, 0, 1.
        numbers = np.frombuffer(found["__function_workspace__"].tobytes()[: -8 or None], np.float64)
        matrices = np.lib.stride_tricks.sliding_window_view(numbers, 9)
        to_ccd = next(m for m in matrices if tuple(m[6:]) == (0, 0, 1)).reshape(3, 3)
        rows: list[list[str]] = []
        for shares in _SHARES:
            kept = adaptive_scan(measured, coarse, wavelet, shares)
            psnr = real_psnr(picture(kept, coarse, wavelet), to_ccd, found["F"])
            rows.append([f"{np.count_nonzero(kept)} of {held}", f"{psnr:.2f}"])
        print(
            f"{Path(path).name}\n", *markdown_table(("coefficients", "PSNR to the CCD, dB"), rows), sep="\n"
        )


if __name__ == "__main__":
    main(sys.argv[1:])
