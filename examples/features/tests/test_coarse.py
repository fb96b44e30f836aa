from engram_coarse import COARSE

from engram.frontend.features import feature_kind
from engram.testing import check_kind, unmet


def test_it_meets_the_contract() -> None:
    assert unmet(check_kind(feature_kind("coarse"))) == []


def test_engram_finds_it() -> None:
    assert feature_kind("coarse") is COARSE
