"""Export of the truth with everything that belongs to it: depth, normals, ids, flow, masks and poses."""

from optsim.dataset.export import check_slots, export_passes, parse_slots
from optsim.dataset.extras import Extras, choose_extras

__all__ = ["Extras", "check_slots", "choose_extras", "export_passes", "parse_slots"]
