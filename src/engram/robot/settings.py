"""All settings of a run in one place: what a TOML file given with --config may contain."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Self

from engram.config import load_toml
from engram.doctor.examination import DoctorConfig
from engram.errors import ConfigError
from engram.frontend.features import fitted_matcher
from engram.frontend.frame import DescriptorKind
from engram.frontend.frontend import FrontendConfig
from engram.graph.placing import PlacingConfig
from engram.localiser.localisation import Budget
from engram.localiser.settings import LocaliserConfig
from engram.mapper.mapper import MapperConfig
from engram.odometry.fixed import FixedConfig
from engram.odometry.motion import GapConfig
from engram.odometry.odometry import OdometryConfig
from engram.odometry.outside import FrozenConfig, OutsideConfig
from engram.ranking.policies import check_for_robot

# Settings files that ship with the package: the rules of one paper each.
PAPERS = ("linegar2015", "gadd2016")
# Tables of a settings file that only the verbs of the command line read.
VERB_TABLES = frozenset({"drive", "merge", "build", "download", "repair", "islands", "weak_spots"})


@dataclass(frozen=True, slots=True)
class Settings:
    """The resolved configuration, kept with every result and in every map revision."""

    frontend: FrontendConfig = field(default_factory=FrontendConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    localiser: LocaliserConfig = field(default_factory=LocaliserConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    doctor: DoctorConfig = field(default_factory=DoctorConfig)
    outside: OutsideConfig = field(default_factory=OutsideConfig)
    gaps: GapConfig = field(default_factory=GapConfig)
    fixed: FixedConfig = field(default_factory=FixedConfig)
    frozen: FrozenConfig = field(default_factory=FrozenConfig)
    placing: PlacingConfig = field(default_factory=PlacingConfig)

    def for_descriptor(self, descriptor: DescriptorKind | None) -> Self:
        """These settings for a map's kind of descriptor; None keeps their own.

        Matcher settings that are not set explicitly become the defaults of that kind.

        Raises:
            ConfigError: the kind is unknown.
        """
        before = self.frontend.descriptor
        frontend = self.frontend
        if descriptor is not None:
            frontend = replace(frontend, descriptor=descriptor)
        kind = frontend.descriptor
        odometry = fitted_matcher(self.odometry.matcher, before, kind)
        localiser = fitted_matcher(self.localiser.matcher, before, kind)
        return replace(
            self,
            frontend=frontend,
            odometry=replace(self.odometry, matcher=odometry),
            localiser=replace(self.localiser, matcher=localiser),
        )


@dataclass(frozen=True, slots=True)
class RobotOptions:
    """Ranking policy and budget of a robot.

    Attributes:
        ranking: which nodes to try first: key of `POLICIES`.
        lanes, rounds: the budget of each frame.
        deadline_ms: latest start of an attempt after its frame arrived. With None only the counts
            limit it, so that equal input gives equal results.
        relocaliser: one of `relocaliser_names()`, for a lost robot; None for none.
        threads: most threads of the robot, its caller's included; None for one per lane and per
            background task. Without a deadline the results are the same with any number.
        memory_bytes: largest memory of the map's landmarks and graph; None for 300 MB.
        author: author of revisions; None for the robot.
        force: whether a drive with a fatal finding of the doctor is mapped all the same.
    """

    ranking: str = "recall"
    lanes: int = 2
    rounds: int = 2
    deadline_ms: float | None = None
    relocaliser: str | None = "fabmap"
    threads: int | None = None
    memory_bytes: int | None = None
    author: str | None = None
    force: bool = False

    def __post_init__(self) -> None:
        check_for_robot(self.ranking)
        Budget(self.lanes, self.rounds, deadline_ms=self.deadline_ms)  # checks the values
        if self.threads is not None and (type(self.threads) is not int or self.threads < 1):
            raise ConfigError(f"threads is {self.threads}, must be a number of at least 1, or None")

    @property
    def budget(self) -> Budget:
        """The budget of each frame."""
        return Budget(self.lanes, self.rounds, deadline_ms=self.deadline_ms)

    def lane_threads(self, *, remembers: bool = False, maps: bool = False) -> int:
        """Threads that the lanes share, the caller's included: what the others leave.

        Args:
            remembers: whether the robot writes what it finds.
            maps: whether it maps.

        Raises:
            ConfigError: `threads` is too small for what the robot does.
        """
        others = ["decodes images", "reads the map ahead"]
        others += ["writes"] if remembers or maps else []
        others += ["closes loops"] if maps else []
        if self.threads is None:
            return self.lanes
        if self.threads <= len(others):
            raise ConfigError(
                f"threads is {self.threads}, must be at least {len(others) + 1} for this robot: "
                f"one that localises, and one each that {', '.join(others)}"
            )
        return min(self.lanes, self.threads - len(others))


def load_settings(path: Path | None) -> Settings:
    """Settings from a TOML file; with None the defaults.

    The file may hold tables of the command line's verbs, such as ``merge``; they are left alone.
    """
    settings = Settings() if path is None else _read_settings(path)
    return settings.for_descriptor(None)


def _read_settings(path: Path) -> Settings:
    text = settings_text(path)
    try:
        return load_toml(text, Settings, VERB_TABLES)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def settings_text(path: Path) -> str:
    """The text of a settings file, or of one that ships with the package, by its name."""
    if str(path) in PAPERS and not path.exists():
        return (files("engram.robot") / "papers" / f"{path}.toml").read_text(encoding="utf-8")
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        known = " and ".join(PAPERS)
        raise ConfigError(
            f"{path}: no such settings file; {known} ship with Engram, by these names"
        ) from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read as settings: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read as settings: not UTF-8 text") from error
