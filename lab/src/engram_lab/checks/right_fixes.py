"""Right fixes that `confidence` loses against the published rule of inliers, by weather and robot.

    python -m engram_lab.checks.right_fixes                    # held-out towns
    python -m engram_lab.checks.right_fixes --towns 401,402 --json right.json
    python -m engram_lab.checks.right_fixes --set localiser.acceptance.rival_share=1000

Every drive of a small town is localised in each map that it is no part of, once by each rule, from
a true start. Fixes within 1 m and 5° are right. Lost is what the rule of inliers found rightly and
`confidence` did not, less what only `confidence` found, in points of the frames. `--set` changes a
setting of the robots that are localised, of `localiser` or `gaps`; maps are those of the defaults.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from engram.cli.settings import read_settings
from engram.errors import ConfigError
from engram.frontend.frame import BRIEF, DescriptorKind
from engram.localiser.acceptance import Rule
from engram.localiser.settings import LocaliserConfig
from engram.monitor import QUIET
from engram.robot.settings import Settings
from engram_lab.misplaced import Kind, Street, Try
from engram_lab.programs import Figure, command_line, numbers, report
from engram_lab.studies.in_force import check_used
from engram_lab.trial_towns import HELD_OUT_TOWNS, all_streets, light_of


@dataclass(frozen=True, slots=True)
class Compared:
    """One drive by both rules.

    Attributes:
        street, weather, robot: what was driven, in what weather, by which kind of robot.
        frames: how many.
        right: frames with a right fix, by each rule.
        false: fixes that are false, by each rule.
    """

    street: str
    weather: str
    robot: str
    frames: int
    right: dict[Rule, frozenset[int]]
    false: dict[Rule, int]

    @property
    def lost_points(self) -> float:
        """Right fixes lost, in hundredths of the frames; below 0 if there are more."""
        lost = len(self.right[Rule.INLIERS]) - len(self.right[Rule.CONFIDENCE])
        return 100 * lost / self.frames


def fixes(street: Street, rule: Rule) -> tuple[frozenset[int], int]:
    """Frames with a right fix, and the number of false fixes, of an undisturbed robot."""
    plain = street.settings
    acceptance = replace(plain.localiser.acceptance, rule=rule)
    street.settings = replace(plain, localiser=replace(plain.localiser, acceptance=acceptance))
    right, false = set(), 0
    for looked in street.run(Try(Kind.UNDISTURBED, 0)):
        found = looked.found
        if found.node is None or found.node_from_live is None:
            continue
        wrong = street.is_false(looked.frame, found.node, found.node_from_live)
        false += wrong is True
        if wrong is False:
            right.add(looked.frame)
    street.settings = plain
    return frozenset(right), false


def compared(towns: Sequence[int], settings: Settings, live: Settings) -> Iterator[Compared]:
    """All drives of some towns, localised with settings of their own in maps of `settings`."""
    for plan, name, street in all_streets(towns, settings, 8, QUIET):
        street.settings = live
        found = {rule: fixes(street, rule) for rule in Rule}
        street.close()
        yield Compared(
            name,
            light_of(plan),
            plan.robot,
            len(street.frames),
            {rule: right for rule, (right, _) in found.items()},
            {rule: false for rule, (_, false) in found.items()},
        )


def figures(rows: Sequence[Compared]) -> Iterator[Figure]:
    """The mean and the worst drive, then each weather and each robot."""
    yield Figure("drives", len(rows))
    yield Figure("  lost in the mean", sum(row.lost_points for row in rows) / len(rows), "points")
    yield Figure("  most of one drive", max(row.lost_points for row in rows), "points")
    for name in sorted({key for row in rows for key in (row.weather, row.robot)}):
        some = [row for row in rows if name in {row.weather, row.robot}]
        frames = sum(row.frames for row in some)
        for rule in Rule:
            right = sum(len(row.right[rule]) for row in some)
            yield Figure(f"{name}: right by {rule.value}", 100 * right / frames, "%")
            yield Figure("  false", sum(row.false[rule] for row in some), "fixes")
        lost = sum(row.lost_points for row in some) / len(some)
        yield Figure("  lost in the mean", lost, "points")
        yield Figure("  most of one drive", max(row.lost_points for row in some), "points")


# Tables of the settings by which a recorded drive is localised.
_USED = frozenset({"localiser", "gaps"})


def live_settings(changes: Sequence[str], kind: DescriptorKind) -> Settings:
    """Those of the robots that are localised.

    Raises:
        ConfigError: a change concerns nothing that they do, or the rule, of which each is tried.
    """
    given = read_settings(None, changes)
    check_used(given, _USED, "a robot in a map of the defaults")
    if given.localiser.acceptance.rule is not LocaliserConfig().acceptance.rule:
        raise ConfigError("localiser.acceptance.rule: each rule is tried; leave it out")
    return given.of_robot(kind)


def main() -> None:
    """Runs the program."""
    parser = command_line(__doc__)
    parser.add_argument("--kind", type=DescriptorKind, default=BRIEF, help="of features")
    parser.add_argument("--towns", type=numbers, default=list(HELD_OUT_TOWNS))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    asked = parser.parse_args()
    settings, rows = Settings().for_descriptor(asked.kind), []
    live = live_settings(asked.set, asked.kind)
    for row in compared(asked.towns, settings, live):
        rows.append(row)
        counts = ", ".join(f"{rule.value} {len(row.right[rule])}" for rule in Rule)
        print(f"{row.street} {row.weather} {row.robot}: {counts} of {row.frames}", flush=True)
    report(figures(rows), asked.json, "right fixes against the rule of inliers")


if __name__ == "__main__":
    main()
