"""The page of a calibration: what a bench told of a camera, how well, and what it did not tell."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup
from rich.table import Table

from optsim.core.console import table
from optsim.core.files import write_text
from optsim.core.quantities import Doubles, Floats
from optsim.metrics.records import Record
from optsim.report import plots, words
from optsim.report.html import page_environment

INTERVAL_SIGMAS = 1.96
"""Half width of a 95 % interval in standard errors."""


class Quantity(Record):
    """One number of a calibration.

    Parameters
    ----------
    key : str
        Its name, with the unit as suffix.
    what : str
        What it is, in words.
    value : float
        The estimate.
    standard_error : float or None
        None where the bench tells none.
    true : float or None
        The camera's own, where it is known.
    """

    key: str
    what: str
    value: float
    standard_error: float | None = None
    true: float | None = None

    @property
    def interval(self) -> float | None:
        """Half width of the 95 % interval."""
        return None if self.standard_error is None else INTERVAL_SIGMAS * self.standard_error

    @property
    def holds(self) -> bool | None:
        """Whether the interval has the true value in it; None where one of them is unknown."""
        if self.true is None or self.interval is None:
            return None
        return abs(self.value - self.true) <= self.interval


class Misaligned(Record):
    """The quantity of a key as a displacement, with 95 % half widths, and the move that undoes it.

    The displacement is of the whole image by a shift, of the panel's corner by anything else. On the CCD it
    is None without the pitch. ``undo`` is the image's move, in the unit of the key.
    """

    key: str
    panel_px: float
    panel_half_px: float
    ccd_m: float | None
    ccd_half_m: float | None
    undo: float
    screw: str

    @property
    def said(self) -> str:
        """The displacement and the screw in a sentence."""
        moved = f"{words.number(self.panel_px)} ± {words.number(self.panel_half_px)} panel pixels"
        if self.ccd_m is not None:
            moved += (
                f", {words.quantity('_m', self.ccd_m)} ± {words.quantity('_m', self.ccd_half_m)} on the CCD"
            )
        return f"{self.key}: {moved}; {self.screw}."


class HeldIntervals(Record):
    """How often the 95 % intervals of something on every panel pixel hold.

    Parameters
    ----------
    what : str
        What it is, in words.
    rms : float
        Rms deviation from the true values, in ``unit``.
    unit : str
        Unit of ``rms``.
    held : float
        Share of the pixels whose interval has the true value in it.
    """

    what: str
    rms: float
    unit: str
    held: float


class TruthScore(Record):
    """A calibration against the camera that the bench was of.

    Parameters
    ----------
    truth : str
        Name of the experiment.
    map_rms_px, map_worst_px : float
        Distance of the map from the true centres of the panel's pixels, panel pixels.
    same_pixel_share : float
        Share of the valid panel pixels that are read at the CCD pixel of their true centre.
    intervals, held : int
        Quantities with an interval and a true value, and those whose interval holds.
    coverage : list of Coverage
        Of what every panel pixel has.
    """

    truth: str
    map_rms_px: float
    map_worst_px: float
    same_pixel_share: float
    intervals: int
    held: int
    coverage: list[HeldIntervals]


class HeldOut(Record):
    """A calibration against an earlier one, on images of the bench that were held out.

    Parameters
    ----------
    before : str
        File of the earlier calibration.
    n_images : int
        Images held out.
    before_sigmas, after_sigmas : float
        Rms deviation of the images from what each predicts, in standard deviations of the noise.
    gain_sigmas, gain_half : float
        Mean difference of both over the images, and half of its 95 % interval.
    better : bool
        Whether the later one explains them better than the earlier one, beyond that interval.
    """

    before: str
    n_images: int
    before_sigmas: float
    after_sigmas: float
    gain_sigmas: float
    gain_half: float
    better: bool

    @property
    def said(self) -> str:
        """The comparison in a sentence, with a flag where the later one isn't better."""
        flag = "" if self.better else "Flag: not better than before. "
        return (
            f"{flag}{self.n_images} held-out images are {self.after_sigmas:.2f} standard deviations of their "
            f"noise off, with {self.before} {self.before_sigmas:.2f}: "
            f"{self.gain_sigmas:+.2f} ± {self.gain_half:.2f}."
        )


