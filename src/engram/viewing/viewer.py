"""A map and a robot in it, in the Rerun viewer: `engram view`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, MissingExtraError
from engram.frontend import StereoPair
from engram.localiser import Localisation, LocalisationStatus
from engram.localiser.attempts import best_success
from engram.maps import Map
from engram.robot.robot import Seen

_STATUS_COLOURS = {
    LocalisationStatus.LOCALISED: (60, 180, 75),
    LocalisationStatus.DEAD_RECKONING: (255, 165, 0),
    LocalisationStatus.LOST: (220, 50, 50),
}
_GREY = (140, 140, 140)
_JPEG_QUALITY = 80


class Viewer:
    """Shows a map from above by experience, and a robot's frames as they come.

    Args:
        opened: the map.
        save: write a recording here and open no window; None opens the viewer.

    Raises:
        MissingExtraError: Rerun is not installed.
        InputError: the recording cannot be written.
    """

    def __init__(self, opened: Map, save: Path | None = None) -> None:
        self._opened = opened
        self._rr = _rerun()
        self._stream = self._rr.RecordingStream("engram")
        if save is None:
            self._stream.spawn()
        else:
            try:
                self._stream.save(str(save))
            except (OSError, RuntimeError) as error:
                raise InputError(f"{save}: cannot be written: {error}") from error
        self._driven: list[NDArray[np.float64]] = []
        self._show_map()

    def close(self) -> None:
        """Writes what was not written yet."""
        self._stream.flush()
        self._stream.disconnect()

    def see(self, seen: Seen, found: Localisation) -> None:
        """Shows a frame, its inliers, the candidates, and how sure the robot is.

        Args:
            seen: `Robot.last`.
            found: its localisation.
        """
        stream, rr = self._stream, self._rr
        stream.set_time("stamp", timestamp=np.datetime64(found.stamp_ns, "ns"))
        if isinstance(seen.arrived, StereoPair):
            image = rr.Image(seen.arrived.left).compress(jpeg_quality=_JPEG_QUALITY)
            stream.log("live/image", image)
        colour = _STATUS_COLOURS.get(found.status, _GREY)
        pixels, best = seen.frame.landmarks.pixels, best_success(seen.outcomes)
        stream.log("live/image/landmarks", rr.Points2D(pixels, colors=_GREY, radii=1.0))
        inliers = pixels[:0] if best is None else pixels[best.match.live_rows]
        stream.log("live/image/inliers", rr.Points2D(inliers, colors=colour, radii=2.0))
        stream.log("status", rr.TextLog(found.status.value, color=colour))
        stream.log("confidence", rr.Scalars(max(found.confidence, -20.0)))
        stream.log("inliers", rr.Scalars(found.inliers))
        self._show_candidates(seen)
        self._show_place(found, colour)

    def _show_map(self) -> None:
        graph, rr = self._opened.graph, self._rr
        positions = self._opened.frame.positions
        sessions = list(dict.fromkeys(node.session for node in graph.nodes))
        for number, session in enumerate(sessions):
            rows = [at for at, node in enumerate(graph.nodes) if node.session == session]
            points = rr.Points3D(positions[rows], colors=_hue(number), radii=0.3)
            self._stream.log(f"map/{str(session)[:8]}", points, static=True)

    def _show_candidates(self, seen: Seen) -> None:
        tried = [one for one in seen.outcomes if one.candidate.node in self._opened.graph]
        places = [self._opened.frame.pose(one.candidate.node).translation for one in tried]
        right, wrong = (
            _STATUS_COLOURS[one] for one in (LocalisationStatus.LOCALISED, LocalisationStatus.LOST)
        )
        colours = [right if one.accepted else wrong for one in tried]
        points = self._rr.Points3D(np.reshape(places, (-1, 3)), colors=colours, radii=0.6)
        self._stream.log("map/tried", points)

    def _show_place(self, found: Localisation, colour: tuple[int, int, int]) -> None:
        position = found.position
        if position is None or position.node not in self._opened.graph:
            return
        map_from_live = self._opened.frame.pose(position.node) @ position.node_from_live
        self._driven.append(map_from_live.translation)
        points = self._rr.Points3D([map_from_live.translation], colors=colour, radii=0.8)
        self._stream.log("map/robot", points)
        self._stream.log("map/driven", self._rr.LineStrips3D([self._driven], colors=_GREY))


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError(
            "the viewer needs Rerun: pip install 'engram-localisation[view]'. Without it, plot and "
            "localise --pictures draw"
        ) from error
    return rerun


def _hue(number: int) -> tuple[int, int, int]:
    """Colours that differ for neighbouring numbers: the golden angle round the circle of hues."""
    hue = (number * 0.618034) % 1.0
    channels = np.abs(((hue + np.array([0.0, 2 / 3, 1 / 3])) % 1.0) * 6.0 - 3.0) - 1.0
    red, green, blue = (60 + 180 * channels.clip(0.0, 1.0)).astype(int).tolist()
    return red, green, blue
