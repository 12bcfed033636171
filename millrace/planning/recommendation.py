"""Recommends settings for a measured environment, with reasons: algorithm, env copies, workers, lanes and lag. Pure.

Rule: among all sizes whose expected env steps/s are at least `AS_GOOD` times the best, choose those with the least lag, then
the fewest env copies, then the fewest workers. These are the rules of docs/how-to/algorithms.md and
docs/how-to/slow_environments.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import msgspec

from millrace.learner.config.update_size import rollout_with
from millrace.learner.members.failure_count import WORK_S
from millrace.planning.expected_rate import Situation, Sizes
from millrace.planning.in_words import counted, number_in_words, time_in_words
from millrace.planning.measurements import WORKER_BYTES, Machine, Measurements

AS_GOOD = 0.95
SLOW_S = 0.003  # if a step takes longer, divided by the copies at once, an algorithm with a replay buffer ends sooner
SLOW_WITH_IMAGES_S = 0.05  # the limit if actions are continuous and observations are images
MOST_ENVS = 64  # if a step computes rather than waits, more env copies gain little
UNEVEN = 3.0  # steps are uneven if the 95th percentile of the step time is above this multiple of the median
LEARNER_BYTES = 500 << 20
TRANSITION_BYTES = 24  # memory of a transition in addition to its observation
REPLAY_SIZES = (1_000_000, 500_000, 200_000, 100_000, 50_000, 20_000, 10_000)
OF_MEMORY = 0.8  # share of the free memory that a run may use
OF_MEMORY_FOR_REPLAY = 0.4  # share of the free memory that the replay buffer may use
LAGS = (0, 1, 2)
NOTABLE_S = 10.0  # if the env steps before the first update take longer, a plan says so
OUTSIDE_S = 1e-3  # a step that takes longer may be that of a program outside of the worker, which may hang
STEP_TIMEOUTS_S = (30, 60, 120, 300)
SLOWEST_STEPS = 100  # a step timeout is at least this many times the slowest measured step
OFTENER = 2.0  # failures may become this many times as frequent as they were
LEAST_BETWEEN_S = 1.0  # if failures are more frequent, no setting helps
STARTS = 10  # and at least this many times a start or a reset, because some environments restart their simulator in a step
NEEDED_STEPS = {"xqc": 100_000, "rainbow": 100_000, "sac": 300_000, "ppo": 1_000_000}
"""About how many env steps tasks such as MuJoCo's took with each algorithm. Other tasks may take more or fewer."""


class ChosenSetting(msgspec.Struct, frozen=True):
    """A setting of `millrace train`, with the recommended value and the reason for it."""

    name: str
    value: int | str
    why: str


Rate = Callable[[Sizes, Situation], float]
"""The env steps/s to expect of these sizes."""


class Limit(NamedTuple):
    """An upper limit, and the reason for it."""

    number: int
    why: str


class Learning(NamedTuple):
    """How a run with the chosen algorithm is usually set up."""

    envs: int
    """the usual number of env copies"""
    rollout_steps: int
    """the usual number of steps in a rollout, with this number of copies"""
    least_steps: int = 1
    """the smallest number of steps in a rollout from which the algorithm learns well"""
    acting_bytes: int = 0
    """additional memory that a worker needs to act with the policy"""

    @property
    def rows_of_update(self) -> int:
        """The usual number of env steps between two updates."""
        return self.envs * self.rollout_steps

    def steps(self, envs: int) -> int:
        """The number of steps in a rollout with this number of env copies: as many as leave the size of updates as usual."""
        return rollout_with(envs, self.rows_of_update, self.least_steps)


def copies_at_once(measured: Measurements, machine: Machine, acting_bytes: int = 0) -> Limit:
    """How many env copies can be stepped at the same time on this machine."""
    limits: list[Limit] = []
    if machine.most_copies:
        limits.append(Limit(machine.most_copies, _at_most(machine)))
    if machine.free_bytes is not None:
        size = max(measured.worker_bytes, WORKER_BYTES) + acting_bytes
        fit = max(1, int((OF_MEMORY * machine.free_bytes - LEARNER_BYTES) / size))
        limits.append(
            Limit(fit, f"a worker with a copy takes {size / 2**20:,.0f} MB, and no more of them fit into the memory")
        )
    if measured.alone.computes:
        are = "are" if machine.cores > 1 else "is"
        limits.append(Limit(machine.cores, f"a step computes, and there {are} {counted(machine.cores, 'core')}"))
    else:
        limits.append(_tried(measured))
    return min(limits, key=lambda limit: limit.number)


