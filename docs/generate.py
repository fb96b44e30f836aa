"""References that the code knows: every verb's help, the public settings and Python names."""

from __future__ import annotations

import inspect
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
        ("python", public_names()),
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


def public_names() -> str:
    """What `import engram` offers: signatures and docstrings."""
    parts = []
    for name in engram.__all__:
        thing = getattr(engram, name)
        if name.startswith("__"):
            continue
        parts.append(f"### `{name}`")
        parts.append(f"```text\n{inspect.getdoc(thing) or ''}\n```")
        if not inspect.isclass(thing):
            continue
        for method, value in vars(thing).items():
            documented = inspect.getdoc(value)
            if method.startswith("_") or not callable(value) or documented is None:
                continue
            try:
                signature = str(inspect.signature(value))
            except ValueError:
                continue
            parts.append(f"```text\n{method}{signature}\n\n{documented}\n```")
    return "\n\n".join(parts) + "\n"


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
