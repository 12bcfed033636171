"""Steps an environment in workers, with random actions, and measures the time and memory that it needs.

Rule: the environment's code runs in workers, never in this process. Everything has a deadline. An error before the first
step is raised; a later one becomes a finding of one line.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array

from millrace.launch.crew import Crew
from millrace.launch.vector import call_timeouts_of, start_vector_env
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.planning.measurements import WORKER_BYTES, ActionKind, Machine, Measurements, StepCosts
from millrace.planning.random_actions import SEED, RandomActions, SeenMasks
from millrace.planning.stopwatch import CopyTimes, read_notes
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import one_line
from millrace.protocol.env_spec import EnvLike, EnvSpec, Scalar
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import MillraceError, RunError, UsageError, first_line
from millrace.protocol.specs import ActionSpec

LEAST_STEPS = 8  # number of steps that each copy takes, even if they last longer than planned
WARM_UP = 2  # this many steps at the beginning of a copy aren't counted
OF_ALONE = 0.15  # share of the time in which one copy steps alone
OF_SIDE_BY_SIDE = 0.9  # share of the time after which no more copies are started
EACH_S = 2.0  # how long each number of workers is measured
MOST_PER_CORE = 8  # largest number of workers to try per core
MOST_AT_LEAST = 16  # number of workers to try even if `MOST_PER_CORE` allows fewer
SHORT_S = 1e-3  # shorter steps are measured in workers with several copies, because a run steps them in this way
COPIES_OF_SHORT = 8  # number of copies in a worker if steps are short
OF_ITS_OWN = "if a copy needs a port, a folder or a licence of its own, see docs/how-to/simulators.md"
GROWTH = 4  # each number of workers to try is this many times the one before
WORTH_WHILE = 1.1  # if more workers don't increase the env steps/s by this factor, even larger numbers aren't tried
OF_MEMORY = 0.7  # the probe uses at most this share of the free memory


class ProbedEnv(NamedTuple):
    """The environment to measure."""

    env: EnvLike
    kwargs: Mapping[str, Scalar]
    wrappers: Sequence[WrapperLike]

    @property
    def name(self) -> str:
        """The environment's id, as `millrace train` takes it."""
        return EnvSpec.of(self.env).id

    def in_wrapper(self, wrapper: str) -> EnvSpec:
        """The environment with one more wrapper around it, the outermost one."""
        return EnvSpec.of(self.env, dict(self.kwargs), (*self.wrappers, wrapper))


class Probed(NamedTuple):
    """The measurements, and the environment's spaces and agents."""

    measured: Measurements
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    seats: tuple[str, ...]


