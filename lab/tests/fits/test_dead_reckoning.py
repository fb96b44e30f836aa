"""The measurement of dead reckoning, on drives whose error is known."""

import sys
from types import SimpleNamespace
from uuid import UUID

import numpy as np
import pytest

from engram.geometry.se3 import SE3
from engram.graph.model import SessionId
from engram.odometry.step import OdometryStatus, OdometryStep
from engram_lab.fits import dead_reckoning

SIGMA_M, FRAMES = 0.01, 30


def ahead(metres: float) -> SE3:
    return SE3(np.eye(3), np.array([0.0, 0.0, metres]))


def driven(measured_m: float, dark: frozenset[int] = frozenset()) -> SimpleNamespace:
    """A metre a frame, measured as so much; frames of no use make the next step longer."""
    frames, since = [], 0
    for number in range(FRAMES):
        since += 1
        if number == 0:
            odometry = OdometryStep(OdometryStatus.FIRST)
        elif number in dark:
            odometry = OdometryStep(OdometryStatus.UNUSABLE_FRAME)
        else:
            step = ahead(measured_m * since)
            odometry = OdometryStep(OdometryStatus.OK, step, np.eye(6) * SIGMA_M**2, 100)
        if number not in dark:
            since = 0
        frame = SimpleNamespace(stamp_ns=number * 100_000_000)
        frames.append(SimpleNamespace(odometry=odometry, frame=frame))
    truth = SimpleNamespace(at=lambda stamp_ns: ahead(stamp_ns / 1e8))
    session = SimpleNamespace(id=SessionId(UUID(int=1)))
    return SimpleNamespace(frames=lambda: frames, truth=lambda: truth, session=session)


@pytest.mark.parametrize("dark", [frozenset(), frozenset({7, 10, 28})])
def test_errors_and_standard_deviations_of_a_straight_way_add_up(dark: frozenset[int]) -> None:
    found = list(dead_reckoning.ways(driven(0.9, dark), 7))
    assert len(found) == (4 if not dark else 1)  # from 0, 7, 14 and 21; 7 and 28 are dark
    for off_m, sigma_m, off_rad, sigma_rad in found:
        assert off_m == pytest.approx(0.7)
        assert off_rad == pytest.approx(0.0, abs=1e-9)
        assert sigma_rad == pytest.approx(SIGMA_M * np.sqrt(7))
        # Each step's own, and what turns of the steps before make of the way after them.
        assert sigma_m == pytest.approx(SIGMA_M * np.sqrt(7 + sum(k**2 for k in range(7))), rel=0.2)


def test_a_campaign_without_such_drives_is_told(monkeypatch, capsys) -> None:
    nothing = SimpleNamespace(drives=())
    monkeypatch.setattr(dead_reckoning, "open_campaign", lambda *_: nothing)
    monkeypatch.setattr(sys, "argv", ["dead_reckoning.py", "hamlet", "--weather", "hail"])
    dead_reckoning.main()
    told = capsys.readouterr().out
    assert "0 drives in hail" in told
    assert told.count("no way") == len(dead_reckoning.LENGTHS)
