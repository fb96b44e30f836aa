"""Robots that drove past simulated places, and the maps that they hand in."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from tests.builders import Mapped, World, drive, map_simulated

from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.merge.report import MergeReport
from engram.frontend.frame import DescriptorKind
from engram.geometry.se3 import SE3
from engram.graph.model import Clock, NodeId, Session
from engram.maps.map import Map
from engram.maps.records import StoredNode
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FrameLogWriter
from engram.sequences.sequence import LoggedFrame, SequenceInfo

DAY_NS = 86_400_000_000_000
HOUR_NS = 3_600_000_000_000
WORLD = World(length_m=40.0, seed=11)
# FAB-MAP knows nothing of random descriptors: every node is looked at instead.
OPTIONS = MergeOptions(relocaliser="exhaustive")


def robot_map(
    path: Path,
    places_m: np.ndarray,
    appearance: int | np.ndarray = 0,
    *,
    name: str = "r1",
    day: int = 1,
    aside_m: float = 0.0,
    world: World = WORLD,
) -> Mapped:
    """One more drive in a robot's map, which is made if there is none."""
    steps = drive(world, places_m, appearance, aside_m=aside_m, start_ns=day * DAY_NS, seed=day)
    return map_simulated(path, steps, name)


def merged(
    centre: Path, *robots: Path, asked: MergeOptions = OPTIONS, **options: object
) -> list[MergeReport]:
    return merge(centre, robots, asked, **options)


def rewritten(
    source: Path,
    target: Path,
    *,
    session: Callable[[Session], Session] = lambda one: one,
    node: Callable[[StoredNode], StoredNode] = lambda one: one,
    descriptor: DescriptorKind | None = None,
) -> Path:
    """A copy of a map that remembers no attempt, with records changed on the way."""
    with Map.open(source) as given, Map.create(target) as store:
        contents, frontends = given.load(), given.frontends
        with store.begin_revision(author="tests", message="", configuration={}) as writer:
            for one in contents.sessions:
                kind, frontend = frontends[one.id]
                writer.add_session(
                    session(one),
                    contents.cameras[one.camera],
                    descriptor=descriptor or kind,
                    frontend=frontend,
                )
            for stored in given.frames.stored(contents.nodes):
                kept = replace(stored, descriptor=descriptor or stored.descriptor)
                writer.copy_node(node(kept))
            for edge in contents.edges:
                writer.add_edge(edge)
            for entry in contents.path_entries:
                writer.add_path_entry(entry)
            writer.commit()
    return target


def truth_of(*maps: Mapped) -> dict[NodeId, SE3]:
    return {node: pose for one in maps for node, pose in one.saved.items()}


def frame_log(
    path: Path,
    places_m: np.ndarray,
    appearance: int = 0,
    *,
    name: str = "r1",
    day: int = 1,
    hour: float = 12.0,
    aside_m: float = 0.0,
) -> Path:
    """A drive as a frame log, at an hour of the day at Greenwich."""
    steps = drive(
        WORLD,
        places_m,
        appearance,
        aside_m=aside_m,
        start_ns=day * DAY_NS + round(hour * HOUR_NS),
        seed=day,
    )
    first = steps[0].frame
    info = SequenceInfo(path.stem, "synthetic", Clock.UTC, name, longitude_deg=0.0)
    header = FrameLogHeader(info, first.camera, first.descriptor, first.frontend)
    with FrameLogWriter(path, header) as writer:
        for number, seen in enumerate(steps):
            logged = LoggedFrame(seen.frame, seen.odometry)
            writer.append(logged, hashlib.sha256(f"{path.stem} {number}".encode()).hexdigest())
        writer.close(complete=True)
    return path
