"""Saving a drive in a map: begun or resumed, written as it goes, committed at its end."""

from __future__ import annotations

import platform
from contextlib import ExitStack, nullcontext
from typing import Any

from engram import __version__
from engram.config import to_dict
from engram.localiser import ByAppearance, FrameMatcher, Localiser, Rule
from engram.localiser.attempts import Attempter
from engram.localiser.relocalisation import Suggested
from engram.localiser.yardstick import Yardstick
from engram.mapper import LoopConfig, LoopSearch, Mapper, NodeSaver, Saver
from engram.maps import Map, Revision, RevisionWriter, StoredSession
from engram.places import RECOGNISERS
from engram.places.words import NodeWords, words_of
from engram.robot.localisers import drives_of
from engram.robot.settings import RobotOptions, Settings


class SavedDrive:
    """Saves one drive with a mapper, on its own thread, and commits it.

    Args:
        opened: the map, open for writing; its graph grows.
        writer: writer of the session.
        localiser: localiser of the drive, in the same map.
        settings: settings of the mapper and the map frame.
        words: finds the words of nodes, see `node_words`.
        waits: whether a slow disk slows the drive; else it ends the saving.

    Attributes:
        mapper: the drive's keeper.
    """

    def __init__(
        self,
        opened: Map,
        writer: RevisionWriter,
        localiser: Localiser,
        settings: Settings,
        words: NodeWords | None,
        *,
        waits: bool = True,
    ) -> None:
        opened.derived(drives_of)[writer.session.id] = writer.session
        self._writer, self._placing = writer, settings.placing
        every = settings.mapper.checkpoint_every
        self._saver = Saver(writer, NodeSaver(writer, opened.frames, words), every, waits)
        self._stack = ExitStack()
        loops = self._stack.enter_context(loop_search(opened, localiser, settings))
        self.mapper = Mapper(
            localiser.graph,
            localiser,
            self._saver,
            writer.session,
            settings.mapper,
            loops,
            writer.stored,
        )

    def finish(self) -> None:
        """Ends the drive and saves what its last frames still add."""
        self.mapper.finish()

    def close(self) -> None:
        """Writes what is queued, and ends the threads. The session can be resumed.

        Raises:
            MapError: a write failed.
        """
        with self._stack:
            self._saver.finish()

    def commit(self) -> Revision:
        """Makes the session a revision of the map, without the edges that its fixes disproved."""
        for removal in self.mapper.votes.removals:
            self._writer.add_mark(removal)
        return self._writer.commit(self._placing)

    def leave(self) -> None:
        """Leaves the session uncommitted, for ``engram check --seal`` alone."""
        self._writer.leave()


def commit_crashed(opened: Map, robot: str, settings: Settings) -> tuple[int, ...]:
    """Commits what earlier live drives of a robot had saved before their process ended.

    Drives that `engram map` was mapping stay as they are: it resumes them. So do those that the
    doctor found unfit.

    Args:
        opened: the map; sees the new revisions.
        robot: name of the robot.
        settings: how the map frame is laid out.

    Returns:
        Numbers of the revisions.

    Raises:
        MapLockedError: another process writes to the map.
        MapError: it cannot be written.
    """
    waiting = [one for one in opened.interrupted() if one.live and one.pid]
    mine = [one.session.id for one in waiting if one.session.robot == robot]
    if not mine:
        return ()
    numbers = []
    with Map.open(opened.location, writes=True) as own:
        for session in mine:
            writer = own.resume_session(session)
            if writer.stored == StoredSession():
                writer.abandon()  # it ended before it had saved anything
            else:
                numbers.append(writer.commit(settings.placing).number)
    with opened.writing():
        pass  # shows it the newest revision
    return tuple(numbers)


def configuration_of(settings: Settings, options: RobotOptions) -> dict[str, Any]:
    """The resolved configuration, which every revision keeps."""
    return {
        "settings": to_dict(settings),
        "options": to_dict(options),
        "machine": platform.machine(),
        "engram": __version__,
    }


def node_words(opened: Map, settings: Settings, relocaliser: str | None) -> NodeWords | None:
    """Finds the words of saved nodes; first adds those missing from older nodes."""
    if relocaliser not in RECOGNISERS:
        return None
    words = opened.derived(words_of, settings.frontend.descriptor)
    words.keep_missing([node.id for node in opened.graph.nodes])
    return words


def loop_search(
    opened: Map, localiser: Localiser, settings: Settings
) -> LoopSearch | nullcontext[None]:
    """Loop search by the words of the relocaliser; a null context if it has none."""
    finder = localiser.relocaliser
    if isinstance(finder, Suggested):
        finder = finder.inner
    if not isinstance(finder, ByAppearance):
        return nullcontext()
    matching = settings.localiser
    attempter = Attempter(opened.frames, matching, FrameMatcher(opened.frames, matching.matcher))
    told = matching.lookalikes.doubt > 0 and matching.acceptance.rule is Rule.CONFIDENCE
    return LoopSearch(
        localiser.graph,
        finder.book,
        attempter,
        matching.acceptance,
        LoopConfig(near_m=matching.search_radius_m, own_exclusion_m=matching.own_exclusion_m),
        Yardstick(localiser.graph, attempter.frame, matching.matcher) if told else None,
    )
