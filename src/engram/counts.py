"""Counts in words: "1 node", "2 nodes"."""

from __future__ import annotations


def counted(number: int, thing: str) -> str:
    """A number of things, in the plural unless it is one.

    Args:
        thing: one of them, a word or several whose last one has a regular plural.
    """
    if number == 1:
        return f"1 {thing}"
    if thing.endswith("y"):
        return f"{number} {thing[:-1]}ies"
    return f"{number} {thing}{'es' if thing.endswith(('ch', 'x', 's')) else 's'}"
