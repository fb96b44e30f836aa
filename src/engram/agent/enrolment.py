"""How a robot joins a centre: its folder, its key, its enrolment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from engram.agent.link import Link, new_client
from engram.agent.state import AgentState
from engram.errors import InputError, storage_full
from engram.monitor import write_whole
from engram.transfers.signing import Signer, enrolment_text

if TYPE_CHECKING:
    import httpx

PARTS = ("live", "base", "next")


def enrol(folder: Path, url: str, code: str, name: str, client: httpx.Client | None = None) -> str:
    """Enrols a robot with a centre; the key pair is made here and never leaves the folder.

    Returns:
        The name of its map.

    Raises:
        InputError: the folder has an agent of another centre already, or cannot hold one.
        CentreRefusedError: the code is not valid.
        Unreachable: the centre does not answer.
    """
    url = url.rstrip("/")
    _check_centre(folder, url)
    key = folder / "key"
    try:
        for part in PARTS:
            (folder / part).mkdir(parents=True, exist_ok=True)
        if not key.exists():
            with write_whole(key) as draft:
                draft.touch(mode=0o600)
                draft.write_bytes(Signer.new_key())
    except OSError as error:
        fact = f"{folder} cannot hold an agent: {error.strerror}"
        raise storage_full(error, folder) or InputError(fact) from error
    signer = signer_of(key)
    link = Link(client or new_client(url), "", signer, None, lambda _: None)
    body = {
        "code": code,
        "name": name,
        "public_key": signer.public_key.hex(),
        "signature": signer.sign(enrolment_text(code)).hex(),
    }
    answer = link.bare("/v1/robots/enrol", body)
    state = AgentState(folder / "agent.sqlite")
    state.remember(url=url, robot=answer["robot"], map=answer["maps"][0], name=name)
    state.close()
    return str(answer["maps"][0])


def signer_of(key: Path) -> Signer:
    """A signer with a robot's key.

    Raises:
        InputError: it is missing, or not one.
    """
    try:
        return Signer(key.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(
            f"{key} is not a robot's key ({error}); remove it and enrol the robot again"
        ) from error


def enrolled(folder: Path) -> AgentState:
    """Opens the state of an agent.

    Raises:
        InputError: the robot is not enrolled, or only half.
    """
    path = folder / "agent.sqlite"
    if path.exists():
        state = AgentState(path)
        if state.fact("robot") is not None:
            return state
        state.close()
    raise InputError(
        f"{folder} is not the folder of an enrolled robot; enrol it: engram agent enrol {folder} "
        "URL CODE --robot NAME"
    )


def _check_centre(folder: Path, url: str) -> None:
    """Checks that a folder holds no agent of another centre, whose state would remain."""
    path = folder / "agent.sqlite"
    if not path.exists():
        return
    state = AgentState(path)
    known, name = state.fact("url"), state.fact("name")
    state.close()
    if known is not None and known.rstrip("/") != url:
        raise InputError(
            f"{folder} belongs to the robot {name!r} of {known}; give another folder for {url}"
        )
