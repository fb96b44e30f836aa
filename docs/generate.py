"""References that the code knows: every verb's help, the public settings and Python names."""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

import engram
from engram.cli.app import GROUPS, NESTED, app
from engram.cli.settings import AllSettings, shown_settings
from engram.doctor.examination import DoctorConfig
from engram.doctor.table import CHECKS
from engram.maps.schema import metadata


def write_references(folder: Path) -> None:
    """Writes one Markdown file for each reference."""
    folder.mkdir(exist_ok=True)
    for name, text in (
        ("commands", commands()),
        ("settings", settings()),
        ("findings", findings()),
        ("tables", tables()),
    ):
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


def commands() -> str:
    """The help of every verb, by group."""
    program: Any = typer.main.get_command(app)
    parts = []
    for title in dict.fromkeys([*GROUPS, *NESTED]):
        parts.append(f"### {title}")
        with program.make_context("engram", [], resilient_parsing=True) as context:
            for name in GROUPS.get(title, {}):
                parts += _help(name, program.commands[name], context)
            for name in NESTED.get(title, {}):
                group = program.commands[name]
                with group.make_context(name, [], parent=context, resilient_parsing=True) as outer:
                    for inner, verb in group.commands.items():
                        parts += _help(inner, verb, outer)
    return "\n\n".join(parts) + "\n"


def _help(name: str, verb: Any, context: Any) -> list[str]:
    """Heading and help of a verb, with the words before its name."""
    with verb.make_context(name, [], parent=context, resilient_parsing=True) as inner:
        words = inner.command_path.partition(" ")[2]
        return [f"#### {words}", f"```text\n{verb.get_help(inner)}\n```"]


def settings() -> str:
    """A table of the public settings with their defaults."""
    rows = ["| setting | default | bounds | meaning |", "| --- | --- | --- | --- |"]
    rows += [
        f"| `{one.key}` | `{one.value}` | {one.bounds} | {one.description} |"
        for one in shown_settings(AllSettings(), every=False)
    ]
    return "\n".join(rows).replace("<", "&lt;") + "\n"


def findings() -> str:
    """A table of the doctor's checks."""
    rows = ["| code | severity | alarm | meaning | cure |", "| --- | --- | --- | --- | --- |"]
    for one in CHECKS:
        limit = getattr(DoctorConfig(), one.limit) if isinstance(one.limit, str) else one.limit
        alarm = f"{'under' if one.below else 'over'} {limit:g} {one.unit}".rstrip()
        rows.append(f"| `{one.code}` | {one.severity} | {alarm} | {one.message} | {one.cure} |")
    return "\n".join(rows) + "\n"


def write_api(folder: Path) -> None:
    """Writes a page for each public module: signatures and docstrings of its `__all__`."""
    folder.mkdir(exist_ok=True)
    described: dict[int, str] = {}
    for name in public_modules():
        (folder / f"{name}.md").write_text(api_page(name, described), encoding="utf-8")


def public_modules() -> list[str]:
    """Names of the modules with an `__all__`, but for the command line, which has its own page."""
    package = Path(engram.__file__).parent
    files = (path for path in sorted(package.rglob("*.py")) if "\n__all__ = " in path.read_text())
    named = (path.relative_to(package.parent).with_suffix("").parts for path in files)
    names = [".".join(part for part in parts if part != "__init__") for parts in named]
    return sorted(name for name in names if not name.startswith("engram.cli"))


def api_page(name: str, described: dict[int, str]) -> str:
    """A public module: what its docstring says, and each public name in reStructuredText.

    Args:
        described: name of each thing, by its id, that a page describes; gains those of this one.
    """
    module = import_module(name)
    blocks = [f".. automodule:: {name}\n   :no-members:"]
    for public in sorted(module.__all__):
        thing = getattr(module, public)
        if public.startswith("__"):
            continue
        full = f"{name}.{public}"
        first = described.setdefault(id(thing), full)
        if first != full:
            blocks.append(f"{public}: see :py:obj:`{first}`.")
        elif callable(thing):
            blocks.append(f".. auto{'class' if inspect.isclass(thing) else 'function'}:: {full}")
        else:
            blocks.append(f".. py:data:: {full}\n   :type: {type(thing).__name__}")
    return f"# {name}\n\n```{{eval-rst}}\n" + "\n\n".join(blocks) + "\n```\n"


def tables() -> str:
    """The tables of a map, each with its columns."""
    rows = ["| table | columns after `key`, before `checksum` |", "| --- | --- |"]
    for table in metadata.tables.values():
        columns = (
            f"`{one.name}`" + (f" ({one.info['note']})" if one.info.get("note") else "")
            for one in table.columns
            if one.name not in {"key", "checksum"}
        )
        rows.append(f"| `{table.name}` | {', '.join(columns)} |")
    return "\n".join(rows) + "\n"
