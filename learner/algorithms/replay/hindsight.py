"""Hindsight experience replay (Andrychowicz et al. 2017): learn from a row as if an outcome reached later were its goal.

Law: a row shows what an action did, whatever the goal was. When a row is drawn, its goal may therefore be replaced with one
that was achieved later in its episode, provided that the row's reward and end are recomputed for this goal. The learner runs
no environment code, so reward and end must be functions of only the achieved and the desired goal, and the user names these
functions. Each row that arrives is checked against them.

As in gymnasium-robotics, a row's reward and end depend on the achieved and the desired goal in its next observation. This
module is pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from millrace.learner.config.hyperparameters import AlgorithmConfig, OffPolicyConfig
from millrace.protocol.arrays import Array, Bools, Doubles, Floats, Ints
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError
from millrace.protocol.own_module import own_callable, own_code_failed
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import Leaf

ACHIEVED = "achieved_goal"
DESIRED = "desired_goal"
"""The keys of the goals in the observation, as in gymnasium-robotics."""
FLOAT32_ROUNDOFF = 2.0**-24
EXAMPLE = "sparse:0.05"


class GoalReward(Protocol):
    """A reward function that depends only on two goals."""

    def __call__(self, achieved: Doubles, desired: Doubles, /) -> Array:
        """The rewards [B] for rows that achieved the goals `achieved` [B, G] while the goals were `desired` [B, G]."""
        ...


class Goals(NamedTuple):
    """Replacement goals for some of the sampled rows."""

    rows: Ints
    """[K] the indices of these rows in the sample"""
    goal: Array
    """[K, *goal] the goals, in the form in which observations hold them"""


class Outcome(NamedTuple):
    """The rewards and ends of some steps under other goals."""

    reward: Floats
    """[K]"""
    terminated: Bools
    """[K]"""


def distance(achieved: Doubles, desired: Doubles) -> Doubles:
    """The Euclidean distances [B] between goals [B, G]."""
    apart: Doubles = np.linalg.norm(achieved - desired, axis=-1)
    return apart


def minus_distance(achieved: Doubles, desired: Doubles) -> Doubles:
    """The reward function that the name `dense` stands for."""
    return -distance(achieved, desired)


@dataclass(frozen=True)
class WithinDistance:
    """A reward such as `sparse:0.05` or `success:0.45`: one value within a distance of the goal, another beyond it."""

    within: float
    reward: float
    beyond: float

    def __call__(self, achieved: Doubles, desired: Doubles, /) -> Doubles:
        """See `GoalReward`."""
        return np.where(distance(achieved, desired) <= self.within, self.reward, self.beyond)


def goal_reward(name: str) -> GoalReward:
    """The reward function that `--goal-reward` names. Raises `UsageError`, with a one-line message, if there is none."""
    if name == "dense":
        return minus_distance
    kind, _, number = name.partition(":")
    if kind in ("sparse", "success"):
        try:
            within = float(number)
        except ValueError:
            pass  # the user's own module may have this name
        else:
            if not 0 <= within < math.inf:
                raise UsageError(f"goal_reward {name}: expected a distance of at least 0, got {number}")
            return WithinDistance(within, 0, -1) if kind == "sparse" else WithinDistance(within, 1, 0)
    expected = "sparse:DISTANCE, success:DISTANCE, dense or module:function"
    if ":" not in name:
        raise UsageError(f"goal_reward {name}: expected {expected}, as in {EXAMPLE}")
    return own_callable(name, f"goal_reward {name}", f"{EXAMPLE} or mine:reward")


def goals_of(observation: Sequence[Leaf]) -> tuple[int, int] | None:
    """The indices of the leaves with the achieved and desired goals; None unless both exist and share shape and dtype."""
    paths = [leaf.path for leaf in observation]
    if ACHIEVED not in paths or DESIRED not in paths:
        return None
    achieved = paths.index(ACHIEVED)
    desired = paths.index(DESIRED)
    forms = [(observation[leaf].shape, observation[leaf].dtype) for leaf in (achieved, desired)]
    return (achieved, desired) if forms[0] == forms[1] else None


def goals_not_used(config: AlgorithmConfig, observation: Sequence[Leaf], env: str) -> str:
    """A line for the user if the observations have goals but the run doesn't use hindsight; otherwise empty."""
    if not isinstance(config, OffPolicyConfig) or config.hindsight or goals_of(observation) is None:
        return ""
    return (
        f"{env} shows an achieved and a desired goal: if its reward is sparse, --hindsight 0.8 --goal-reward {EXAMPLE} "
        "learns from goals that were reached by chance; see 'Goals' in docs/how-to/algorithms.md"
    )


