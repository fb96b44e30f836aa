"""What keeps the code readable: short functions, few parameters, no idea in two classes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import engram

_MOST_LINES, _MOST_PARAMETERS = 60, 8

# What is longer today. Entries go, none comes.
_LONG = {
    "cli/drive.py": {"live"},
    "cli/drives.py": {"localise"},
    "fleet/cli/verbs.py": {"build", "download", "merge"},
}
_MANY_PARAMETERS = {
    "fleet/merge/merging.py": {"merge"},
    "maps/map.py": {"robot"},
    "testing/contracts.py": {"make_context"},
}


@dataclass
class Class:
    """A class of the package, as far as its source tells.

    Attributes:
        bases: names of its bases.
        methods: public methods and properties that it defines itself.
        holds: names of the types that its fields, or the arguments of its `__init__`, have.
    """

    file: str
    bases: list[str]
    methods: set[str]
    holds: set[str] = field(default_factory=set)


@cache
def _files() -> dict[str, ast.Module]:
    root = Path(engram.__file__).parent
    return {
        str(path.relative_to(root)): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(root.rglob("*.py"))
    }


def _functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for file, tree in _files().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield file, node


def _lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    first = function.body[0]
    has_docstring = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    docstring = (first.end_lineno or 0) - first.lineno + 1 if has_docstring else 0
    return (function.end_lineno or 0) - function.lineno + 1 - docstring


def _arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.arg]:
    """The parameters of a function, without `self`."""
    one = function.args
    plain = [*one.posonlyargs, *one.args, *one.kwonlyargs]
    starred = [arg for arg in (one.vararg, one.kwarg) if arg is not None]
    return [arg for arg in (*plain, *starred) if arg.arg not in ("self", "cls")]


def _names(node: ast.AST | None) -> set[str]:
    """The names in an annotation or a base."""
    if node is None:
        return set()
    return {one.id for one in ast.walk(node) if isinstance(one, ast.Name)} | {
        one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute)
    }


def _name(base: ast.expr) -> str:
    plain = base.value if isinstance(base, ast.Subscript) else base
    return plain.attr if isinstance(plain, ast.Attribute) else getattr(plain, "id", "")


def _class(file: str, node: ast.ClassDef) -> Class:
    found = Class(file, [_name(base) for base in node.bases], set())
    for one in node.body:
        if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef):
            if not one.name.startswith("_"):
                found.methods.add(one.name)
            if one.name == "__init__":
                for arg in _arguments(one):
                    found.holds |= _names(arg.annotation)
        elif isinstance(one, ast.AnnAssign):
            found.holds |= _names(one.annotation)
    return found


@cache
def _classes() -> dict[str, Class]:
    return {
        node.name: _class(file, node)
        for file, tree in _files().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }


def _ancestors(name: str) -> Iterator[str]:
    for base in _classes()[name].bases if name in _classes() else ():
        yield base
        yield from _ancestors(base)


def _values() -> set[str]:
    """Names of classes that are used otherwise than as a type or as a base."""
    used = set()
    for tree in _files().values():
        types: set[int] = set()
        for node in ast.walk(tree):
            for part in (
                *(node.bases if isinstance(node, ast.ClassDef) else ()),
                getattr(node, "annotation", None),
                getattr(node, "returns", None),
            ):
                if part is not None:
                    types |= {id(one) for one in ast.walk(part)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Name) and id(node) not in types:
                used.add(node.id)
    return used


def test_functions_stay_short() -> None:
    long: dict[str, set[str]] = {}
    for file, function in _functions():
        if _lines(function) > _MOST_LINES:
            long.setdefault(file, set()).add(function.name)
    assert long == _LONG


def test_functions_take_few_parameters() -> None:
    many: dict[str, set[str]] = {}
    for file, function in _functions():
        if len(_arguments(function)) > _MOST_PARAMETERS and "cli" not in Path(file).parts:
            many.setdefault(file, set()).add(function.name)
    assert many == _MANY_PARAMETERS


def test_no_class_is_there_only_to_be_the_base_of_one_other() -> None:
    children: dict[str, int] = {}
    for one in _classes().values():
        for base in one.bases:
            children[base] = children.get(base, 0) + 1
    used = _values()
    only = {
        name
        for name in _classes()
        if children.get(name) == 1
        and name not in used
        and name not in engram.__all__
        and "Body" not in _ancestors(name)  # bodies of requests are made by FastAPI
    }
    assert only == set()


def test_what_wraps_another_of_its_kind_passes_on_every_method() -> None:
    # A method that a wrapper forgets is the base's own: it does nothing, without a word.
    forgotten = {}
    for name, one in _classes().items():
        for base in set(_ancestors(name)) & one.holds & _classes().keys():
            missing = _classes()[base].methods - one.methods
            if missing:
                forgotten[name, base] = missing
    assert forgotten == {}
