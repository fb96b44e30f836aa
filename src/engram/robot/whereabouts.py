"""Where a driving robot is in the map frame, also among nodes that it saved itself."""

from __future__ import annotations

import numpy as np

from engram.geometry import SE3
from engram.graph.model import NodeId
from engram.graph.placing import MAP_FROM_CAMERA
from engram.localiser import Localisation
from engram.maps import MapFrame


class Whereabouts:
    """Follows a robot in the map frame, for display and messages.

    Nodes get their place in the frame with the revision that commits them. Until then one that the
    robot saved lies where the robot took itself to be. In an empty map the first frame lies at the
    origin and looks along x, as the committed frame will have it.

    Args:
        frame: that of the map as it was when the drive began.
    """

    def __init__(self, frame: MapFrame) -> None:
        self._frame = frame
        self._saved: dict[NodeId, SE3] = {}

    def of(self, node: NodeId) -> SE3 | None:
        """``map_from_node``; None for a node without a place."""
        return self._saved.get(node) or self._frame.find(node)

    def after(self, found: Localisation) -> SE3 | None:
        """``map_from_live`` at the next frame of the drive; None where it is not known.

        Args:
            found: the result of each frame, one after another.
        """
        position = found.position
        map_from_node = None if position is None else self.of(position.node)
        here = None
        if position is not None and map_from_node is not None:
            here = map_from_node @ position.node_from_live
        elif found.saved is not None and not self._saved and not len(self._frame.positions):
            here = SE3(MAP_FROM_CAMERA.copy(), np.zeros(3))
        if found.saved is not None and here is not None:
            self._saved[found.saved] = here
        return here
