"""Changes of what a robot hands in, and hostile uploads to a centre."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from fastapi.testclient import TestClient

from engram.fleet.agent.agent import Agent
from engram.fleet.agent.centre_link import enrol
from engram.fleet.centre import handins, jobs
from engram.fleet.centre.access import new_code
from engram.fleet.centre.application import create_app
from engram.fleet.centre.merge_job import merge_hand_in
from engram.fleet.centre.service import Centre, CentreSettings, MapPolicy
from engram.fleet.centre.worker import work_off
from engram.fleet.merge.merge_settings import MergeOptions
from engram.fleet.transfers import (
    MAX_PART_BYTES,
    Manifest,
    PartHash,
    bundle,
    encode_manifest,
    part_hash,
)
from engram.maps.map import Map
from engram.maps.map_files import check_file
from engram.maps.rows import checksum
from engram_lab.mutations import case
from engram_lab.mutations.case import Case, Samples, Subject
from engram_lab.mutations.files import changed_value


def pages(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Bytes of a page or blob, under its new name."""
    del folder
    old = chance.choice(list(samples.parts))
    new = case.blob(samples.parts[old], chance)
    manifest, parts = _swapped(samples, old, new)
    return Case(Subject.HANDIN, "bytes of a part", True, None, manifest, parts)


