"""Γ(time-of-day): experiences of the same hour first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, round_robin
from engram.ranking.times import hour_difference

_NS_PER_DAY = 86_400_000_000_000


class TimeOfDayPolicy:
    """By difference in hour of day, then by age, experiences round robin (SPEC §4).

    Experiences whose hour is unknown stand behind those of any known hour; if the live frame's
    own is unknown, none has a difference and age alone decides.
    """

    name = "time-of-day"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        sessions, times = context.sessions, context.background.times
        age_days = np.abs(context.stamp_ns / _NS_PER_DAY - times.days(context.graph, sessions))
        if context.hour is None:
            apart_h = np.zeros(len(sessions))
        else:
            apart_h = hour_difference(times.hours(context.graph, sessions), context.hour)
        return round_robin(context, apart_h, age_days)  # what is no number stands last
