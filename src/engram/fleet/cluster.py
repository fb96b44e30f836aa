"""Groups mapped on a Dask cluster: an extra, imported only where a scheduler is named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from engram.errors import MissingExtraError, WorkerError
from engram.fleet.group_mapping import GroupResult, GroupTask, map_group_far_away
from engram.fleet.workers import MAX_RETRIES

_CONNECT_S = 30


def map_groups_on_cluster(
    tasks: Sequence[GroupTask],
    place: Callable[[int], Path],
    scheduler: str,
    advance: Callable[[str], None],
    check: Callable[[], None],
    mapped: Callable[[GroupResult], None],
) -> None:
    """Maps groups on the workers of a cluster, which read the drives by themselves.

    Their maps come back through the scheduler's network, whole: no disk is shared.

    Args:
        tasks: the groups.
        place: where the map of a group goes, by its number.
        scheduler: address of the Dask scheduler.
        advance: called once per frame of a group when the group is done.
        check: called after each group; what it raises ends the work.
        mapped: told of each group that is done.

    Raises:
        MissingExtraError: Dask is not installed.
        WorkerError: the scheduler cannot be reached, or a group's workers died again and again.
        EngramError: a group cannot be mapped.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError as error:
        raise MissingExtraError(
            "building on a cluster needs Dask: pip install 'engram[cluster]'"
        ) from error
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkerError(f"the scheduler at {scheduler} does not answer: {error}") from error
    with client:
        # Pure functions of their tasks, but what they do is work: each task is submitted once.
        futures = [
            client.submit(map_group_far_away, task, pure=False, retries=MAX_RETRIES)
            for task in tasks
        ]
        try:
            for future in as_completed(futures, loop=client.loop):
                result, content = future.result()
                _keep(place(result.number), content)
                mapped(result)
                for summary in result.sessions:
                    for _ in range(summary["frames"]):
                        advance("mapped")
                check()
        except KilledWorker as error:
            raise WorkerError(f"workers of the cluster died over a group: {error}") from error
        finally:
            client.cancel(futures)


def _keep(path: Path, content: bytes) -> None:
    """The group's map, whole or not at all."""
    draft = path.with_suffix(".part")
    draft.write_bytes(content)
    draft.replace(path)
