"""What is known of a map beyond its graph and its paths: made once, serves all frames."""

from __future__ import annotations

from dataclasses import dataclass, field

from engram.ranking.lessons import Lessons
from engram.ranking.times import SessionTimes
from engram.ranking.words import WordSource


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """What some policies want to know of a map. All of it may be missing.

    Attributes:
        times: when the sessions were driven.
        lessons: what past drives matched and failed to match.
        words: the visual words of nodes and frames; None without a vocabulary.
    """

    times: SessionTimes = field(default_factory=SessionTimes)
    lessons: Lessons = field(default_factory=Lessons.none)
    words: WordSource | None = None
