"""A map in use: its graph and path memory in memory, its landmarks on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from engram.errors import ConfigError
from engram.frontend import DescriptorKind, Frontend, StereoPair
from engram.geometry import StereoCamera
from engram.graph.basin import MatchBasin
from engram.graph.clock import Clocked
from engram.graph.graph import ExperienceGraph
from engram.graph.model import PathEntryKind, SessionId, path_id
from engram.graph.neighbourhood import Neighbourhood
from engram.graph.paths import PathMemory
from engram.localiser import (
    RELOCALISERS,
    UNNAMED_LIVE_SESSION,
    Budget,
    Localisation,
    Localiser,
    Matcher,
    Relocaliser,
    Searched,
)
from engram.maps import MapStore
from engram.odometry import GapFiller, Odometry
from engram.places import Vocabulary, decode_vocabulary, default_vocabulary
from engram.places.stored_words import stored_words
from engram.ranking import (
    Background,
    Lessons,
    PastAttempts,
    QuantisedWords,
    RankingPolicy,
    check_for_robot,
    policy_named,
    uses_words,
)
from engram.robot.settings import Settings


class OpenMap:
    """A map that is open for reading, or for a mapper to add to.

    Attributes:
        store: the file.
        graph: its experience graph.
        path_memory: its paths.
        remembered: its attempts; sessions are places in `sessions`, nodes are dense indices.
        attempts: counts of them, from which match basins are learnt.
        drives: its sessions and those that are being added, by id: what policies may ask.
        sessions: its sessions, by id.
        last_iterations: number of the newest remembered iteration of each session that has any.
    """

    def __init__(self, store: MapStore) -> None:
        self.store = store
        self.graph = ExperienceGraph()
        self.path_memory = PathMemory(self.graph)
        contents = store.load()
        for node in contents.nodes:
            self.graph.add_node(node)
        self.graph.add_edges(contents.edges)
        for entry in contents.path_entries:
            self.path_memory.add(entry)
        self.drives = {session.id: session for session in contents.sessions}
        self._words: dict[DescriptorKind, QuantisedWords] = {}
        self.remembered = contents.attempts
        self._lessons: dict[float, Lessons] = {}
        self.sessions = {session.id: session for session in contents.sessions}
        self.attempts = contents.basin_counts(self.graph.experiences)
        self.last_iterations = contents.last_iterations()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file."""
        self.store.close()

    def counting(self, kinds: Collection[PathEntryKind]) -> OpenMap:
        """This map with a path memory in which only these kinds of entry count.

        It shares the file and the graph with this one, and is closed with it.
        """
        if frozenset(kinds) == self.path_memory.kinds:
            return self
        other = copy(self)
        other.path_memory = PathMemory(self.graph, kinds)
        for path in self.path_memory.paths:
            for entry in self.path_memory.entries(path):
                other.path_memory.add(entry)
        return other

    @property
    def descriptor(self) -> DescriptorKind | None:
        """Kind of all descriptors of the map; None while it is empty."""
        return self.store.descriptor()

    @cached_property
    def vocabulary(self) -> Vocabulary | None:
        """The vocabulary that was trained for this map; None if there is none.

        Raises:
            MapCorruptError: it is damaged.
        """
        body = self.store.vocabulary()
        return None if body is None else decode_vocabulary(body)

    def vocabulary_or_default(self, descriptor: DescriptorKind) -> Vocabulary:
        """The map's vocabulary, or the default one; `descriptor` counts while it is empty."""
        return self.vocabulary or default_vocabulary(self.descriptor or descriptor)

    def relocaliser(self, name: str, descriptor: DescriptorKind) -> Relocaliser:
        """What finds a lost robot in this map.

        Args:
            name: key of `RELOCALISERS`.
            descriptor: kind of the live frames' descriptors; counts while the map is empty.

        Raises:
            ConfigError: there is no such relocaliser.
            MapCorruptError: the vocabulary or a node's landmarks are damaged.
        """
        if name not in RELOCALISERS:
            raise ConfigError(f"relocaliser {name!r} is unknown; known: {', '.join(RELOCALISERS)}")
        return RELOCALISERS[name](
            Searched(
                self.graph,
                self.store.frames,
                lambda: self.vocabulary_or_default(descriptor),
                lambda vocabulary: stored_words(self.store, vocabulary),
            )
        )

    def lessons(self, focal_px: float) -> Lessons:
        """What the drives of this map learnt, for a live camera of this focal length, px."""
        if focal_px not in self._lessons:
            made, basin = self.remembered, MatchBasin.of(focal_px, self.attempts)
            along_m, across_m = (x.astype(np.float64) for x in (made.along_m, made.across_m))
            attempts = PastAttempts(
                made.session, made.node, basin.success_rate(along_m, across_m), made.accepted
            )
            self._lessons[focal_px] = Lessons.learnt(
                self.graph,
                self.path_memory,
                [path_id(session) for session in self.sessions],
                attempts,
            )
        return self._lessons[focal_px]

    def localiser(
        self,
        camera: StereoCamera,
        settings: Settings,
        *,
        policy: str | RankingPolicy = "recall",
        budget: Budget | None = None,
        relocaliser: str | Relocaliser | None = "fabmap",
        live: SessionId = UNNAMED_LIVE_SESSION,
        saves: bool = False,
        matcher: Matcher | None = None,
        threads: bool = True,
        search: Callable[..., Neighbourhood] | None = None,
        clock: Clocked | None = None,
    ) -> Localiser:
        """A localiser for one session in this map.

        Args:
            camera: the live camera, which need not be one of the map's.
            settings: the resolved configuration.
            policy: key of `POLICIES`, or a policy of the caller's own.
            budget: by default 2 lanes × 2 rounds.
            relocaliser: key of `RELOCALISERS`, or one that several drives share; None for none.
            live: the live session.
            saves: whether it is being mapped.
            threads: whether lanes run on threads.
            matcher, search: in place of the usual ones; see `Localiser`.
            clock: what its stamps mean, and where it is; None if unknown.

        Raises:
            ConfigError: there is no such policy or relocaliser.
        """
        ranking = policy_named(policy) if isinstance(policy, str) else policy
        background = self._background(camera.fx, settings.frontend.descriptor)
        if uses_words(ranking):
            self._words[settings.frontend.descriptor].prepare()
        return Localiser(
            self.graph,
            self.path_memory,
            self.store.frames,
            policy=ranking,
            budget=budget or Budget(),
            relocaliser=self.relocaliser(relocaliser, settings.frontend.descriptor)
            if isinstance(relocaliser, str)
            else relocaliser,
            basin=MatchBasin.of(camera.fx, self.attempts),
            live=live,
            saves=saves,
            config=settings.localiser,
            matcher=matcher,
            threads=threads,
            search=search,
            background=background,
            clock=clock,
        )

    def _background(self, focal_px: float, descriptor: DescriptorKind) -> Background:
        """Made of parts that serve all localisers of this map."""
        if descriptor not in self._words:
            self._words[descriptor] = QuantisedWords(
                self.graph,
                self.store.frames,
                lambda: self.vocabulary_or_default(descriptor),
                lambda vocabulary: stored_words(self.store, vocabulary),
            )
        return Background(self.drives, self.lessons(focal_px), self._words[descriptor])

    def robot(
        self,
        camera: StereoCamera,
        settings: Settings | None = None,
        *,
        policy: str = "recall",
        lanes: int = 2,
        rounds: int = 2,
        relocaliser: str | None = "fabmap",
    ) -> LiveRobot:
        """A robot that hands in image pairs one by one; see `LiveRobot.localise`.

        Args:
            camera: its rectified stereo camera.
            settings: the configuration; None for the defaults.
            policy: key of `POLICIES`.
            lanes: attempts at the same time (Np).
            rounds: rounds of attempts for one frame (Nr).
            relocaliser: how it is found when lost; None for not at all.
        """
        return LiveRobot(
            self,
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
        opened: OpenMap,
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
        self._localiser = opened.localiser(
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


def open_map(path: str | Path, at: int | str | None = None) -> OpenMap:
    """Opens a map for localising in it.

    Args:
        path: NAME.engram.
        at: number or tag of a revision, to see the map as it was then; None for the newest.

    Raises:
        MapError: the file is no map, of a newer format, or damaged.
        RevisionError: there is no such revision.
    """
    return OpenMap(MapStore.open(path, at=at))
