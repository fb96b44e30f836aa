"""Localisers in a map; they share what is derived from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypedDict, Unpack

import numpy as np

from engram.errors import InputError, SequenceError
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import StereoCamera
from engram.graph.basin import BasinConfig, MatchBasin
from engram.graph.clock import Clocked
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session, SessionId, path_id
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.pages import PagedGraph
from engram.graph.paths import Evidence, PathMemory
from engram.localiser.attempts import Matcher
from engram.localiser.localisation import Budget
from engram.localiser.localiser import UNNAMED_LIVE_SESSION, LiveDrive, Localiser, MapParts
from engram.localiser.relocalisation import Relocaliser, relocaliser_named
from engram.localiser.settings import LocaliserConfig
from engram.maps.map import Map
from engram.places.words import words_of
from engram.ranking.context import Background, RankingPolicy, uses_words
from engram.ranking.lessons import Lessons, PagedLessons
from engram.ranking.policies import policy_named
from engram.robot.settings import Settings
from engram.sequences.framelog.reader import FrameLog
from engram.sequences.sequence import StereoSequence, first_pair_hash, session_of


class LocaliserParts(TypedDict, total=False):
    """How a localiser differs from the default one.

    Attributes:
        policy: key of `POLICIES`, or a policy.
        budget: attempts per frame; None for 2 lanes × 2 rounds.
        relocaliser: one of `relocaliser_names()`, or one that several drives share; None for none.
        saves: whether the session is being mapped.
        graph: the graph in which it localises, and which grows where it maps; None for one of its
            own by pages. Of `Map.graph` paths, lessons and attempts are read whole.
        threads: how many threads the lanes share; None for one each.
        matcher, search: replace the default ones; see `Localiser` and `MapParts`.
        clock: time zone and location of its stamps; None if unknown.
    """

    policy: str | RankingPolicy
    budget: Budget | None
    relocaliser: str | Relocaliser | None
    live: SessionId
    saves: bool
    matcher: Matcher | None
    threads: int | None
    search: Callable[..., Neighbourhood] | None
    graph: ExperienceGraph | None
    clock: Clocked | None


def localiser_in(
    opened: Map, camera: StereoCamera, settings: Settings, **parts: Unpack[LocaliserParts]
) -> Localiser:
    """A localiser for one session in a map.

    Args:
        camera: the live camera; it may differ from those of the map.
        **parts: what differs from the default; see `LocaliserParts`.
    """
    policy = parts.get("policy", "recall")
    relocaliser = parts.get("relocaliser", "fabmap")
    ranking = policy_named(policy) if isinstance(policy, str) else policy
    descriptor = settings.frontend.descriptor
    words = opened.derived(words_of, descriptor)
    graph = parts.get("graph")
    graph = opened.read_graph() if graph is None else graph  # one without nodes is not true
    learn = _by_pages if isinstance(graph, PagedGraph) else _whole
    known = learn(opened, graph, camera.fx, settings.localiser)
    background = Background(opened.derived(drives_of), known.lessons, words, opened.cameras)
    if uses_words(ranking):
        words.prepare()
    return Localiser(
        MapParts(graph, known.paths, opened.frames, background, parts.get("search")),
        LiveDrive(
            known.basin,
            parts.get("live", UNNAMED_LIVE_SESSION),
            parts.get("saves", False),
            parts.get("clock"),
        ),
        policy=ranking,
        budget=parts.get("budget") or Budget(),
        relocaliser=relocaliser_in(opened, relocaliser, descriptor, graph)
        if isinstance(relocaliser, str)
        else relocaliser,
        config=settings.localiser,
        matcher=parts.get("matcher"),
        threads=parts.get("threads"),
    )


def relocaliser_in(
    opened: Map, name: str, descriptor: DescriptorKind, graph: ExperienceGraph | None = None
) -> Relocaliser:
    """The relocaliser of a map.

    Args:
        name: one of `relocaliser_names()`.
        descriptor: kind of the live frames' descriptors; used while the map is empty.
        graph: the graph of the localiser; None for one of the map by pages.

    Raises:
        MapCorruptError: the vocabulary or a node's landmarks are damaged.
    """
    words = opened.derived(words_of, descriptor)
    return relocaliser_named(name)(opened.read_graph() if graph is None else graph, words)


def drives_of(opened: Map) -> dict[SessionId, Session]:
    """Sessions of a map by id, including those being added; for `Map.derived`."""
    return dict(opened.sessions)


def lessons_of(opened: Map, focal_px: float, config: LocaliserConfig) -> Lessons:
    """`Lessons` of a map, for a live camera of this focal length, px; for `Map.derived`."""
    made, basin = opened.attempts, MatchBasin.of(focal_px, opened.basin_counts, config.basin)
    along_m, across_m = (x.astype(np.float64) for x in (made.along_m, made.across_m))
    rates = basin.success_rate(along_m, across_m)
    viewers = [path_id(session) for session in opened.sessions]
    return Lessons.learnt(opened.graph, opened.path_memory, viewers, made, rates, config.lessons)


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What a localiser reads of paths and attempts."""

    paths: PathMemory
    lessons: Lessons | PagedLessons
    basin: MatchBasin


def _by_pages(
    opened: Map, graph: ExperienceGraph, focal_px: float, config: LocaliserConfig
) -> _Known:
    pages = opened.pages
    basin, evidence = opened.derived(_past_drives, focal_px, config.basin)
    paths = PathMemory(graph, config.path_entries.kinds, pages)
    return _Known(paths, PagedLessons(evidence, pages.end, config.lessons), basin)


def _past_drives(
    opened: Map, focal_px: float, config: BasinConfig
) -> tuple[MatchBasin, Callable[[int, int], Evidence]]:
    basin = MatchBasin.of(focal_px, opened.totals().basin_counts, config)
    return basin, opened.pages.evidence(basin)


def _whole(opened: Map, graph: ExperienceGraph, focal_px: float, config: LocaliserConfig) -> _Known:
    assert graph is opened.graph
    return _Known(
        opened.path_memory.counting(config.path_entries.kinds),
        opened.derived(lessons_of, focal_px, config),
        MatchBasin.of(focal_px, opened.basin_counts, config.basin),
    )


DriveSequence: TypeAlias = StereoSequence | FrameLog


def session_of_drive(sequence: DriveSequence) -> Session:
    """The session of a drive: the same drive read twice is the same session (method §2.7)."""
    if not isinstance(sequence, StereoSequence | FrameLog):
        raise InputError(
            f"a value of {type(sequence).__name__} is not a drive: open a path with "
            "engram.open_drive(PATH); give pairs of your own to `step` of Map.robot(maps=True)"
        )
    info = sequence.info
    if isinstance(sequence, FrameLog):
        return session_of(
            info, sequence.camera, int(sequence.stamps_ns[0]), sequence.first_pair_hash
        )
    first = next(iter(sequence), None)
    if first is None:
        raise SequenceError(f"{info.name}: no frame can be used")
    return session_of(info, sequence.camera, first.stamp_ns, first_pair_hash(first))
