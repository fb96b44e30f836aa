"""Localisers in a map; they share what is derived from it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias, TypedDict, Unpack

from engram.errors import InputError, SequenceError
from engram.frontend.frame import DescriptorKind
from engram.geometry.cameras import StereoCamera
from engram.graph.basin import BasinConfig, MatchBasin
from engram.graph.clock import Clocked
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session, SessionId
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import PathMemory
from engram.localiser.attempts import Matcher
from engram.localiser.localisation import Budget
from engram.localiser.localiser import UNNAMED_LIVE_SESSION, LiveDrive, Localiser, MapParts
from engram.localiser.relocalisation import Relocaliser, relocaliser_named
from engram.maps.map import Map
from engram.places.words import words_of
from engram.ranking.context import Background, RankingPolicy, uses_words
from engram.ranking.lessons import LessonsConfig, PagedLessons
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
        graph: the graph in which it localises, of the map's pages, and which grows where it maps;
            None for one of its own.
        paths: the paths of that graph; None for those of the map.
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
    paths: PathMemory | None
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
    paths = parts.get("paths")
    paths = PathMemory(graph, pages=opened.pages) if paths is None else paths
    config = settings.localiser
    basin, lessons = opened.derived(lessons_of, camera.fx, config.basin, config.lessons)
    background = Background(opened.derived(drives_of), lessons, words, opened.cameras)
    if uses_words(ranking):
        words.prepare()
    return Localiser(
        MapParts(
            graph,
            paths.counting(config.path_entries.kinds),
            opened.frames,
            background,
            parts.get("search"),
        ),
        LiveDrive(
            basin,
            parts.get("live", UNNAMED_LIVE_SESSION),
            parts.get("saves", False),
            parts.get("clock"),
            settings.frontend,
        ),
        policy=ranking,
        budget=parts.get("budget") or Budget(),
        relocaliser=relocaliser_in(opened, relocaliser, descriptor, graph)
        if isinstance(relocaliser, str)
        else relocaliser,
        config=config,
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


def lessons_of(
    opened: Map, focal_px: float, basin_config: BasinConfig, config: LessonsConfig
) -> tuple[MatchBasin, PagedLessons]:
    """What past drives teach a live camera of this focal length, px; for `Map.derived`."""
    pages = opened.pages
    basin = MatchBasin.of(focal_px, pages.basin_counts, basin_config)
    return basin, PagedLessons(pages.evidence(basin), pages.end, config)


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
