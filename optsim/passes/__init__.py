"""Export of the truth with everything that belongs to it: depth, normals, ids, flow, masks and poses."""

from optsim.passes.export import check_slots, export_passes, parse_slots

__all__ = ["check_slots", "export_passes", "parse_slots"]
