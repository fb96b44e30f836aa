"""What every ranking policy must do, checked in made-up situations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from engram.ranking import RankingContext, RankingPolicy
from engram.testing.checks import Check
from engram.testing.situations import (
    foreknown,
    make_context,
    neighbourhood_of,
    path_uuid,
    random_context,
)

_SITUATIONS = 100


def check_policy(
    make: Callable[[], RankingPolicy], contexts: Sequence[RankingContext] | None = None
) -> list[Check]:
    """Runs a policy in made-up situations; a fraction of a second.

    Args:
        make: makes the policy, such as its class.
        contexts: the situations; None for a hundred at random.
    """
    given = [random_context(seed) for seed in range(_SITUATIONS)] if contexts is None else contexts
    first_day = foreknown(make_context(candidates=[4, 2, 7], along_m=[2.0, 0.5, 1.0], sessions=3))
    return [
        _checked("every row of the candidates stands once in the order", given, _orders(make)),
        _checked("no candidates give an empty order", [foreknown(make_context())], _orders(make)),
        _checked(
            "a robot on its first day, without history, clock or words, gets an order",
            [first_day],
            _orders(make),
        ),
        _checked("a used policy orders as a new one", given, _orders_again(make)),
        _checked("nodes come in the same order when rows are shuffled", given, _shuffled(make)),
        _checked("the robot's own path does not count", [_past()], _without_own_path(make)),
    ]


# The fault of a policy in one situation; "" for none.
_Fault = Callable[[RankingContext], str]


def _checked(demand: str, contexts: Iterable[RankingContext], fault: _Fault) -> Check:
    found = ((number, fault(one)) for number, one in enumerate(contexts))
    number, first = next(((number, text) for number, text in found if text), (0, ""))
    return Check(demand, not first, f"{first} in situation {number}" if first else "yes")


def _orders(make: Callable[[], RankingPolicy]) -> _Fault:
    def fault(context: RankingContext) -> str:
        order: object = make().rank(context)
        rows = len(context.neighbourhood)
        if not isinstance(order, np.ndarray) or order.dtype != np.int64:
            return f"{order!r} is not an array of int64"
        whole = sorted(order.tolist()) == list(range(rows))
        return "" if whole else f"{order.tolist()} is not an order of {rows} rows"

    return fault


def _orders_again(make: Callable[[], RankingPolicy]) -> _Fault:
    def fault(context: RankingContext) -> str:
        policy = make()
        first = policy.rank(context)
        policy.rank(foreknown(make_context(candidates=[0, 1, 2], paths=[[0, 1]], reference=1)))
        return _difference(first, policy.rank(context)) or _difference(first, make().rank(context))

    return fault


def _shuffled(make: Callable[[], RankingPolicy]) -> _Fault:
    def fault(context: RankingContext) -> str:
        near = context.neighbourhood
        rows = np.random.default_rng(0).permutation(len(near))
        other = neighbourhood_of(near.nodes[rows], near.along_m[rows])
        moved = foreknown(replace(context, neighbourhood=other))
        return _difference(
            near.nodes[make().rank(foreknown(context))], other.nodes[make().rank(moved)]
        )

    return fault


_PATHS = ([4, 1, 5], [6, 2])


def _past(paths: Sequence[Sequence[int]] = _PATHS, own: int | None = None) -> RankingContext:
    """A map with paths, of which one is the robot's own."""
    return foreknown(
        make_context(
            paths=paths,
            own_path=None if own is None else path_uuid(own),
            candidates=[0, 1, 2, 3],
            observed=[4, 5, 6],
            outcomes=[True, True, False],
            reference=4,
        )
    )


def _without_own_path(make: Callable[[], RankingPolicy]) -> _Fault:
    with_own = _past((*_PATHS, [4, 3, 5]), own=len(_PATHS))
    return lambda context: _difference(make().rank(context), make().rank(with_own))


def _difference(one: NDArray[np.signedinteger], other: NDArray[np.signedinteger]) -> str:
    return "" if np.array_equal(one, other) else f"{one.tolist()}, then {other.tolist()}"
