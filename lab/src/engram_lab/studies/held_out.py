"""One held-out drive in one map: where it starts, and how it is localised (method §8)."""

from __future__ import annotations

from collections.abc import Sequence

from engram.localiser import FrameMatcher, Matcher
from engram.maps import Map
from engram.robot import Settings
from engram.sequences import LoggedFrame
from engram_lab.studies.building import true_nodes
from engram_lab.studies.configurations import Configuration
from engram_lab.studies.drives import EvaluatedDrive
from engram_lab.studies.lockstep import Runs, Situation, run_in_step
from engram_lab.studies.memo import MatchMemo
from engram_lab.studies.starting import start_by_matching


def localise_held_out(
    opened: Map,
    drive: EvaluatedDrive,
    frames: Sequence[LoggedFrame],
    training: Sequence[EvaluatedDrive],
    configurations: Sequence[Configuration],
    settings: Settings,
    matcher: Matcher | None,
    relocaliser: str | None,
    threads: int | None = None,
) -> Runs:
    """Localises a drive with every configuration, from the node nearest by truth.

    Where truth is not known, its own or that of every node, it starts at its first frame that
    matches any node.

    Args:
        opened: the map; it stays as it is.
        drive: the drive, which is not in it.
        frames: of the drive.
        training: at least the drives that the map was built from.
        configurations: what to run.
        settings: the resolved configuration.
        matcher: makes the matches, unguided; None for the localiser's own, guided ones.
        relocaliser: key of `RELOCALISERS`; None leaves the lost to what is near.
        threads: most threads that a robot's lanes share; None for one each.
    """
    nodes, truth = true_nodes(opened, training), drive.truth()
    first = None if truth is None else truth.at(frames[0].frame.stamp_ns)
    position = None if first is None else nodes.start(first)
    start = None if position is None else (0, position)
    if start is None:
        config = settings.localiser
        start = start_by_matching(
            opened,
            frames,
            drive.session.id,
            FrameMatcher(opened.frames, config.matcher) if matcher is None else matcher,
            config.acceptance,
        )
    situation = Situation(opened, drive, frames, start, nodes, truth)
    cost = (lambda: matcher.seconds) if isinstance(matcher, MatchMemo) else (lambda: 0.0)
    return run_in_step(situation, configurations, settings, matcher, relocaliser, cost, threads)
