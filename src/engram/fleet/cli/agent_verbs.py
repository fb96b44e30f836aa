"""`engram agent …`: the robot's side of the centre."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from engram.cli import options
from engram.cli.options import PartlyDoneError

if TYPE_CHECKING:
    from engram.fleet.agent.agent import Agent

agent_group = typer.Typer(
    help="The robot's side of the centre.",
    epilog="Start with: engram agent enrol FOLDER URL CODE --robot r1",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Folder: TypeAlias = Annotated[Path, typer.Argument(metavar="FOLDER", help="The agent's folder.")]
_LOOK_S = 0.5


def _open(folder: Path) -> Agent:
    """The agent of a folder, with the settings in its `agent.toml`."""
    from engram.config import load_toml
    from engram.errors import ConfigError
    from engram.fleet.agent.agent import Agent
    from engram.fleet.agent.agent_state import AgentSettings
    from engram.untrusted import read_text

    config = folder / "agent.toml"
    text = read_text(config, ConfigError) if config.exists() else ""
    settings = load_toml(text, AgentSettings)
    return Agent(folder, settings, wait=threading.Event().wait)


@agent_group.command()
def enrol(
    folder: Folder,
    url: Annotated[str, typer.Argument(metavar="URL", help="Address of the centre.")],
    code: Annotated[str, typer.Argument(metavar="CODE", help="What engram centre code printed.")],
    *,
    robot: Annotated[str, typer.Option("--robot", metavar="NAME", help="Name of the robot.")],
) -> None:
    """Enrol this robot with a centre.

    The robot generates a key, which never leaves FOLDER.

    \b
    Examples:
      engram agent enrol r1 https://town.example:8440 CODE --robot r1
    """
    from engram.fleet.agent.centre_link import enrol as enrol_robot

    typer.echo(f"{robot} is a robot of {enrol_robot(folder, url, code, robot)}")


@agent_group.command()
def run(folder: Folder) -> None:
    """Send and fetch maps until stopped.

    Settings of link and download are in FOLDER/agent.toml.

    Sends what is queued and fetches the version that the centre wants on this robot. Reports each
    event in a line on stderr.

    \b
    Examples:
      engram agent run r1
    """
    from engram.logs import logging_to_stderr

    waiting = threading.Event()
    with logging_to_stderr(), _open(folder) as agent:
        agent.introduce()
        while True:
            waiting.wait(agent.step())


@agent_group.command()
def sync(
    folder: Folder,
    *,
    wait_s: Annotated[
        float,
        typer.Option(
            "--wait", metavar="S", min=0, help="Seconds to wait for what the centre is making."
        ),
    ] = 0.0,
    as_json: options.Json = False,
) -> None:
    """Send and fetch maps once, as far as the link allows.

    Exits with status 2 if anything is left; the next sync or run retries it.

    \b
    Examples:
      engram agent sync r1
      engram agent sync r1 --wait 60 --json
    """
    waiting = threading.Event()
    with _open(folder) as agent:
        until_s = time.monotonic() + wait_s
        while (pause_s := agent.step()) == 0 or (agent.is_pending and time.monotonic() < until_s):
            waiting.wait(min(pause_s, _LOOK_S))
        if agent.trouble is None or not as_json:
            _print(agent, as_json=as_json)
        if agent.trouble is not None:
            raise PartlyDoneError(agent.trouble, agent.status())


@agent_group.command("hand-in")
def hand_in(folder: Folder) -> None:
    """Queue what the robot has mapped.

    Needs no link: the next sync or run sends it.

    \b
    Examples:
      engram agent hand-in r1
    """
    from engram.fleet.transfers import SHORT

    with _open(folder) as agent:
        key = agent.hand_in()
    if key is None:
        typer.echo("nothing new to hand in")
    else:
        typer.echo(f"hand-in {key[:SHORT]} is queued: engram agent sync {folder} sends it")


@agent_group.command()
def switch(folder: Folder) -> None:
    """Switch to the fetched version of the map.

    The robot must be parked.

    \b
    Examples:
      engram agent switch r1
    """
    with _open(folder) as agent:
        typer.echo(
            "switched" if agent.switch() else "nothing to switch to; after a drive, sync first"
        )


@agent_group.command("fall-back")
def fall_back(folder: Folder) -> None:
    """Go back to the last good map.

    \b
    Examples:
      engram agent fall-back r1
    """
    with _open(folder) as agent:
        agent.fall_back()
    typer.echo("went back to the last good map")


@agent_group.command()
def drove(
    folder: Folder,
    *,
    share: Annotated[
        float,
        typer.Option(
            "--share", metavar="SHARE", min=0, max=1, help="Share of frames that were localised."
        ),
    ],
    driven_m: Annotated[
        float, typer.Option("--metres", metavar="M", min=0, help="Distance driven.")
    ],
) -> None:
    """Report how well the map localised a drive.

    A map that localised badly is replaced by the last good one.

    \b
    Examples:
      engram agent drove r1 --share 0.97 --metres 1200
    """
    with _open(folder) as agent:
        typer.echo("fell back" if agent.drove(share, driven_m) else "noted")


@agent_group.command()
def status(folder: Folder, *, as_json: options.Json = False) -> None:
    """Show which map this robot runs, wants and has queued.

    \b
    Examples:
      engram agent status r1
      engram agent status r1 --json
    """
    with _open(folder) as agent:
        _print(agent, as_json=as_json)


def _print(agent: Agent, *, as_json: bool) -> None:
    found = agent.status()
    options.show(found, "\n".join(_status_lines(found, agent.folder)), as_json=as_json)


def _status_lines(found: dict[str, Any], folder: Path) -> list[str]:
    """What `Agent.status` reports, without what is as usual."""
    lines = [f"{found['name']}, a robot of {found['map']} at {found['url']}"]
    lines += [_handin_line(row) for row in found["outbox"]]
    lines.append(_runs_line(found))
    if found["staged"]:
        ready = f"revision {_revision(found['staged'])} is ready"
        lines.append(f"{ready}: when the robot is parked, engram agent switch {folder}")
    if found["rejected"]:
        lines.append(f"revision {_revision(found['rejected'])} localised badly and is not reused")
    if found["share"] is not None:
        share, driven_m = found["share"], found["driven_m"] or 0.0
        lines.append(f"with it {share:.0%} of the frames localised over {driven_m:.0f} m")
    if found["trouble"]:
        lines.append(f"the last round failed: {found['trouble']}")
    return lines


def _runs_line(found: dict[str, Any]) -> str:
    runs, wanted = found["runs"], found["wanted"]
    if not runs:
        return "drives with its own map: it has taken none from the centre yet"
    newer = "" if wanted in {None, "0", runs} else f", is to run {_revision(wanted)}"
    return f"runs revision {_revision(runs)}{newer}"


def _revision(version: str) -> str:
    """The number of the revision of a version."""
    return version.split("-", maxsplit=1)[0]


def _handin_line(row: dict[str, Any]) -> str:
    """A hand-in in the outbox: where it is, and why it stays."""
    from engram.fleet.agent.outbox import QUEUED, SENT, SETTLED
    from engram.fleet.transfers import SHORT

    size = f"{row['bytes'] / 1e6:.1f} MB"
    if row["state"] == SETTLED and row["revision"] is not None:
        fate = f"merged in revision {row['revision']}, kept until a backup of the centre holds it"
    else:
        fates = {QUEUED: "to be sent", SENT: "waits for the centre to merge it"}
        fate = fates.get(row["state"], "not taken by the centre")
    why = f": {row['error']}" if row["error"] else ""
    return f"hand-in {row['id'][:SHORT]} ({size}): {fate}{why}"
