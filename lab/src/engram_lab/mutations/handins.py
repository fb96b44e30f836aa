"""Changes of what a robot hands in: pages, blobs and the manifest that names them."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import msgspec

from engram.maps.rows import checksum
from engram.transfers import Manifest, PartHash, part_hash
from engram.transfers.manifest import encode_manifest
from engram_lab.mutations import values
from engram_lab.mutations.case import Case, Subject
from engram_lab.mutations.rowwise import changed_value
from engram_lab.mutations.samples import Samples


def pages(samples: Samples, folder: Path, chance: random.Random) -> Case:
    """Bytes of a page or blob, under its new name."""
    del folder
    old = chance.choice(list(samples.parts))
    new = values.blob(samples.parts[old], chance)
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
        wild = chance.choice([values.bent_json, values.text])(body, chance)
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
