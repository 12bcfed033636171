"""Steps an environment in workers, with random actions, and measures the time and memory that it needs.

Rule: the environment's code runs in workers, never in this process. Each session has a deadline; if it isn't whole by then,
its number of copies counts as not measured. An error before the first step is raised; a later one becomes a finding of one
line. If all copies of a session have taken enough steps, and then a call takes as long as half of the time that is left and
much longer than any call before, the call counts as one that hangs, so the other half is left for other numbers of copies.
If a number of copies fails, numbers between the largest one that worked and the smallest one that failed are tried.
"""

from __future__ import annotations

import math
import os
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
from millrace.planning.last_output import with_last_output
from millrace.planning.measurements import ActionKind, Machine, Measurements, NoMore, StepCosts
from millrace.planning.probe_sizes import SessionSize, between, enough_s, most_each, numbers_of_workers, two_fit
from millrace.planning.random_actions import SEED, RandomActions, SeenMasks
from millrace.planning.sessions import GRACE_S, MORE_TIME, WARM_UP, Failures, SteppedCopies, Tries, hangs
from millrace.planning.stopwatch import CopyTimes, read_notes
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import one_line
from millrace.protocol.env_spec import EnvLike, EnvSpec, Scalar
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import MillraceError, RunError, UsageError, first_line
from millrace.protocol.specs import ActionSpec
from millrace.workers.machine_slots import LIMIT_VARIABLE, Slots, copies_per_machine, slots_path

OF_PROBE = 0.7  # share of a plan's time in which the environment is measured; millrace's own part is measured in the rest
LEAST_STEPS = 8  # number of steps that each copy takes, even if they last longer than planned
OF_ALONE = 0.15  # share of the time in which one copy steps alone
EACH_S = 2.0  # how long each number of workers is measured
SHORT_S = 1e-3  # shorter steps are measured in workers with several copies, because a run steps them in this way
WORTH_WHILE = 1.1  # if more workers don't increase the env steps/s by this factor, even larger numbers aren't tried


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
    """Step one copy, then several in one worker and side by side, for about this many seconds in total.

    Raises `UserFacingError` if no step was completed.
    """
    end_s = time.monotonic() + seconds
    alone = _tries(env, SessionSize(), OF_ALONE * seconds, end_s)
    first = alone.longest
    if not first.times or not len(first.times[0].steps):
        raise RunError(f"plan: {env.name}: {_why_no_step(first, seconds / OF_PROBE)}")
    tried = [alone]
    measured = _measured_alone(env, alone)
    each = 1
    if alone.worked and measured.alone.own_s < SHORT_S and (most := most_each(measured, machine)) > 1:
        # Several workers need the other half of the time that is left.
        several = _tries(env, SessionSize(each=most), OF_ALONE * seconds, (time.monotonic() + end_s) / 2, alone)
        tried.append(several)
        if several.worked:
            each = most
            measured = msgspec.structs.replace(measured, side_by_side=(_costs(1, several.times),))
    no_more: NoMore = "time" if first.is_too_slow else ""
    for workers in () if no_more else numbers_of_workers(measured, machine, each):
        tries = _tries(env, SessionSize(workers, each), EACH_S, end_s, alone)
        tried.append(tries)
        if not tries.worked:
            no_more = "failed" if tries.show_a_limit else "time"
            break
        if (faster := _with_more(measured, workers, tries)) is measured:
            no_more = "no faster"
            break
        measured = faster
    if alone.worked and not any(tries.decide_about_two for tries in tried):
        # An evaluation makes a second copy in a worker. It also shows whether the environment is deterministic.
        two = SessionSize(each=2 if two_fit(measured, machine) else 1)
        tried.append(_tries(env, two, EACH_S, end_s, alone))
    measured = _with_all(msgspec.structs.replace(measured, no_more=no_more), tried)
    measured = _with_numbers_between(env, measured, tried, end_s, each)
    again_s = max(2 * seconds, enough_s(measured, machine, each, LEAST_STEPS + 1)) / OF_PROBE
    failed = measured.copies_failed
    told = [tries for tries in tried if not (tries.show_a_limit and tries.size.workers > 1 and tries.size.copies > failed)]
    findings = [Failures.of(tried).finding, *(tries.finding(math.ceil(again_s / 60) * 60) for tries in told)]
    measured = msgspec.structs.replace(measured, findings=tuple(filter(None, findings)))
    return Probed(measured, first.observation_space, first.action_space, first.seats)


