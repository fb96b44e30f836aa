"""A map and a robot in it, in the Rerun viewer: `engram view`, and `--view` of other verbs."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from engram.errors import InputError, extra
from engram.frontend.frame import StereoPair
from engram.graph.graph import ExperienceGraph
from engram.graph.model import SessionId
from engram.localiser.attempts import outcome_at
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.maps.map import Map
from engram.robot.robot import DisplayPose, LastFrame, Robot
from engram.untrusted import printable

_STATUS_COLOURS = {
    LocalisationStatus.LOCALISED: (60, 180, 75),
    LocalisationStatus.DEAD_RECKONING: (255, 165, 0),
    LocalisationStatus.LOST: (220, 50, 50),
}
_GREY = (140, 140, 140)
_JPEG_QUALITY = 80
# Positions of the driven path that are sent again with each new one.
_STRIP = 50
# Width that the map's pane shows of a map without nodes yet.
_LEAST_SHOWN_M = 20.0


# What ``--view`` takes in place of a file.
WINDOW = Path("window")


class Viewer:
    """Shows a map from above by experience, and a robot's frames as they come.

    A frame costs the loop that calls `see` a few milliseconds, most of them for its image.

    Args:
        save: write a recording here and open no window; None opens the viewer.
    """

    def __init__(self, save: Path | None = None) -> None:
        self._rr = _rerun()
        self._stream = self._rr.RecordingStream("engram")
        if save is None:
            self._stream.spawn()
        else:
            try:
                self._stream.save(str(save))
            except (OSError, RuntimeError) as error:
                raise InputError(f"{save}: cannot be written: {error}") from error
        self._display_pose: DisplayPose | None = None
        self._driven: list[NDArray[np.float64]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Writes what was not written yet."""
        self._stream.flush()
        self._stream.disconnect()

    def watch(self, robot: Robot, opened: Map) -> None:
        """Shows a map, and from now on each frame of a robot in it."""
        self.show(opened, robot.graph)
        robot.watch = self.see

    def _arrange(self, positions: NDArray[np.float64], *, robot: bool) -> None:
        """Lays out the panes: the map from above, and what is seen of a robot that drives in it."""
        import rerun.blueprint as rrb

        eye = rrb.EyeControls3D(**_from_above(positions))
        panes = rrb.Spatial3DView(origin="map", name="Map from above", eye_controls=eye)
        if robot:
            image = rrb.Spatial2DView(origin="live/image", name="Image, and what matched of it")
            sure = rrb.TimeSeriesView(origin="confidence", name="Confidence, log-odds")
            matched = rrb.TimeSeriesView(origin="inliers", name="Inliers of the best match")
            panes = rrb.Horizontal(rrb.Vertical(image, rrb.Tabs(sure, matched)), panes)
        self._stream.send_blueprint(rrb.Blueprint(panes, collapse_panels=True))

    def show(self, opened: Map, graph: ExperienceGraph | None = None) -> None:
        """Shows a map, in which the next frames are; the one before goes.

        Args:
            graph: with what a robot saves; None for that of the map, in which none drives.
        """
        self._display_pose = DisplayPose(opened.frame, opened.graph if graph is None else graph)
        self._driven = []
        numbers: dict[SessionId, int] = {}
        for node in opened.graph.nodes:
            numbers.setdefault(node.session, len(numbers))
        colours = [_hue(numbers[node.session]) for node in opened.graph.nodes]
        positions = opened.layout().positions
        self._arrange(positions, robot=graph is not None)
        points = self._rr.Points3D(positions, colors=colours, radii=0.3)
        self._stream.log("map/nodes", points, static=True)
        goals = {name: opened.frame.locate(goal) for name, goal in opened.goals.items()}
        stars = self._rr.Points3D(
            np.array([(goal.x_m, goal.y_m, goal.z_m) for goal in goals.values()]).reshape(-1, 3),
            labels=[printable(name) for name in goals],
            radii=0.5,
        )
        self._stream.log("map/goals", stars, static=True)

    def see(self, seen: LastFrame, localisation: Localisation) -> None:
        """Shows a frame, its inliers, the candidates, and how sure the robot is.

        Args:
            seen: `Robot.last`.
        """
        stream, rr = self._stream, self._rr
        stream.set_time("stamp", timestamp=np.datetime64(localisation.stamp_ns, "ns"))
        if isinstance(seen.arrived, StereoPair):
            image = rr.Image(seen.arrived.left).compress(jpeg_quality=_JPEG_QUALITY)
            stream.log("live/image", image)
        colour = _STATUS_COLOURS.get(localisation.status, _GREY)
        pixels, best = seen.frame.landmarks.pixels, outcome_at(seen.outcomes, localisation.node)
        stream.log("live/image/landmarks", rr.Points2D(pixels, colors=_GREY, radii=1.0))
        inliers = pixels[:0] if best is None else pixels[best.match.live_rows]
        stream.log("live/image/inliers", rr.Points2D(inliers, colors=colour, radii=2.0))
        stream.log("confidence", rr.Scalars(max(localisation.confidence, -20.0)))
        stream.log("inliers", rr.Scalars(localisation.inliers))
        self._show_candidates(seen)
        self._show_place(localisation, colour)

    def _show_candidates(self, seen: LastFrame) -> None:
        right, wrong = (
            _STATUS_COLOURS[status]
            for status in (LocalisationStatus.LOCALISED, LocalisationStatus.LOST)
        )
        places, colours = [], []
        for outcome in seen.outcomes:
            map_from_node = self._display_pose and self._display_pose.of(outcome.candidate.node)
            if map_from_node:
                places.append(map_from_node.translation)
                colours.append(right if outcome.accepted else wrong)
        points = self._rr.Points3D(np.reshape(places, (-1, 3)), colors=colours, radii=0.6)
        self._stream.log("map/tried", points)

    def _show_place(self, localisation: Localisation, colour: tuple[int, int, int]) -> None:
        map_from_live = self._display_pose and self._display_pose.after(localisation)
        if not map_from_live:
            return
        position_m = map_from_live.translation
        self._stream.log("map/robot", self._rr.Points3D([position_m], colors=colour, radii=0.8))
        self._driven.append(position_m)
        part = (len(self._driven) - 1) // _STRIP
        strip = self._rr.LineStrips3D([self._driven[max(part * _STRIP - 1, 0) :]], colors=_GREY)
        self._stream.log(f"map/driven/{part}", strip)


