"""Pages: who may see them, and that what robots say is text."""

from __future__ import annotations

import re
from collections import Counter
from html.parser import HTMLParser
from itertools import pairwise

import pytest

from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre import merge_job
from engram.fleet.centre.access import Role, add_person, new_code
from engram.fleet.centre.fleet import note_report
from engram.viewing.drawings import COLOURS

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
    assert len(found["node"]) == len(set(found["node"])) == 3
    assert found["added"] == [1, 1, 1]
    assert found["parts"] == [3]
    assert {len(found[column]) for column in ("x", "y", "part", "chain")} == {3}
    assert all(len(found["by"][by]["of"]) == 3 for by in COLOURS)
    empty = visited.http.get(f"/maps/{NAME}/nodes?at=0", headers=cookie(visited)).json()
    assert empty["node"] == empty["parts"] == []
    node = found["node"][0]
    picture = visited.http.get(f"/maps/{NAME}/nodes/{node}/picture", headers=cookie(visited))
    assert picture.content[:2] == b"\xff\xd8"
    assert visited.http.get(f"/maps/{NAME}/nodes/{node}/picture").status_code == 401


def test_a_revision_tells_what_it_changed_by_drives_and_pictures(visited):
    url = f"/maps/{NAME}/revisions/1/changes"
    found = visited.http.get(url, headers=cookie(visited)).json()
    assert found["lines"][0] == "3 nodes added: 3 in the map"
    assert found["lines"][1].startswith("3 nodes added between 0 and 50 m into the drive of ")
    shown = visited.http.get(f"/maps/{NAME}/nodes", headers=cookie(visited)).json()["node"]
    assert set(found["nodes"]) == set(shown)
    assert visited.http.get(url).status_code == 401


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


def test_logging_out_forgets_the_cookie_of_this_site_only(visited):
    left = visited.http.post("/logout", headers=cookie(visited), follow_redirects=False)
    assert left.status_code == 303
    assert left.headers["set-cookie"].startswith('engram_token=""')
    assert "set-cookie" not in visited.http.post("/logout", follow_redirects=False).headers


OFFERS = [
    ("history", "Revert…", "viewer", "operator"),
    ("fleet", "data-follows", "viewer", "operator"),
    ("fleet", "data-delete", "operator", "admin"),
    ("fleet", "data-code", "operator", "admin"),
]


@pytest.mark.parametrize(("page", "offer", "without", "role"), OFFERS)
def test_what_a_role_may_not_do_is_not_offered(visited, page, offer, without, role):
    url = f"/maps/{NAME}/{page}"
    assert offer not in visited.http.get(url, headers=cookie(visited, without)).text
    assert offer in visited.http.get(url, headers=cookie(visited, role)).text


def test_robots_shows_an_outbox_that_is_settled_and_what_ran_before(visited):
    page = visited.http.get(f"/maps/{NAME}/fleet", headers=cookie(visited)).text
    assert "all handed in" in page
    assert "1 kept until a backup" in page
    assert "no drive reported" in page
    assert "before:" not in page
    agent = next(iter(visited.agents.values()))
    for runs in ("7-a", "8-b"):
        note_report(visited.centre, NAME, agent.status()["robot"], {"runs": runs})
    page = visited.http.get(f"/maps/{NAME}/fleet", headers=cookie(visited)).text
    assert "revision 8" in page
    assert "before: revision 7" in page


class Structure(HTMLParser):
    """What a reader by ear needs of a page: its language, headings, labels and names."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.headings: list[int] = []
        self.unnamed: list[str] = []
        self.lang = ""
        self._in_label = False
        self._labelled = set(re.findall(r'<label for="(\w+)"', page))
        self._ids = re.findall(r' id="([^"]+)"', page)
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self._in_label |= tag == "label"
        if tag == "html":
            self.lang = given.get("lang") or ""
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        named = given.get("aria-label") or given.get("aria-labelledby") in self._ids
        if tag in {"input", "select"} and not self._in_label:
            named = named or given.get("id") in self._labelled
        elif tag not in {"canvas", "table", "nav"}:
            return
        if not named:
            self.unnamed.append(self.get_starttag_text() or tag)

    def handle_endtag(self, tag: str) -> None:
        self._in_label &= tag != "label"

    def repeated(self) -> list[str]:
        return [one for one, count in Counter(self._ids).items() if count > 1]


@pytest.mark.parametrize("page", ["login", *PAGES])
def test_pages_have_a_language_one_heading_in_order_and_names(visited, page):
    url = "/" if page == "login" else f"/maps/{NAME}/{page}"
    headers = {} if page == "login" else cookie(visited, "admin")
    found = Structure(visited.http.get(url, headers=headers).text)
    assert found.lang == "en"
    assert found.headings.count(1) == 1
    assert found.headings[0] == 1
    assert all(below <= above + 1 for above, below in pairwise(found.headings))
    assert found.unnamed == []
    assert found.repeated() == []


def test_health_shows_the_newest_change_first(visited):
    page = visited.http.get(f"/maps/{NAME}/health", headers=cookie(visited)).text
    numbers = [int(one) for one in re.findall(r'<tr><td data-is="number">(\d+)</td>', page)]
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
        assert ">Åsa</td>" in visited.http.get(f"/maps/{NAME}/{page}", headers=who).text
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
