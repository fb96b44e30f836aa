"""How informative each attempt of this run is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.ranking import RunAttempts


def decay(run: RunAttempts, length_m: float) -> NDArray[np.float64]:
    """(R,) exp(−Δs / length) of the distance driven since each attempt."""
    return np.asarray(np.exp((run.at_m - run.driven_m) / length_m))


def failure_weights(run: RunAttempts) -> NDArray[np.float64]:
    """(R,) how much each failure counts against its experience: g, and 0 for successes.

    A failure far from the node was to be expected; one without a prediction counts nothing.
    """
    return np.where(run.accepted | np.isnan(run.rates), 0.0, run.rates)
