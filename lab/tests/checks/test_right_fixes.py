"""Which settings the check of right fixes takes."""

import pytest

from engram.errors import ConfigError
from engram.frontend.frame import BRIEF
from engram_lab.checks.right_fixes import live_settings


@pytest.mark.parametrize(
    "change",
    [
        "drive.lanes=3",
        "mapper.save_every_m=2",
        "frontend.landmarks=500",
        "odometry.min_inliers=12",
        "doctor.frames=7",
        "merge.unit=segment",
        "localiser.acceptance.rule=inliers",
    ],
)
def test_a_setting_that_would_change_nothing_is_refused(change: str) -> None:
    with pytest.raises(ConfigError, match=change.partition("=")[0].replace(".", r"\.")):
        live_settings([change], BRIEF)


def test_settings_of_localising_are_taken() -> None:
    found = live_settings(["localiser.search_radius_m=9", "gaps.speed_steps=4"], BRIEF)
    assert found.localiser.search_radius_m == 9
    assert found.gaps.speed_steps == 4
