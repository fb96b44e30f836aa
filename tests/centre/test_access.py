"""Every route, asked by everybody: what a role may not do is refused, whatever the map."""

from __future__ import annotations

import queue
import socket
import threading
import tracemalloc
from dataclasses import replace

import httpx
import pytest
import uvicorn
from sqlalchemy import delete, func, insert, select

from engram.errors import ConfigError, InputError
from engram.fleet.agent.centre_link import CentreRefusedError, enrol
from engram.fleet.centre import dreams, serving
from engram.fleet.centre.access import Role, add_person, disable, new_code, revoke_access
from engram.fleet.centre.database import AuditCheck, _hash
from engram.fleet.centre.fleet import robots_of
from engram.fleet.centre.problems import UnknownError
from engram.fleet.centre.serving import Listening, serve
from engram.fleet.centre.tables import Event, audit, values_of

from .conftest import NAME, POLICY, drive

ANYBODY = frozenset({None, "viewer", "robot", "operator", "admin"})
KNOWN = ANYBODY - {None}
PEOPLE = frozenset({"viewer", "operator", "admin"})
OPERATORS = frozenset({"operator", "admin"})
# Who may ask; `own` is the robot that handed in or asked for the thing.
ROUTES = {
    "get /v1/health": ANYBODY,
    "get /v1/metrics": ANYBODY,
    "post /v1/robots/enrol": ANYBODY,
    "post /v1/token/nonce": ANYBODY,
    "post /v1/token": ANYBODY,
    "get /v1/me": KNOWN,
    "get /v1/maps": KNOWN,
    "get /v1/maps/{name}": KNOWN,
    "get /v1/maps/{name}/revisions": KNOWN,
    "get /v1/maps/{name}/refs": KNOWN,
    "get /v1/maps/{name}/refs/{ref}": KNOWN,
    "put /v1/maps/{name}/refs/{ref}": OPERATORS,
    "delete /v1/maps/{name}/refs/{ref}": OPERATORS,
    "get /v1/maps/{name}/diff": PEOPLE,
    "get /v1/maps/{name}/weak-spots": PEOPLE,
    "get /v1/maps/{name}/blame/{node}": PEOPLE,
    "get /v1/maps/{name}/events": PEOPLE,
    "get /v1/maps/{name}/audit": frozenset({"admin"}),
    "post /v1/maps/{name}/reverts": OPERATORS,
    "get /v1/maps/{name}/robots": PEOPLE,
    "get /v1/maps/{name}/robots/me": frozenset({"robot"}),
    "put /v1/maps/{name}/robots/me/report": frozenset({"robot"}),
    "put /v1/maps/{name}/robots/{robot}/follows": OPERATORS,
    "delete /v1/maps/{name}/robots/{robot}": frozenset({"admin"}),
    "post /v1/maps/{name}/codes": frozenset({"admin"}),
    "get /v1/maps/{name}/jobs": PEOPLE,
    "get /v1/maps/{name}/handins": KNOWN,
    "post /v1/maps/{name}/handins": frozenset({"robot"}),
    "get /v1/handins/{handin}": PEOPLE | {"own"},
    "put /v1/handins/{handin}/parts/{part}": frozenset({"own"}),
    "post /v1/handins/{handin}/parts": frozenset({"own"}),
    "post /v1/handins/{handin}/complete": frozenset({"own"}),
    "post /v1/handins/{handin}/cancel": OPERATORS | {"own"},
    "post /v1/handins/{handin}/merge": OPERATORS,
    "get /v1/jobs/{job}": PEOPLE | {"own"},
    "post /v1/maps/{name}/dreams": OPERATORS,
    "get /v1/maps/{name}/dreams": PEOPLE,
    "post /v1/dreams/{dream}/cancel": OPERATORS,
    "post /v1/maps/{name}/downloads": KNOWN,
    "get /v1/artifacts/{artifact}": frozenset({"own"}),
    "get /v1/artifacts/{artifact}/manifest": frozenset({"own"}),
    "post /v1/artifacts/{artifact}/parts": frozenset({"own"}),
    "get /v1/artifacts/{artifact}/file": frozenset({"own"}),
}
# These look at codes and signatures instead of tokens.
SIGNED = {"post /v1/robots/enrol", "post /v1/token"}
BODIES = {
    "post /v1/robots/enrol": {
        "code": "x", "name": "x", "public_key": "00" * 32, "signature": "00" * 64,
    },
    "post /v1/token/nonce": {"robot": "x"},
    "post /v1/token": {"robot": "x", "nonce": "x", "signature": "00" * 64},
    "put /v1/maps/{name}/refs/{ref}": {"revision": 1},
    "post /v1/maps/{name}/reverts": {"revision": 1, "dry_run": True},
    "put /v1/maps/{name}/robots/me/report": {},
    "put /v1/maps/{name}/robots/{robot}/follows": {"follows": "head"},
    "post /v1/maps/{name}/codes": {},
    "post /v1/maps/{name}/handins": {
        "format": "engram-parts-1", "content_hash": "00" * 16, "revision": 0, "tables": {},
    },
    "post /v1/maps/{name}/downloads": {"options": {}},
    "post /v1/artifacts/{artifact}/parts": {"want": []},
}  # fmt: skip


