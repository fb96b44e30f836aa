"""A map on disk: revisions, transactions, integrity, history."""

from engram.maps.difference import MapDifference
from engram.maps.hiding import Reverted
from engram.maps.history import (
    RevertReport,
    blame_node,
    map_log,
    map_tags,
    revert_revision,
    show_revision,
)
from engram.maps.map import Map
from engram.maps.map_files import check_file, compact_map, copy_map, publish_map
from engram.maps.map_frame import FramePose, MapFrame, Moves, moves
from engram.maps.opening import open_map
from engram.maps.provenance import Origin
from engram.maps.records import (
    CheckReport,
    InterruptedSession,
    MapContents,
    MapInfo,
    Problem,
    Revision,
    SessionState,
    StoredNode,
    StoredSession,
)
from engram.maps.schema import FORMAT_VERSION
from engram.maps.tags import Tag
from engram.maps.writer import RevisionWriter

__all__ = [
    "FORMAT_VERSION",
    "CheckReport",
    "FramePose",
    "InterruptedSession",
    "Map",
    "MapContents",
    "MapDifference",
    "MapFrame",
    "MapInfo",
    "Moves",
    "Origin",
    "Problem",
    "RevertReport",
    "Reverted",
    "Revision",
    "RevisionWriter",
    "SessionState",
    "StoredNode",
    "StoredSession",
    "Tag",
    "blame_node",
    "check_file",
    "compact_map",
    "copy_map",
    "map_log",
    "map_tags",
    "moves",
    "open_map",
    "publish_map",
    "revert_revision",
    "show_revision",
]
