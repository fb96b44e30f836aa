from engram_newest import NewestPolicy

from engram.ranking import policy_named
from engram.testing import check_policy, unmet


def test_it_meets_the_contract() -> None:
    assert unmet(check_policy(NewestPolicy)) == []


def test_engram_finds_it() -> None:
    assert isinstance(policy_named("newest"), NewestPolicy)
