"""What every ranking policy, reader of drives and kind of features must do, as checks to run.

For the tests of Engram and of packages that add to it::

    from engram.testing import check_policy, unmet

    def test_contract():
        assert unmet(check_policy(Newest)) == []

Nothing here needs a test framework.
"""

from engram.testing.contracts import Check, check_kind, check_policy, check_reader, unmet

__all__ = ["Check", "check_kind", "check_policy", "check_reader", "unmet"]
