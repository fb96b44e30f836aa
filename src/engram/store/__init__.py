"""A map on disk: revisions, transactions, integrity; and the bytes that stand for a frame."""

from engram.store.blob import decode_landmarks, decode_thumbnail, encode_landmarks, encode_thumbnail
from engram.store.bulk_writer import BulkWriter
from engram.store.hiding import Reverted
from engram.store.map_store import MapStore, WritableMapStore
from engram.store.provenance import Origin
from engram.store.records import (
    AttemptArrays,
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
from engram.store.schema import FORMAT_VERSION
from engram.store.session_writer import SessionWriter
from engram.store.tags import Tag

__all__ = [
    "FORMAT_VERSION",
    "AttemptArrays",
    "BulkWriter",
    "CheckReport",
    "InterruptedSession",
    "MapContents",
    "MapInfo",
    "MapStore",
    "Origin",
    "Problem",
    "Reverted",
    "Revision",
    "SessionState",
    "SessionWriter",
    "StoredNode",
    "StoredSession",
    "Tag",
    "WritableMapStore",
    "decode_landmarks",
    "decode_thumbnail",
    "encode_landmarks",
    "encode_thumbnail",
]
