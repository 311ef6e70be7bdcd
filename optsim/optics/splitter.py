"""The polarising beam splitter with its clean-up polarisers: p goes in, s comes out."""

from __future__ import annotations

from pydantic import Field

from optsim.config import Part
from optsim.forward.mueller import polariser
from optsim.quantities import Doubles


class Splitter(Part):
    """A cube that transmits p towards the panel and reflects the returning s towards the CCD.

    Defaults of the coating: typical broadband visible cube; no data sheet was at hand, so they have no
    source. Clean-up polarisers stand before and behind, each with its transmission and contrast.

    Parameters
    ----------
    tp, ts : float
        Transmittance of p and of s.
    rs, rp : float
        Reflectance of s and of p.
    face_transmission : float
        Of the cube's faces together, both passes.
    cleanup_transmission : float
        Of each clean-up polariser, for the light it should pass; no source. 1 with contrast 1: none.
    cleanup_contrast : float
        Wanted over unwanted transmission of each clean-up polariser; no source.
    """

    tp: float = Field(default=0.95, gt=0, le=1)
    ts: float = Field(default=0.001, ge=0, le=1)
    rs: float = Field(default=0.99, gt=0, le=1)
    rp: float = Field(default=0.03, ge=0, le=1)
    face_transmission: float = Field(default=0.97, gt=0, le=1)
    cleanup_transmission: float = Field(default=0.9, gt=0, le=1)
    cleanup_contrast: float = Field(default=1000.0, ge=1)

    def inbound(self) -> Doubles:
        """Mueller matrix from the objective to the panel."""
        wanted = self.cleanup_transmission
        return polariser(self.tp, self.ts) @ polariser(wanted, wanted / self.cleanup_contrast)

    def outbound(self) -> Doubles:
        """Mueller matrix from the panel to the relay; carries the transmission of the faces."""
        wanted = self.cleanup_transmission * self.face_transmission
        return polariser(wanted / self.cleanup_contrast, wanted) @ polariser(self.rp, self.rs)
