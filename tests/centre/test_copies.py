"""Workers that share the database and the objects alone: each keeps a copy of the map."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from engram.errors import InputError
from engram.fleet.centre import dreams, handins, jobs, merge_job, worker
from engram.fleet.centre.objects import BucketObjects, Packs
from engram.fleet.centre.problems import StoreError
from engram.fleet.centre.service import DAY_NS, Centre
from engram.fleet.centre.serving import back_up
from engram.fleet.centre.tables import Dream, HandIn, JobState
from engram.fleet.centre.worker import keep_to_cap, sweep, work_off
from engram.fleet.cli.centre_verbs import open_centre
from engram.fleet.download.updating import update
from engram.fleet.dream import DreamReport
from engram.fleet.forgetting import Retention, forget
from engram.fleet.merge.merging import merge
from engram.fleet.serving import node_bytes
from engram.fleet.transfers import Manifest, split
from engram.maps.exchange import stamp_of
from engram.maps.forgetting import erase_map
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .conftest import NAME, POLICY, Site, drive
from .faults import Killed, dying

pytestmark = pytest.mark.usefixtures("in_process")
TOWN = "town"
GATE = ("v1", "v2", "v3")


def hand_in(site: Site, robot: str, start_ns: int, on: str = NAME) -> HandIn:
    """A complete hand-in of one more drive."""
    agent = site.robot(robot, on=on)
    drive(agent.live, robot, start_ns)
    agent.hand_in()
    agent.step(fetch=False)
    return jobs.pending(site.centre, HandIn, on)[-1]


def work(centre: Centre) -> int:
    return work_off(centre, merge_job.merge_hand_in)


def content(centre: Centre, name: str = NAME) -> Manifest:
    """Every row of a copy, once it is what is published."""
    with centre.lane(name) as is_ours:
        assert is_ours
        return split(centre.map_path(name)).manifest


def check(site: Site, other: Centre, drives: int, name: str = NAME) -> None:
    """Each hand-in is merged once, and both copies are equal to the bit and sound."""
    rows = handins.listed(site.centre, name)
    assert {row.state for row in rows} == {JobState.MERGED}
    assert sorted(row.revision or 0 for row in rows) == list(range(1, drives + 1))
    assert content(site.centre, name) == content(other, name)
    for centre in (site.centre, other):
        assert check_file(centre.map_path(name)).problems == ()
        with centre.reading(name) as store:
            assert len(store.sessions) == store.revision == drives


def test_two_workers_alternate_on_one_map(apart):
    site, other = apart
    for number, centre in enumerate((site.centre, other, other, site.centre)):
        hand_in(site, f"r{number % 2}", 1_000 * (number + 1))
        assert work(centre) == 1
    check(site, other, 4)


def test_two_workers_merge_into_two_maps_at_once(apart, monkeypatch):
    site, other = apart
    site.centre.add_map(TOWN, "tests", POLICY)
    site.centre.keep_copies(TOWN, "tests")
    hand_in(site, "r1", 1_000)
    at_once = []

    def merge_beside(*given, **options):
        monkeypatch.setattr(merge_job, "merge", merge)
        with other.lane(NAME) as is_ours:
            at_once.append(is_ours)
        hand_in(site, "r2", 2_000, on=TOWN)
        at_once.append(work(other))
        return merge(*given, **options)

    monkeypatch.setattr(merge_job, "merge", merge_beside)
    assert work(site.centre) == 1
    assert at_once == [False, 1]
    check(site, other, 1)
    check(site, other, 1, TOWN)


def kill(*_, **__):
    raise Killed


def killed_before_the_commit(monkeypatch) -> None:
    monkeypatch.setattr(merge_job, "merge", kill)


def killed_before_it_is_published(monkeypatch) -> None:
    monkeypatch.setattr(Centre, "prepared", kill)


def killed_after_some_parts(monkeypatch) -> None:
    real = Packs.add

    def add(packs, parts, now_ns, robot=None):
        real(packs, list(parts)[:2], now_ns, robot)
        raise Killed

    monkeypatch.setattr(Packs, "add", add)


def killed_before_the_manifest(monkeypatch) -> None:
    real = BucketObjects.put

    def put(objects, key, body):
        if key.startswith("published/"):
            raise Killed
        real(objects, key, body)

    monkeypatch.setattr(BucketObjects, "put", put)


def killed_before_the_row(monkeypatch) -> None:
    monkeypatch.setattr(jobs, "note", kill)  # within the transaction


def killed_afterwards(monkeypatch) -> None:
    real = jobs.set_state

    def set_state(*given, **options):
        real(*given, **options)
        raise Killed

    monkeypatch.setattr(jobs, "set_state", set_state)


KILLS = (
    killed_before_the_commit,
    killed_before_it_is_published,
    killed_after_some_parts,
    killed_before_the_manifest,
    killed_before_the_row,
    killed_afterwards,
)


@pytest.mark.parametrize("die", KILLS, ids=lambda one: one.__name__)
def test_the_other_goes_on_from_wherever_a_worker_was_killed(apart, monkeypatch, die):
    site, other = apart
    published = int(die is killed_afterwards)
    hand_in(site, "r1", 1_000)
    with monkeypatch.context() as patch:
        die(patch)
        with pytest.raises(Killed):
            work(site.centre)
    committed = stamp_of(site.centre.folder / "maps" / f"{NAME}.engram")[0]
    assert committed == (die is not killed_before_the_commit)
    for centre in (site.centre, other):
        with centre.reading(NAME) as store:
            assert store.revision == published
    hand_in(site, "r2", 2_000)
    assert work(other) == 2 - published
    hand_in(site, "r1", 3_000)
    assert work(site.centre) == 1
    check(site, other, 3)


def kill_at_random(site: Site, other: Centre, kills: int, seed: int) -> None:
    rng = random.Random(seed)
    centres, drives, killed = [site.centre, other], 0, 0
    while killed < kills:
        if not jobs.pending(site.centre, HandIn, NAME):
            drives += 1
            hand_in(site, f"r{rng.randrange(3)}", 1_000 * drives)
        at = rng.randrange(2)
        with dying(rng.randrange(1, 30)) as death:
            try:
                work(centres[at])
            except BaseException:
                if not death.came:
                    raise
        if death.came:
            killed += 1
            old = centres[at]
            old.close()
            centres[at] = Centre(old.folder, *old.addresses, old.settings, site.clock)
            if not at:
                site.centre = centres[at]
                site.restart()
                centres[at] = site.centre
    work(centres[rng.randrange(2)])
    check(site, centres[1], drives)
    centres[1].close()


@pytest.mark.parametrize("seed", range(2))
def test_kills_at_random_steps_lose_nothing_and_merge_nothing_twice(apart, seed):
    kill_at_random(*apart, kills=4, seed=seed)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_many_kills_lose_nothing_and_merge_nothing_twice(apart, seed):
    kill_at_random(*apart, kills=15, seed=100 + seed)


def test_a_worker_that_lost_its_lane_publishes_nothing(apart, monkeypatch):
    site, other = apart
    hand_in(site, "r1", 1_000)
    later = hand_in(site, "r2", 2_000)
    real = Centre.prepared

    def prepared_late(centre, name):
        made = real(centre, name)
        monkeypatch.setattr(Centre, "prepared", real)
        merge_job.merge_hand_in(other, later)  # as if the lane had been free
        return made

    monkeypatch.setattr(Centre, "prepared", prepared_late)
    with pytest.raises(StoreError, match="another worker published meanwhile"):
        work(site.centre)
    assert jobs.get(site.centre, HandIn, later.id).revision == 1
    work(site.centre)
    check(site, other, 2)


def test_a_sweep_keeps_what_is_published_and_a_new_worker_gets_it(apart, tmp_path):
    site, other = apart
    old = site.centre.copies.row(NAME)
    for number in range(3):
        hand_in(site, "r1", 1_000 * (number + 1))
        work(other)
    for _ in range(2):
        site.clock.forward(30 * DAY_NS / 1e9)
        sweep(site.centre, NAME)
    assert list(site.centre.objects.keys(f"published/{NAME}")) == [
        f"published/{NAME}/{site.centre.copies.row(NAME).manifest}"
    ]
    assert site.centre.copies.row(NAME) != old
    with Centre(tmp_path / "third", *other.addresses, clock=site.clock) as third:
        check(site, third, 3)


def test_what_a_cap_forgot_is_published_or_never_was(apart, monkeypatch):
    site, other = apart
    hand_in(site, "r1", 1_000)
    work(site.centre)
    with site.centre.reading(NAME) as store:
        before, size = store.node_count(), int(node_bytes(store.sized().sizes).sum())
    policy = replace(site.centre.policy(NAME), cap_bytes=size // 2)
    site.centre.set_policy(NAME, policy, "tests")
    with monkeypatch.context() as patch:
        killed_before_it_is_published(patch)
        with site.centre.lane(NAME), pytest.raises(Killed):
            keep_to_cap(site.centre, NAME)
    with other.lane(NAME):
        forgot = keep_to_cap(other, NAME)
    assert content(site.centre) == content(other)
    for centre in (site.centre, other):
        with centre.reading(NAME) as store:
            assert (store.revision, store.node_count()) == (2, before - forgot)
            assert 0 < forgot < before


def test_a_sweep_while_a_worker_publishes_is_noticed(apart, monkeypatch):
    site, other = apart
    hand_in(site, "r1", 1_000)
    with monkeypatch.context() as patch:
        patch.setattr(Packs, "add_split", lambda *_: None)  # as if they were all gone again
        with pytest.raises(StoreError, match="a sweep took parts"):
            work(site.centre)
    assert work(site.centre) == 1
    check(site, other, 1)


def test_a_commit_stores_what_it_adds(apart):
    site, _ = apart

    def stored() -> int:
        keys = site.centre.objects.keys(f"packs/{NAME}")
        return sum(map(site.centre.objects.size, keys))

    hand_in(site, "r1", 1_000)
    for number in range(2, 12):
        drive(site.robot("r1").live, "r1", 1_000 * number, nodes=20)
    site.robot("r1").hand_in()
    site.robot("r1").step(fetch=False)
    work(site.centre)
    whole = stored()
    hand_in(site, "r2", 100_000)
    given = stored()
    work(site.centre)
    assert stored() - given < 0.3 * whole


def test_what_an_operator_reverts_is_reverted_in_every_copy(apart):
    site, other = apart
    for number in range(2):
        hand_in(site, f"r{number}", 1_000 * (number + 1))
        work(other)
    person = {**site.token("operator"), "If-Match": '"2"'}
    asked = {"revision": 2, "message": "a wrong robot"}
    where = f"/v1/maps/{NAME}/reverts"
    with other.lane(NAME):
        answer = site.http.post(where, json=asked, headers=person)
        assert (answer.status_code, "a worker merges into" in answer.text) == (409, True)
    tried = site.http.post(where, json={**asked, "dry_run": True}, headers=person)
    assert tried.json()["revision"] is None
    assert site.http.post(where, json=asked, headers=person).json()["revision"] == 3
    assert content(site.centre) == content(other)
    with other.reading(NAME) as store:
        assert (store.revision, len(store.sessions)) == (3, 1)


def test_what_was_forgotten_by_hand_goes_from_every_copy(apart):
    site, other = apart
    for number in range(2):
        hand_in(site, f"r{number}", 1_000 * (number + 1))
    work(site.centre)
    assert content(other).revision == 2
    path = site.centre.map_path(NAME)
    site.centre.close()
    with Map.open(path) as store:
        gone = next(one.id for one in store.sessions.values() if one.robot == "r0")
    forget(path, Retention(sessions=[str(gone)]), author="tests", why="asked to")
    erase_map(path)
    site.restart()
    site.centre.keep_copies(NAME, "tests")
    assert content(other) == content(site.centre)
    for centre in (site.centre, other):
        assert check_file(centre.map_path(NAME)).problems == ()
        with centre.reading(NAME) as store:
            assert [one.robot for one in store.sessions.values()] == ["r1"]
    hand_in(site, "r3", 9_000)
    assert work(other) == 1
    assert content(other) == content(site.centre)


def test_a_file_that_others_left_behind_is_not_published(apart):
    site, other = apart
    hand_in(site, "r1", 1_000)
    work(other)
    row = site.centre.copies.row(NAME)
    site.centre.keep_copies(NAME, "tests")  # behind: it is brought up to date when it is needed
    assert site.centre.copies.row(NAME) == row
    for number in range(2):
        drive(site.centre.folder / "maps" / f"{NAME}.engram", f"by-hand-{number}", 7_000)
    with pytest.raises(InputError, match="does not continue revision 1"):
        site.centre.keep_copies(NAME, "tests")
    assert site.centre.copies.row(NAME) == row
    assert content(site.centre) == content(other)


def test_copies_need_stores_that_all_workers_reach(site):
    if None not in site.centre.addresses:
        pytest.skip("the tables and parts of this site are where all workers reach them")
    with pytest.raises(InputError, match="set ENGRAM_DATABASE and ENGRAM_OBJECTS"):
        site.centre.keep_copies(NAME, "tests")
    assert not site.centre.policy(NAME).copies


def test_a_backup_holds_what_is_published(apart, monkeypatch, tmp_path):
    site, other = apart
    hand_in(site, "r1", 1_000)
    work(other)
    hand_in(site, "r1", 2_000)
    with monkeypatch.context() as patch:
        killed_before_it_is_published(patch)
        with pytest.raises(Killed):
            work(site.centre)
    assert back_up(site.centre, tmp_path / "backup") == {NAME: 1}
    assert site.centre.map_row(NAME).durable_revision == 1


def test_a_worker_begins_in_a_new_folder(apart, tmp_path, monkeypatch):
    site, _ = apart
    database, objects = site.centre.addresses
    monkeypatch.setenv("ENGRAM_DATABASE", database)
    with pytest.raises(InputError, match="there is no centre"):
        open_centre(tmp_path / "new")
    monkeypatch.setenv("ENGRAM_OBJECTS", objects)
    hand_in(site, "r1", 1_000)
    with open_centre(tmp_path / "new") as third:
        assert work(third) == 1
        check(site, third, 1)


def test_a_service_begins_in_a_new_folder(apart, tmp_path):
    site, _ = apart
    hand_in(site, "r1", 1_000)
    work(site.centre)
    with Centre(tmp_path / "new", *site.centre.addresses, clock=site.clock) as third:
        third.add_map(NAME, "tests")
        assert third.map_path(NAME).exists()
        check(site, third, 1)


def test_a_map_that_is_made_later_has_copies_too(apart):
    site, other = apart
    site.centre.add_map(TOWN, "tests", POLICY)
    hand_in(site, "r1", 1_000, on=TOWN)
    assert work(other) == 1
    check(site, other, 1, TOWN)


@pytest.mark.parametrize("is_killed", [False, True])
def test_what_a_dream_adds_is_published(apart, monkeypatch, tmp_path, is_killed):
    site, other = apart
    hand_in(site, "r1", 1_000)
    work(other)
    site.centre.set_policy(NAME, replace(site.centre.policy(NAME), gate=GATE), "tests")
    row = dreams.ask(site.centre, NAME, "tests")

    drive(tmp_path / "better.engram", "r1", 9_000)

    def dreamt(path, *_):
        added = update(tmp_path / "better.engram", path, message="dream: as usual, order 0")
        return DreamReport(str(path), added=added)

    monkeypatch.setattr(worker, "dream", dreamt)
    if is_killed:
        with monkeypatch.context() as patch:
            killed_before_it_is_published(patch)
            with pytest.raises(Killed), site.centre.lane(NAME):
                worker.dream_of(site.centre, row)
    with other.lane(NAME):
        worker.dream_of(other, row)
    assert jobs.get(site.centre, Dream, row.id).revision == 2
    assert content(site.centre) == content(other)
    with site.centre.reading(NAME) as store:
        assert len(store.sessions) == store.revision == 2


def test_downloads_go_by_what_is_published(apart):
    site, other = apart
    hand_in(site, "r1", 1_000)
    work(site.centre)
    robot = site.robot("r2")
    robot.step()
    assert work(other) == 1
    robot.step()
    assert robot.switch()
    with Map.open(robot.live) as store:
        assert len(store.sessions) == 1