@pytest.fixture(scope="module")
def used(tmp_path_factory):
    """A centre with a map that was handed in and asked for, and everybody's tokens."""
    from engram.fleet.centre import merge_job

    from .conftest import Site, admit_here

    patch = pytest.MonkeyPatch()
    patch.setattr(merge_job, "admit", admit_here)
    site = Site(tmp_path_factory.mktemp("used"))
    site.centre.add_map("other", "tests", POLICY)
    own, robot, foreign = site.robot("r1"), site.robot("r2"), site.robot("r3")
    drive(own.live, "r1", 1_000)
    own.hand_in()
    site.settle()
    with site.centre.database.writing() as connection:
        from sqlalchemy import update

        from engram.fleet.centre.tables import grants

        connection.execute(
            update(grants).where(grants.c.subject == foreign.state.facts.robot).values(map="other")
        )
    tokens = {str(role): site.token(role) for role in Role if role is not Role.ROBOT}
    tokens |= {f"{role} elsewhere": site.token(role, "other") for role in Role if role != "robot"}
    tokens |= {None: {}, "own": own.link._headers(), "robot": robot.link._headers()}
    tokens["robot elsewhere"] = foreign.link._headers()
    handin = own.state.facts.handin
    revision = site.centre.map_path(NAME)
    assert revision.exists()
    artifact = site.http.post(
        f"/v1/maps/{NAME}/downloads",
        json={"ref": "1", "options": {"thumbnails": False}},
        headers=tokens["own"],
    ).json()["id"]
    site.work()
    site.centre.set_policy(NAME, replace(POLICY, gate=("a", "b", "c")), "tests")
    places = {
        "name": NAME,
        "dream": dreams.ask(site.centre, NAME, "tests").id,
        "handin": next(iter(handin.values())),
        "job": next(iter(handin.values())),
        "artifact": artifact,
        "ref": "head",
        "robot": own.state.facts.robot,
        "node": "0",
        "part": "00" * 32,
    }
    yield site, tokens, places
    site.close()
    patch.undo()


def ask(used, route: str, who: str | None):
    site, tokens, places = used
    method, path = route.split(" ")
    url = path.format(**places) + ("?follow=false" if path.endswith("events") else "")
    if "diff" in path:
        url += "?before=0&after=1"
    return site.http.request(method, url, headers=tokens[who], json=BODIES.get(route))


def test_the_table_names_every_route(used):
    paths = used[0].http.get("/openapi.json").json()["paths"]
    assert {f"{method} {path}" for path, methods in paths.items() for method in methods} == set(
        ROUTES
    )


@pytest.mark.parametrize("route", ROUTES)
def test_who_may_not_is_refused_and_who_may_is_not(used, route):
    if route.startswith("delete /v1/maps/{name}/robots"):
        pytest.skip("it would take the robot that the others ask as; tested below")
    for who in ("viewer", "robot", "operator", "admin", None, "own"):
        allowed = who in ROUTES[route] or (who == "own" and "robot" in ROUTES[route])
        status = ask(used, route, who).status_code
        if allowed:
            assert status not in {403, 500} or route in SIGNED, (route, who)
            assert (status == 401) is False, (route, who)
        else:
            assert status in {401, 403, 404}, (route, who, status)


@pytest.mark.parametrize("route", [one for one in ROUTES if "{" in one])
def test_who_has_another_map_learns_nothing_of_this_one(used, route):
    for who in ("viewer", "operator", "admin", "robot"):
        answer = ask(used, route, f"{who} elsewhere")
        assert answer.status_code in {403, 404}, (route, who)
        assert NAME not in answer.text.replace(f"'{NAME}'", "") or "no map" in answer.text


