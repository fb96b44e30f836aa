"""Γ(time-of-day): experiences of the same hour first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking.context import RankingContext, round_robin
from engram.ranking.reasons import IN_TURNS, Reasons
from engram.ranking.times import hour_difference


class TimeOfDayPolicy:
    """By difference in hour of day, then by age, experiences round robin (SPEC §4).

    Experiences whose hour is unknown stand behind those of any known hour; if the live frame's
    own is unknown, none has a difference and age alone decides. A frame of unknown date counts as
    of the day of the newest drive.
    """

    name = "time-of-day"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """See `RankingPolicy`."""
        return round_robin(context, *self._differences(context))  # what is no number stands last

    def reasons(self, context: RankingContext) -> Reasons:
        """See `Explains`."""
        apart_h, age_days = self._differences(context)
        meaning = {
            "hours apart": "difference in time of day to the node's drive",
            "days apart": "difference in date",
        }
        rule = f"{IN_TURNS}; fewest hours apart first within a turn, then fewest days"
        return Reasons({"hours apart": apart_h, "days apart": age_days}, meaning, rule=rule)

    @staticmethod
    def _differences(context: RankingContext) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(Y,) hours, 0 to 12, and days."""
        sessions, times = context.sessions, context.background.times
        days = times.days(context.graph, sessions)
        today = np.fmax.reduce(days, initial=-np.inf) if context.day is None else context.day
        age_days = np.abs(today - days)
        if context.hour is None:
            return np.zeros(len(sessions)), age_days
        return hour_difference(times.hours(context.graph, sessions), context.hour), age_days