def _tried(measured: Measurements) -> Limit:
    """How many env copies were stepped side by side, and why no more."""
    tried = measured.side_by_side[-1]
    number = tried.workers
    why = {
        "": "so many were tried side by side" if number > 1 else "the licences or the memory allowed no others side by side",
        "time": "the time was up before more of them could be tried side by side",
        "no faster": "more of them were tried side by side, and were hardly faster",
        "failed": "more of them did not work side by side",
    }[measured.no_more]
    faster = tried.steps_per_s / measured.alone.steps_per_s
    return Limit(number, f"{why}; {number} made {faster:.1f} times the env steps of one" if number > 1 else why)


def _at_most(machine: Machine) -> str:
    return f"at most {counted(machine.most_copies, 'copy', 'copies')} may train here"


# ------------------------------------------------------------------------------------------------------------ the algorithm


def choose_algorithm(measured: Measurements, machine: Machine) -> ChosenSetting:
    """Choose the algorithm by the three questions in docs/how-to/algorithms.md."""
    at_once = copies_at_once(measured, machine).number
    slow_s = SLOW_WITH_IMAGES_S if measured.images and measured.action == "box" else SLOW_S
    each_s = measured.step_with_reset_s / at_once
    takes = (
        f"a step takes {time_in_words(measured.step_with_reset_s)} with its share of a reset, and "
        f"{counted(at_once, 'copy', 'copies')} can run at once: {time_in_words(each_s)} for each env step"
    )
    if each_s <= slow_s:
        return ChosenSetting(
            "algo", "ppo", f"{takes}; below {time_in_words(slow_s)}, PPO is done sooner, although it takes more of them"
        )
    if measured.agents > 1:
        why = "but the settings of algorithms with a replay buffer were not measured with several"
        return ChosenSetting("algo", "ppo", f"{takes}; it has {measured.agents} agents, {why}")
    match measured.action:
        case "box":
            algo = "sac" if measured.images else "xqc"
            actions = "continuous"
        case "discrete":
            algo = "rainbow"
            actions = "discrete"
        case "other":
            return ChosenSetting("algo", "ppo", "only algorithms without a replay buffer take such actions")
    why = f"{takes}; above {time_in_words(slow_s)}, the algorithm is done first that takes the fewest; actions are {actions}"
    return ChosenSetting("algo", algo, why)


def about_first_steps(algo: str, learning_starts: int, steps_per_s: float) -> str:
    """A line about the env steps before the first update, if they take long; otherwise empty.

    `steps_per_s`: the env steps/s as long as there are no updates.
    """
    seconds = learning_starts / steps_per_s
    if seconds < NOTABLE_S:
        return ""
    return (
        f"{algo} begins to learn after {learning_starts:,} env steps (learning_starts): until then, for about "
        f"{time_in_words(seconds)}, actions are random, so returns don't improve"
    )


def choose_replay_size(default: int, measured: Measurements, machine: Machine) -> ChosenSetting | None:
    """A smaller replay buffer, if a buffer of `default` transitions would need too much memory; otherwise None."""
    if machine.free_bytes is None:
        return None
    of_one = measured.observation_bytes + TRANSITION_BYTES
    room = OF_MEMORY_FOR_REPLAY * machine.free_bytes
    if default * of_one <= room:
        return None
    size = next((size for size in REPLAY_SIZES if size < default and size * of_one <= room), REPLAY_SIZES[-1])
    why = f"a transition takes {of_one:,} bytes, so {default:,} of them would take {default * of_one / 2**30:,.1f} GB"
    return ChosenSetting("replay_size", size, why)


def choose_step_timeout(default_s: float, measured: Measurements) -> ChosenSetting | None:
    """A shorter step timeout, if steps are so much faster than the default that one which hangs would waste time."""
    if measured.alone.mean_s < OUTSIDE_S:
        return None
    least_s = max(SLOWEST_STEPS * measured.slowest_step_s, STARTS * max(measured.start_s, measured.reset_s))
    timeout_s = next((each for each in STEP_TIMEOUTS_S if each >= least_s), None)
    if timeout_s is None or timeout_s > default_s / 2:
        return None
    why = (
        f"the slowest measured step took {time_in_words(measured.slowest_step_s)}; if a step hangs, its worker is restarted "
        f"after {timeout_s} s instead of {default_s:g} s"
    )
    return ChosenSetting("step_timeout_s", timeout_s, why)


def choose_max_env_failures(default: int, measured: Measurements) -> ChosenSetting | None:
    """A larger number of failures that a run survives, if the environment failed so often that the default (at least 1)
    might end a run.
    """
    if not measured.failures:
        return None
    between_s = measured.calls_s / measured.failures
    needed = math.ceil(OFTENER * WORK_S / max(between_s, LEAST_BETWEEN_S))
    if needed <= default or between_s < LEAST_BETWEEN_S:
        return None
    why = (
        f"a copy failed about once in {time_in_words(between_s)} of steps and resets; {default} allows a failure in "
        f"{time_in_words(WORK_S / default)}, and {needed} in {time_in_words(WORK_S / needed)}"
    )
    return ChosenSetting("max_env_failures", needed, why)


