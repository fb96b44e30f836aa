"""A robot that hands in its image pairs one by one."""

from __future__ import annotations

import time
from typing import Self

from engram.frontend import Frontend, StereoPair
from engram.geometry import StereoCamera
from engram.localiser import Budget, Localisation
from engram.maps import Map
from engram.odometry import GapFiller, Odometry
from engram.ranking import check_for_robot
from engram.robot.localisers import localiser_in
from engram.robot.settings import Settings


def live_robot(
    opened: Map,
    camera: StereoCamera,
    settings: Settings | None,
    *,
    policy: str,
    lanes: int,
    rounds: int,
    relocaliser: str | None,
) -> LiveRobot:
    """See `Map.robot`."""
    return LiveRobot(
        opened,
        camera,
        settings or Settings(),
        policy=policy,
        budget=Budget(lanes, rounds),
        relocaliser=relocaliser,
    )


class LiveRobot:
    """One robot on one drive: image pairs in, `Localisation`s out. Not thread-safe."""

    def __init__(
        self,
        opened: Map,
        camera: StereoCamera,
        settings: Settings,
        *,
        policy: str,
        budget: Budget,
        relocaliser: str | None,
    ) -> None:
        check_for_robot(policy)
        self.camera = camera
        self._frontend = Frontend(settings.for_descriptor(opened.descriptor).frontend)
        self._odometry, self._gaps = Odometry(settings.odometry), GapFiller()
        self._localiser = localiser_in(
            opened,
            camera,
            settings,
            policy=policy,
            budget=budget,
            relocaliser=relocaliser,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the threads of the lanes."""
        self._localiser.close()

    def localise(self, pair: StereoPair, deadline_ms: float | None = None) -> Localisation:
        """Localises one pair of images; call it for every pair, in the order of time.

        Args:
            pair: (h, w) uint8 grey, rectified, synchronised; `stamp_ns` later than the last.
            deadline_ms: no match attempt starts later than this after the call.

        Returns:
            Where the robot is, as far as it is known. `node_from_live` (metres, x right, y down,
            z forward) is set only where the frame was matched.

        Raises:
            MapError: the map's landmarks cannot be read.
        """
        arrived = time.perf_counter()
        frame = self._frontend.extract(pair)
        self._localiser.move(self._gaps.motion(self._odometry.step(frame), frame.stamp_ns))
        deadline = None if deadline_ms is None else arrived + deadline_ms / 1e3
        return self._localiser.localise(frame, deadline)
