"""The description of the API: every body has a schema, with an example of every field."""

from __future__ import annotations

import pytest

from engram.fleet.centre.application import create_app

DESCRIBED = create_app(None).openapi()
OPERATIONS = [
    (f"{method} {path}", operation)
    for path, methods in DESCRIBED["paths"].items()
    for method, operation in methods.items()
]
# Bytes, not JSON of a schema: manifests, bundles, files, events, metrics.
BYTES = ("/manifest", "/file", "/events", "/metrics", "post /v1/artifacts/{artifact}/parts")


def resolved(schema: dict) -> dict:
    """A schema, by its name where it has one, or that of the items of a list."""
    if "$ref" in schema:
        return DESCRIBED["components"]["schemas"][schema["$ref"].rsplit("/", 1)[1]]
    return resolved(schema["items"]) if schema.get("type") == "array" else schema


@pytest.mark.parametrize(("name", "operation"), OPERATIONS, ids=[one for one, _ in OPERATIONS])
def test_an_operation_says_what_it_takes_and_gives(name, operation):
    assert operation["description"]
    problem = operation["responses"]["4XX"]["content"]["application/problem+json"]["schema"]
    assert problem["properties"]["detail"]["examples"]
    if "204" in operation["responses"] or name.endswith(BYTES):
        return
    bodies = [operation["responses"]["200"]["content"]["application/json"]["schema"]]
    asked = operation.get("requestBody", {}).get("content", {}).get("application/json")
    bodies += [] if asked is None else [asked["schema"]]
    for body in map(resolved, bodies):
        assert body["description"]
        assert any("examples" in one for one in body["properties"].values()), body["title"]
