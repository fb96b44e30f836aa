"""When a match is a fix: the one page that says it.

1. *Evidence* (`MatchRule`). A match is weighed by itself: its inliers and their spread, where it
   lies relative to the prediction, and how far the robot's position was confirmed before it. By the
   log-odds that it is right it is accepted, waits, or is refused. By the published rule its inliers
   alone decide.
2. *Waiting* (`Hypotheses`). A match of a lost robot that is too weak, or contradicts the estimated
   position, may be right, or two cars parked alike in two streets. Right matches agree with each
   other while the robot drives on: the position of the first, carried on by odometry, predicts that
   of the second. So it waits, later frames attempt the nodes near it, and the next match that
   agrees with it is accepted. Of a robot that found nothing for long, matches must agree one after
   another over a longer distance.
3. *Rivals* (`uncontested`). Refused, where another match of the frame is nearer to the prediction.
4. *Look-alikes* (`engram.localiser.yardstick.Run`). Refused, while the run of matches shows too
   little of what matches usually have here.
5. *Choice* (`best_success`). The surest accepted match of the frame is the fix.
6. *Trial* (`FixChain`). A street repeats, and matches one period off agree with each other for some
   metres. So the fixes since a robot was lost, or since its position was set, are on trial. They
   settle once one of them is sure by itself, or once they have agreed over some distance. A match
   that contradicts them before that withdraws them. If it comes later, the robot was rather carried
   elsewhere. The longer a drive stays disconnected from the map, the more look-alike places it
   passes, some of them alike over tens of metres: fixes that join it must agree over a share of
   that distance, however sure one is.

`Fixes` applies all of it, frame by frame.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Frame
from engram.frontend.frontend import FrontendConfig
from engram.frontend.matching import Match
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import NodeId
from engram.graph.neighbourhood import Neighbourhood
from engram.localiser.acceptance import (
    AcceptanceConfig,
    Prediction,
    Rule,
    Spread,
    accept,
    accept_lost,
    agrees,
    apart,
    determined,
    plausible,
)
from engram.localiser.confidence import Evidence, Record, Standing, confidence_of
from engram.localiser.localisation import Position, ResultSink
from engram.localiser.settings import HypothesesConfig, LocaliserConfig
from engram.localiser.tracking import Track, seen_from
from engram.localiser.yardstick import Likeness, Run, Yardstick, is_measured

if TYPE_CHECKING:
    from engram.localiser.attempts import Attempter, Candidate, Outcome

# Matches of fewer inliers are wrong or useless, and not weighed.
LEAST_WEIGHED = 12


class Verdict(NamedTuple):
    """The judgement of one match by itself.

    Attributes:
        accepted: whether it is a localisation.
        waits: whether it would be one if another frame agreed.
    """

    accepted: bool
    waits: bool
    confidence: float
    evidence: Evidence


class MatchRule:
    """Weighs one match by itself."""

    def __init__(self, acceptance: AcceptanceConfig) -> None:
        self.acceptance = acceptance

    def verdict(
        self, live: Frame, candidate: Candidate, match: Match, spread: Callable[[], Spread]
    ) -> Verdict:
        """The verdict on a match that has a pose; `spread` is computed only where it decides."""
        evidence = self._evidence(live, candidate, match, spread)
        model = confidence_of(live.descriptor)
        anywhere = candidate.prediction is None or candidate.doubted
        readings = (
            model.as_predicted(evidence),
            model.as_anywhere(evidence) if anywhere else -math.inf,
        )
        if self.acceptance.rule is Rule.CONFIDENCE:
            accepted, waits = self._weighed(candidate, match, readings, model.witness)
        else:
            accepted, waits = self._counted(candidate, match, spread)
        return Verdict(accepted, waits, max(readings), evidence)

    def _evidence(
        self, live: Frame, candidate: Candidate, match: Match, spread: Callable[[], Spread]
    ) -> Evidence:
        assert match.reference_from_live is not None
        assert match.covariance is not None
        prediction, acceptance = candidate.prediction, self.acceptance
        pose = match.reference_from_live
        x_m2, y_m2, z_m2 = match.covariance.diagonal()[:3].tolist()
        in_reach = pose.distance_m <= acceptance.reach_m
        unproved = prediction is None or candidate.doubted or not candidate.standing.agreed
        weak = match.inliers < confidence_of(live.descriptor).weak_inliers
        spreads = (in_reach if unproved else weak) and match.inliers >= LEAST_WEIGHED
        return Evidence(
            match.inliers,
            match.inliers / (len(live.landmarks) + live.left_out),
            pose.distance_m,
            math.sqrt(x_m2 + y_m2 + z_m2),
            candidate.standing,
            math.inf if prediction is None else prediction.sigma_m,
            math.inf if prediction is None else apart(pose, prediction, acceptance),
            spread() if spreads else None,
        )

    def _weighed(
        self, candidate: Candidate, match: Match, readings: tuple[float, float], witness: float
    ) -> tuple[bool, bool]:
        """Whether a match is a localisation, and whether it would be one with a second.

        Where the position was only supplied by the caller, a second match may repeat the error of
        the first: it confirms what would also be accepted without that position.
        """
        acceptance, confirmed = self.acceptance, candidate.standing.agreed > 0
        expected = confirmed and candidate.prediction is not None
        fewest = LEAST_WEIGHED if expected else acceptance.min_inliers
        if match.inliers < fewest or not determined(match, acceptance):
            return False, False
        predicted, anywhere = readings
        least = sure = acceptance.min_confidence_lost
        if candidate.lost_long:
            sure = max(acceptance.sure_confidence, least)
        over = anywhere - least
        near = predicted - (
            acceptance.min_confidence if confirmed else acceptance.min_confidence_told
        )
        waits = over >= -witness or (confirmed and near >= -witness)
        return max(anywhere - sure, near) >= 0, waits

    def _counted(
        self, candidate: Candidate, match: Match, spread: Callable[[], Spread]
    ) -> tuple[bool, bool]:
        """The same by the published rule, in inliers."""
        acceptance, prediction = self.acceptance, candidate.prediction
        spread = cache(spread)
        if prediction is not None and accept(match, prediction, acceptance):
            return True, False
        anywhere = prediction is None or candidate.doubted
        return (
            prediction is None and accept_lost(match, spread, acceptance),
            anywhere and plausible(match, spread, acceptance),
        )


@dataclass(slots=True)
class _Hypothesis:
    """A match that waits.

    Attributes:
        agreed_m: distance before it over which others agreed with it.
    """

    position: Position
    driven_m: float = 0.0
    agreed_m: float = 0.0

    def renew(self, position: Position) -> None:
        """Continues from a later match that agrees."""
        self.position = position
        self.agreed_m += self.driven_m
        self.driven_m = 0.0


class Hypotheses:
    """Weak matches that wait for a second one; a `Follower`.

    Args:
        vague_m: standard deviation of a position beyond which agreement with it says nothing.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        search: Callable[[Position], Neighbourhood],
        acceptance: AcceptanceConfig,
        vague_m: float = 1.0,
        config: HypothesesConfig | None = None,
    ) -> None:
        self._graph = graph
        self._search = search
        self._acceptance = acceptance
        self._vague_m = vague_m
        self._config = config or HypothesesConfig()
        self._waiting: list[_Hypothesis] = []

    def forget(self) -> None:
        """Drops all: the robot was found."""
        self._waiting.clear()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """See `Follower`; drops those that became too vague."""
        for one in self._waiting:
            one.position = one.position.carried_on(prev_from_curr, covariance)
            one.driven_m += prev_from_curr.distance_m
        self._waiting = [
            hypothesis
            for hypothesis in self._waiting
            if hypothesis.driven_m <= self._config.forgotten_after_m
            and hypothesis.position.sigma_m <= self._vague_m
        ]

    def nodes_near(self, count: int) -> list[int]:
        """Nodes, by dense index, that could confirm one: `count` for each, nearest first."""
        nodes: list[int] = []
        for hypothesis in reversed(self._waiting):
            near = self._search(hypothesis.position)
            order = np.argsort(near.distance_m, kind="stable")[:count]
            nodes += [node for node in near.nodes[order].tolist() if node not in nodes]
        return nodes

    def judge(self, outcomes: list[Outcome], witness: float = 0.0) -> list[Outcome]:
        """Accepts plausible matches that agree with an earlier one; the others wait.

        Args:
            outcomes: of this frame's attempts; returned unchanged if one is already accepted.
            witness: what agreement adds to the confidence of a match.

        Returns:
            The same outcomes, in their order.
        """
        found = [outcome for outcome in outcomes if outcome.plausible]
        if not found or any(outcome.accepted for outcome in outcomes):
            return outcomes
        expected = [
            (hypothesis, self._predictions(hypothesis.position)) for hypothesis in self._waiting
        ]
        confirmed = []
        for outcome in found:
            agreeing = [one for one, near in expected if self._agree(outcome, near)]
            if any(one.agreed_m + one.driven_m >= self._needed_m(outcome) for one in agreeing):
                confirmed.append(outcome)
            elif not agreeing:
                new = _Hypothesis(outcome.position)
                expected.append((new, self._predictions(new.position)))
                self._waiting = [*self._waiting, new][-self._config.most :]
            for one in agreeing:
                if one.driven_m >= self._config.base_line_m:
                    one.renew(outcome.position)
        return [
            replace(outcome, accepted=True, confidence=outcome.confidence + witness)
            if outcome in confirmed
            else outcome
            for outcome in outcomes
        ]

    def _needed_m(self, outcome: Outcome) -> float:
        config = self._config
        return config.long_base_line_m if outcome.candidate.lost_long else config.base_line_m

    def _predictions(self, position: Position) -> dict[int, Prediction]:
        near = self._search(position)
        return {node: Prediction.of(near, row) for row, node in enumerate(near.nodes.tolist())}

    def _agree(self, outcome: Outcome, predictions: dict[int, Prediction]) -> bool:
        prediction = predictions.get(outcome.candidate.index)
        pose = outcome.match.reference_from_live
        assert pose is not None
        return prediction is not None and agrees(pose, prediction, self._acceptance)


