"""Packs that nothing needs go; what is needed stays, whatever happens meanwhile."""

from __future__ import annotations

import pytest

from engram.fleet.centre.objects import Packs
from engram.fleet.centre.service import DAY_NS
from engram.fleet.centre.worker import sweep
from engram.fleet.transfers import part_hash

from .conftest import NAME, drive


def packs_of(site) -> list[str]:
    return list(site.centre.objects.keys(f"packs/{NAME}"))


def hand_in(site, name: str, start_ns: int) -> None:
    agent = site.robot(name)
    drive(agent.live, name, start_ns)
    agent.hand_in()
    agent.step(fetch=False)
    site.work()


@pytest.fixture
def old(site, in_process):
    """Two hand-ins of one robot, long ago: the second continues the first."""
    for start_ns in (1_000, 2_000_000):
        hand_in(site, "r1", start_ns)
    site.clock.forward(30 * DAY_NS / 1e9)
    return site


def test_what_the_next_hand_in_continues_stays_and_the_rest_goes(old):
    before = packs_of(old)
    size = sum(map(old.centre.objects.size, before))
    gone = sweep(old.centre, NAME)
    assert gone > 0
    assert set(packs_of(old)) > set(before)  # what readers and backups hold stays for a while
    old.clock.forward(2 * DAY_NS / 1e9)
    sweep(old.centre, NAME)
    assert sum(map(old.centre.objects.size, packs_of(old))) == size - gone
    hand_in(old, "r1", 4_000_000)
    assert old.robot("r1").trouble is None
    with old.centre.reading(NAME) as store:
        assert len(store.sessions) == 3
    assert sweep(old.centre, NAME) == 0


def test_nothing_goes_soon(site, in_process):
    hand_in(site, "r1", 1_000)
    assert sweep(site.centre, NAME) == 0


def test_a_download_keeps_its_parts_until_it_expires(old):
    agent = old.robot("r2")
    old.settle()
    assert agent.switch()
    sweep(old.centre, NAME)
    key = old.robot("r3").link.ask("POST", f"/v1/maps/{NAME}/downloads", {"ref": "head"})["id"]
    answer = agent.link.ask("GET", f"/v1/artifacts/{key}")
    assert answer["state"] == "ready"
    old.settle()
    assert old.robot("r3").switch()


def test_what_was_swept_between_looking_and_noting_is_stored_again(old, monkeypatch):
    store: Packs = old.centre.packs(NAME)
    body = b"a part that nothing needs"
    store.add([body], old.centre.now_ns() - 20 * DAY_NS)
    put = type(old.centre.objects).put

    def put_late(objects, key, content):
        put(objects, key, content)
        monkeypatch.setattr(type(old.centre.objects), "put", put)
        assert sweep(old.centre, NAME) >= len(body)

    monkeypatch.setattr(type(old.centre.objects), "put", put_late)
    store.add([body, b"a new part"], old.centre.now_ns())
    some = [body, b"a new part"]
    assert [one for _, one in store.read(map(part_hash, some))] == some


def test_a_pack_that_a_killed_service_left_goes(old):
    left = [f"packs/{NAME}/{old.centre.now_ns() - 20 * DAY_NS:016x}-0a", f"packs/{NAME}/0b"]
    fresh = f"packs/{NAME}/{old.centre.now_ns():016x}-0c"
    for key in (*left, fresh):
        old.centre.objects.put(key, b"x")
    sweep(old.centre, NAME)
    assert fresh in packs_of(old)
    assert not set(left) & set(packs_of(old))