def _with_numbers_between(
    env: ProbedEnv, measured: Measurements, tried: list[Tries], end_s: float, each: int
) -> Measurements:
    """Step numbers of copies between those that worked and those that failed, as long as there is time.

    Appends the sessions to `tried`. `each`: the number of copies of each worker in the costs that were measured before.
    """
    while copies := between(measured.copies_worked, measured.copies_failed):
        tries = _tries(env, SessionSize(copies), EACH_S, end_s, tried[0])
        tried.append(tries)
        if not (tries.worked or tries.show_a_limit):
            break
        if tries.worked and each == 1 and not measured.alone.computes:
            measured = _with_more(measured, copies, tries)
        measured = _with_all(measured, tried)
    return measured


def _why_no_step(session: SteppedCopies, plan_s: float) -> str:
    """Why a plan that was to take `plan_s` could not make a step, and what to do unless something was wrong."""
    if session.no_slot:
        return f"no step could be made: {session.no_slot}; plan again when such a copy has ended"
    if session.wrong:
        return f"no step could be made: {session.wrong}"
    why = "the start of a copy, a reset or a step takes longer"
    return (
        f"no step could be made in the {plan_s * OF_PROBE:g} s that a plan with --seconds {plan_s:g} has for steps: {why}; "
        f"unless it hangs, {MORE_TIME} {4 * plan_s:g}"
    )


# ------------------------------------------------------------------------------------------------------------ one session


class _TimeIsUp(Exception):
    """A session's deadline has passed, and copies have not answered."""


class _CallHangs(Exception):
    """A call to a copy has not returned for a long time, although all copies had taken enough steps before."""


class _NewestCall:
    """When the newest call of a session began, or when no more were to begin, if that is later; and how long copies had been
    stepped when the newest call returned.
    """

    at_s = math.inf
    stepped_s = 0.0


def _tries(env: ProbedEnv, size: SessionSize, seconds: float, deadline_s: float, alone: Tries | None = None) -> Tries:
    """Step copies for this many seconds in total, as `_session` does, and try again if they fail early."""
    tries = Tries((_session(env, size, seconds, deadline_s),), alone)
    while tries.need_another(seconds, deadline_s - time.monotonic()):
        again = _session(env, size, seconds - tries.stepped_s, deadline_s)
        tries = tries._replace(sessions=(*tries.sessions, again))
    return tries


