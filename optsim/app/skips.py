"""``optsim run --check-skips``: one frame with and without what an experiment leaves out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optsim.app.options import print_json

if TYPE_CHECKING:
    from optsim.experiment.experiment import Experiment


def show_skip_check(loaded: Experiment, backend: str | None, as_json: bool) -> None:
    """Print how far off each method's first frame is."""
    from optsim.core.console import page, progress_bars, table
    from optsim.experiment.check_skips import check_skips

    with progress_bars(quiet=as_json) as progress:
        found = check_skips(loaded, backend=backend, progress=progress)
    if as_json:
        print_json(found)
        return
    title = f"one frame with and without {', '.join(found[0]['left_out']) or 'nothing left out'}"
    rows = [(each["method"], each["error"], each["loss_db"]) for each in found]
    page.print(table(title, ("method", "error in noise", "lowers a PSNR by at most, dB"), rows))
