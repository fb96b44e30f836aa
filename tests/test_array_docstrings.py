"""Every public array says its shape, what its numbers are, and points say their frame."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "src/engram"
# Annotations of arrays, and the names that modules give to some of them.
_ARRAY = re.compile(r"\b(NDArray|Array|Indices)\b")
_FLOATS = re.compile(r"float|\bArray\b|Any|generic")
# (N,), (N, 3), (h, w) and the like.
_SHAPE = re.compile(r"\([\w+*×-]+,[\w+*×, -]*\)")
# Units, and the words of numbers without one.
_UNIT = re.compile(
    r"\b(m|m²|metres?|px|pixels?|rad|radians|degrees|s|ns|seconds|nats|hours?|days?|min|minutes|"
    r"bits?|bytes|counts?|shares?|probabilit\w+|log|logs|log-\w+|scores?|weights?|success rates?|"
    r"ratios?|cosines?|similarit\w+|units?|numbers|grey|deviations|quaternions?|rotations?|"
    r"transforms?|identity|information|covariances?|homogeneous)\b|°|σ|0…1|\[0, 1\]"
)
_UNIT_IN_NAME = re.compile(r"_(m|m2|px|rad|deg|s|ns|h|sigmas|m_s|rad_s)\b")
_SECTION = re.compile(r"^(Args|Attributes|Returns|Yields):$")
_ENTRY = re.compile(r"^ {4}(\*{0,2}\w[\w, *]*): ?(.*)$")


@dataclass(frozen=True)
class Documented:
    """One array of the public interface, and what its docstring says of it."""

    where: str
    name: str
    annotation: str
    text: str

    def __str__(self) -> str:
        return f"{self.where} {self.name}: {self.text[:70]!r}"


def entries(docstring: str) -> dict[str, str]:
    """Name → text of Args and Attributes; "return" → text of Returns."""
    found: dict[str, str] = {}
    section, names = "", [""]
    for line in docstring.splitlines():
        if heading := _SECTION.match(line):
            section, names = heading[1], ["return"]
        elif line and not line.startswith(" "):
            section = ""
        elif section in {"Returns", "Yields"}:
            found["return"] = f"{found.get('return', '')} {line.strip()}"
        elif section and (entry := _ENTRY.match(line)):
            names = [name.strip(" *") for name in entry[1].split(",")]
            found.update(dict.fromkeys(names, entry[2]))
        elif section:
            found.update({name: f"{found.get(name, '')} {line.strip()}" for name in names})
    return found


def is_array(annotation: ast.expr | None) -> bool:
    return annotation is not None and _ARRAY.search(ast.unparse(annotation)) is not None


def of_function(function: ast.FunctionDef, owner: ast.ClassDef | None) -> Iterator[tuple[str, ...]]:
    """Name, annotation and text of each array that a function takes or returns."""
    docstring = ast.get_docstring(function) or ""
    said = entries(docstring)
    if function.name == "__init__" and owner is not None:
        said = {**entries(ast.get_docstring(owner) or ""), **said}
    taken = function.args
    for one in (*taken.posonlyargs, *taken.args, *taken.kwonlyargs):
        if is_array(one.annotation):
            text = said.get(one.arg) or docstring
            yield f"{function.name}({one.arg})", ast.unparse(one.annotation), text
    if is_array(function.returns):
        text = said.get("return") or docstring
        yield f"{function.name} →", ast.unparse(function.returns), text


def of_class(owner: ast.ClassDef) -> Iterator[tuple[str, ...]]:
    """The same of each field of a class."""
    said = entries(ast.get_docstring(owner) or "")
    for one in owner.body:
        if isinstance(one, ast.AnnAssign) and is_array(one.annotation):
            name = ast.unparse(one.target)
            if not name.startswith("_"):
                yield f"{owner.name}.{name}", ast.unparse(one.annotation), said.get(name, "")


def public_arrays(
    node: ast.Module | ast.ClassDef, owner: ast.ClassDef | None = None
) -> Iterator[tuple[str, ...]]:
    """All arrays of the public names of a module."""
    for one in node.body:
        if isinstance(one, ast.ClassDef) and not one.name.startswith("_"):
            yield from of_class(one)
            yield from public_arrays(one, one)
        elif isinstance(one, ast.FunctionDef) and (
            not one.name.startswith("_") or one.name == "__init__"
        ):
            yield from of_function(one, owner)


@pytest.fixture(scope="module")
def arrays() -> list[Documented]:
    return [
        Documented(str(path.relative_to(PACKAGE)), name, annotation, text)
        for path in sorted(PACKAGE.rglob("*.py"))
        for name, annotation, text in public_arrays(ast.parse(path.read_text()))
        if not re.search(r"\b[Ss]ee `", text)  # said once, where the protocol is
    ]


def test_the_arrays_of_the_public_interface_are_met(arrays: list[Documented]) -> None:
    assert len(arrays) > 350


def test_every_public_array_says_its_shape(arrays: list[Documented]) -> None:
    assert [str(one) for one in arrays if not _SHAPE.search(one.text)] == []


def test_every_public_array_of_floats_says_its_unit_or_what_it_counts(
    arrays: list[Documented],
) -> None:
    floats = [one for one in arrays if _FLOATS.search(one.annotation)]
    assert len(floats) > 100
    without = [one for one in floats if not _UNIT.search(one.text)]
    assert [str(one) for one in without if not _UNIT_IN_NAME.search(one.name)] == []


def test_every_public_array_says_its_type(arrays: list[Documented]) -> None:
    typed = re.compile(r"u?int(8|16|32|64|p)?\b|float(32|64)|bool|indices|bits|numbers|rows")
    without = [one for one in arrays if not typed.search(f"{one.annotation} {one.text}")]
    assert [str(one) for one in without if not re.search(r"\bArray\b", one.annotation)] == []


def test_public_points_say_their_frame(arrays: list[Documented]) -> None:
    points = [one for one in arrays if re.search(r"[.(]\w*(points|positions)", one.name)]
    assert points
    framed = re.compile(
        r"_in_|\bin (the|a|its|each|that|world)\b|frame|pixel|px|image|row|index|indices"
    )
    assert [str(one) for one in points if not framed.search(one.name + one.text)] == []
