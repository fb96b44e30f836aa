"""Who may do what: roles on a map, enrolment of robots, tokens that live for minutes.

Robots enrol with a one-time code and a key pair of their own; tokens live for minutes. A robot
proves who it is by signing a nonce of the centre: its clock plays no part.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from sqlalchemy import Connection, delete, update

from engram.errors import InputError
from engram.fleet.centre.database import first_row, note, rows_of
from engram.fleet.centre.fleet import check_followed
from engram.fleet.centre.problems import NotAllowedError, NotKnownError, UnknownError
from engram.fleet.centre.service import DAY_NS, Centre
from engram.fleet.centre.tables import (
    Account,
    EnrolmentCode,
    Grant,
    Nonce,
    RobotOnMap,
    Token,
    codes,
    grants,
    nonces,
    subjects,
    tokens,
)
from engram.fleet.transfers import check_signature, enrolment_text, token_text

ALL_MAPS = "*"


class Role(StrEnum):
    """Role of a person or robot on a map."""

    VIEWER = "viewer"  # reads the map, its history and the state of the fleet
    ROBOT = "robot"  # downloads, its own hand-ins and reports
    OPERATOR = "operator"  # moves refs, reverts, merges what a gate refused, cancels
    ADMIN = "admin"  # enrols robots, sets a map's options


# Roles that may do what a role may.
_INCLUDES: Mapping[Role, frozenset[Role]] = {
    Role.VIEWER: frozenset({Role.VIEWER, Role.OPERATOR, Role.ADMIN}),
    Role.ROBOT: frozenset({Role.ROBOT}),
    Role.OPERATOR: frozenset({Role.OPERATOR, Role.ADMIN}),
    Role.ADMIN: frozenset({Role.ADMIN}),
}


@dataclass(frozen=True, slots=True)
class Subject:
    """The caller of a request.

    Attributes:
        id: of the robot or person.
        name: for people.
        roles: by map; `ALL_MAPS` for every map.
    """

    id: str
    name: str
    roles: Mapping[str, Role]

    def role_on(self, name: str) -> Role | None:
        """The role on a map; None without one."""
        return self.roles.get(name, self.roles.get(ALL_MAPS))

    def check(self, name: str, *roles: Role) -> None:
        """Refuses who has none of the roles on a map.

        Raises:
            UnknownError: no role at all: that the map exists is not revealed.
            NotAllowedError: another role.
        """
        role = self.role_on(name)
        if role is None:
            raise UnknownError(f"you have no access to a map {name!r:.60}")
        if not any(role in _INCLUDES[wanted] for wanted in roles):
            raise NotAllowedError(
                f"a role of {role} may not do this; it needs {' or '.join(roles)}"
            )


_S = 1_000_000_000


def new_code(centre: Centre, name: str, follows: str, by: str) -> str:
    """A code with which one robot enrols on a map.

    Raises:
        InputError: no ref can be called what the robot is to follow.
    """
    centre.map_path(name)
    check_followed(follows)
    code = secrets.token_hex(12)  # on a command line: a first - would be an option
    now = centre.now_ns()
    with centre.database.writing() as connection:
        expires_ns = now + centre.settings.code_days * DAY_NS
        row = EnrolmentCode(_hash(code), name, follows, expires_ns, used_by=None)
        centre.database.add(connection, row)
        note(connection, now, by, "code", name, follows=follows)
    return code


def enrol(centre: Centre, code: str, name: str, public_key: bytes, signature: bytes) -> Subject:
    """Enrols a robot; again with the same key it is the same robot, with its new name.

    Raises:
        NotAllowedError: the code is unknown, expired, or used by another robot, or the robot was
            removed.
        InputError: the signature is not of this key.
    """
    check_signature(public_key, signature, enrolment_text(code))
    robot, now = hashlib.sha256(public_key).hexdigest()[:32], centre.now_ns()
    with centre.database.writing() as connection:
        row = first_row(connection, EnrolmentCode, codes.c.hash == _hash(code))
        known = first_row(connection, Account, subjects.c.id == robot)
        if known is not None and known.disabled:
            raise NotAllowedError("this robot was removed; enrol it again from a new folder")
        if row is None or row.expires_ns < now or row.used_by not in {None, robot}:
            raise NotAllowedError("the code is unknown, expired or used; ask for a new one")
        if row.used_by is None:
            put = centre.database.put
            put(connection, replace(row, used_by=robot))
            account = known or Account(robot, "robot", name, public_key, now, disabled=0)
            put(connection, replace(account, name=name))
            put(connection, Grant(robot, row.map, Role.ROBOT))
            on_map = RobotOnMap(robot, row.map, row.follows, report={}, reported_ns=None)
            centre.database.add(connection, on_map)
            note(connection, now, robot, "enrol", row.map, name=name)
        return _subject(connection, robot)


def new_nonce(centre: Centre, robot: str) -> str:
    """A nonce that a robot must sign to get a token; given to unknown robots, too."""
    nonce, now = secrets.token_hex(16), centre.now_ns()
    with centre.database.writing(durable=False) as connection:
        connection.execute(delete(nonces).where(nonces.c.expires_ns < now))
        if first_row(connection, Account, subjects.c.id == robot) is not None:
            expires_ns = now + centre.settings.nonce_s * _S
            centre.database.add(connection, Nonce(nonce, robot, expires_ns))
    return nonce


def new_token(centre: Centre, robot: str, nonce: str, signature: bytes) -> str:
    """A token for a robot that signed a nonce.

    Raises:
        NotAllowedError: the nonce is unknown, used or expired, the robot is disabled, or the
            signature is not its.
    """
    now = centre.now_ns()
    with centre.database.writing(durable=False) as connection:
        of_robot = (nonces.c.nonce == nonce, nonces.c.subject == robot)
        row = first_row(connection, Nonce, *of_robot)
        connection.execute(delete(nonces).where(nonces.c.nonce == nonce))
        known = first_row(connection, Account, subjects.c.id == robot)
    refused = NotAllowedError(
        "no token: the robot is unknown here, was removed, or signed an expired nonce"
    )
    if row is None or row.expires_ns < now or known is None or known.disabled:
        raise refused
    try:
        check_signature(known.public_key or b"", signature, token_text(robot, nonce))
    except InputError as error:
        raise refused from error
    return _issue(centre, robot, now + centre.settings.token_s * _S)


def add_person(centre: Centre, name: str, map_name: str, role: Role) -> str:
    """A token for a person, without end; `engram centre token` makes them.

    Raises:
        UnknownError: there is no such map.
        InputError: no name is given.
    """
    if not name.strip():
        raise InputError("a token needs the name of a person: the audit log shows it")
    if map_name != ALL_MAPS:
        centre.map_row(map_name)
    person, now = secrets.token_hex(16), centre.now_ns()
    with centre.database.writing() as connection:
        account = Account(person, "person", name, public_key=None, created_ns=now, disabled=0)
        centre.database.add(connection, account)
        centre.database.put(connection, Grant(person, map_name, role))
        note(connection, now, "shell", "token", map_name, name=name, role=str(role))
    return _issue(centre, person, None)


def subject_of(centre: Centre, token: str) -> Subject:
    """The holder of a token.

    Raises:
        NotKnownError: the token is unknown, or has expired.
    """
    with centre.database.reading() as connection:
        row = first_row(connection, Token, tokens.c.hash == _hash(token))
        if row is None or (row.expires_ns or 2**63) < centre.now_ns():
            raise NotKnownError("the token is not known or has expired; ask for a new one")
        return _subject(connection, row.subject)


def disable(centre: Centre, robot: str, by: str) -> None:
    """Revokes all tokens of a robot or person, and issues no more."""
    with centre.database.writing() as connection:
        connection.execute(update(subjects).where(subjects.c.id == robot).values(disabled=1))
        connection.execute(delete(tokens).where(tokens.c.subject == robot))
        note(connection, centre.now_ns(), by, "disable", "", robot=robot)


def revoke_access(centre: Centre, name: str, by: str) -> list[str]:
    """Revokes all tokens of every person of this name, or of the robot of this name or id.

    Returns:
        Their ids.

    Raises:
        UnknownError: no person or robot has this name.
        InputError: several robots have it.
    """
    of_name = (subjects.c.name == name) | (subjects.c.id == name)
    found = centre.database.rows(Account, of_name, subjects.c.disabled == 0)
    alike = [account.id for account in found if account.kind == "robot"]
    if len(alike) > 1:
        raise InputError(f"{len(alike)} robots are called {name!r}; name one by its id: {alike}")
    if not found:
        raise UnknownError(f"{name!r:.60} has no token")
    for account in found:
        disable(centre, account.id, by)
    return [account.id for account in found]


def names_of(centre: Centre) -> dict[str, str]:
    """Names of all robots and people, by id."""
    return {account.id: account.name for account in centre.database.rows(Account)}


def _issue(centre: Centre, subject: str, expires_ns: int | None) -> str:
    token = secrets.token_urlsafe(32)
    with centre.database.writing(durable=expires_ns is None) as connection:
        connection.execute(delete(tokens).where(tokens.c.expires_ns < centre.now_ns()))
        centre.database.add(connection, Token(_hash(token), subject, expires_ns))
    return token


def _subject(connection: Connection, found: str) -> Subject:
    row = first_row(connection, Account, subjects.c.id == found)
    if row is None or row.disabled:
        raise NotKnownError("the owner of this token is no longer known; ask for a new one")
    held = rows_of(connection, Grant, grants.c.subject == found)
    return Subject(found, row.name, {grant.map: Role(grant.role) for grant in held})


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()