def _session(env: ProbedEnv, size: SessionSize, seconds: float, deadline_s: float) -> SteppedCopies:
    """Step copies for this many seconds, but not beyond the deadline. After the deadline, start no copies at all.

    Raises `UserFacingError` if there is only one copy and it can't be made.
    """
    called = _NewestCall()

    def check_time() -> None:
        now_s = time.monotonic()
        if now_s > deadline_s + GRACE_S:
            raise _TimeIsUp
        if min(map(len, traces)) <= LEAST_STEPS or not hangs(now_s, called.at_s, deadline_s, 0.0):
            return
        if hangs(now_s, called.at_s, deadline_s, _slowest_s(notes)):  # only now, because reading notes takes time
            raise _CallHangs(f"a call took longer than {now_s - called.at_s:.0f} s; unless it hangs, {MORE_TIME}")

    with TemporaryDirectory(prefix="millrace-plan-") as folder:
        notes, logs = Path(folder, "notes"), Path(folder, "logs")
        notes.mkdir()
        began_s = time.monotonic()
        traces: list[list[int]] = [[] for _ in range(size.copies)]
        wrong = ""
        cut_off = False
        known: tuple[Any, ...] = (None, None, (), None)
        masks = SeenMasks(False, "")
        start_s = 0.0
        try:
            if began_s > deadline_s:
                raise _TimeIsUp
            settings = VectorEnvSettings(
                env.in_wrapper(f"millrace.planning.stopwatch:stopwatch(folder={str(notes)!r})"),
                size.copies,
                workers=size.workers,
                lanes=size.workers,
                on_worker_loss="raise",
                max_env_failures=0,
                timeout_s=math.inf,  # only `check_time` limits a call, because a slow worker isn't lost
                call_timeouts=call_timeouts_of(math.inf),
            )
            with start_vector_env(settings, Crew(logs=logs), check_time) as envs:
                start_s = time.monotonic() - began_s
                known = (envs.single_observation_space, envs.single_action_space, envs.seats, envs.max_episode_steps)
                random_actions = RandomActions(*known[:2], max(1, len(envs.seats)))
                called.at_s = end_at_s = time.monotonic() + seconds
                try:
                    _step(envs, random_actions, traces, end_at_s, deadline_s, called)
                finally:
                    masks = random_actions.masks
        except UsageError:
            raise
        except _TimeIsUp:
            cut_off = True
        except _CallHangs as error:
            wrong = str(error)
        except MillraceError as error:
            if size.copies == 1 and not any(notes.iterdir()) and not _no_slot(1):
                raise
            wrong = with_last_output(one_line(first_line(error, type(error).__name__)), logs)
        times = [each for each in read_notes(notes) if len(each.resets)]
        session = SteppedCopies(size, times, traces, start_s, wrong, cut_off, called.stepped_s, masks, *known)
        no_slot = "" if session.has_stepped else _no_slot(size.copies)
        # Without slots, copies can't be made, whatever error follows from this.
        return session._replace(wrong="", cut_off=True, no_slot=no_slot) if no_slot else session


def _no_slot(copies: int) -> str:
    """Why this machine has no slots for so many copies, if other programs have taken too many; otherwise empty."""
    most = copies_per_machine()
    slots = Slots(most=most)
    try:
        if not most or slots.have_room(copies):
            return ""
    finally:
        os.close(slots.fd)
    return f"env copies of other programs hold the slots; {LIMIT_VARIABLE} allows {most} on this machine ({slots_path()})"


def _step(
    envs: ZmqVectorEnv,
    random_actions: RandomActions,
    traces: list[list[int]],
    end_at_s: float,
    deadline_s: float,
    called: _NewestCall,
) -> None:
    """Step all copies until `end_at_s`, or until the deadline if they haven't taken `LEAST_STEPS` steps by `end_at_s`.

    A copy's next step begins as soon as its previous one has ended.
    """
    agents = max(1, len(envs.seats))
    space = envs.single_action_space
    began_s = time.monotonic()
    envs.reset_async(seed=[SEED] * len(traces))
    while envs.outstanding:
        observation, reward, terminated, truncated, infos = envs.recv()
        called.stepped_s = time.monotonic() - began_s
        ready = infos["env_id"].tolist()
        for i, copy in enumerate(ready):
            rows = slice(i * agents, (i + 1) * agents)
            shown = [array[rows] for array in _arrays(observation)]
            traces[copy].append(_digest([*shown, reward[rows], terminated[rows], truncated[rows]]))
        if envs.seats:  # only the action of an agent that acts is taken
            terminated = ~infos["acts"]
        actions = random_actions.choose([len(traces[copy]) for copy in ready], observation, infos, terminated, truncated)
        now_s = time.monotonic()
        if now_s < deadline_s and (now_s < end_at_s or min(map(len, traces)) <= LEAST_STEPS):
            into: Any = create_empty_array(space, len(actions))
            batch = concatenate(space, actions, into)
            envs.send(batch, ready)
            called.at_s = max(end_at_s, now_s)


