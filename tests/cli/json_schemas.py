"""The schemas of `--json`, as strict as the tests want them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator
from referencing import Registry, Resource

SCHEMAS = Path(__file__).parents[2] / "docs" / "schemas"
SHARED = "shared.json"


def named(words: Iterable[str]) -> str:
    """The file of a verb: drive-info.json."""
    return f"{'-'.join(words)}.json"


def closed(schema: Any) -> Any:
    """The same, but keys that it does not name are refused, so that a test meets new ones."""
    if isinstance(schema, list):
        return [closed(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    found = {key: closed(value) for key, value in schema.items()}
    if isinstance(schema.get("properties"), dict) and "type" in schema:
        found.setdefault("additionalProperties", False)
    return found


@cache
def _registry() -> Registry[Any]:
    return Registry().with_resources(
        (path.name, Resource.from_contents(closed(json.loads(path.read_text()))))
        for path in SCHEMAS.glob("*.json")
    )


@cache
def _validator(reference: str) -> Draft202012Validator:
    return Draft202012Validator({"$ref": reference}, registry=_registry())


def problems(reference: str, output: Any) -> list[str]:
    """Where an output breaks a schema, named by its file, or by a place in it."""
    return [
        f"{reference}: {one.json_path}: {one.message:.200}"
        for one in _validator(reference).iter_errors(output)
    ]


def problems_of_line(line: Sequence[str], printed: str) -> list[str]:
    """The same of what a command line printed: its result, an error, or what was done before it.

    Verbs of other packages, and words that are no verb, have no schema.
    """
    name = next((one for one in _names(line) if (SCHEMAS / one).exists()), None)
    output = json.loads(printed)
    # A hand-in has a text or null of this name.
    if not isinstance(output, dict) or not isinstance(output.get("error"), dict):
        return problems(name, output) if name else []
    done = {key: value for key, value in output.items() if key != "error"}
    found = problems(f"{SHARED}#/$defs/error", output["error"])
    return found + (problems(name, done) if name and done else [])


def _names(line: Sequence[str]) -> Iterator[str]:
    """The files that a schema of a command line may have: two words, then one."""
    yield from (named(line[:count]) for count in (2, 1))
