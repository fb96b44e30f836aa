"""Data about a map beyond its graph and paths, made once for all frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from engram.geometry import CameraId, StereoCamera
from engram.graph.model import Session, SessionId
from engram.places.words import NodeWords
from engram.ranking.lessons import Lessons


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Data about a map that some policies use. Any of it may be missing.

    Attributes:
        sessions: the drives by id, with their start times.
        lessons: how likely each node matches, by past drives.
        words: the visual words of nodes and frames; None without a vocabulary.
        cameras: of the drives, by id.
    """

    sessions: Mapping[SessionId, Session] = field(default_factory=dict)
    lessons: Lessons = field(default_factory=Lessons.none)
    words: NodeWords | None = None
    cameras: Mapping[CameraId, StereoCamera] = field(default_factory=dict)