def uncontested(outcomes: Sequence[Outcome], config: AcceptanceConfig) -> list[Outcome]:
    """Outcomes of one frame, of which those stay accepted that no other match contests.

    In rain twenty inliers may agree by chance, a metre off. Often another match of the frame has
    nearly as many, lies elsewhere, and nearer to where odometry puts the robot.
    """
    if len(outcomes) < 2 or not any(outcome.accepted for outcome in outcomes):
        return list(outcomes)
    moved = [_correction(outcome) for outcome in outcomes]

    def contested(at: int) -> bool:
        mine = moved[at]
        return mine is not None and any(
            its is not None
            and rival.match.inliers >= config.rival_share * outcomes[at].match.inliers
            and its.distance_m < mine.distance_m
            and np.linalg.norm(its.translation - mine.translation) > config.slack_m
            for rival, its in zip(outcomes, moved, strict=True)
        )

    return [
        replace(one, accepted=False) if one.accepted and contested(at) else one
        for at, one in enumerate(outcomes)
    ]


def _correction(outcome: Outcome) -> SE3 | None:
    """The measured pose of the live camera in the predicted one; None unless both are known."""
    prediction, measured = outcome.candidate.prediction, outcome.match.reference_from_live
    if prediction is None or measured is None:
        return None
    return prediction.node_from_live.inverse() @ measured


