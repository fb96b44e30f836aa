"""Nodes as a camera with another lens sees them best: from farther behind, or farther ahead.

A longer lens shows the same scene larger. A live frame is most alike a node of a shorter lens where
it stands behind it, so that both show the scene at one scale. The offset grows with the ratio of
the focal lengths and the usual depth of what matches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engram.geometry import CameraId, StereoCamera
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session, SessionId
from engram.graph.neighbourhood import Neighbourhood


class Lenses:
    """The focal lengths of a map's drives, compared with that of the live camera.

    Args:
        graph: the experience graph; it may grow.
        sessions, cameras: of the map.
        focal_px: of the live camera, which saves whatever is not in the map yet.
        depth_m: usual depth of what matches; 0 turns the correction off.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        sessions: Mapping[SessionId, Session],
        cameras: Mapping[CameraId, StereoCamera],
        focal_px: float,
        depth_m: float,
    ) -> None:
        self._graph = graph
        self._sessions, self._cameras = sessions, cameras
        self._focal_px, self._depth_m = focal_px, depth_m
        self._of_session = np.zeros(0)
        self._alike = True  # whether none of them shifts

    def shifts_m(self, nodes: NDArray[np.int32]) -> NDArray[np.float64]:
        """(Y,) metres along the viewing direction at which nodes are most alike the live view."""
        self._look_at_sessions()
        return self._of_session[self._graph.sessions_of(nodes)]

    def _look_at_sessions(self) -> None:
        while len(self._of_session) < self._graph.session_count:
            session = self._sessions.get(self._graph.session(len(self._of_session)))
            camera = None if session is None else self._cameras.get(session.camera)
            shift_m = 0.0
            if camera is not None:
                shift_m = self._depth_m * (1 - self._focal_px / camera.fx)
            self._of_session = np.append(self._of_session, shift_m)
            self._alike = self._alike and not shift_m

    def as_seen(self, near: Neighbourhood) -> Neighbourhood:
        """Candidates with their offsets as by one lens; the very same if all lenses are."""
        self._look_at_sessions()
        if self._alike or not (shifts_m := self.shifts_m(near.nodes)).any():
            return near
        along_m = near.along_m - shifts_m
        height_m = near.node_from_live[:, 1, 3]
        distance_m = np.sqrt(along_m**2 + near.across_m**2 + height_m**2)
        return replace(near, along_m=along_m, distance_m=distance_m)