def test_a_robot_that_is_taken_away_has_no_token_and_gets_none(site):
    agent = site.robot("r1")
    agent.step()
    key = agent.state.facts.robot
    answer = site.http.delete(f"/v1/maps/{NAME}/robots/{key}", headers=site.token("admin"))
    assert answer.status_code == 204
    assert agent.step() > 0
    assert "refuses (403)" in agent.status()["trouble"]


def test_a_code_enrols_one_robot_once_and_expires(site):
    agent = site.robot("r1")
    code = new_code(site.centre, NAME, "head", "tests")
    signature = agent.link._signer.sign(b"engram enrol " + code.encode()).hex()
    body = {"code": code, "name": "r1", "public_key": agent.link._signer.public_key.hex()}
    first = site.http.post("/v1/robots/enrol", json={**body, "signature": signature})
    again = site.http.post("/v1/robots/enrol", json={**body, "signature": signature})
    assert first.json() == again.json()
    forged = site.http.post("/v1/robots/enrol", json={**body, "signature": "00" * 64})
    assert forged.status_code == 422
    late = new_code(site.centre, NAME, "head", "tests")
    site.clock.forward(8 * 86_400)
    signature = agent.link._signer.sign(b"engram enrol " + late.encode()).hex()
    expired = site.http.post(
        "/v1/robots/enrol", json={**body, "code": late, "signature": signature}
    )
    assert expired.status_code == 403


def test_a_token_ends_and_a_robot_whose_clock_is_wrong_gets_another(site):
    agent = site.robot("r1")
    agent.step()
    site.clock.forward(3_600)
    assert agent.step() == agent.settings.idle_s
    assert agent.status()["trouble"] == ""


def test_a_cookie_alone_changes_nothing(site):
    token = site.token("admin")["Authorization"].removeprefix("Bearer ")
    url = f"/v1/maps/{NAME}/codes"
    cookies = {"Cookie": f"engram_token={token}"}
    assert site.http.post(url, json={}, headers=cookies).status_code == 401
    page = {**cookies, "X-Engram": "page"}
    assert site.http.post(url, json={}, headers=page).status_code == 200


def test_the_audit_log_shows_what_was_changed_in_it(site):
    site.robot("r1")
    disable(site.centre, "nobody", "tests")
    with site.centre.database.writing() as connection:
        assert AuditCheck().first_broken(connection, 0) is None
        connection.execute(audit.update().where(audit.c.number == 2).values(subject="me"))
        assert AuditCheck().first_broken(connection, 0) == 2


def test_a_service_reads_the_audit_log_once_and_all_of_it_once_an_hour(site):
    site.robot("r1")
    check, hour_ns = AuditCheck(), 3_600_000_000_000
    now_ns = 10 * hour_ns
    change = audit.update().values(subject="me")
    with site.centre.database.writing() as connection:
        assert check.first_broken(connection, now_ns) is None
        connection.execute(change.where(audit.c.number == 1))
        assert check.first_broken(connection, now_ns + hour_ns) is None
        assert check.whole_ns == now_ns
        assert check.first_broken(connection, now_ns + hour_ns + 1) == 1
        assert check.first_broken(connection, now_ns + hour_ns + 1) == 1


def test_what_follows_a_changed_row_is_noticed_at_once(site):
    site.robot("r1")
    check = AuditCheck()
    with site.centre.database.writing() as connection:
        assert check.first_broken(connection, 1) is None
        last = audit.c.number == select(func.max(audit.c.number)).scalar_subquery()
        connection.execute(audit.update().where(last).values(hash="another"))
        assert check.first_broken(connection, 2) is not None


def test_a_long_audit_log_is_checked_in_little_memory(site):
    with site.centre.database.writing() as connection:
        connection.execute(delete(audit))
        rows, before = [], ""
        for number in range(1, 5_001):
            row = Event(number, 1, subject="s", action="a", map="", detail="{}", hash="")
            before = _hash(before, row)
            rows.append(values_of(replace(row, hash=before)))
        connection.execute(insert(audit), rows)
        del rows
        tracemalloc.start()
        assert AuditCheck().first_broken(connection, 0) is None
        assert tracemalloc.get_traced_memory()[1] < 2_000_000  # all rows at once are 2.8
        tracemalloc.stop()


