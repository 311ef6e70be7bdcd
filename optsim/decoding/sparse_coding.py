"""Video from one coded image by sparse coding over a learned dictionary (equations 3 and 4 of the paper)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import CodedFrame
from optsim.decoding.coded_images import CodedImage, CodedImageDecoder, ImageDecoder, covered
from optsim.decoding.partial import Partial
from optsim.decoding.patch_grid import overlap, patch_corners
from optsim.decoding.shared_weights import shared_weights
from optsim.priors.dictionary import Dictionary, load_dictionary, shipped_dictionary
from optsim.priors.prior_file import fitted


class SparseCoding(CodedImageDecoder):
    """Orthogonal matching pursuit patch by patch, overlapping patches averaged.

    Only patches that touch ``code.moving`` are decoded, so the time grows with the moving area. The
    pixel gains are divided out first and crosstalk is undone (or added to the weights). Patches share their
    weights where the code repeats, with any period: see ``weight_tolerance``. A saturated pixel enters
    with its lower bound: without it a patch in the sun would be black.

    Parameters
    ----------
    dictionary : str or None
        A dictionary file, or None for the one shipped.
    stride_px : int
        Distance of patches. 1 is the paper's; 2 costs a quarter.
    max_atoms : int
        Cap of a patch's atoms; more than 10 buy nothing from 64 measurements.
    noise_gain : float
        Pursuit stops at this many times the predicted rms noise (equation 4's epsilon).
    weight_tolerance : float
        Relative rms deviation of a patch's weights from those of its place in the periodic tile. Beyond it
        the patch gets its own matrix; at 0 every deviating patch does.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    kind: Literal["sparse_coding"] = "sparse_coding"
    dictionary: str | None = None
    stride_px: int = Field(default=1, ge=1, le=8)
    max_atoms: int = Field(default=10, ge=1, le=64)
    noise_gain: float = Field(default=1.1, ge=0)
    weight_tolerance: float = Field(default=0.02, ge=0)

    def quick(self) -> Self:
        """Return it with every other patch."""
        return self.model_copy(update={"stride_px": max(2, self.stride_px)})

    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare the dictionary for a calibration."""
        # Imports numba, which reading an experiment must not.
        from optsim.decoding.sparse.patch_codes import PatchCoder

        coder = PatchCoder.of(self._dictionary(calibration))
        patch = coder.atoms.shape[1]

        def decoded(frame: CodedFrame, image: CodedImage) -> Partial:
            moving = frame.code.moving
            corners = patch_corners(moving, patch, self.stride_px)
            tolerance = self.weight_tolerance
            shared = shared_weights(image.weights, moving & image.usable, corners, patch, tolerance)
            support, amounts = coder.encode(
                image, corners, shared, cap=self.max_atoms, noise_gain=self.noise_gain
            )
            total, count = coder.paint(corners, support, amounts, calibration.shape)
            return covered(frame, image, total, count, overlap(calibration.shape, patch, self.stride_px))

        return decoded

    def _dictionary(self, calibration: Calibration) -> Dictionary:
        found = shipped_dictionary() if self.dictionary is None else load_dictionary(Path(self.dictionary))
        return fitted(found, "dictionary", calibration)
