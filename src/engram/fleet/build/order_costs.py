"""What trying all orders of merging costs ([G16] eq. (8), SPEC §7)."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class OrderCosts:
    """What trying all orders costs, seconds.

    Attributes:
        model_s: numerator of (8): every order's merges made afresh.
        sequential_s: its denominator: every order built by mapping sequentially, but for the copy
            of the first group.
        tree_s: merges of a common prefix made once.
        sequential_tree_s: sequential building that shares its prefixes likewise.
    """

    model_s: float
    sequential_s: float
    tree_s: float
    sequential_tree_s: float


def order_costs(groups: int, group_s: float, merge_s: float, copy_s: float) -> OrderCosts:
    """The cost model of trying all orders ([G16] eq. (8), SPEC §7).

    Args:
        groups: k.
        group_s: T_G, mapping one group.
        merge_s: T_M, merging one group's map.
        copy_s: T_C, copying an intermediate map.
    """
    k, orders = groups, math.factorial(groups)
    inner = sum(orders // math.factorial(k - depth) for depth in range(2, k + 1))
    copies_s = (inner + k) * copy_s
    return OrderCosts(
        model_s=k * group_s + orders * (k - 1) * merge_s + k * (orders - 1) * copy_s,
        sequential_s=(orders * (k - 1) + 1) * group_s + (orders - 1) * copy_s,
        tree_s=k * group_s + inner * merge_s + copies_s,
        sequential_tree_s=(inner + k) * group_s + copies_s,
    )
