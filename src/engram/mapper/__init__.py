"""The EBN loop: localise, else save an experience. Saving runs on its own thread."""

from engram.mapper.edges import edge_through_live, match_edges
from engram.mapper.loops import LoopConfig, LoopSearch
from engram.mapper.mapper import Mapper, MapperConfig
from engram.mapper.memory import Memory, Walk
from engram.mapper.saver import NodeSaver, Records, Saver

__all__ = [
    "LoopConfig",
    "LoopSearch",
    "Mapper",
    "MapperConfig",
    "Memory",
    "NodeSaver",
    "Records",
    "Saver",
    "Walk",
    "edge_through_live",
    "match_edges",
]
