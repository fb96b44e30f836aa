"""The agent: hand-ins out, versions in, and a switch when the robot is parked.

::

    folder/
      live/map.engram    the map that the robot drives with and adds to
      base/map.engram    the last good one
      next/map.engram    the wanted one, verified, until the robot is parked
      agent.sqlite       outbox, parts that arrived, facts
      key                the robot's private key
"""

from __future__ import annotations

import logging
import os
import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engram.errors import (
    EngramError,
    InputError,
    MapCorruptError,
    MapError,
    StorageFullError,
    storage_full,
)
from engram.files import WriterLock
from engram.fleet.agent.agent_state import AgentSettings
from engram.fleet.agent.centre_link import FOLDERS, CentreLink, enrolled, new_client, signer_of
from engram.fleet.agent.fetching import fetch_map
from engram.fleet.agent.outbox import QUEUED, SENT, Outbox
from engram.maps.map import Map
from engram.maps.map_files import check_file, copy_map

if TYPE_CHECKING:
    import httpx

MAP = "map.engram"
_log = logging.getLogger(__name__)


class Agent:
    """One robot's agent. A context manager.

    Args:
        folder: of an enrolled robot.
        settings: limits.
        client: of the centre; None for the address at which it enrolled.
        wait: waits some seconds, for the cap of the link.
        chance: uniform in [0, 1), for the jitter of retries.

    Attributes:
        trouble: why the last round failed; None after a good one. `Unreachable` passes by itself.

    Raises:
        InputError: the robot is not enrolled.
    """

    def __init__(
        self,
        folder: Path,
        settings: AgentSettings | None = None,
        *,
        client: httpx.Client | None = None,
        wait: Callable[[float], object] = lambda _: None,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self.folder = folder
        self.settings = settings or AgentSettings()
        self.state = enrolled(folder)
        self.trouble: EngramError | None = None
        facts = self.state.facts
        self._failures = facts.failures or 0
        self._chance = chance
        self._owns_client = client is None
        self.live = folder / "live" / MAP
        for name in FOLDERS:
            (folder / name).mkdir(exist_ok=True)
        signer = signer_of(folder / "key")
        self._map = facts.map or ""
        self.link = CentreLink(
            client or new_client(facts.url or ""),
            facts.robot or "",
            signer,
            self.settings.bytes_per_s,
            wait,
        )
        self.outbox = Outbox(self.state, self._map, self.live, self.settings.outbox_bytes)

    def __enter__(self) -> Agent:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes its files, and its connections."""
        self.state.close()
        if self._owns_client:
            self.link.close()

    def hand_in(self) -> str | None:
        """Queues what the live map holds; call it after each drive. No link is needed.

        Returns:
            Its id at the centre; None if nothing is new, or there is no map yet.

        Raises:
            StorageFullError: the outbox is full; the live map keeps everything.
        """
        if not self.live.exists():
            return None
        return self.outbox.queue()

    def drove(self, localised_share: float, driven_m: float) -> bool:
        """Records how well the map localised a drive; falls back if a new map does badly.

        Returns:
            Whether it fell back to the last good map.
        """
        facts = self.state.facts
        driven_m += facts.driven_m or 0.0
        self.state.remember(share=localised_share, driven_m=driven_m)
        if driven_m < self.settings.judged_m or facts.good == facts.runs:
            return False
        if (
            localised_share >= self.settings.least_share
            or not (self.folder / "base" / MAP).exists()
        ):
            self.state.remember(good=facts.runs)
            return False
        self.fall_back()
        return True

    def step(self, *, fetch: bool = True) -> float:
        """One round: report, send, fetch. What fails is `trouble`, and is tried again.

        Args:
            fetch: whether to fetch the wanted version; False while the next mission is not known.

        Returns:
            Seconds until the next round.
        """
        try:
            path, report = f"/v1/maps/{self._map}/robots/me/report", self._report()
            wanted = self.link.ask("PUT", path, report)
            self.state.remember(wanted=wanted["version"], durable=wanted["durable_revision"])
            busy = self.outbox.send(self.link, wanted["durable_revision"])
            if self._report() != report:  # what is settled is no longer to be handed in
                self.link.ask("PUT", path, self._report())
            busy = (fetch and self._fetch(wanted["revision"], wanted["version"])) or busy
            self.state.remember(failures=0, trouble="")
        except (EngramError, OSError) as error:
            return self._failed(error)
        self.trouble, self._failures = None, 0
        return 0.0 if busy else self.settings.idle_s

    def introduce(self) -> None:
        """Logs whose agent this is, and what it has."""
        known = self.status()
        _log.info(
            "robot %s of map %s at %s: runs version %s, outbox %d",
            *(known["name"], known["map"], known["url"]),
            *(known["runs"] or "none", len(known["outbox"])),
        )

    def _failed(self, error: EngramError | OSError) -> float:
        """Notes why a round failed; returns seconds until the next one."""
        if isinstance(error, OSError):
            fact = f"{self.folder} cannot be read or written: {error.strerror}"
            error = storage_full(error, self.folder) or MapError(fact)
        self.trouble = error
        self._failures += 1
        with suppress(MapError):  # of a full disk: what it could not note is logged below
            self.state.remember(failures=self._failures, trouble=str(error))
        longest: float = self.settings.first_retry_s * 2.0 ** min(self._failures - 1, 40)
        pause_s = min(longest, self.settings.longest_retry_s) * (0.5 + self._chance() / 2)
        _log.info("%s; tried again in %.0f s", error, pause_s)
        return pause_s

    def _report(self) -> dict[str, Any]:
        facts = self.state.facts
        return {
            "runs": facts.runs,
            "localised_share": facts.share,
            "driven_m": facts.driven_m,
            "outbox": sum(entry.state in {QUEUED, SENT} for entry in self.state.outbox()),
            "told": (facts.trouble or "")[:500],
        }

    def _fetch(self, revision: int, version: str) -> bool:
        """Fetches the wanted version, unless it is running, staged or rejected."""
        facts = self.state.facts
        if revision == 0 or version in {facts.runs, facts.staged, facts.rejected}:
            return False
        path = self.folder / "next" / "download.engram"
        fetched = (version, self.settings.download)
        if facts.fetched != fetched or not path.exists():
            wanted = {"ref": str(revision), "options": self.settings.download}
            request = f"/v1/maps/{self._map}/downloads"
            if not fetch_map(self.link, self.state, request, wanted, self.live, path):
                return False
            self.state.remember(fetched=fetched)
            _log.info("fetched version %s: %d bytes received", version, self.link.received_bytes)
        try:
            self._stage(version, path)
        except MapCorruptError:  # of the file: it is fetched again
            path.unlink()
            raise
        path.unlink(missing_ok=True)
        _log.info("version %s is ready: the robot takes it when it is parked", version)
        return True

    def _stage(self, version: str, download: Path) -> None:
        """Puts the download into a copy of the live map, and verifies the copy."""
        staged = self.folder / "next" / MAP
        _clear(staged)
        on = None
        if self.live.exists():
            from engram.fleet.download.updating import update

            with Map.open(self.live) as store:
                on = store.revision
            copy_map(self.live, staged)
            update(download, staged)
            problems = check_file(staged).problems
            if problems:
                raise MapError(
                    f"the updated map has {len(problems)} faults ({problems[0]}); the live map "
                    "is unchanged"
                )
        else:
            download.replace(staged)
        self.state.remember(staged=version, staged_on=on)

    def switch(self) -> bool:
        """Switches to the staged version; call it when the robot is parked.

        The live map's lock is taken meanwhile. A kill leaves the one map or the other.

        Returns:
            Whether it switched; False if nothing is staged.

        Raises:
            MapLockedError: the live process still writes to the map.
        """
        staged, version = self.folder / "next" / MAP, self.state.facts.staged
        if version is None:
            return False
        if not staged.exists():  # killed after the rename, before this was noted
            self._installed(version)
            return True
        lock = WriterLock(self.live)
        try:
            if self._moved_on():  # a drive came in between: its nodes are not in the copy
                self.state.remember(staged=None)
                return False
            if self.live.exists():
                self._keep_as_base()
            staged.replace(self.live)
        finally:
            lock.release()
        self._installed(version)
        return True

    def fall_back(self) -> None:
        """Goes back to the last good map; what the other one holds beyond it is handed in first."""
        base = self.folder / "base" / MAP
        if not base.exists():
            raise InputError(f"{self.folder} has no earlier map to fall back to")
        with suppress(StorageFullError):
            self.hand_in()
        lock = WriterLock(self.live)
        try:
            base.replace(self.live)
        finally:
            lock.release()
        facts = self.state.facts
        self.state.remember(rejected=facts.runs, runs=facts.runs_before, share=None, driven_m=0.0)

    @property
    def is_pending(self) -> bool:
        """Whether a version or the result of a hand-in is pending."""
        facts = self.state.facts
        known = {facts.runs, facts.staged, facts.rejected, None, "0"}
        unsettled = any(entry.state in {QUEUED, SENT} for entry in self.state.outbox())
        return unsettled or facts.wanted not in known

    def status(self) -> dict[str, Any]:
        """The state, as ``engram agent status --json`` prints it."""
        names = (
            "robot", "name", "url", "map", "runs", "wanted", "staged", "rejected", "durable",
            "share", "driven_m", "failures", "trouble",
        )  # fmt: skip
        facts = self.state.facts
        outbox = [
            {
                "id": self.outbox.name_of(entry.id),
                "state": entry.state,
                "bytes": entry.size_bytes,
                "revision": entry.revision,
                "error": entry.error,
            }
            for entry in self.state.outbox()
        ]
        return {**{name: getattr(facts, name) for name in names}, "outbox": outbox}

    def _moved_on(self) -> bool:
        if not self.live.exists():
            return False
        with Map.open(self.live) as store:
            return bool(store.revision != self.state.facts.staged_on)

    def _keep_as_base(self) -> None:
        base = self.folder / "base" / MAP
        draft = base.with_name("draft.engram")
        _clear(draft)
        try:
            os.link(self.live, draft)
        except OSError:
            shutil.copyfile(self.live, draft)
        draft.replace(base)

    def _installed(self, version: str) -> None:
        self.state.remember(
            runs_before=self.state.facts.runs,
            runs=version,
            staged=None,
            share=None,
            driven_m=0.0,
        )


def _clear(path: Path) -> None:
    """Removes a map file with the files that SQLite left next to it."""
    for left in path.parent.glob(f"{path.name}*"):
        left.unlink()