def best_success(outcomes: Sequence[Outcome], rule: Rule) -> Outcome | None:
    """The accepted outcome that is surest, then of the best rank (method §3.2).

    By the published rule that is the one with the most inliers. In rain, of two matches of one
    frame the one with a few more of them is sometimes a metre off.
    """
    successes = [outcome for outcome in outcomes if outcome.accepted]

    def least(outcome: Outcome) -> tuple[float, int]:
        return -(
            outcome.confidence if rule is Rule.CONFIDENCE else outcome.match.inliers
        ), outcome.rank

    return min(successes, key=least, default=None)


# A trial ends this far beyond the distance that settles it: nothing came that could contradict.
_PATIENCE_M = 20.0
# Newest fixes that may be withdrawn, and frames that wait for it: a robot may stand for hours on a
# weak match. Ten seconds at 20 Hz.
MOST_ON_TRIAL = 200


class FixChain:
    """The fixes that agree with each other, on trial until they settle.

    Args:
        sure_confidence: log-odds of one fix by itself that settle the chain.
        settle_after_m: distance between agreeing fixes that settles it, metres.
    """

    def __init__(self, sure_confidence: float, settle_after_m: float) -> None:
        self._limits = sure_confidence, settle_after_m
        self._sure, self._after_m = self._limits
        self._on_trial: deque[int] = deque(maxlen=MOST_ON_TRIAL)
        self._moved_m = 0.0
        self.position: Position | None = None

    @property
    def on_trial(self) -> bool:
        """Whether the newest fixes may still be withdrawn."""
        return bool(self._on_trial)

    def begin(
        self, stamp_ns: int, found: Position, alone: float, joins_after_m: float = 0.0
    ) -> tuple[int, ...]:
        """A fix that agrees with none before it; returns the stamps of those on trial.

        Args:
            stamp_ns: stamp of its frame.
            joins_after_m: distance between agreeing fixes, metres, that joins two parts of a map.
                Where it is longer than what settles any chain, no single fix settles this one.
        """
        self._sure, self._after_m = self._limits
        if joins_after_m > self._after_m:
            self._sure, self._after_m = np.inf, joins_after_m
        before = tuple(self._on_trial)
        self._on_trial.clear()
        self._on_trial.append(stamp_ns)
        self._moved_m, self.position = 0.0, found
        if alone >= self._sure:
            self.settle()
        return before

    def join(self, stamp_ns: int, found: Position, alone: float) -> None:
        """A fix that agrees with those before it; see `begin`."""
        if not self._on_trial:
            return
        self._on_trial.append(stamp_ns)
        self.position = found
        if alone >= self._sure or self._moved_m >= self._after_m:
            self.settle()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """See `Follower`."""
        if self.position is None:
            return
        self.position = self.position.carried_on(prev_from_curr, covariance)
        self._moved_m += prev_from_curr.distance_m
        if self._moved_m > self._after_m + _PATIENCE_M:
            self.settle()

    def settle(self) -> None:
        """The fixes stay, whatever comes."""
        self._on_trial.clear()
        self.position = None


