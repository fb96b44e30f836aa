"""A map that finds its own wrong edges, and takes them out."""

from engram.repair.config import RepairConfig
from engram.repair.finding import Finding, Findings, find_wrong_edges
from engram.repair.repairing import GeometryReport, check_geometry, remove_edges

__all__ = [
    "Finding",
    "Findings",
    "GeometryReport",
    "RepairConfig",
    "check_geometry",
    "find_wrong_edges",
    "remove_edges",
]
