"""What hostile or broken robots send: refused with a reason, and nothing else is touched."""

from __future__ import annotations

import random
import subprocess
import sys

import msgspec
import pytest

from engram.errors import EngramError, MapCorruptError, MapLockedError
from engram.fleet.centre import downloads, handins, jobs
from engram.fleet.centre.merge_job import admit
from engram.fleet.centre.service import CentreSettings
from engram.fleet.transfers import Manifest, bundle, part_hash, split
from engram.maps.map import Map
from engram.maps.map_files import check_file

from .conftest import NAME, Site, drive


@pytest.fixture
def robot(site, in_process):
    """A robot with a map, not handed in yet."""
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000, 2)
    return agent


def send(site, agent, manifest: Manifest, parts: dict[bytes, bytes]):
    """Hands in whatever is given; the last answer."""
    headers = agent.link._headers()
    body = msgspec.to_builtins(manifest.on_wire(None))
    begun = site.http.post(f"/v1/maps/{NAME}/handins", json=body, headers=headers)
    if begun.status_code != 200:
        return begun
    url = f"/v1/handins/{begun.json()['id']}"
    body = b"".join(bundle(parts.values()))
    sent = site.http.post(f"{url}/parts", content=body, headers=headers)
    return site.http.post(f"{url}/complete", headers=headers) if sent.is_success else sent


def taken_apart(agent):
    taken = split(agent.live)
    names = [*taken.pages, *taken.blobs]
    return taken.manifest, dict(zip(names, taken.parts(names), strict=True))


def swapped(manifest: Manifest, parts: dict, old: bytes, new: bytes):
    """The same hand-in with another page in the place of one."""
    name = part_hash(new)
    pages = {
        table: tuple(name if one == old else one for one in some)
        for table, some in manifest.pages.items()
    }
    changed = {one: body for one, body in parts.items() if one != old} | {name: new}
    return Manifest(manifest.content_hash, manifest.revision, pages), changed


def test_mutated_pages_and_blobs_never_reach_the_map(site, robot):
    manifest, parts = taken_apart(robot)
    chance = random.Random(7)
    before = site.content()
    pages = list(dict.fromkeys(manifest.hashes()))
    for _ in range(40):
        old = chance.choice(pages)
        body = bytearray(parts[old])
        for _ in range(chance.randint(1, 3)):
            match chance.randrange(3):
                case 0:
                    body[chance.randrange(len(body))] = chance.randrange(256)
                case 1:
                    del body[chance.randrange(len(body)) :]
                case _:
                    at = chance.randrange(len(body) + 1)
                    body[at:at] = chance.randbytes(chance.randint(1, 9))
            body = body or bytearray(b"\x90")
        if bytes(body) == parts[old]:
            continue
        answer = send(site, robot, *swapped(manifest, parts, old, bytes(body)))
        assert answer.status_code in {200, 409, 422, 429}
        site.work()
        for row in handins.listed(site.centre, NAME, state="open"):
            jobs.cancel(site.centre, row, "tests")
        assert not handins.listed(site.centre, NAME, state="merged"), bytes(body)
    states = {row.state for row in handins.listed(site.centre, NAME)}
    assert states <= {"failed", "cancelled"}
    assert site.content() == before
    assert check_file(site.centre.map_path(NAME)).problems == ()


def test_the_parts_of_another_robot_are_not_taken_by_their_hashes(site, robot):
    robot.hand_in()
    robot.step()
    site.work()
    thief = site.robot("r2")
    manifest, _ = taken_apart(robot)
    answer = send(site, thief, manifest, {})
    assert answer.status_code == 409
    headers = thief.link._headers()
    rows = site.http.get(f"/v1/maps/{NAME}/handins", headers=headers).json()["items"]
    assert [row["robot"] for row in rows] == [thief.state.facts.robot]
    wanted = site.http.get(f"/v1/handins/{rows[0]['id']}", headers=headers).json()["wanted"]
    assert set(wanted) == {one.hex() for one in manifest.hashes()}


def test_a_manifest_of_somebody_else_is_no_base(site, robot):
    robot.hand_in()
    robot.step()
    site.work()
    thief = site.robot("r2")
    manifest, _ = taken_apart(robot)
    body = msgspec.to_builtins(manifest.on_wire(manifest))
    answer = site.http.post(f"/v1/maps/{NAME}/handins", json=body, headers=thief.link._headers())
    assert answer.status_code == 422
    assert "not known here" in answer.json()["detail"]


def test_an_artifact_gives_only_its_own_parts(site, robot):
    robot.hand_in()
    site.settle()
    drive(robot.live, "r1", 9_000, 2)
    robot.hand_in()
    site.settle()
    viewer = site.token("viewer")
    asked = {"ref": "1", "options": {}}
    artifact = site.http.post(f"/v1/maps/{NAME}/downloads", json=asked, headers=viewer).json()
    site.work()
    _, parts = taken_apart(robot)
    url = f"/v1/artifacts/{artifact['id']}/parts"
    body = {"want": [one.hex() for one in parts]}
    answer = site.http.post(url, json=body, headers=viewer).content
    newest = {one: body for one, body in parts.items() if len(body) > 100}
    with Map.open(robot.live, at=1) as store:
        old = {node.id for node in store.load().nodes}
    with Map.open(robot.live) as store:
        new = [node for node in store.load().nodes if node.id not in old]
        secret = [next(iter(store.frames.stored([node]))).landmarks for node in new]
    assert newest
    assert all(one not in answer for one in secret)


