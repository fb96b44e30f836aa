"""Γ(time-of-day): experiences of the same hour first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.graph.clock import day_of, hour_of_day
from engram.ranking.context import RankingContext
from engram.ranking.reasons import Reasons
from engram_lab.policies.turns import IN_TURNS, round_robin


class TimeOfDayPolicy:
    """By difference in hour of day, then by age, experiences round robin (method §4).

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
        numbers, group = np.unique(context.sessions, return_inverse=True)
        began = np.array([_began(context, number) for number in numbers.tolist()])
        hours, days = began.reshape(-1, 2)[group].T
        today = np.fmax.reduce(days, initial=-np.inf) if context.day is None else context.day
        age_days = np.abs(today - days)
        if context.hour is None:
            return np.zeros(len(group)), age_days
        apart_h = np.abs(hours - context.hour) % 24
        return np.minimum(apart_h, 24 - apart_h), age_days


def _began(context: RankingContext, number: int) -> tuple[float, float]:
    """Hour of day and days since 1970 at which a session began; NaN where it is not known."""
    session = context.background.sessions.get(context.graph.session(number))
    if session is None:
        return np.nan, np.nan
    hour, day = hour_of_day(session, session.start_ns), day_of(session, session.start_ns)
    return np.nan if hour is None else hour, np.nan if day is None else day
