"""The centre says where the next drives of a fleet will hardly be localised."""

from __future__ import annotations

import json

from engram.maps.map import Map
from engram.viewing.weakness import advice_text, spot_rows, verdict
from engram.weak_spots import find_weak_spots

from .conftest import NAME, drive

DAY_NS = 86_400 * 10**9


def test_the_weak_spots_of_the_fleet_map_are_those_of_the_verb(site) -> None:
    drive(site.centre.map_path(NAME), "r1", 1_700_000_000 * 10**9, nodes=12)
    found = site.http.get(f"/v1/maps/{NAME}/weak-spots", headers=site.token("viewer"))
    assert found.status_code == 200
    with Map.open(site.centre.map_path(NAME)) as store:
        known = find_weak_spots(store).to_dict()
    assert found.json() == json.loads(json.dumps(known))
    assert found.json()["advice"]["mends"] > 0


def test_a_map_without_drives_has_none(site) -> None:
    found = site.http.get(f"/v1/maps/{NAME}/weak-spots", headers=site.token("viewer")).json()
    assert (found["spots"], found["advice"], found["drives"]) == ([], None, 0)


def shown(site, at: int | None = None) -> dict:
    """What the page Map gets of them."""
    url = f"/maps/{NAME}/weak-spots" + ("" if at is None else f"?at={at}")
    assert site.http.get(url).status_code == 401
    found = site.http.get(url, headers=site.token("viewer"))
    assert found.status_code == 200
    return found.json()


def test_the_page_shows_them_in_the_words_of_the_report_at_nodes_of_its_map(site) -> None:
    drive(site.centre.map_path(NAME), "r1", 1_700_000_000 * 10**9, nodes=12)
    found = shown(site)
    with Map.open(site.centre.map_path(NAME)) as store:
        known = find_weak_spots(store)
        rows, advice = spot_rows(known, store), advice_text(known.advice, store)
    assert found["verdict"] == verdict(known)
    assert found["advice"]["text"] == advice
    assert [one["why"] for one in found["spots"]] == [row[-1] for row in rows]
    assert found["more"] == 0
    nodes = site.http.get(f"/maps/{NAME}/nodes", headers=site.token("viewer")).json()
    assert len(found["colours"]["of"]) == len(nodes["node"]) == 12
    first = nodes["node"][found["spots"][0]["nodes"][0]]
    assert first == str(known.spots[0].node)


def test_an_older_revision_shows_its_own(site) -> None:
    path = site.centre.map_path(NAME)
    for day in range(2):
        drive(path, "r1", 1_700_000_000 * 10**9 + day * DAY_NS, nodes=12)
    assert (shown(site)["revision"], shown(site, at=1)["revision"]) == (2, 1)
    with Map.open(path, at=1) as store:
        assert shown(site, at=1)["verdict"] == verdict(find_weak_spots(store))
    assert shown(site, at=0)["verdict"] == "no weak spot is known: the map has no drive"


def test_they_are_found_once_for_all_who_ask(site, monkeypatch) -> None:
    drive(site.centre.map_path(NAME), "r1", 1_700_000_000 * 10**9, nodes=12)
    asked = []

    def counting(store: Map):
        asked.append(store.revision)
        return find_weak_spots(store)

    monkeypatch.setattr("engram.fleet.centre.pages.positions.find_weak_spots", counting)
    for _ in range(3):
        shown(site)
    assert asked == [1]