@pytest.mark.parametrize(
    "path",
    [
        "..%2f..%2fetc%2fpasswd",
        "fleet%00",
        "../fleet",
        "FLEET",
        "a" * 500,
        "%2e%2e",
        "fleet.engram",
    ],
)
def test_names_of_maps_are_no_paths(site, path):
    answer = site.http.get(f"/v1/maps/{path}", headers=site.token("admin", "*"))
    assert answer.status_code == 404
    assert "application/problem+json" in answer.headers["content-type"]


def test_quotas_hold(tmp_path, in_process):
    limits = CentreSettings(bytes_a_day=30_000, open_handins=2)
    site = Site(tmp_path, settings=limits)
    agent = site.robot("r1")
    drive(agent.live, "r1", 1_000, 30)
    agent.hand_in()
    agent.step()
    assert "429" in agent.status()["trouble"]
    headers = agent.link._headers()
    for number in range(3):
        manifest = Manifest("00" * 16, number, {"nodes": (part_hash(b"x"),)})
        body = msgspec.to_builtins(manifest.on_wire(None))
        last = site.http.post(f"/v1/maps/{NAME}/handins", json=body, headers=headers)
    assert last.status_code == 429
    site.close()


def test_admission_ends_at_its_limits(tmp_path, robot):
    manifest, parts = taken_apart(robot)
    admit(manifest, parts, tmp_path / "a.engram", 2**32, 60)
    assert check_file(tmp_path / "a.engram", thin=True).problems == ()
    with pytest.raises(EngramError):  # out of memory: where depends on the machine
        admit(manifest, parts, tmp_path / "b.engram", 2**20, 60)
    wrong = Manifest("00" * 16, manifest.revision, manifest.pages)
    with pytest.raises(MapCorruptError, match="not '0000"):
        admit(wrong, parts, tmp_path / "c.engram", 2**32, 60)


def test_admission_runs_under_a_lower_limit_of_the_system():
    """With ``ulimit -f`` below its own it failed every hand-in, in words of time and memory."""
    code = (
        "import resource as r; from engram.fleet.centre.merge_job import confine; "
        "r.setrlimit(r.RLIMIT_FSIZE, (2**20, 2**20)); confine(2**33, 60, 2**26); "
        "print(r.getrlimit(r.RLIMIT_FSIZE), r.getrlimit(r.RLIMIT_CPU))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.stdout == "(1048576, 1048576) (60, 65)\n", ran.stderr


def test_what_the_gate_refuses_stays_and_a_person_may_merge_it(site, robot, monkeypatch):
    from engram.errors import RefusedError
    from engram.fleet.centre import merge_job

    real = merge_job.merge

    def refusing(*arguments, require_better=(), **options):
        if require_better:
            raise RefusedError("held-out localises worse")
        return real(*arguments, **options)

    monkeypatch.setattr(merge_job, "merge", refusing)
    policy = site.centre.policy(NAME)
    site.centre.set_policy(NAME, type(policy)(policy.merge, ("held-out.framelog",), "stable"), "t")
    robot.hand_in()
    site.settle()
    (row,) = handins.listed(site.centre, NAME)
    assert (row.state, row.error) == ("refused", "held-out localises worse")
    operator = site.token("operator")
    answer = site.http.post(f"/v1/handins/{row.id}/merge", headers=operator)
    assert answer.json()["state"] == "complete"
    site.settle()
    (row,) = handins.listed(site.centre, NAME)
    assert (row.state, row.revision) == ("merged", 1)
    refs = site.http.get(f"/v1/maps/{NAME}/refs", headers=operator).json()
    assert [one["name"] for one in refs] == ["head"]  # what a person forced moves no ref


def test_an_error_names_no_place_on_the_centres_machine(site, robot, monkeypatch):
    robot.hand_in()
    site.settle()

    def locked(*_, **__):
        raise MapLockedError(f"{site.centre.map_path(NAME)} is locked")

    monkeypatch.setattr(downloads, "download", locked)
    asked = {"options": {"thumbnails": False}}
    row = robot.link.ask("POST", f"/v1/maps/{NAME}/downloads", asked)
    site.work()
    row = robot.link.ask("GET", f"/v1/artifacts/{row['id']}")
    assert (row["state"], row["error"]) == ("failed", f"maps/{NAME}.engram is locked")
    monkeypatch.setattr(Map, "writing", locked)
    answer = site.http.post(
        f"/v1/maps/{NAME}/reverts", json={"revision": 1, "dry_run": True},
        headers=site.token("operator"),
    )  # fmt: skip
    assert answer.json()["detail"] == f"maps/{NAME}.engram is locked"


def test_what_stays_incomplete_or_unused_goes(site, robot):
    manifest, _ = taken_apart(robot)
    assert send(site, robot, manifest, {}).status_code == 409
    viewer = site.token("viewer")
    robot.hand_in()
    site.settle()
    asked = {"ref": "1", "options": {}}
    url = f"/v1/maps/{NAME}/downloads"
    key = site.http.post(url, json=asked, headers=viewer).json()["id"]
    site.work()
    site.clock.forward(31 * 86_400)
    site.work()
    assert not handins.listed(site.centre, NAME, state="open")
    assert site.http.get(f"/v1/artifacts/{key}", headers=viewer).status_code == 404
    assert list(site.centre.objects.keys("artifacts")) == []
    assert site.http.post(url, json=asked, headers=viewer).json()["state"] == "asked"


def test_a_job_can_be_cancelled_before_and_within(site, robot):
    robot.hand_in()
    robot.step()
    (row,) = handins.listed(site.centre, NAME)
    jobs.cancel(site.centre, row, "tests")
    site.work()
    (row,) = handins.listed(site.centre, NAME)
    assert (row.state, row.revision) == ("cancelled", None)
    with Map.open(site.centre.map_path(NAME)) as store:
        assert store.revision == 0
