"""Remembered attempts, carried over to the equivalents of omitted nodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from engram.graph.model import Attempt, NodeId
from engram.localiser import Position
from engram.maps import AttemptArrays


def at_equivalents(made: AttemptArrays, positions: Sequence[Position | None]) -> AttemptArrays:
    """Attempts as if they had been made on the equivalents of the attempted nodes.

    An equivalent shows the place as the omitted node does: what is known of one is known of the
    other. The predicted offset is told from the equivalent; heights are left out of account.

    Args:
        made: attempts of one session; `node` and `reference` are indices into `positions`.
        positions: of each node handed in, in the centre; None for one that it does not know.

    Returns:
        The attempts between nodes that the centre knows, their indices unchanged.
    """
    known = np.array([position is not None for position in positions], np.bool_)
    made = made.rows(known[made.reference] & known[made.node])
    moved = [position or Position.at(NodeId(_NOBODY)) for position in positions]
    rotations = np.array([one.node_from_live.rotation for one in moved]).reshape(-1, 3, 3)
    offsets = np.array([one.node_from_live.translation for one in moved]).reshape(-1, 3)
    rotation, offset = rotations[made.node], offsets[made.node]
    x_m, z_m = made.across_m.astype(np.float64), made.along_m.astype(np.float64)
    turn = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
    return replace(
        made,
        across_m=_single(rotation[:, 0, 0] * x_m + rotation[:, 0, 2] * z_m + offset[:, 0]),
        along_m=_single(rotation[:, 2, 0] * x_m + rotation[:, 2, 2] * z_m + offset[:, 2]),
        yaw_rad=_single(_wrapped(made.yaw_rad + turn)),
    )


def lacking(made: AttemptArrays, remembered: AttemptArrays) -> NDArray[np.intp]:
    """Places of the attempts that are not remembered yet.

    Two attempts are one when they agree in all that carrying them over leaves alone: session,
    iteration, rank, the uncertainty of the prediction, outcome and policy. Iteration and rank alone
    would not do: ranks above 255 are stored as 255, and two centres that replay one drive number
    their iterations alike. Of equal attempts as many are lacking as there are more of.

    Args:
        made: attempts, sessions named as in `remembered`.
        remembered: those that are known.
    """
    known = _by_session(remembered)
    found = [np.empty(0, np.intp)]
    # One session at a time: a centre remembers millions.
    for session, rows in _by_session(made).items():
        ours = remembered.rows(known.get(session, np.empty(0, np.intp)))
        found.append(rows[_lacking_in_session(made.rows(rows), ours)])
    return np.sort(np.concatenate(found))


def _by_session(made: AttemptArrays) -> dict[int, NDArray[np.intp]]:
    """The places of each session's attempts, in their order."""
    order = np.argsort(made.session, kind="stable")
    ends = np.flatnonzero(np.diff(made.session[order])) + 1
    return {int(made.session[rows[0]]): rows for rows in np.split(order, ends) if len(rows)}


def _lacking_in_session(made: AttemptArrays, remembered: AttemptArrays) -> NDArray[np.intp]:
    policies = list(dict.fromkeys((*remembered.policies, *made.policies)))
    keys = np.concatenate([_identities(one, policies) for one in (remembered, made)])
    _, named = np.unique(keys, axis=0, return_inverse=True)
    named = named.reshape(-1)
    known, new = named[: len(remembered)], named[len(remembered) :]
    order = np.argsort(new, kind="stable")
    ranked = new[order]
    # How many equals came before each: they take what is remembered one by one.
    before = np.arange(len(ranked)) - np.searchsorted(ranked, ranked)
    counts = np.bincount(known, minlength=int(named.max()) + 1)
    return order[before >= counts[ranked]]


def _identities(made: AttemptArrays, policies: Sequence[str]) -> NDArray[np.int64]:
    """(A, 7) what names each attempt of a session, free of the nodes that it is told from."""
    policy = np.array([policies.index(name) for name in made.policies], np.int64)
    columns: list[NDArray[Any]] = [
        made.iteration,
        made.rank,
        made.sigma_m.view(np.int32),  # to the bit
        made.sigma_yaw_rad.view(np.int32),
        made.accepted,
        made.inliers,
        policy[made.policy],
    ]
    return np.stack(columns, axis=1, dtype=np.int64)


def from_records(made: Sequence[Attempt]) -> tuple[AttemptArrays, list[NodeId]]:
    """Records as columns, and the nodes that their columns are indices into."""
    ids = list(dict.fromkeys(node for one in made for node in (one.reference, one.node)))
    place = {node: at for at, node in enumerate(ids)}
    policies = tuple(dict.fromkeys(one.policy for one in made))

    def column(name: str, kind: Any) -> NDArray[Any]:
        return np.array([getattr(one, name) for one in made], kind)

    arrays = AttemptArrays(
        session=np.zeros(len(made), np.int32),
        iteration=column("iteration", np.int64),
        reference=np.array([place[one.reference] for one in made], np.int32),
        node=np.array([place[one.node] for one in made], np.int32),
        **{name: column(name, np.float32) for name in _FLOATS},
        accepted=column("accepted", np.bool_),
        inliers=column("inliers", np.int32),
        rank=column("rank", np.int32),
        policy=np.array([policies.index(one.policy) for one in made], np.int32),
        policies=policies,
    )
    return arrays, ids


_NOBODY = UUID(int=0)
_FLOATS = ("along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad")


def _single(values: NDArray[np.float64]) -> NDArray[np.float32]:
    return values.astype(np.float32)


def _wrapped(angle_rad: NDArray[Any]) -> NDArray[np.float64]:
    """In (-π, π]."""
    return np.asarray(np.pi - (np.pi - angle_rad.astype(np.float64)) % (2 * np.pi))