def test_an_address_that_is_taken_and_a_certificate_that_is_gone_are_named(site, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(
            InputError, match=rf"listen at 127\.0\.0\.1:{port}: Address already in use"
        ):
            serve(site.centre, Listening("127.0.0.1", port), worker=False)
    gone = tmp_path / "gone.pem"
    with pytest.raises(InputError, match=r"TLS cannot be had with .*gone\.pem"):
        serve(site.centre, Listening("127.0.0.1", 0, gone, gone), worker=False)


def test_it_listens_elsewhere_only_with_tls_or_on_demand(tmp_path):
    with pytest.raises(ConfigError, match="unencrypted"):
        Listening("0.0.0.0", 1)
    Listening("127.0.0.1", 1)
    Listening("::1", 1)
    Listening("0.0.0.0", 1, insecure=True)
    Listening("0.0.0.0", 1, tmp_path / "a", tmp_path / "b")


def test_a_robot_hands_in_what_makes_the_version_that_it_follows(site):
    agent = site.robot("r1", follows="stable")
    drive(agent.live, "r1", 0)
    agent.hand_in()
    agent.step()
    assert agent.trouble is None
    assert agent.status()["wanted"] == "0"
    assert [one["state"] for one in agent.status()["outbox"]] == ["sent"]


def test_codes_and_tokens_are_made_for_what_can_be(site):
    with pytest.raises(InputError, match="is not a version to follow"):
        new_code(site.centre, NAME, "Stable version", "tests")
    with pytest.raises(UnknownError, match="there is no map"):
        add_person(site.centre, "alice", "twon", Role.VIEWER)
    with pytest.raises(InputError, match="the name of a person"):
        add_person(site.centre, " ", NAME, Role.VIEWER)


def test_a_robot_that_enrols_again_has_its_new_name_and_one_taken_away_is_told(site):
    agent = site.robot("r1")

    def again() -> None:
        code = new_code(site.centre, NAME, "head", "tests")
        assert code.isalnum()  # on a command line - would begin an option
        enrol(agent.folder, "http://centre/", code, "renamed", site.http)

    again()
    assert [row.name for row in robots_of(site.centre, NAME)] == ["renamed"]
    disable(site.centre, agent.state.facts.robot, "tests")
    with pytest.raises(CentreRefusedError, match=r"\(403\): this robot was removed"):
        again()


def test_a_person_or_robot_is_taken_away_by_name(site):
    token = {"Authorization": f"Bearer {add_person(site.centre, 'Åsa', NAME, Role.ADMIN)}"}
    assert site.http.get("/v1/me", headers=token).status_code == 200
    revoke_access(site.centre, "Åsa", "tests")
    assert site.http.get("/v1/me", headers=token).status_code == 401
    with pytest.raises(UnknownError, match="'Åsa' has no token"):
        revoke_access(site.centre, "Åsa", "tests")
    first, second = site.robot("r1"), site.robot("r2")
    code = new_code(site.centre, NAME, "head", "tests")
    enrol(second.folder, "http://centre", code, "r1", site.http)
    with pytest.raises(InputError, match="2 robots are called 'r1'"):
        revoke_access(site.centre, "r1", "tests")
    revoke_access(site.centre, first.state.facts.robot, "tests")
    first.step()
    second.step()
    assert "was removed" in str(first.trouble)
    assert second.trouble is None


def test_a_service_ends_although_somebody_follows_its_events(site, monkeypatch):
    started: queue.Queue = queue.Queue()

    class Told(uvicorn.Server):
        async def startup(self, sockets=None) -> None:
            await super().startup(sockets=sockets)
            started.put((self, sockets[0].getsockname()[1]))

    monkeypatch.setattr(serving, "_announcing", lambda _: Told)
    monkeypatch.setattr(serving, "_GRACE_S", 0)
    given = (site.centre, Listening("127.0.0.1", 0))
    service = threading.Thread(target=serve, args=given, kwargs={"worker": False}, daemon=True)
    service.start()
    server, port = started.get(timeout=30)
    url = f"http://127.0.0.1:{port}/v1/maps/{NAME}/events"
    with httpx.stream("GET", url, headers=site.token("viewer")) as answer:
        assert next(answer.iter_lines()) == ": events"
        server.should_exit = True
        service.join(30)
        assert not service.is_alive()