def rows(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Values of a row of a page, under a right checksum."""
    del folder
    table = chance.choice(list(samples.manifest.pages))
    old: PartHash = chance.choice(samples.manifest.pages[table])
    content: list[list[Any]] = msgspec.msgpack.decode(samples.parts[old])
    row = chance.choice(content)
    at = chance.randrange(len(row) - 1)
    row[at] = changed_value(row[at], chance)
    row[-1] = checksum(row[:-1])
    if chance.random() < 0.2:
        content += content[: chance.choice([1, 50])]
    manifest, parts = _swapped(samples, old, msgspec.msgpack.encode(content))
    what = f"{table} {row[at]!r:.60}"
    return Case(Subject.HANDIN, what, True, None, manifest, parts)


def manifests(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """The manifest: its JSON, its pages' order and number."""
    del folder
    kept = samples.manifest
    if chance.random() < 0.5:
        body = encode_manifest(kept).decode()
        wild = chance.choice([case.bent_json, case.text])(body, chance)
        raw = wild.encode(errors="replace")
        return Case(Subject.HANDIN, f"manifest {wild!r:.60}", True, None, raw, samples.parts)
    listed = {name: list(some) for name, some in kept.pages.items()}
    table = chance.choice(list(listed))
    match chance.randrange(4):
        case 0:
            listed[table] = listed[table] * chance.choice([2, 10_000])
        case 1:
            chance.shuffle(listed[table])
            listed[table] = listed[table][: chance.randrange(len(listed[table]) + 1)]
        case 2:
            other = chance.choice(list(listed))
            listed[table], listed[other] = listed[other], listed[table]
        case _:
            del listed[table]
    pages_ = {name: tuple(some) for name, some in listed.items()}
    manifest = Manifest(kept.content_hash, kept.revision, pages_)
    return Case(Subject.HANDIN, f"pages of {table}", True, None, manifest, samples.parts)


def _swapped(samples: Samples, old: PartHash, new: bytes) -> tuple[Manifest, dict[PartHash, bytes]]:
    """The hand-in with another part in the place of one; a blob is also renamed in its rows."""
    name, kept = part_hash(new), samples.manifest
    parts = {one: body for one, body in samples.parts.items() if one != old} | {name: new}
    renamed = {old: name}
    if not any(old in some for some in kept.pages.values()):
        for page in kept.hashes():
            if parts[page].find(old) >= 0:
                body = parts.pop(page).replace(old, name)
                renamed[page] = part_hash(body)
                parts[renamed[page]] = body
    listed = {
        table: tuple(renamed.get(one, one) for one in some) for table, some in kept.pages.items()
    }
    return Manifest(kept.content_hash, kept.revision, listed), parts


_MAP = "fleet"
_JSON = {"Content-Type": "application/json"}
_TRICKS = ("..%2f..%2fetc%2fpasswd", "..", "fleet%00", "%2e%2e", "a" * 3_000, "~", "fleet.engram")


class Site:
    """A centre, a robot that handed in, and one that is hostile."""

    def __init__(self, folder: Path, samples: Samples) -> None:
        limits = CentreSettings(token_s=86_400, admission_bytes=2**30, admission_s=30)
        self.centre = Centre(folder / "centre", settings=limits)
        self.centre.add_map(_MAP, "lab", MapPolicy(merge=MergeOptions(relocaliser="none")))
        self.http = TestClient(create_app(self.centre), raise_server_exceptions=False)
        self.answers: Counter[int] = Counter()
        self._samples = samples
        self._victim, self._thief = (self._robot(folder / name) for name in ("r1", "r2"))
        headers = self._victim.link._headers()  # as its own client sends them
        self._begun(samples.manifest, headers)

    def upload(self, chance: random.Random) -> None:
        """One upload of any kind."""
        kinds: tuple[Callable[[random.Random], None], ...] = (
            self._changed,
            self._changed,
            self._wrong_hash,
            self._stolen,
            self._path,
            self._bomb,
        )
        chance.choice(kinds)(chance)
        work_off(self.centre, merge_hand_in)
        for row in handins.listed(self.centre, _MAP, state="open"):
            if row.robot == self._thief.state.facts.robot:
                jobs.cancel(self.centre, row, "lab")

    def states(self) -> Counter[str]:
        """Results of the hand-ins."""
        rows = handins.listed(self.centre, _MAP)
        return Counter(row.state for row in rows)

    def faults(self) -> list[str]:
        """What is wrong with the map, or was left behind."""
        found = [str(one) for one in check_file(self.centre.map_path(_MAP)).problems]
        with Map.open(self.centre.map_path(_MAP)) as store:
            store.content_hash()
        return found + [one.name for one in (self.centre.folder / "work").iterdir()]

    def _robot(self, folder: Path) -> Agent:
        code = new_code(self.centre, _MAP, "head", "lab")
        enrol(folder, "http://centre", code, folder.name, self.http)
        return Agent(folder, client=self.http)

    def _ask(self, method: str, url: str, **given: Any) -> Any:
        headers = {**self._thief.link._headers(), **given.pop("headers", {})}
        answer = self.http.request(method, url, headers=headers, **given)
        self.answers[answer.status_code] += 1
        return answer

    def _begun(self, manifest: Manifest | bytes, headers: dict[str, str] | None = None) -> str:
        """The hand-in of a manifest; "" if it is refused."""
        body = manifest if isinstance(manifest, bytes) else encode_manifest(manifest)
        given = {**_JSON, **(headers or {})}
        answer = self._ask("POST", f"/v1/maps/{_MAP}/handins", content=body, headers=given)
        return answer.json()["id"] if answer.status_code == 200 else ""

    def _handed_in(self, manifest: Manifest | bytes, parts: dict[PartHash, bytes]) -> None:
        key = self._begun(manifest)
        if key:
            body = b"".join(bundle(parts.values()))
            self._ask("POST", f"/v1/handins/{key}/parts", content=body)
            self._ask("POST", f"/v1/handins/{key}/complete")

    def _changed(self, chance: random.Random) -> None:
        kind = chance.choice([pages, rows, rows, manifests])
        case = kind(self._samples, Path(), chance)
        assert case.manifest is not None
        assert case.parts is not None
        self._handed_in(case.manifest, case.parts)

    def _wrong_hash(self, chance: random.Random) -> None:
        key = self._begun(self._samples.manifest)
        name = chance.choice(list(self._samples.parts)).hex()
        self._ask("PUT", f"/v1/handins/{key}/parts/{name}", content=chance.randbytes(100))
        body = bytearray(b"".join(bundle(self._samples.parts.values())))
        body[chance.randrange(len(body))] ^= 1
        self._ask("POST", f"/v1/handins/{key}/parts", content=bytes(body))

    def _stolen(self, chance: random.Random) -> None:
        """Parts that only their hashes name."""
        key = self._begun(self._samples.manifest)
        mine = {} if chance.random() < 0.5 else {part_hash(b"x"): b"x"}
        self._ask("POST", f"/v1/handins/{key}/parts", content=b"".join(bundle(mine.values())))
        self._ask("POST", f"/v1/handins/{key}/complete")
        its = self._victim.state.facts.robot
        self._ask("GET", f"/v1/maps/{_MAP}/robots/{its}")

    def _path(self, chance: random.Random) -> None:
        trick = chance.choice(_TRICKS)
        for url in (
            f"/v1/maps/{trick}/handins",
            f"/v1/handins/{trick}/parts",
            f"/v1/handins/{trick}/complete",
            f"/v1/artifacts/{trick}/parts",
        ):
            self._ask("POST", url, json={"want": []})
        self._ask("PUT", f"/v1/handins/{trick}/parts/{trick}", content=b"x")
        self._ask("GET", f"/static/{trick}")

    def _bomb(self, chance: random.Random) -> None:
        match chance.randrange(5):
            case 0:
                self._begun(b'{"tables":' * 100_000)
            case 1:
                tables = {f"t{at}": {"kept": 0, "pages": []} for at in range(20_000)}
                self._begun(msgspec.json.encode({"format": "engram-parts-1", "tables": tables}))
            case 2:
                page = next(self._samples.manifest.hashes())
                many = Manifest("00" * 16, 1, {"nodes": (page,) * 200_000})
                self._begun(many)
            case 3:
                key = self._begun(self._samples.manifest)
                url = f"/v1/handins/{key}/parts/{'00' * 32}"
                self._ask("PUT", url, content=bytes(MAX_PART_BYTES + 1))
            case _:
                key = self._begun(self._samples.manifest)
                promise = (2**40).to_bytes(8, "big") + chance.randbytes(64)
                self._ask("POST", f"/v1/handins/{key}/parts", content=promise * 100)