# ---------------------------------------------------------------------------------------------------------------- the sizes


def candidates(learning: Learning, measured: Measurements, machine: Machine) -> Iterator[Sizes]:
    """All sizes of a run to choose from."""
    at_once = copies_at_once(measured, machine, learning.acting_bytes).number
    for envs in _numbers_of_envs(measured, machine, learning, at_once):
        # Workers that wait only take memory. They are worth it even if updates are the limit: updates begin only after many
        # env steps if there is a replay buffer, and if a copy hangs or crashes, no other copy is in its worker.
        numbers = {envs} if measured.best_apart else {1, min(at_once, envs)}
        for workers in sorted(numbers):
            for lanes in sorted({_lanes_for(workers, envs), envs}):
                for lag in LAGS:
                    yield Sizes(workers=workers, envs=envs, lanes=lanes, max_lag=lag, rollout_steps=learning.steps(envs))


def _lanes_for(workers: int, envs: int) -> int:
    """The smallest number of lanes that divides `envs` and is a multiple of `workers`; `envs` if there is none."""
    return next((lanes for lanes in range(workers, envs + 1, workers) if envs % lanes == 0), envs)


def _numbers_of_envs(measured: Measurements, machine: Machine, learning: Learning, at_once: int) -> list[int]:
    """The numbers of env copies to consider, ascending."""
    if measured.best_apart:
        return sorted({min(learning.envs * 2**n, at_once) for n in range(at_once.bit_length() + 1)})
    most = _most_envs(measured, machine, learning, at_once).number
    least = _least_envs(machine, learning)
    return sorted({min(least * 2**n, most) for n in range(most.bit_length() + 1)})


