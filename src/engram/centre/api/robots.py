"""Routes: enrolment, tokens, reports of robots."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from engram.centre.access.enrolment import disable, enrol, new_code, new_nonce, new_token
from engram.centre.access.roles import Role
from engram.centre.api import models
from engram.centre.api.context import Asking, CentreHere, takes
from engram.centre.fleet import Fleet

router = APIRouter(tags=["robots"])


@router.post("/robots/enrol", response_model=models.Enrolled)
def enrol_robot(body: models.Enrolment, centre: CentreHere) -> dict[str, Any]:
    """Enrols a robot with a one-time code. Again with the same code and key it is the same."""
    key, signature = bytes.fromhex(body.public_key), bytes.fromhex(body.signature)
    robot = enrol(centre, body.code, body.name, key, signature)
    return {"robot": robot.id, "maps": sorted(robot.roles)}


@router.post("/token/nonce", response_model=models.Nonce)
def ask_nonce(body: models.NonceRequest, centre: CentreHere) -> dict[str, Any]:
    """What to sign to get a token."""
    return {"nonce": new_nonce(centre, body.robot)}


@router.post("/token", response_model=models.Token)
def ask_token(body: models.TokenRequest, centre: CentreHere) -> dict[str, Any]:
    """A token for a signed nonce."""
    token = new_token(centre, body.robot, body.nonce, bytes.fromhex(body.signature))
    return {"token": token, "expires_in_s": centre.settings.token_s}


@router.get("/me", response_model=models.Me)
def who_am_i(who: Asking) -> dict[str, Any]:
    """The holder of the token."""
    return {"id": who.id, "name": who.name, "roles": dict(who.roles)}


@router.put(
    "/maps/{name}/robots/me/report", response_model=models.Wanted, dependencies=[takes(Role.ROBOT)]
)
def report(name: str, body: models.RobotReport, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """Reports what the robot runs; answers what it is to run."""
    return Fleet(centre).report(name, who.id, body.model_dump())


@router.get(
    "/maps/{name}/robots/me", response_model=models.Wanted, dependencies=[takes(Role.ROBOT)]
)
def wanted(name: str, centre: CentreHere, who: Asking) -> dict[str, Any]:
    """What the robot is to run."""
    return Fleet(centre).wanted(name, who.id)


@router.get(
    "/maps/{name}/robots",
    response_model=list[models.RobotListed],
    dependencies=[takes(Role.VIEWER)],
)
def robots(name: str, centre: CentreHere) -> list[dict[str, Any]]:
    """The robots of a map and their last reports."""
    return Fleet(centre).all(name)


@router.put(
    "/maps/{name}/robots/{robot}/follows",
    status_code=204,
    dependencies=[takes(Role.OPERATOR)],
)
def follow(name: str, robot: str, body: models.Following, centre: CentreHere, who: Asking) -> None:
    """Lets a robot follow a ref, or pins it to a revision."""
    Fleet(centre).follow(name, robot, body.follows, who.id)


@router.delete("/maps/{name}/robots/{robot}", status_code=204, dependencies=[takes(Role.ADMIN)])
def take_away(name: str, robot: str, centre: CentreHere, who: Asking) -> None:
    """Revokes a robot's tokens permanently."""
    Fleet(centre).wanted(name, robot)
    disable(centre, robot, who.id)


@router.post("/maps/{name}/codes", response_model=models.Code, dependencies=[takes(Role.ADMIN)])
def make_code(
    name: str, body: models.CodeRequest, centre: CentreHere, who: Asking
) -> dict[str, Any]:
    """A code with which one robot enrols."""
    return {"code": new_code(centre, name, body.follows, who.id)}