class CalibrationRecord(Record):
    """Everything of a calibration that its page says.

    Parameters
    ----------
    bench : str
        Folder of the images.
    about : dict
        Notes of its manifest.
    n_images : int
        Images read.
    panel, ccd : tuple of int
        Pixels (rows, columns).
    reading_px : int
        Side of the readout window, CCD pixels.
    orientation : str
        Orientation of the panel's image, in words.
    valid_share : float
        Share of the panel's pixels that are valid.
    quantities : list of Quantity
        The numbers.
    edges_off_px : dict
        Where the panel's sides are, beyond where the map has them.
    misaligned : list of Misaligned
        How the panel's image lies on the CCD.
    remarks : list of str
        What was refused, extrapolated, or could not be told.
    score : TruthScore or None
        Against the true camera.
    held_out : HeldOut or None
        Against an earlier calibration; its sentence is the first remark.
    """

    bench: str
    about: dict[str, str]
    n_images: int
    panel: tuple[int, int]
    ccd: tuple[int, int]
    reading_px: int
    orientation: str
    valid_share: float
    quantities: list[Quantity]
    edges_off_px: dict[str, float]
    misaligned: list[Misaligned]
    remarks: list[str]
    score: TruthScore | None = None
    held_out: HeldOut | None = None

    def quantity(self, key: str) -> Quantity:
        """Return a quantity by its key."""
        return next(each for each in self.quantities if each.key == key)


def write_calibration_page(
    path: Path,
    record: CalibrationRecord,
    *,
    dots_px: Doubles,
    off_px: Doubles,
    fields: dict[str, tuple[Floats, str]],
) -> None:
    """Write the page as one HTML file that opens from disk.

    Parameters
    ----------
    path : Path
        The file.
    record : CalibrationRecord
        Its numbers.
    dots_px, off_px : ndarray of shape (n, 2), float64
        Dots of the map, (v, u), and how far they were seen from where the map has them, panel pixels.
    fields : dict
        Images over the panel with their units, by caption.
    """
    arrows = plots.arrow_plot(
        dots_px,
        off_px,
        shape=record.panel,
        title="Residual of the pixel map at each dot",
        label="panel pixels",
    )
    drawn: list[tuple[str, Markup]] = [
        (caption, plots.field_plot(image, title=caption, unit=unit))
        for caption, (image, unit) in fields.items()
    ]
    page = page_environment().get_template("calibration.html.j2")
    write_text(path, page.render(r=record, arrows=arrows, fields=drawn, quantity=words.quantity))


def summary(record: CalibrationRecord) -> list[Table | str]:
    """Tables and lines of a record for a terminal."""
    columns = ("quantity", "value", "± 95 %")
    rows = [
        (q.what, words.quantity(q.key, q.value), words.quantity(q.key, q.interval)) for q in record.quantities
    ]
    score = record.score
    moves = [
        "How the panel's image lies, at its corner but for shifts, ± 95 %; focus is not measured:",
        *(each.said for each in record.misaligned),
    ]
    if score is None:
        return [table(f"calibration from {record.bench}", columns, rows), *moves, *record.remarks]
    scored = [
        (*row, words.quantity(q.key, q.true), {True: "holds", False: "fails", None: ""}[q.holds])
        for row, q in zip(rows, record.quantities, strict=True)
    ]
    return [
        table(f"calibration from {record.bench}", (*columns, f"true: {score.truth}", "interval"), scored),
        *moves,
        f"The map is {score.map_rms_px:.2g} panel pixels rms off the true centres, at worst "
        f"{score.map_worst_px:.2g}; {score.held} of {score.intervals} intervals hold.",
        *(
            f"{words.sentence(each.what)}: {each.rms:.3g} {each.unit} rms off; {each.held:.1%} of the "
            "pixels' intervals hold."
            for each in score.coverage
        ),
        *record.remarks,
    ]
