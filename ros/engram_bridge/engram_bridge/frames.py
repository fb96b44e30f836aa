"""The tree of fixed frames, from /tf_static: where a camera is mounted on the robot."""

from __future__ import annotations

import threading

import numpy as np

from engram_bridge import rigid

# More links than any robot's tree has; ends a search in a tree that is a circle.
_DEEPEST = 100


class StaticFrames:
    """Fixed transforms by child; the newest counts. Threads may share it."""

    def __init__(self) -> None:
        self._parents = {}
        self._lock = threading.Lock()

    def add(self, parent: str, child: str, translation, xyzw) -> None:
        """Takes ``parent_from_child``: metres, and a quaternion of any length but 0.

        Raises:
            ValueError: a value is not finite, or the quaternion is 0.
        """
        matrix = rigid.of_quaternion(xyzw, translation)
        if not np.isfinite(matrix).all():
            raise ValueError(f"the transform {parent} -> {child} of /tf_static is not finite")
        with self._lock:
            self._parents[child.lstrip("/")] = parent.lstrip("/"), matrix

    def between(self, base: str, child: str):
        """``base_from_child`` (4, 4); None if no chain of fixed transforms joins them."""
        from_base, from_child = self._ancestors(base), self._ancestors(child)
        for name, ancestor_from_child in from_child.items():
            if name in from_base:
                return rigid.inverse(from_base[name]) @ ancestor_from_child
        return None

    def _ancestors(self, name: str):
        """``ancestor_from_name`` by ancestor, the frame itself first."""
        name = name.lstrip("/")
        found = {name: np.eye(4)}
        with self._lock:
            while name in self._parents and len(found) < _DEEPEST:
                parent, parent_from_name = self._parents[name]
                if parent in found:
                    break
                found[parent] = parent_from_name @ found[name]
                name = parent
        return found
