"""The EBN loop: localise, else save an experience. Saving runs on a thread of its own."""

from engram.mapper.edges import edge_through_live, match_edges
from engram.mapper.loops import LoopConfig, LoopSearch
from engram.mapper.mapper import Mapper, MapperConfig, MappingStep
from engram.mapper.saver import NodeWords, Records, RecordWriter, Saver

__all__ = [
    "LoopConfig",
    "LoopSearch",
    "Mapper",
    "MapperConfig",
    "MappingStep",
    "NodeWords",
    "RecordWriter",
    "Records",
    "Saver",
    "edge_through_live",
    "match_edges",
]
