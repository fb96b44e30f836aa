"""A ranking policy that tries first what was saved last."""

import numpy as np
from numpy.typing import NDArray

from engram.ranking import RankingContext, order_by


class NewestPolicy:
    """Orders candidates by when they were saved."""

    name = "newest"

    def rank(self, context: RankingContext) -> NDArray[np.int64]:
        """(Y,) int64: the rows of the candidates, the newest first."""
        nodes = map(context.graph.node, context.neighbourhood.nodes.tolist())
        return order_by(context, np.array([-node.stamp_ns for node in nodes]))
