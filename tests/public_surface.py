"""What Engram promises to keep, one line each; `public_surface.txt` is the committed listing.

    python -m tests.public_surface    # writes the listing of the code as it is

Lines that go or change break somebody's program: deprecate first (CONTRIBUTING, "Compatibility").
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import typer

from engram.cli.app import GROUPS, NESTED, app
from engram.cli.options import ExitStatus
from engram.cli.settings import AllSettings, every_setting
from engram.frontend.features import FEATURES
from engram.places.recognisers import RECOGNISERS
from engram.ranking.policies import POLICIES
from engram.sequences.opening import SEQUENCES

LISTING = Path(__file__).with_suffix(".txt")
# Modules and the names in them; None: those of `__all__`. docs/python.md names the same modules.
MODULES: dict[str, tuple[str, ...] | None] = {
    "engram": None,
    "engram.calibration": None,
    "engram.cli.options": ("At", "DrivePath", "Json", "MapPath"),
    "engram.errors": None,
    "engram.fleet.build": None,
    "engram.fleet.download": None,
    "engram.fleet.merge": None,
    "engram.frontend": None,
    "engram.geometry": None,
    "engram.monitor": ("Monitor",),
    "engram.ranking": None,
    "engram.sequences": None,
    "engram.testing": None,
}
# Of these classes only some members are promised; the others serve Engram itself, as do their
# constructors: robots are made by `Map.robot`, maps by `open_map`.
MEMBERS = {
    "engram.Map": {
        "check", "close", "content_hash", "diff", "frame", "goals", "graph", "info", "log",
        "node_count", "revert", "revision", "robot", "sessions", "tag", "tags", "untag",
    },
    "engram.Robot": {
        "close", "diagnosis", "drive", "lose", "place_at", "pose_at", "record", "saving", "step",
    },
}  # fmt: skip
ENTRY_POINTS = ("features", "policies", "readers", "recognisers", "verbs")


def surface() -> list[str]:
    """The lines of the listing."""
    lines: list[str] = []
    homes: dict[int, str] = {}
    for name, names in MODULES.items():
        module = import_module(name)
        for public in names if names is not None else _all_of(module):
            full, thing = f"{name}.{public}", getattr(module, public)
            first = homes.setdefault(id(thing), full)
            lines += _described(full, thing) if first == full else [f"{full}: {first}"]
    lines += [f"entry points engram.{group}" for group in ENTRY_POINTS]
    for kind, table, group in (
        ("ranking policy", POLICIES, "policies"),
        ("kind of features", FEATURES, "features"),
        ("place recogniser", RECOGNISERS, "recognisers"),
        ("layout of drives", SEQUENCES, "readers"),
    ):
        # The table also has what other packages add, once it was looked for.
        others = {one.name for one in entry_points(group=f"engram.{group}")}
        lines += sorted(f"{kind} {name}" for name in set(table) - others)
    lines += [f"setting {one.key}" for one in every_setting(AllSettings()) if one.public]
    lines += [f"exit status {one.value}: {one.meaning}" for one in ExitStatus]
    lines += _verbs()
    return lines


def _all_of(module: Any) -> list[str]:
    """The names of `__all__`; of the errors, which have none, the classes."""
    errors = (name for name in vars(module) if name.endswith("Error"))
    return sorted(getattr(module, "__all__", errors))


def _described(name: str, thing: Any) -> Iterator[str]:
    if not inspect.isclass(thing):
        signature = _signature(thing) if inspect.isfunction(thing) else ""
        yield f"{name}{signature}: {'function' if signature else 'value'}"
        return
    yield f"{name}: class of {', '.join(base.__name__ for base in thing.__bases__)}"
    if issubclass(thing, enum.Enum):
        yield from (f"{name}.{one.name} = {one.value!r}" for one in thing)
        return
    fields = getattr(thing, "__dataclass_fields__", {})
    for field in fields.values():
        yield f"{name}.{field.name}: {_type(field.type)}{' = …' if _has_default(field) else ''}"
    if "__init__" in vars(thing) and not (fields or name in MEMBERS or _is_protocol(thing)):
        yield f"{name}{_signature(thing.__init__)}"
    for member, value in sorted(inspect.getmembers_static(thing)):
        promised = member in MEMBERS[name] if name in MEMBERS else not member.startswith("_")
        if promised and member not in fields and not _is_inherited(thing, member):
            yield f"{name}.{member}{_member(value)}"


def _is_protocol(thing: type) -> bool:
    return getattr(thing, "_is_protocol", False)


def _is_inherited(thing: type, member: str) -> bool:
    """Whether a class of Python or of another library brings it."""
    home = next(one for one in thing.__mro__ if member in vars(one))
    return not home.__module__.startswith("engram")


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return not field.default is field.default_factory is dataclasses.MISSING


def _member(value: Any) -> str:
    if isinstance(value, property):
        return ": property"
    if isinstance(value, classmethod | staticmethod):
        return f"{_signature(value.__func__)}: {type(value).__name__}"
    return _signature(value) if inspect.isfunction(value) else ": value"


def _signature(function: Callable[..., Any]) -> str:
    """Parameters with their annotations; of defaults, that there is one."""
    signature = inspect.signature(inspect.unwrap(function))
    shown = [
        one.replace(
            default=one.empty if one.default is one.empty else _DEFAULT,
            annotation=one.empty if one.annotation is one.empty else _type(one.annotation),
        )
        for one in signature.parameters.values()
    ]
    return str(signature.replace(parameters=shown)).replace("'", "")


def _type(annotation: str) -> str:
    """An annotation without what it says besides the type: descriptions, bounds."""
    plain = re.sub(r"^Annotated\[(.*?), \w+\(.*\]$", r"\1", annotation, flags=re.DOTALL)
    return " ".join(plain.split())


class _Default:
    def __repr__(self) -> str:
        return "…"


_DEFAULT = _Default()


def _verbs() -> Iterator[str]:
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    for name in [verb for verbs in (*GROUPS.values(), *NESTED.values()) for verb in verbs]:
        yield from _verb((name,), commands[name])


def _verb(words: tuple[str, ...], command: Any) -> Iterator[str]:
    for name, inner in getattr(command, "commands", {}).items():
        yield from _verb((*words, name), inner)
    if hasattr(command, "commands"):
        return
    line = " ".join(("engram", *words))
    yield " ".join([line, *command.collect_usage_pieces(None)[1:]])
    for one in command.params:
        if one.param_type_name == "option" and one.name != "help":
            flags = "/".join((*one.opts, *one.secondary_opts))
            many = " (many)" if one.multiple else ""
            yield f"{line} {flags}{'' if one.is_flag else ' VALUE'}{many}"


if __name__ == "__main__":
    LISTING.write_text("\n".join(surface()) + "\n", encoding="utf-8")
    print(f"{LISTING}: {len(surface())} lines")
