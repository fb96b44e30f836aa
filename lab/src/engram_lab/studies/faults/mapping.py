"""A drive with a fault is mapped on, by force: what that does to the map."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

from engram.graph.model import EdgeKind
from engram.localiser import Localisation
from engram.maps import open_map
from engram.robot import RobotOptions, Settings, map_drive
from engram.robot.mapping import Beginning
from engram.robot.robot import Seen
from engram_lab.studies.edge_truth import edge_errors
from engram_lab.studies.faults.clips import ClipDrive
from engram_lab.studies.faults.staging import Scene
from engram_lab.studies.faults.trials import Trial


def map_on(trial: Trial, scene: Scene, path: Path) -> None:
    """Maps the scene into a copy of its map, and fills in what that did to it.

    Args:
        trial: gets what it tells of the map.
        scene: what the robot meets.
        path: the copy; replaced if it is there.
    """
    shutil.copyfile(scene.place.path, path)
    drive = ClipDrive(scene.clip.plan, [one.pair for one in scene.shown])
    begin = partial(_told, scene)
    report = map_drive(path, drive, Settings(), RobotOptions(force=True), begin=begin)
    assert report.diagnosis is not None
    trial.map_refused = [one.code for one in report.diagnosis.fatal]
    if drive.skipped:
        trial.map_refused.append("stamps that do not rise")
    true = {one.pair.stamp_ns: scene.clip.world_from_cam[one.frame] for one in scene.shown}
    with open_map(path) as opened:
        graph = opened.graph
        live = {
            one.id: true[one.stamp_ns] for one in graph.nodes if one.session == report.session.id
        }
        laid = [edge for edge in graph.edges if edge.a in live or edge.b in live]
    world_from_node = {**scene.place.world_from_node, **live}
    trial.nodes, trial.edges = len(live), len(laid)
    wrong = [one for one in edge_errors(laid, world_from_node.get) if one.joins_places]
    trial.joined_odometry = sum(one.kind is EdgeKind.ODOMETRY for one in wrong)
    trial.joined = len(wrong) - trial.joined_odometry
    trial.worst_edge_m = max((one.error_m for one in wrong), default=0.0)


def _told(scene: Scene, beginning: Beginning) -> None:
    """Gives the robot a wrong place before the first frame of the fault."""
    if scene.hint is None:
        return
    hint, before_ns = scene.hint, scene.clip.pairs[scene.start - 1].stamp_ns

    def tell(seen: Seen, found: Localisation) -> None:
        del found
        if seen.frame.stamp_ns == before_ns:
            beginning.robot.place_at(hint)

    beginning.robot.watch = tell
