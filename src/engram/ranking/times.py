"""When sessions were driven, by their numbers in a graph."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from engram.graph.clock import day_of, hour_of_day
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session, SessionId


class SessionTimes:
    """Hour of day and date of sessions; sessions that nothing is known of have NaN.

    Args:
        sessions: those known; more may be added.
    """

    def __init__(self, sessions: Iterable[Session] = ()) -> None:
        self._known: dict[SessionId, tuple[float, float]] = {}
        self._columns = np.zeros((0, 2))
        for session in sessions:
            self.add(session)

    def add(self, session: Session) -> None:
        """Makes a session known."""
        hour = hour_of_day(session, session.start_ns)
        day = day_of(session, session.start_ns)
        self._known[session.id] = (_number(hour), _number(day))
        self._columns = np.zeros((0, 2))

    def hours(self, graph: ExperienceGraph, numbers: NDArray[np.int32]) -> NDArray[np.float64]:
        """Hour of day (N,) in [0, 24) at which sessions began; `numbers` (N,) are the graph's."""
        return self._rows(graph, numbers)[:, 0]

    def days(self, graph: ExperienceGraph, numbers: NDArray[np.int32]) -> NDArray[np.float64]:
        """When sessions began (N,), in days since 1970; NaN unless their clock is UTC."""
        return self._rows(graph, numbers)[:, 1]

    def _rows(self, graph: ExperienceGraph, numbers: NDArray[np.int32]) -> NDArray[np.float64]:
        # Sessions join a graph in the order of their numbers, so known columns stay right.
        while len(numbers) and len(self._columns) <= int(numbers.max()):
            unknown = (np.nan, np.nan)
            known = range(len(self._columns), int(numbers.max()) + 1)
            rows = [self._known.get(graph.session(number), unknown) for number in known]
            self._columns = np.concatenate([self._columns, np.array(rows).reshape(-1, 2)])
        return self._columns[numbers]


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def hour_difference(hours: NDArray[np.float64], hour: float) -> NDArray[np.float64]:
    """Hours between times of day, 0 to 12, the short way round midnight; NaN stays NaN."""
    apart = np.abs(hours - hour) % 24
    return np.asarray(np.minimum(apart, 24 - apart))
