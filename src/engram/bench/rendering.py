"""The stage of the renderer: one stereo pair of a town on a clear day, camera model included."""

from __future__ import annotations

from engram.bench.data import BenchData
from engram.bench.plain import PlainPipeline
from engram.bench.stage import Prepared
from engram.simulation import SimulatedDrive, campaign_named

_SESSION = 1  # of `village`: a clear morning
_FIRST_FRAME, _FRAMES = 200, 60


def prepare_rendering(data: BenchData, plain: PlainPipeline | None) -> Prepared:
    """The pairs follow each other as in a drive; the tiles around them are built beforehand."""
    del data, plain
    drive = SimulatedDrive(campaign_named("village"), _SESSION)
    for _ in drive.frames(
        _FIRST_FRAME,
        _FIRST_FRAME + _FRAMES,
    ):
        pass
    frames = drive.frames(_FIRST_FRAME, _FIRST_FRAME + _FRAMES)

    def ours(_: int) -> dict[str, int]:
        nonlocal frames
        pair = next(frames, None)
        if pair is None:  # round again
            frames = drive.frames(_FIRST_FRAME, _FIRST_FRAME + _FRAMES)
            pair = next(frames)
        return {"pixels": 2 * pair.left.size}

    return Prepared(ours)