def _slowest_s(notes: Path) -> float:
    """The longest time that a step or a reset has taken so far."""
    calls = [each for copy in read_notes(notes) for each in (copy.steps, copy.resets)]
    return max((float(each[:, 1].max(initial=0.0)) for each in calls), default=0.0)


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


def _measured_alone(env: ProbedEnv, alone: Tries) -> Measurements:
    """The measurements from the sessions with one copy."""
    session = alone.longest
    leaves = observation_leaves(session.observation_space)
    keys = session.observation_space.spaces if isinstance(session.observation_space, spaces.Dict) else {}
    return Measurements(
        env=env.name,
        agents=max(1, len(session.seats)),
        action=_kind(action_spec(session.action_space)),
        images=any(leaf.is_image for leaf in leaves),
        goals={"achieved_goal", "desired_goal"} <= {*keys},
        observation_bytes=sum(math.prod(leaf.shape) * np.dtype(leaf.dtype).itemsize for leaf in leaves),
        side_by_side=(_costs(1, alone.times),),
        start_s=session.start_s,
        worker_bytes=max(each.bytes for each in alone.times),
    )


def _with_more(measured: Measurements, workers: int, tries: Tries) -> Measurements:
    """Add the costs of a step with more workers, unless they hardly increase the env steps/s."""
    costs = _costs(workers, tries.times)
    if costs.steps_per_s < WORTH_WHILE * measured.side_by_side[-1].steps_per_s:
        return measured
    return msgspec.structs.replace(measured, side_by_side=(*measured.side_by_side, costs))


def _with_all(measured: Measurements, tried: Sequence[Tries]) -> Measurements:
    """Add the measurements that need all sessions, except the findings.

    The first reset of a copy may be slower than the later ones, so it isn't counted unless no copy was reset twice.
    """
    sessions = [session for tries in tried for session in tries.sessions]
    times = [each for session in sessions for each in session.times]
    later = [each.resets[1:] for each in times if len(each.resets) > 1]
    resets = np.concatenate(later or [each.resets for each in times])
    steps = sum(int(np.count_nonzero(each.steps[:, 0] < each.resets[-1, 0])) for each in times)  # steps of complete episodes
    share = max(each.others_cpu_share for each in times)
    worked = max((tries.size.copies for tries in tried if tries.worked), default=1)
    worked_in_one = max((tries.size.each for tries in tried if tries.worked), default=1)
    failed = [tries.size for tries in tried if tries.show_a_limit and tries.size.copies > 1]
    failures = Failures.of(tried)
    # If several copies have worked in one worker, a process allows several. If more then failed there, the reason may be
    # their number or the number in a process, so both are limited.
    too_many = [size for size in failed if size.copies > worked and (size.workers > 1 or worked_in_one > 1)]
    wrong_masks = next((each.masks.wrong for each in sessions if each.masks.wrong), "")
    return msgspec.structs.replace(
        measured,
        masks_in_info=any(each.masks.in_info for each in sessions) and not wrong_masks,
        wrong_masks=wrong_masks,
        slowest_step_s=max(float(each.steps[:, 1].max(initial=0.0)) for each in times),
        reset_s=float((resets[:, 1] - resets[:, 3]).mean()),
        reset_cpu_s=float((resets[:, 2] + share * resets[:, 1]).mean()),
        resets=len(resets),
        copies_worked=worked,
        copies_failed=min((size.copies for size in too_many), default=0),
        copies_tried=tuple(sorted({size.copies for size in (*too_many, *(tries.size for tries in tried if tries.worked))})),
        worked_in_one_worker=worked_in_one,
        failed_in_one_worker=min((size.each for size in failed if size.workers == 1), default=0),
        episode_steps=steps / sum(map(len, later)) if later else tried[0].longest.time_limit,
        deterministic=_deterministic([trace for session in sessions for trace in session.traces]),
        failures=len(failures.sessions),
        calls=failures.calls,
        calls_s=failures.calls_s,
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
