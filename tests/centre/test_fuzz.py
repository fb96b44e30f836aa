"""Every operation of the API, with whatever its description allows and much that it does not."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from engram.fleet.centre import dreams
from engram.fleet.centre.access import Role
from engram.fleet.centre.application import create_app
from engram.maps.map import Map

from .conftest import NAME, POLICY, Site, admit_here, drive

schemathesis = pytest.importorskip("schemathesis")
pytestmark = pytest.mark.skipif(
    "ENGRAM_TEST_POSTGRES" not in os.environ, reason="minutes; make test-services runs it"
)
ROLES = ("admin", "own")
EXAMPLES = 20
TAKES_THE_ROBOT = "DELETE /v1/maps/{name}/robots/{robot}"  # that the others ask as


@pytest.fixture(scope="module")
def used(tmp_path_factory):
    """A centre with a robot, a hand-in, a download and a dream; what places in paths can name."""
    from engram.fleet.centre import merge_job

    patch = pytest.MonkeyPatch()
    patch.setattr(merge_job, "admit", admit_here)
    site = Site(tmp_path_factory.mktemp("fuzzed"))
    own = site.robot("r1")
    drive(own.live, "r1", 1_000)
    own.hand_in()
    site.settle()
    tokens = {"admin": site.token(Role.ADMIN, "*"), "own": own.link._headers()}
    asked = site.http.post(f"/v1/maps/{NAME}/downloads", json={}, headers=tokens["own"]).json()
    site.work()
    site.centre.set_policy(NAME, replace(POLICY, gate=("a", "b", "c")), "tests")
    with Map.open(own.live) as store:
        node = str(store.graph.nodes[0].id)
    handin = next(iter(own.state.facts.handin.values()))
    yield (
        site,
        tokens,
        {
            "name": NAME,
            "handin": handin,
            "job": handin,
            "dream": dreams.ask(site.centre, NAME, "tests").id,
            "artifact": asked["id"],
            "ref": "head",
            "robot": own.state.facts.robot,
            "node": node,
            "part": "00" * 32,
        },
    )
    site.close()
    patch.undo()


@schemathesis.serializer("application/vnd.engram.bundle")
def bundled(_, value):
    """Bodies that are no JSON are sent as they are drawn."""
    return value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")


def operations():
    described = create_app(None).openapi()
    schema = schemathesis.openapi.from_dict(described)
    return [one.ok() for one in schema.get_all_operations()]


def request(site, case, tokens):
    """Sends a case; the client is httpx, the case speaks requests."""
    asked = case.as_transport_kwargs(base_url="http://centre")
    headers = {**asked["headers"], **tokens}
    headers = {
        name: value.encode("latin-1", "replace") if isinstance(value, str) else value
        for name, value in headers.items()
    }
    body = {"json": asked["json"]} if "json" in asked else {}
    data = asked.get("data")
    if data is not None:
        body = {
            "content": data if isinstance(data, bytes) else str(data).encode("utf-8", "replace")
        }
    return site.http.request(
        asked["method"], asked["url"], headers=headers, params=asked.get("params"), **body
    )


@pytest.mark.parametrize("operation", operations(), ids=lambda one: one.label)
def test_no_request_makes_the_centre_fail(used, operation):
    site, tokens, places = used
    statuses = set()
    modes = [operation.as_strategy(generation_mode=mode) for mode in schemathesis.GenerationMode]

    @given(case=st.one_of(modes))
    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        derandomize=True,
        database=None,
        phases=(Phase.generate,),
        suppress_health_check=list(HealthCheck),
    )
    def ask(case):
        if operation.path.endswith("/events"):
            case.query = {**(case.query or {}), "follow": "false"}
        as_made = dict(case.path_parameters or {})
        for who in ROLES:
            for given_places in (as_made, {name: places[name] for name in as_made}):
                case.path_parameters = given_places
                if operation.label == TAKES_THE_ROBOT and given_places is not as_made:
                    continue
                answer = request(site, case, tokens[who])
                statuses.add(answer.status_code)
                assert answer.status_code < 500, (who, answer.status_code, answer.text[:500])
                if answer.status_code >= 400:
                    assert "problem+json" in answer.headers["content-type"], answer.text[:200]

    ask()
    if operation.method.upper() == "GET":
        assert 200 in statuses  # it came past who may ask, and what there is