def viewer_for(view: Path | None) -> Viewer | nullcontext[None]:
    """The viewer of an option ``--view``: a window, a recording, or none."""
    return nullcontext() if view is None else viewer_on(view)


def viewer_on(view: Path) -> Viewer:
    """The viewer of an option ``--view`` that is given; see `viewer_for`."""
    if view == WINDOW:
        return Viewer()
    if view.suffix != ".rrd":
        raise InputError(f"--view {view}: give window, or a file to write, NAME.rrd")
    return Viewer(view)


def _from_above(positions: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """An eye over the middle of a map, so high that all (N, 3) positions are in view; y is up."""
    low, high = (positions.min(0), positions.max(0)) if len(positions) else np.zeros((2, 3))
    middle = (low + high) / 2
    height_m = max(float((high - low)[:2].max()), _LEAST_SHOWN_M)
    above, ahead = np.array([0.0, 0.0, height_m]), np.array([0.0, 1.0, 0.0])
    return {"position": middle + above, "look_target": middle, "eye_up": ahead}


def _rerun() -> Any:
    with extra(
        "view", "the viewer needs Rerun (engram plot and engram localise --pictures do not)"
    ):
        import rerun
    return rerun


def _hue(number: int) -> tuple[int, int, int]:
    """Colours that differ for neighbouring numbers: the golden angle round the circle of hues."""
    hue = (number * 0.618034) % 1.0
    channels = np.abs(((hue + np.array([0.0, 2 / 3, 1 / 3])) % 1.0) * 6.0 - 3.0) - 1.0
    red, green, blue = (60 + 180 * channels.clip(0.0, 1.0)).astype(int).tolist()
    return red, green, blue
