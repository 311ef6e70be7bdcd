"""A method of an experiment: a coding scheme with the decoder of its frames."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from optsim.calibration import Calibration
from optsim.calibration.choice import Operator, ReadingPx
from optsim.coding import Scheme
from optsim.core.config import Part
from optsim.core.errors import ConfigError, StorageError
from optsim.decoding import Decoder


class Method(Part):
    """A coding scheme and the decoder of its frames.

    Parameters
    ----------
    name : str
        Name in results, file names and figures.
    scheme, decoder
        The coding scheme, and the decoder of its frames; ``optsim list schemes`` and ``decoders`` name them.
    calibration
        Calibration of this scheme and decoder; the experiment's by default.
    reading_px
        Side of their readout window, CCD pixels; the experiment's by default.
    """

    name: str = Field(
        pattern=r"^[a-z][a-z0-9_]*$", description="a letter, then letters, digits and _, all in lower case"
    )
    scheme: Scheme
    decoder: Decoder
    calibration: Operator | None = None
    reading_px: ReadingPx | None = None

    def check(self, calibration: Calibration) -> None:
        """Refuse a calibration that this method cannot work with, before there is a frame."""
        try:
            self.scheme.init(calibration, np.random.default_rng(0))
            # Decoders prepare before they ask for the first frame.
            list(self.decoder.decode((), calibration))
        except (ConfigError, StorageError) as error:
            raise type(error)(f"methods, {self.name!r}: {error}") from None
