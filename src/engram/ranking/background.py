"""What is known of a map beyond its graph and its paths: made once, serves all frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from engram.graph.model import Session, SessionId
from engram.places.words import NodeWords
from engram.ranking.lessons import Lessons


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """What some policies want to know of a map. All of it may be missing.

    Attributes:
        sessions: the drives by id, with the times when they began.
        lessons: what past drives matched and failed to match.
        words: the visual words of nodes and frames; None without a vocabulary.
    """

    sessions: Mapping[SessionId, Session] = field(default_factory=dict)
    lessons: Lessons = field(default_factory=Lessons.none)
    words: NodeWords | None = None