@dataclass(frozen=True)
class Hindsight:
    """The settings of hindsight: how many rows in a sample get another goal, and how their outcome is then computed."""

    share: float
    """the fraction of the rows in a sample that get another goal"""
    achieved: int
    """the leaf of the observation that holds the achieved goal"""
    desired: int
    """the leaf that holds the desired goal"""
    name: str
    """the name of the reward function in the settings"""
    reward_of: GoalReward
    ends_within: float | None
    """the distance from the goal at which the episode terminates; None if reaching the goal doesn't end it"""
    roundoff: float
    """the largest relative rounding error of a goal's numbers in observations"""

    @classmethod
    def of(cls, config: OffPolicyConfig, observation: Sequence[Leaf]) -> Hindsight | None:
        """The hindsight that the settings ask for; None if it is off.

        Raises `UsageError`, with a one-line message, if the run can't use it.
        """
        if not config.hindsight:
            return None
        given = f"hindsight {config.hindsight:g}"
        if config.core is not None:
            raise UsageError(f"{given}: expected core none, because whole sequences are drawn as they were; drop --core")
        goals = goals_of(observation)
        if goals is None:
            got = ", ".join(f"{leaf.path or 'one array'} {leaf.dtype}{list(leaf.shape)}" for leaf in observation)
            raise UsageError(
                f"{given}: expected a Dict observation with {ACHIEVED} and {DESIRED}, of one shape and dtype, got "
                f"{one_line(got)}; take --hindsight 0, or a wrapper that gives the two"
            )
        if config.goal_reward is None:
            raise UsageError(f"{given}: expected the reward of a goal, got none; name it, as in --goal-reward {EXAMPLE}")
        achieved, desired = goals
        dtype = np.dtype(observation[achieved].dtype)
        own_roundoff = float(np.finfo(dtype).eps) / 2 if dtype.kind == "f" else 0.0
        return cls(
            share=config.hindsight,
            achieved=achieved,
            desired=desired,
            name=config.goal_reward,
            reward_of=goal_reward(config.goal_reward),
            ends_within=config.goal_ends,
            # Rewards are sent as float32, and the environment may compute them in float32.
            roundoff=max(FLOAT32_ROUNDOFF, own_roundoff),
        )

    # ---------------------------------------------------------------- under another goal

    def outcome(self, achieved: Array, desired: Array, terminated: Bools, goal: Array) -> Outcome:
        """Rewards and terminations [K] of steps whose goals are replaced by `goal` [K, *goal].

        The steps reached `achieved`, their original goals were `desired`, and `terminated` [K] says which of them terminated
        their episode. A termination is dropped if reaching the original goal caused it; otherwise, it is kept.
        """
        led_to = _flat(achieved)
        wanted = _flat(goal)
        reward = self.rewards(led_to, wanted).astype(np.float32)
        if self.ends_within is None:
            return Outcome(reward, terminated)
        by_goal = distance(led_to, _flat(desired)) <= self.ends_within
        return Outcome(reward, (terminated & ~by_goal) | (distance(led_to, wanted) <= self.ends_within))

    def rewards(self, achieved: Doubles, desired: Doubles) -> Doubles:
        """The rewards [B] for goals [B, G]. Raises `UsageError` if the user's function fails or returns something else."""
        what = f"goal_reward {self.name}"
        try:
            found = self.reward_of(achieved, desired)
        except (Exception, SystemExit) as error:
            raise own_code_failed(what, error) from error
        expected = f"expected an array of {len(achieved)} numbers for goals {list(achieved.shape)}"
        if not isinstance(found, np.ndarray):
            raise UsageError(f"{what}: {expected}, got {type(found).__name__}")
        if found.shape != (len(achieved),) or found.dtype.kind not in "biuf":
            raise UsageError(f"{what}: {expected}, got {found.dtype}{list(found.shape)}")
        return found.astype(np.float64)

    # ---------------------------------------------------------------- the check of what arrives

    def check(self, batch: Batch) -> None:
        """Raise `UsageError`, with a one-line message, unless rewards and ends of all valid rows agree with their goals.

        Goals may have been rounded after the reward was computed, and the reward was rounded to float32. The reward is
        therefore computed for three pairs of goals: for the pair as it arrived, and for the closest and the most distant
        pair that may have been rounded to it. A row is right if its reward lies between the lowest and the highest of these
        three rewards. If the reward is a function of the distance between the goals, these bounds are exact.
        """
        valid = batch.valid
        achieved = _flat(batch.obs[self.achieved][1:][valid])
        desired = _flat(batch.obs[self.desired][1:][valid])
        got = batch.reward[valid].astype(np.float64) + 0.0  # adding 0 lets errors show -0 as 0
        if not len(got):
            return
        expected = self.rewards(achieved, desired)
        near, far = self._moved(achieved, desired)
        low = expected
        high = expected
        if not np.array_equal(expected, got):
            others = [self.rewards(moved, desired) for moved in (near, far)]
            low = np.minimum.reduce([expected, *others])
            high = np.maximum.reduce([expected, *others])
        single = np.finfo(np.float32)
        rounding = float(single.eps) * np.maximum(abs(low), abs(high)) + float(single.tiny)
        right = (low - rounding <= got) & (got <= high + rounding)
        if not right.all():
            i = int(np.flatnonzero(~right)[0])
            raise UsageError(
                f"goal_reward {self.name}: {_place(batch, i)}: expected {expected[i]:g} for "
                f"{_goals_in_words(achieved[i], desired[i])}, got {got[i]:g} from the environment; name the function that "
                "it computes rewards with, and leave out wrappers that change them"
            )
        self._check_ends(batch, batch.terminated[valid], achieved, desired, far)

    def _check_ends(self, batch: Batch, terminated: Bools, achieved: Doubles, desired: Doubles, far: Doubles) -> None:
        """Raise `UsageError` unless episodes terminate at their goal if and only if `goal_ends` says so.

        Episodes may terminate elsewhere, too. Therefore, they count as terminating at their goal only if all rows whose
        rewards say that the goal is reached terminate.
        """
        ends_within = -1.0 if self.ends_within is None else self.ends_within
        given = "goal_ends none" if self.ends_within is None else f"goal_ends {ends_within:g}"
        goes_on = (distance(far, desired) <= ends_within) & ~terminated
        if goes_on.any():
            i = int(np.flatnonzero(goes_on)[0])
            raise UsageError(
                f"{given}: {_place(batch, i)}: expected that the task ends at {_goals_in_words(achieved[i], desired[i])}, "
                "got a row that goes on; take the distance at which it ends, or --goal-ends none"
            )
        if isinstance(self.reward_of, WithinDistance):
            apart = distance(achieved, desired)
            reached = (apart <= self.reward_of.within) & (apart > ends_within)
            if reached.any() and terminated[reached].all():
                i = int(np.flatnonzero(reached)[0])
                raise UsageError(
                    f"{given}: {_place(batch, i)}: expected that the task goes on at "
                    f"{_goals_in_words(achieved[i], desired[i])}, got its end; take --goal-ends "
                    f"{self.reward_of.within:g} if it ends at its goal, else a --goal-reward of your own"
                )

    def _moved(self, achieved: Doubles, desired: Doubles) -> tuple[Doubles, Doubles]:
        """The achieved goals, moved as near to the desired ones and as far from them as they may have been before rounding.

        Each number in a goal was rounded once, and a norm of G numbers has a relative error of G/2 + 2 roundoffs.
        """
        apart = achieved - desired
        most = (achieved.shape[1] / 2 + 3) * self.roundoff * (abs(achieved) + abs(desired))
        sign = np.where(apart < 0, -1, 1)
        near = desired + sign * np.maximum(abs(apart) - most, 0)
        far = desired + sign * (abs(apart) + most)
        return near, far


def _flat(goals: Array) -> Doubles:
    """Flatten goals [B, *goal] to [B, G] float64."""
    return goals.reshape(len(goals), math.prod(goals.shape[1:])).astype(np.float64)


def _place(batch: Batch, index: int) -> str:
    """Describe where the valid row with this index is in a batch, for an error message."""
    step, column = np.argwhere(batch.valid)[index].tolist()
    return f"lane {batch.lane[column]}, column {column % batch.columns_per_rollout}, step {step} of its rollout"


def _goals_in_words(achieved: Doubles, desired: Doubles) -> str:
    def shown(goal: Any) -> str:
        return one_line(np.array2string(goal, precision=6, threshold=8, max_line_width=1000), 100)

    apart = float(distance(achieved, desired))
    return f"the achieved goal {shown(achieved)} at a distance of {apart:g} from the desired one {shown(desired)}"
