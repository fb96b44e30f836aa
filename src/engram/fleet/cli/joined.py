"""What the fleet adds to the program: its verbs and its groups of verbs."""

from __future__ import annotations

from collections.abc import Callable

import typer

from engram.fleet.cli.agent_verbs import agent_group
from engram.fleet.cli.centre_verbs import centre_group
from engram.fleet.cli.verbs import build, download, dream, forget, merge

FLEET_VERBS: dict[str, Callable[..., None]] = {
    "merge": merge,
    "download": download,
    "build": build,
    "dream": dream,
    "forget": forget,
}
FLEET_GROUPS: dict[str, typer.Typer] = {"centre": centre_group, "agent": agent_group}
