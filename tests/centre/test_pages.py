"""Pages: who may see them, and that what robots say is text."""

from __future__ import annotations

import re

import pytest

from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre import merge_job
from engram.fleet.centre.access import Role, add_person, new_code

from .conftest import KINDS, NAME, admit_here, drive, opened_site

PAGES = ["map", "history", "fleet", "queue", "health"]


@pytest.fixture(scope="module", params=KINDS)
def visited(request, tmp_path_factory):
    """A centre that a robot with an evil name has visited; made once: no test takes it away."""
    with (
        pytest.MonkeyPatch.context() as patch,
        opened_site(request, tmp_path_factory.mktemp("pages")) as site,
    ):
        patch.setattr(merge_job, "admit", admit_here)
        evil = site.robot("<script>x</script>")
        drive(evil.live, "<img src=x>", 1_000)
        evil.hand_in()
        site.settle()
        yield site


def cookie(site, role="viewer"):
    token = site.token(role)["Authorization"].removeprefix("Bearer ")
    return {"Cookie": f"engram_token={token}"}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_needs_a_token_and_takes_names_as_text(visited, page):
    url = f"/maps/{NAME}/{page}"
    assert visited.http.get(url).status_code == 401
    login = visited.http.get(url, headers={"Accept": "text/html,*/*"}, follow_redirects=False)
    assert (login.status_code, login.headers["location"]) == (303, "/")
    answer = visited.http.get(url, headers=cookie(visited))
    assert answer.status_code == 200
    assert "<script>x" not in answer.text
    assert "<img src=x>" not in answer.text
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert re.findall(r'(?:src|href)="(?!/|#)', answer.text) == []


def test_the_map_page_gets_every_node_with_its_revision(visited):
    found = visited.http.get(f"/maps/{NAME}/nodes", headers=cookie(visited)).json()
    assert len(found["nodes"]) == 3
    assert {node[4] for node in found["nodes"]} == {1}
    empty = visited.http.get(f"/maps/{NAME}/nodes?at=0", headers=cookie(visited)).json()
    assert empty["nodes"] == []
    node = found["nodes"][0][0]
    picture = visited.http.get(f"/maps/{NAME}/nodes/{node}/picture", headers=cookie(visited))
    assert picture.content[:2] == b"\xff\xd8"
    assert visited.http.get(f"/maps/{NAME}/nodes/{node}/picture").status_code == 401


def test_a_map_that_nobody_handed_in_to_says_so(site):
    page = site.http.get(f"/maps/{NAME}/history", headers=cookie(site)).text
    assert "1970" not in page
    assert "no robot has handed in" in page


def test_logging_in_sets_a_cookie_that_only_the_server_reads(visited):
    token = visited.token("viewer")["Authorization"].removeprefix("Bearer ")
    answer = visited.http.post("/login", data={"token": token}, follow_redirects=False)
    assert answer.status_code == 303
    said = answer.headers["set-cookie"].lower()
    assert "httponly" in said
    assert "samesite=strict" in said
    assert visited.http.post("/login", data={"token": "x"}).status_code == 401


@pytest.mark.parametrize(("page", "offer"), [("history", "Revert…"), ("fleet", "data-follows")])
def test_what_a_viewer_may_not_do_is_not_offered(visited, page, offer):
    url = f"/maps/{NAME}/{page}"
    assert offer not in visited.http.get(url, headers=cookie(visited)).text
    assert offer in visited.http.get(url, headers=cookie(visited, "operator")).text


def test_health_shows_the_newest_change_first(visited):
    page = visited.http.get(f"/maps/{NAME}/health", headers=cookie(visited)).text
    numbers = [int(one) for one in re.findall(r"<tr><td>(\d+)</td>", page)]
    assert len(numbers) > 5
    assert numbers == sorted(numbers, reverse=True)
    assert "changed at row" not in page


def test_pages_name_people_and_tell_robots_of_one_name_apart(visited):
    token = add_person(visited.centre, "Åsa", NAME, Role.OPERATOR)
    who = {"Authorization": f"Bearer {token}"}
    visited.http.put(f"/v1/maps/{NAME}/refs/stable", json={"revision": 1}, headers=who)
    code = new_code(visited.centre, NAME, "head", "tests")
    enrol(visited.folder / "twin", "http://centre", code, "<script>x</script>", visited.http)
    for page in ("history", "health"):
        assert "<td>Åsa</td>" in visited.http.get(f"/maps/{NAME}/{page}", headers=who).text
    fleet = visited.http.get(f"/maps/{NAME}/fleet", headers=who).text
    assert len(set(re.findall(r"<small>(\w{8})</small>", fleet))) == 2


def test_a_download_that_cannot_be_made_is_on_the_page_health_with_its_reason(visited):
    who = cookie(visited)
    headers = {**who, "X-Engram": "page"}
    asked = {"ref": "head", "options": {"select": "budget", "budget_bytes": 1}}
    visited.http.post(f"/v1/maps/{NAME}/downloads", json=asked, headers=headers)
    visited.work()
    assert (
        "not one node fits into 1 bytes"
        in visited.http.get(f"/maps/{NAME}/health", headers=who).text
    )