def _least_envs(machine: Machine, learning: Learning) -> int:
    """The usual number of env copies, rounded up to a multiple of the number of cores."""
    return -(-learning.envs // machine.cores) * machine.cores


def _most_envs(measured: Measurements, machine: Machine, learning: Learning, at_once: int) -> Limit:
    """The largest number of env copies to consider if a worker may have several."""
    if machine.most_copies:
        most = Limit(machine.most_copies, _at_most(machine))
    else:
        number = max(MOST_ENVS, learning.envs)
        most = Limit(number, f"a plan recommends at most {number} copies of an environment that computes")
    if machine.free_bytes is None:
        return most
    of_workers = LEARNER_BYTES + at_once * (WORKER_BYTES + learning.acting_bytes)
    fit = max(1, int((OF_MEMORY * machine.free_bytes - of_workers) / measured.copy_bytes))
    why = f"a copy takes {measured.copy_bytes / 2**20:,.0f} MB, and no more of them fit into the memory"
    return min(most, Limit(fit, why), key=lambda limit: limit.number)


def best(rates: Mapping[Sizes, float]) -> Sizes:
    """Choose sizes by the rule at the top of this file. `rates`: the expected env steps/s of each candidate."""
    enough = AS_GOOD * max(rates.values())
    good = [sizes for sizes, rate in rates.items() if rate >= enough]
    return min(good, key=lambda sizes: (sizes.max_lag, sizes.envs, sizes.workers, -sizes.lanes))


def on_machines(sizes: Sizes, machines: int, learning: Learning) -> Sizes:
    """The sizes of a run in which each of `machines` machines has these sizes."""
    envs = sizes.envs * machines
    return Sizes(
        workers=sizes.workers * machines,
        envs=envs,
        lanes=sizes.lanes * machines,
        max_lag=sizes.max_lag,
        rollout_steps=learning.steps(envs),
    )


# -------------------------------------------------------------------------------------------------------------- the reasons


def reasons(sizes: Sizes, learning: Learning, situation: Situation, rate: Rate) -> tuple[ChosenSetting, ...]:
    """The sizes as settings, with the reason for each."""
    return (
        ChosenSetting("workers", sizes.workers, _why_workers(sizes, learning, situation, rate)),
        ChosenSetting("envs", sizes.envs, _why_envs(sizes, learning, situation, rate)),
        ChosenSetting("lanes", sizes.lanes, _why_lanes(sizes, situation.measured)),
        ChosenSetting("max_lag", sizes.max_lag, _why_lag(sizes, situation, rate)),
    )


def why_rollout_steps(sizes: Sizes, learning: Learning) -> str:
    """Why a rollout has other than the usual number of steps."""
    updated = f"the policy is updated after {counted(sizes.steps_per_round, 'env step')}"
    if sizes.steps_per_round <= learning.rows_of_update:
        return f"{updated}, as with {counted(learning.envs, 'env copy', 'env copies')} and the usual rollouts"
    if sizes.rollout_steps == 1:
        return f"{updated}, one of each copy"
    return f"{updated}; with shorter rollouts, advantages would depend more on the critic"


def _why_workers(sizes: Sizes, learning: Learning, situation: Situation, rate: Rate) -> str:
    measured = situation.measured
    share = min(measured.alone.cpu_share, 1.0)
    if measured.failed_in_one_worker:
        return "several copies in one worker did not work, so each copy has a worker of its own"
    if not measured.alone.computes:
        return f"a step waits for {1 - share:.0%} of its time, so each copy waits in a worker of its own"
    if sizes.workers == situation.machine.cores:
        return f"a step computes for {share:.0%} of its time, so there is one for each core"
    if sizes.workers == sizes.envs:
        return f"a step computes for {share:.0%} of its time, so each copy has a worker of its own"
    at_once = copies_at_once(measured, situation.machine, learning.acting_bytes)
    if sizes.workers == at_once.number:
        return at_once.why
    workers = min(at_once.number, sizes.envs)
    return _hardly_faster(sizes, msgspec.structs.replace(sizes, workers=workers, lanes=sizes.envs), situation, rate)


def _why_envs(sizes: Sizes, learning: Learning, situation: Situation, rate: Rate) -> str:
    measured = situation.measured
    machine = situation.machine
    at_once = copies_at_once(measured, machine, learning.acting_bytes)
    if sizes.envs == machine.most_copies:
        return _at_most(machine)
    if measured.best_apart:
        if sizes.envs == at_once.number:
            return at_once.why
        return _hardly_faster(sizes, _apart(at_once.number, sizes, learning), situation, rate)
    least = _least_envs(machine, learning)
    if sizes.envs > least:
        fewest = msgspec.structs.replace(sizes, envs=least, rollout_steps=learning.steps(least))
        in_lanes = [msgspec.structs.replace(fewest, lanes=n) for n in (_lanes_for(sizes.workers, least), least)]
        fewer = number_in_words(max(rate(each, situation) for each in in_lanes))
        here = number_in_words(rate(sizes, situation))
        return f"a worker steps several copies at a time; with {least}, {fewer} env steps/s in place of {here} are expected"
    most = _most_envs(measured, machine, learning, at_once.number)
    if sizes.envs == most.number < least:
        return most.why
    if sizes.envs > learning.envs:
        return f"the usual number, {learning.envs}, rounded up to a multiple of the {counted(machine.cores, 'core')}"
    return "the usual number"


def _apart(envs: int, sizes: Sizes, learning: Learning) -> Sizes:
    """The sizes with another number of env copies, each in a worker and a lane of its own."""
    steps = learning.steps(envs)
    return msgspec.structs.replace(sizes, workers=envs, envs=envs, lanes=envs, rollout_steps=steps)


def _hardly_faster(sizes: Sizes, more: Sizes, situation: Situation, rate: Rate) -> str:
    """Why the larger sizes `more` weren't chosen. Updates or cores are the reason if `more` would be faster without it."""
    without = {
        "because of the updates": msgspec.structs.replace(
            situation, overheads=msgspec.structs.replace(situation.overheads, update_s=0.0)
        ),
        "because the cores are busy": msgspec.structs.replace(
            situation, machine=msgspec.structs.replace(situation.machine, cores=situation.machine.cores + more.workers)
        ),
    }
    said = "more would hardly be faster"
    because = [why for why, other in without.items() if AS_GOOD * rate(more, other) > rate(sizes, other)]
    return f"{said}, {because[0]}" if because else said


def _why_lanes(sizes: Sizes, measured: Measurements) -> str:
    if sizes.lanes < sizes.envs:
        return "the copies of a lane are stepped together, which saves time if steps are short"
    alone = measured.alone
    uneven = alone.p95_s > UNEVEN * alone.median_s or measured.reset_s > UNEVEN * alone.mean_s
    return "no copy waits for another one within a rollout" + (", and their times are uneven" if uneven else "")


def _why_lag(sizes: Sizes, situation: Situation, rate: Rate) -> str:
    lag = sizes.max_lag
    here = number_in_words(rate(sizes, situation))
    if lag == 0:
        other = number_in_words(rate(msgspec.structs.replace(sizes, max_lag=1), situation))
        return f"all rollouts are of the newest policy; with 1, {other} env steps/s in place of {here} are expected"
    other = number_in_words(rate(msgspec.structs.replace(sizes, max_lag=lag - 1), situation))
    return f"workers collect while the learner updates; with {lag - 1}, {other} env steps/s in place of {here} are expected"