def probe(env: ProbedEnv, machine: Machine, seconds: float) -> Probed:
    """Step one copy, then several side by side, for about this many seconds in total.

    Raises `UserFacingError` if no step was completed.
    """
    began_s = time.monotonic()
    give_up_at_s = began_s + seconds
    first = _session(env, 1, OF_ALONE * seconds, give_up_at_s)
    if not first.times or not len(first.times[0].steps):
        why = first.wrong or "a step takes longer"
        raise RunError(f"plan: {env.name}: no step could be made within {seconds:g} s: {why}")
    sessions = [first]
    measured = _measured_alone(env, first)
    each = 1
    most_each = min(COPIES_OF_SHORT, machine.most_copies // machine.cores) if machine.most_copies else COPIES_OF_SHORT

    def has_time() -> bool:
        """Whether another session can start and step; otherwise its timeout would count as a failure of its copies."""
        return time.monotonic() - began_s + 1.5 * sessions[-1].start_s <= OF_SIDE_BY_SIDE * seconds

    if measured.alone.own_s < SHORT_S and not first.wrong and most_each > 1 and has_time():
        several = _session(env, 1, OF_ALONE * seconds, give_up_at_s, each=most_each)
        sessions.append(several)
        if several.is_whole:
            each = most_each
            measured = msgspec.structs.replace(measured, side_by_side=(_costs(1, several.times),))
    for workers in _ladder(measured, machine, each):
        if not has_time():
            break
        session = _session(env, workers, EACH_S, give_up_at_s, each=each)
        sessions.append(session)
        if not session.is_whole:
            break
        costs = _costs(workers, session.times)
        if costs.steps_per_s < WORTH_WHILE * measured.side_by_side[-1].steps_per_s:
            break
        measured = msgspec.structs.replace(measured, side_by_side=(*measured.side_by_side, costs))
    if len(sessions) == 1 and not first.wrong:  # a second copy must show whether the environment is deterministic
        sessions.append(_session(env, 1, OF_ALONE * seconds, give_up_at_s))
    return Probed(_with_all(measured, sessions), first.observation_space, first.action_space, first.seats)


def _ladder(measured: Measurements, machine: Machine, each: int) -> Iterator[int]:
    """The numbers of workers to try, ascending. `each`: the number of copies of each worker."""
    alone = measured.alone
    limit = max(MOST_AT_LEAST, MOST_PER_CORE * machine.cores)
    if machine.free_bytes is not None:
        limit = min(limit, int(OF_MEMORY * machine.free_bytes / max(measured.worker_bytes, WORKER_BYTES)))
    if machine.most_copies:
        limit = min(limit, machine.most_copies // each)
    # Try more copies than cores only if steps spend time waiting rather than computing.
    limit = min(limit, machine.cores if alone.computes else math.ceil(machine.cores / max(alone.cpu_share, 1e-3)))
    workers = max(2, machine.cores)
    while workers < limit:
        yield workers
        workers *= GROWTH
    if limit > 1:
        yield limit


# ------------------------------------------------------------------------------------------------------------ one session


class _SteppedCopies(NamedTuple):
    """The record of a session in which some copies were stepped side by side."""

    times: list[CopyTimes]
    traces: list[list[int]]
    """for each copy and step, a checksum of the observation, reward and flags that it returned"""
    start_s: float
    wrong: str
    """what went wrong, as one line; empty if nothing did"""
    masks: SeenMasks
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    seats: tuple[str, ...]
    time_limit: int | None

    @property
    def is_whole(self) -> bool:
        """Whether all copies took steps and nothing went wrong."""
        stepped = sum(len(each.steps) > WARM_UP for each in self.times)
        return stepped == len(self.traces) and not self.wrong

    @property
    def finding(self) -> str:
        """What went wrong, and with how many copies, as one line; empty if nothing did."""
        copies = len(self.traces)
        if not self.wrong:
            return ""
        if copies == 1:
            return f"one copy, after {max(map(len, self.traces))} calls: {self.wrong}"
        return f"{copies} copies side by side: {self.wrong}; {OF_ITS_OWN}"


def _session(env: ProbedEnv, workers: int, seconds: float, give_up_at_s: float, each: int = 1) -> _SteppedCopies:
    """Step copies for this many seconds. `each`: the number of copies of each worker.

    Raises `UserFacingError` if there is only one copy and it can't be made.
    """
    copies = workers * each
    with TemporaryDirectory(prefix="millrace-plan-") as folder:
        notes = Path(folder, "notes")
        notes.mkdir()
        began_s = time.monotonic()
        traces: list[list[int]] = [[] for _ in range(copies)]
        wrong = ""
        known: tuple[Any, ...] = (None, None, (), None)
        masks = SeenMasks(False, "")
        start_s = 0.0
        try:
            timeout_s = max(1.0, give_up_at_s - began_s)
            settings = VectorEnvSettings(
                env.in_wrapper(f"millrace.planning.stopwatch:stopwatch(folder={str(notes)!r})"),
                copies,
                workers=workers,
                lanes=workers,
                on_worker_loss="raise",
                max_env_failures=0,
                timeout_s=timeout_s,
                call_timeouts=call_timeouts_of(timeout_s),
            )
            with start_vector_env(settings, Crew(logs=Path(folder, "logs"))) as envs:
                start_s = time.monotonic() - began_s
                limit = None if envs.spec is None else envs.spec.max_episode_steps
                known = (envs.single_observation_space, envs.single_action_space, envs.seats, limit)
                random_actions = RandomActions(*known[:2], max(1, len(envs.seats)))
                try:
                    _step(envs, random_actions, traces, time.monotonic() + seconds, give_up_at_s)
                finally:
                    masks = random_actions.masks
        except UsageError:
            raise
        except MillraceError as error:
            if copies == 1 and not any(notes.iterdir()):
                raise
            wrong = one_line(first_line(error, type(error).__name__))
        times = [each for each in read_notes(notes) if len(each.resets)]
        return _SteppedCopies(times, traces, start_s, wrong, masks, *known)


def _step(
    envs: ZmqVectorEnv, random_actions: RandomActions, traces: list[list[int]], end_at_s: float, give_up_at_s: float
) -> None:
    """Step all copies until `end_at_s`; a copy's next step begins as soon as its previous one has ended."""
    agents = max(1, len(envs.seats))
    space = envs.single_action_space
    envs.reset_async(seed=[SEED] * len(traces))
    while envs.outstanding:
        observation, reward, terminated, truncated, infos = envs.recv(timeout=max(1.0, give_up_at_s - time.monotonic()))
        ready = infos["env_id"].tolist()
        for i, copy in enumerate(ready):
            rows = slice(i * agents, (i + 1) * agents)
            shown = [array[rows] for array in _arrays(observation)]
            traces[copy].append(_digest([*shown, reward[rows], terminated[rows], truncated[rows]]))
        if envs.seats:  # only the action of an agent that acts is taken
            terminated = ~infos["acts"]
        actions = random_actions.choose([len(traces[copy]) for copy in ready], observation, infos, terminated, truncated)
        now_s = time.monotonic()
        if now_s < give_up_at_s and (now_s < end_at_s or min(map(len, traces)) <= LEAST_STEPS):
            into: Any = create_empty_array(space, len(actions))
            batch = concatenate(space, actions, into)
            envs.send(batch, ready)


def _arrays(observation: Any) -> Iterator[Array]:
    match observation:
        case dict():
            for value in observation.values():
                yield from _arrays(value)
        case tuple():
            for value in observation:
                yield from _arrays(value)
        case _:
            yield np.asarray(observation)


def _digest(arrays: Sequence[Array]) -> int:
    number = 0
    for array in arrays:
        number = zlib.crc32(np.ascontiguousarray(array).tobytes(), number)
    return number


def _deterministic(traces: Sequence[Sequence[int]]) -> bool | None:
    """Whether all copies returned the same results in the steps that all took; None if fewer than two were stepped."""
    traces = [trace for trace in traces if trace]
    if len(traces) < 2:
        return None
    longest = max(traces, key=len)
    return all(list(trace) == list(longest[: len(trace)]) for trace in traces)


# ------------------------------------------------------------------------------------------------------------ the numbers


def _measured_alone(env: ProbedEnv, session: _SteppedCopies) -> Measurements:
    """The measurements from a session with one copy."""
    leaves = observation_leaves(session.observation_space)
    keys = session.observation_space.spaces if isinstance(session.observation_space, spaces.Dict) else {}
    return Measurements(
        env=env.name,
        agents=max(1, len(session.seats)),
        action=_kind(action_spec(session.action_space)),
        images=any(leaf.is_image for leaf in leaves),
        goals={"achieved_goal", "desired_goal"} <= {*keys},
        observation_bytes=sum(math.prod(leaf.shape) * np.dtype(leaf.dtype).itemsize for leaf in leaves),
        side_by_side=(_costs(1, session.times),),
        start_s=session.start_s,
        worker_bytes=session.times[0].bytes,
    )


def _with_all(measured: Measurements, sessions: Sequence[_SteppedCopies]) -> Measurements:
    """Add the measurements that need all sessions.

    The first reset of a copy may be slower than the later ones, so it isn't counted unless no copy was reset twice.
    """
    times = [each for session in sessions for each in session.times]
    later = [each.resets[1:] for each in times if len(each.resets) > 1]
    resets = np.concatenate(later or [each.resets for each in times])
    steps = sum(int(np.count_nonzero(each.steps[:, 0] < each.resets[-1, 0])) for each in times)  # steps of complete episodes
    share = max(each.others_cpu_share for each in times)
    worked = max((len(each.traces) for each in sessions if each.is_whole), default=1)
    wrong_masks = next((each.masks.wrong for each in sessions if each.masks.wrong), "")
    return msgspec.structs.replace(
        measured,
        masks_in_info=any(each.masks.in_info for each in sessions) and not wrong_masks,
        wrong_masks=wrong_masks,
        reset_s=float((resets[:, 1] - resets[:, 3]).mean()),
        reset_cpu_s=float((resets[:, 2] + share * resets[:, 1]).mean()),
        resets=len(resets),
        copies_worked=worked,
        copies_failed=min((len(each.traces) for each in sessions if each.wrong and len(each.traces) > worked), default=0),
        episode_steps=steps / sum(map(len, later)) if later else sessions[0].time_limit,
        deterministic=_deterministic([trace for session in sessions for trace in session.traces]),
        findings=tuple(session.finding for session in sessions if session.wrong),
    )


def _kind(action: ActionSpec) -> ActionKind:
    match action.kind:
        case "box" if action.unbounded is None:
            return "box"
        case "discrete":
            return "discrete"
    return "other"


def _costs(workers: int, times: Sequence[CopyTimes]) -> StepCosts:
    """The costs of a step, computed from the times of these copies."""
    counted = [each.steps[WARM_UP:] if len(each.steps) > WARM_UP else each.steps for each in times]
    wall_s = np.concatenate([each[:, 1] for each in counted])
    cpu_s = np.concatenate(
        [each[:, 2] + copy.others_cpu_share * each[:, 1] for each, copy in zip(counted, times, strict=True)]
    )
    of_copies = [float(each[:, 1].mean()) for each in counted]
    return StepCosts(
        workers=workers,
        steps=len(wall_s),
        mean_s=float(wall_s.mean()),
        median_s=float(np.median(wall_s)),
        p95_s=float(np.quantile(wall_s, 0.95)),
        std_s=float(wall_s.std()),
        cpu_s=float(cpu_s.mean()),
        delay_s=float(np.concatenate([each[:, 3] for each in counted]).mean()),
        slowest_copy=max(of_copies) / max(float(np.median(of_copies)), 1e-12),
    )
