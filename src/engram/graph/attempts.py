"""Remembered attempts (method §3.5) as one struct of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.geometry import SE3
from engram.graph.model import Attempt, NodeId

_FLOATS = ("along_m", "across_m", "yaw_rad", "sigma_m", "sigma_yaw_rad")


@dataclass(frozen=True, slots=True, eq=False)
class Attempts:
    """Remembered attempts as a struct of arrays, in order of session and iteration.

    Attributes:
        session: (A,) int32, index into a list of sessions.
        iteration: (A,) int64, iteration of the session's localiser.
        reference, node: (A,) int32, indices into a list of nodes; for a map, dense graph indices.
            In the map's file (A,) int64, keys of their rows.
        along_m, across_m, yaw_rad, sigma_m, sigma_yaw_rad: (A,) float32, as in `Attempt`.
        accepted: (A,) bool, whether the match was accepted.
        inliers: (A,) int32, inliers of the match.
        rank: (A,) int32, place in the ranked order, at most 255.
        policy: (A,) int32, index into `policies`.
        policies: names of the ranking policies.
    """

    session: NDArray[np.int32]
    iteration: NDArray[np.int64]
    reference: NDArray[np.int32] | NDArray[np.int64]
    node: NDArray[np.int32] | NDArray[np.int64]
    along_m: NDArray[np.float32]
    across_m: NDArray[np.float32]
    yaw_rad: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    sigma_yaw_rad: NDArray[np.float32]
    accepted: NDArray[np.bool_]
    inliers: NDArray[np.int32]
    rank: NDArray[np.int32]
    policy: NDArray[np.int32]
    policies: tuple[str, ...]

    @staticmethod
    def of(made: Sequence[Attempt]) -> tuple[Attempts, list[NodeId]]:
        """One session's records as columns, and the list of nodes that they index."""
        ids = list(dict.fromkeys(node for one in made for node in (one.reference, one.node)))
        place = {node: at for at, node in enumerate(ids)}
        policies = tuple(dict.fromkeys(one.policy for one in made))

        def column(name: str, kind: Any) -> NDArray[Any]:
            return np.array([getattr(one, name) for one in made], kind)

        attempts = Attempts(
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
        return attempts, ids

    @staticmethod
    def none() -> Attempts:
        """No attempts."""
        return Attempts.of([])[0]

    @staticmethod
    def joined(parts: Sequence[Attempts]) -> Attempts:
        """All attempts in order, with one sorted list of policies."""
        parts = parts or [Attempts.none()]
        policies = tuple(sorted({name for one in parts for name in one.policies}))
        if len(parts) == 1 and parts[0].policies == policies:
            return parts[0]
        columns = {name: np.concatenate([getattr(one, name) for one in parts]) for name in _COLUMNS}
        place = {name: at for at, name in enumerate(policies)}
        known = [np.array([place[name] for name in one.policies], np.int32) for one in parts]
        columns["policy"] = np.concatenate(
            [named[one.policy] for named, one in zip(known, parts, strict=True)]
        )
        return Attempts(**columns, policies=policies)

    def __len__(self) -> int:
        return len(self.node)

    def rows(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Attempts:
        """A selection of the attempts: (A,) bool mask, or (K,) row numbers in the wanted order."""
        columns = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return Attempts(**columns, policies=self.policies)

    def moved_to(self, equivalent_from_node: Sequence[SE3 | None]) -> Attempts:
        """The attempts as if made on the equivalents of the attempted nodes.

        An equivalent shows the place as the node does, so that evidence for one holds for the
        other. The predicted offset becomes that from the equivalent; heights are ignored.

        Args:
            equivalent_from_node: for each node its camera in its equivalent's camera frame; None
                without an equivalent.

        Returns:
            The attempts between nodes that have equivalents, with unchanged indices.
        """
        known = np.array([one is not None for one in equivalent_from_node], np.bool_)
        made = self.rows(known[self.reference] & known[self.node])
        moves = [one or SE3.identity() for one in equivalent_from_node]
        rotations = np.array([one.rotation for one in moves]).reshape(-1, 3, 3)
        offsets = np.array([one.translation for one in moves]).reshape(-1, 3)
        rotation, offset = rotations[made.node], offsets[made.node]
        x_m, z_m = made.across_m.astype(np.float64), made.along_m.astype(np.float64)
        turn = np.arctan2(rotation[:, 0, 2], rotation[:, 2, 2])
        across_m = rotation[:, 0, 0] * x_m + rotation[:, 0, 2] * z_m + offset[:, 0]
        along_m = rotation[:, 2, 0] * x_m + rotation[:, 2, 2] * z_m + offset[:, 2]
        return replace(
            made,
            across_m=across_m.astype(np.float32),
            along_m=along_m.astype(np.float32),
            yaw_rad=_wrapped(made.yaw_rad + turn).astype(np.float32),
        )

    def lacking(self, remembered: Attempts) -> NDArray[np.intp]:
        """Rows of the attempts that are missing from the remembered ones.

        Two attempts are equal if they agree in all that `moved_to` keeps: session, iteration,
        rank, uncertainty of the prediction, outcome and policy. Iteration and rank alone do not
        suffice: ranks above 255 are stored as 255, and two fleet maps that replay one drive use
        the same iteration numbers. Equal attempts are compared by their number.

        Args:
            remembered: the known attempts; `session` indexes the same list.

        Returns:
            (K,) intp, row numbers.
        """
        known = remembered._by_session()
        found = [np.empty(0, np.intp)]
        # One session at a time: a fleet map remembers millions.
        for session, rows in self._by_session().items():
            ours = remembered.rows(known.get(session, np.empty(0, np.intp)))
            found.append(rows[_lacking_in_session(self.rows(rows), ours)])
        return np.sort(np.concatenate(found))

    def _by_session(self) -> dict[int, NDArray[np.intp]]:
        """Rows of each session's attempts, in order."""
        order = np.argsort(self.session, kind="stable")
        ends = np.flatnonzero(np.diff(self.session[order])) + 1
        return {int(self.session[rows[0]]): rows for rows in np.split(order, ends) if len(rows)}

    def _identities(self, policies: Sequence[str]) -> NDArray[np.int64]:
        """(A, 7) int64, identity of each attempt within its session, independent of its nodes."""
        policy = np.array([policies.index(name) for name in self.policies], np.int64)
        columns: list[NDArray[Any]] = [
            self.iteration,
            self.rank,
            self.sigma_m.view(np.int32),  # bit for bit
            self.sigma_yaw_rad.view(np.int32),
            self.accepted,
            self.inliers,
            policy[self.policy],
        ]
        return np.stack(columns, axis=1, dtype=np.int64)


_COLUMNS = tuple(one.name for one in fields(Attempts) if one.name != "policies")


def _lacking_in_session(made: Attempts, remembered: Attempts) -> NDArray[np.intp]:
    policies = list(dict.fromkeys((*remembered.policies, *made.policies)))
    keys = np.concatenate([one._identities(policies) for one in (remembered, made)])
    _, named = np.unique(keys, axis=0, return_inverse=True)
    named = named.reshape(-1)
    known, new = named[: len(remembered)], named[len(remembered) :]
    order = np.argsort(new, kind="stable")
    ranked = new[order]
    # Number of equal attempts before each: the n-th is known if n + 1 equal ones are remembered.
    before = np.arange(len(ranked)) - np.searchsorted(ranked, ranked)
    counts = np.bincount(known, minlength=int(named.max()) + 1)
    return order[before >= counts[ranked]]


def _wrapped(angle_rad: NDArray[Any]) -> NDArray[np.float64]:
    """In (-π, π]."""
    return np.asarray(np.pi - (np.pi - angle_rad.astype(np.float64)) % (2 * np.pi))
