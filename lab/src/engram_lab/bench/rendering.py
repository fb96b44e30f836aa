"""The stages of the renderer: one stereo pair of a town, with camera model and moving things."""

from __future__ import annotations

from engram_lab.bench.data import BenchData
from engram_lab.bench.plain import PlainPipeline
from engram_lab.bench.stage import Prepared
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.session import SimulatedDrive

CLEAR, RAIN, NIGHT = 1, 6, 7  # sessions of `village`: a morning, wet streets, lamps
_FIRST_FRAME, _FRAMES = 200, 60


def prepare_rendering(
    data: BenchData, plain: PlainPipeline | None, *, session: int = CLEAR
) -> Prepared:
    """The pairs follow each other as in a drive; the tiles around them are built beforehand."""
    del data, plain
    drive = SimulatedDrive(campaign_named("village"), session)
    for _ in drive.frames(_FIRST_FRAME, _FIRST_FRAME + _FRAMES):
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
