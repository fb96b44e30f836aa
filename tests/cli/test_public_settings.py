"""The public settings: their names are a promise, so a change to this list is a decision."""

from __future__ import annotations

import re

from engram.cli.settings import AllSettings, every_setting, read_settings

PUBLIC = """
frontend: descriptor landmarks fast_threshold second_threshold side_difference
  max_disparity_px min_landmarks thumbnails
odometry: min_inliers
localiser: search_radius_m max_search_radius_m view_gate_rad lost_after_m guide_below_m
  guide_below_rad neighbourhood path_entries success fix_sigmas
localiser.recent: T T_unit iteration_m
localiser.acceptance: rule min_confidence doubt_after min_inliers min_inliers_lost
mapper: landmarks save_every_m save_every_rad sure_inliers checkpoint_every
doctor: frames row_offset_px faulty_share
drive: format rig channel from_ to skip_bad longitude_deg zone calibration field_of_view_deg
  mask left right motion ranking lanes rounds threads memory relocaliser
merge: ranking lanes rounds relocaliser sure_inliers unit segment_share seed
build: max_gap_m estimator
download: window_min epoch_min best_percent buffer_min latitude_deg radius_m thumbnails
repair: gross_m gross_rad
islands: sigmas reach_m
weak_spots: latitude_deg share_percent
"""
# More than a person reads through.
MOST = 80


def test_the_public_settings_are_these() -> None:
    tables = re.findall(r"^([\w.]+): ((?:.|\n  )+)", PUBLIC, re.MULTILINE)
    promised = [f"{table}.{name}" for table, names in tables for name in names.split()]
    assert [one.key for one in every_setting(AllSettings()) if one.public] == promised
    assert len(promised) <= MOST


def test_every_setting_can_be_set_public_or_not() -> None:
    settings = list(every_setting(AllSettings()))
    changes = [f"{one.key}={_toml(one.value)}" for one in settings if one.value is not None]
    assert len(changes) > 300
    assert read_settings(None, changes) == AllSettings()


def _toml(value: object) -> str:
    if isinstance(value, tuple | list):
        return str(list(value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def test_show_lists_the_public_settings_and_what_was_changed(engram) -> None:
    shown = engram("settings", "show", "--set", "fixed.every=3").out
    assert "fixed.every = 3" in shown
    assert "localiser.search_radius_m = 8.0" in shown
    assert "fixed.first" not in shown
    assert "fixed.first = 12" in engram("settings", "show", "--all").out
