"""The centre says where the next drives of a fleet will hardly be localised."""

from __future__ import annotations

import json

from engram.maps.map import Map
from engram.weak_spots import find_weak_spots

from .conftest import NAME, drive


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
