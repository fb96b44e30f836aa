"""A map on disk: revisions, transactions, integrity; and the bytes that stand for a frame."""

from engram.store.blob import decode_landmarks, decode_thumbnail, encode_landmarks, encode_thumbnail
from engram.store.map_store import MapStore, WritableMapStore
from engram.store.records import (
    AttemptArrays,
    CheckReport,
    InterruptedSession,
    MapContents,
    MapInfo,
    Problem,
    Revision,
    SessionState,
    StoredSession,
)
from engram.store.session_writer import SessionWriter

__all__ = [
    "AttemptArrays",
    "CheckReport",
    "InterruptedSession",
    "MapContents",
    "MapInfo",
    "MapStore",
    "Problem",
    "Revision",
    "SessionState",
    "SessionWriter",
    "StoredSession",
    "WritableMapStore",
    "decode_landmarks",
    "decode_thumbnail",
    "encode_landmarks",
    "encode_thumbnail",
]