class Fixes:
    """Decides which matches of one drive are fixes, and which earlier ones are withdrawn.

    Args:
        graph: the experience graph; it may grow.
        track: the position of the robot; follows the fixes.
        frontend: settings of the robot's front-end.

    Attributes:
        standing: of the position, when the frame began.
        contradicted: whether a caller-supplied position contradicts the robot's own, and no fix
            has confirmed it yet.
        withdraws: stamps of the fixes that the frame's fix contradicts, ns.
        yardstick: what matches with the nodes of the map usually have.
        lookalike: the last frame's best match, if its run may be one of look-alikes.
    """

    def __init__(
        self,
        graph: ExperienceGraph,
        track: Track,
        search: Callable[[Position], Neighbourhood],
        attempter: Attempter,
        config: LocaliserConfig,
        frontend: FrontendConfig,
    ) -> None:
        self._graph = graph
        self._track = track
        self._attempter = attempter
        self._config = config
        acceptance = config.acceptance
        self._accepted = acceptance
        self._record = Record()
        self._chain = FixChain(acceptance.sure_confidence, acceptance.settle_after_m)
        self._run = Run(config.lookalikes)
        self._hypotheses = Hypotheses(
            graph, search, acceptance, config.followed_gap_m, config.hypotheses
        )
        self.yardstick = Yardstick(graph, attempter.frame, config.matcher, frontend)
        self.standing = Standing()
        self.contradicted = False
        self.withdraws: tuple[int, ...] = ()
        self.lookalike: Outcome | None = None
        self._told = False

    @property
    def on_trial(self) -> bool:
        """Whether the last fixes may still be withdrawn: no edge should rest on them yet."""
        return self._chain.on_trial or not self._run.proved

    @property
    def told(self) -> bool:
        """Whether the position was supplied, and no fix and no saved node confirm it yet."""
        return self._told

    @property
    def doubted(self) -> bool:
        """Whether the position may well be wrong: unconfirmed, or expected fixes are missing."""
        after = self._accepted.doubt_after
        return after > 0 and (self._told or self.standing.missed >= after)

    def begin_frame(self, tracked: int) -> None:
        """Begins a frame, with the landmarks that odometry tracked; nothing is withdrawn yet."""
        self._record.begin_frame(tracked)
        self.standing, self.withdraws = self._record.standing, ()

    def carry_on(self, prev_from_curr: SE3, covariance: NDArray[np.float64]) -> None:
        """See `Follower`: carries on what waits, and the fixes on trial."""
        self._hypotheses.carry_on(prev_from_curr, covariance)
        self._chain.carry_on(prev_from_curr, covariance)

    def nodes_to_confirm(self, count: int) -> list[int]:
        """Nodes, by dense index, whose match would confirm one that waits: `count` for each."""
        return self._hypotheses.nodes_near(count)

    def forget_waiting(self) -> None:
        """Drops the matches that wait: the robot was found or carried elsewhere."""
        self._hypotheses.forget()

    def forget(self, agreed: int = 0, *, contradicted: bool = False) -> None:
        """The position is another, confirmed by so many fixes; those before it stay."""
        self.contradicted = contradicted and (self.contradicted or not self._told)
        self._told = not agreed
        self._record.forget(agreed)
        self._chain.settle()
        if agreed:
            self._run.measured()
        else:
            self._run.begin()

    def settled(self) -> None:
        """The live frame was saved as a node, which is the position from now on."""
        self._told = False
        self._record.settled()

    def missed(self) -> None:
        """A frame with predicted candidates had no match."""
        self._record.missed()

    def judged(
        self, live: Frame, live_id: NodeId, driven_m: float, outcomes: list[Outcome]
    ) -> list[Outcome]:
        """The outcomes of one frame, with those accepted that may be its fix.

        Args:
            live: the live frame.
            driven_m: odometry distance from the session's start, metres.
        """
        if self._accepted.rule is Rule.INLIERS:
            return self._hypotheses.judge(outcomes, 0.0)
        confirms = confidence_of(live.descriptor).witness
        outcomes = uncontested(self._hypotheses.judge(outcomes, confirms), self._accepted)
        best, self.lookalike = best_success(outcomes, self._accepted.rule), None
        if best is None or not (self._config.lookalikes.doubt > 0 and is_measured(live.descriptor)):
            return outcomes
        predicted = best.evidence is not None and math.isfinite(best.evidence.apart)
        if self._run.believed and not predicted:
            self._run.begin()
        if self._run.due(driven_m):
            likeness = self._likeness(live, live_id, best)
            if likeness is not None:
                self._run.add(likeness.alike(), driven_m)
        if self._run.believed:
            return outcomes
        self.lookalike = best
        return [
            replace(outcome, accepted=False) if outcome.accepted else outcome
            for outcome in outcomes
        ]

    def _likeness(self, live: Frame, live_id: NodeId, outcome: Outcome) -> Likeness | None:
        """What the match shows; None if its node's drive saved no neighbour of the node."""
        usual = self.yardstick.usual(outcome.candidate.index)
        reference = self._attempter.frame(outcome.candidate.node)
        if usual is None or reference is None:
            return None
        match = self._attempter.with_rows(live, live_id, outcome)
        if not len(match.live_rows):
            return None
        return Likeness.of(match, reference, live, usual)

    def fix(self, live: Frame, success: Outcome, result_sink: ResultSink) -> None:
        """Sets the position to that of a match, and checks it against earlier fixes.

        Of two that contradict, the weaker is withdrawn.

        Args:
            live: the live frame.
            result_sink: has the distance driven since the nodes being saved lost their connection
                to the map: a fix that nothing predicts reconnects them.
        """
        evidence, position, accepted = success.evidence, success.position, self._accepted
        assert evidence is not None
        predicted, certain = math.isfinite(evidence.apart), self._track.certain
        model = confidence_of(live.descriptor)
        before = self._chain.position or self._track.measured
        fits = True if predicted else self._agrees(position, before if certain else None)
        share_m = 0.0 if fits else accepted.join_share * result_sink.alone_m()
        joins_after_m = min(share_m, accepted.join_after_m)
        joins = joins_after_m > accepted.settle_after_m
        alone = model.alone(evidence)
        if fits is False or joins or not self.standing.agreed:
            withdraws = self._chain.begin(live.stamp_ns, position, alone, joins_after_m)
            self.withdraws = withdraws if fits is False else ()
        else:
            self._chain.join(live.stamp_ns, position, alone)
        self._told = self.contradicted = False
        # A robot that meets a node where it was saved has more inliers than elsewhere.
        inliers, usual = success.match.inliers, self.yardstick.usual(success.candidate.index)
        self._record.fixed(
            inliers if usual is None else min(inliers, usual.inliers), agrees=fits is True
        )
        weak = success.match.inliers < model.weak_inliers
        self._track.fix(position, leans=weak and certain and predicted and self.standing.agreed > 0)
        self._hypotheses.forget()

    def _agrees(self, found: Position, before: Position | None) -> bool | None:
        """Whether a match that nothing predicted agrees with a position; None if unknown."""
        if before is None:
            return None
        there = seen_from(self._graph, found.node, before)
        if there is None:
            return None
        sigma_rad = float(np.sqrt(there.covariance[4, 4]))
        prediction = Prediction(there.node_from_live, there.sigma_m, sigma_rad)
        return agrees(found.node_from_live, prediction, self._accepted)
