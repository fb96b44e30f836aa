"""kill -9 of a centre's workers that share no folder: is every hand-in merged, and once?

Two workers with a folder each, and a service with a third, have the database and the objects in
common: PostgreSQL where ENGRAM_DATABASE names an empty one, else an SQLite file; and a folder.
Robots hand in to two maps all the time. Workers are killed before a random commit of any database
or at a random moment, and begin again in their folders. In the end all three copies must be equal
to the bit, pass check, and have the content of the same hand-ins merged one after another by one
process.

    python -m engram_lab.checks.kill_workers --kills 200
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
from collections import Counter
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, event

from engram.errors import EngramError
from engram.fleet.centre import handins, jobs, merge_job
from engram.fleet.centre.service import Centre, CentreSettings, MapPolicy
from engram.fleet.centre.tables import HandIn, JobState
from engram.fleet.centre.worker import work_off
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.merge.merging import merge
from engram.fleet.transfers import Manifest, PartHash, split
from engram.maps.exchange import stamp_of
from engram.maps.map import Map, open_map
from engram.maps.map_files import check_file
from engram_lab.programs import command_line
from engram_lab.synthetic_places import write_session

_MAPS = ("north", "south")
_ROBOTS = 3
_WAITING = 3
_POLICY = MapPolicy(merge=MergeOptions(relocaliser="none"))
# Workers die far more often here than a hand-in may be the cause of.
_SETTINGS = CentreSettings(merge_tries=10**6, bytes_a_day=2**50, open_handins=10**6)
_MOST_COMMITS = 24
_LATEST_S = 3.0
_PAUSE_S = 0.01
_PATIENCE_S = 60.0
_CONTEXT = multiprocessing.get_context("forkserver")


class Robots:
    """Robots that drive and hand in.

    Attributes:
        copies: each map as it was handed in, by its content hash.
    """

    def __init__(self, centre: Centre, folder: Path, rng: random.Random) -> None:
        self._centre = centre
        self._folder = folder
        self._rng = rng
        self._drives = 0
        self.copies: dict[str, Path] = {}

    def hand_in(self, name: str) -> None:
        """One more drive of a random robot, handed in with all that it drove before."""
        robot = f"{name}-{self._rng.randrange(_ROBOTS)}"
        path = self._folder / f"{robot}.engram"
        with (
            open_map(path, create=True) as store,
            store.writing(),
            store.begin_revision(author=robot, message="a drive", configuration={}) as writer,
        ):
            places = range(3 * self._drives, 3 * self._drives + self._rng.randrange(1, 4))
            write_session(writer, robot, self._drives, places)
            writer.commit()
        self._drives += 1
        taken = split(path)
        row = handins.begin(self._centre, name, robot, taken.manifest.on_wire(None))
        while wanted := handins.wanted_parts(self._centre, row):
            handins.put_parts(self._centre, row, list(taken.parts(wanted)))
        handins.complete(self._centre, row)
        copy = self._folder / f"{robot}-{self._drives}.engram"
        shutil.copyfile(path, copy)
        self.copies[taken.manifest.content_hash] = copy


class Worker:
    """A worker in a process of its own, which is killed and begins again."""

    def __init__(
        self, folder: Path, addresses: tuple[str | None, str | None], rng: random.Random
    ) -> None:
        self.folder = folder
        self._addresses = addresses
        self._rng = rng
        self._timer = threading.Timer(0.0, lambda: None)
        self.process = self._begun(None)

    def _begun(self, dies_at: int | None) -> ForkServerProcess:
        process = _CONTEXT.Process(target=_work, args=(self.folder, self._addresses, dies_at))
        process.start()
        return process

    def doom(self, *, within_commit: bool) -> None:
        """Begins again what died, to be killed soon."""
        self._timer.cancel()
        dies_at = self._rng.randrange(1, _MOST_COMMITS) if within_commit else None
        self.process = self._begun(dies_at)
        delay_s = _PATIENCE_S if within_commit else self._rng.uniform(0.05, _LATEST_S)
        self._timer = threading.Timer(delay_s, self.process.kill)
        self._timer.start()

    def end(self) -> None:
        """Kills it."""
        self._timer.cancel()
        self.process.kill()
        self.process.join()


def _work(folder: Path, addresses: tuple[str | None, str | None], dies_at: int | None) -> None:
    """Main function of a worker."""
    merge_job.admit = _admit_here  # so that a kill hits all of its work
    commits = 0

    def count(_: Any) -> None:
        nonlocal commits
        commits += 1
        if commits == dies_at:
            os.kill(os.getpid(), signal.SIGKILL)

    event.listen(Engine, "commit", count)
    pause = threading.Event()
    with Centre(folder, *addresses, _SETTINGS) as centre:
        while True:
            try:
                work_off(centre, merge_job.merge_hand_in)
            except EngramError as error:
                print(f"{folder.name}: {error}", file=sys.stderr)
            pause.wait(_PAUSE_S)


def _admit_here(
    manifest: Manifest,
    parts: dict[PartHash, bytes],
    path: Path,
    memory_bytes: int,
    time_s: int,
    begun: merge_job.Checker | None = None,
) -> None:
    """`merge_job.admit` without a process of its own."""
    del memory_bytes, time_s, begun
    merge_job.write_checked(manifest, parts, path)


def kill_workers(
    folder: Path, database: str | None, kills: int, rng: random.Random
) -> Counter[str]:
    """Kills workers so many times; what was counted.

    Raises:
        AssertionError: a hand-in was lost or merged twice, or copies differ.
    """
    objects = folder / "objects"
    objects.mkdir()
    addresses = (database or f"sqlite:///{folder / 'centre.sqlite'}", f"file://{objects}")
    counts = Counter[str]()
    with Centre(folder / "service", *addresses, _SETTINGS) as centre:
        for name in _MAPS:
            centre.add_map(name, "lab", _POLICY)
            centre.keep_copies(name, "lab")
        robots = Robots(centre, folder, rng)
        workers = [Worker(folder / name, addresses, rng) for name in ("first", "second")]
        for worker in workers:
            worker.end()
        for number, worker in enumerate(workers):
            worker.doom(within_commit=bool(number))
        while counts["kills"] < kills:
            for name in _MAPS:
                while len(jobs.pending(centre, HandIn, name)) < _WAITING:
                    robots.hand_in(name)
            wait([worker.process.sentinel for worker in workers])
            for worker in workers:
                if worker.process.exitcode is not None:
                    assert worker.process.exitcode == -signal.SIGKILL, worker.process.exitcode
                    counts["kills"] += 1
                    counts["ahead"] += sum(_is_ahead(centre, worker.folder, one) for one in _MAPS)
                    worker.doom(within_commit=rng.random() < 0.5)
        for worker in workers:
            worker.end()
        for name in _MAPS:
            _check(centre, [worker.folder for worker in workers], name, robots, counts)
    return counts


def _is_ahead(centre: Centre, folder: Path, name: str) -> bool:
    """Whether a worker died between a commit and its publication."""
    path = folder / "maps" / f"{name}.engram"
    return path.exists() and stamp_of(path)[0] > centre.copies.row(name).revision


def _check(
    centre: Centre, folders: list[Path], name: str, robots: Robots, counts: Counter[str]
) -> None:
    manifests = set()
    for folder in folders:
        with Centre(folder, *centre.addresses, _SETTINGS) as worker:
            work_off(worker, merge_job.merge_hand_in)
            worker.copies.renew(name)
    for folder in (*folders, centre.folder):
        with Centre(folder, *centre.addresses, _SETTINGS) as one:
            one.copies.renew(name)
            path = one.map_path(name)
        assert check_file(path).problems == (), path
        manifests.add(split(path).manifest.id)
    assert len(manifests) == 1, f"copies of {name} differ"
    rows = sorted(handins.listed(centre, name), key=lambda row: row.place or 0)
    assert {row.state for row in rows} == {JobState.MERGED}
    merged = [row.revision for row in rows]
    assert len(set(merged)) == len(rows), "hand-ins share a revision"
    alone = centre.folder / f"{name}-alone.engram"
    merge(alone, [robots.copies[row.content_hash] for row in rows], _POLICY.merge)
    with Map.open(alone) as store, centre.reading(name) as copy:
        assert copy.content_hash() == store.content_hash(), f"{name} has another content"
        counts["revisions"] += copy.revision
        counts["drives"] += len(copy.sessions)
    counts["merged"] += len(rows)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    _CONTEXT.set_forkserver_preload(["engram_lab.checks.kill_workers"])
    with tempfile.TemporaryDirectory() as folder:
        database = os.environ.get("ENGRAM_DATABASE")
        counts = kill_workers(Path(folder), database, asked.kills, random.Random(asked.seed))
    if asked.json is not None:
        asked.json.write_text(json.dumps(counts) + "\n", encoding="utf-8")
    print(
        f"{counts['kills']} kills, {counts['ahead']} of them between a commit and its publication: "
        f"{counts['merged']} hand-ins merged once each, {counts['drives']} drives in "
        f"{counts['revisions']} revisions; the copies are equal"
    )


if __name__ == "__main__":
    main()
