"""`millrace.plan`: measures an environment and this machine, and recommends settings, with the speed to expect."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence

import msgspec

from millrace.arguments import checked
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.planning.advice import about_measurements
from millrace.planning.allowed_copies import AllowedCopies
from millrace.planning.expected_rate import Situation, Sizes, steps_per_s
from millrace.planning.measurements import Machine
from millrace.planning.overheads import StoodFor, overheads
from millrace.planning.probe import OF_PROBE, ProbedEnv, probe
from millrace.planning.recommendation import (
    NEEDED_STEPS,
    ChosenSetting,
    Learning,
    about_first_steps,
    best,
    candidates,
    choose_algorithm,
    choose_max_env_failures,
    choose_replay_size,
    choose_step_timeout,
    on_machines,
    reasons,
    why_rollout_steps,
)
from millrace.planning.run_plan import ExpectedSpeed, RunPlan, added_by_preset, train_command
from millrace.protocol.env_spec import EnvLike
from millrace.protocol.envs.wrappers import WrapperLike, wrapper_names
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.available_memory import available_bytes
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.protocol.random_streams import Purpose, generator
from millrace.workers.machine_slots import copies_per_machine

SECONDS = 30.0
LEAST_S = 5.0
MACHINES = (1, 2, 10)


@checked
def plan(
    env: EnvLike,
    *,
    env_kwargs: Mapping[str, bool | int | float | str] | None = None,
    wrappers: Sequence[WrapperLike] = (),
    max_env_copies: int = 0,
    seconds: float = SECONDS,
) -> RunPlan:
    """Measure an environment on this machine, and recommend settings for a run, with the speed to expect.

    The environment is stepped with random actions, first one copy, then several side by side. Then millrace's own part is
    measured, with an environment that does nothing. Your environment runs only in worker processes, so a crash or a hang
    merely adds a line to `advice`.

    Args:
        env: an id that `gymnasium.make` accepts, a `gymnasium.envs.registration.EnvSpec`, or a callable that returns an
            environment. The environment may be PettingZoo's, with several agents.
        env_kwargs: keyword arguments of the environment.
        wrappers: as in `millrace.train`.
        max_env_copies: maximum number of env copies that may run at the same time, for example because of floating licences;
            0: no limit.
        seconds: about how long the measurement takes on an idle machine; two to four times as long if other programs use
            the cores. Allow more time if a step, or the start of a copy, takes seconds.

    Returns a `RunPlan`. Raises `UsageError` if an argument is wrong or the environment can't be found, and a `RunError`,
    such as `EnvironmentFailed`, if the environment completed no step.

    >>> import millrace
    >>> plan = millrace.plan("Pendulum-v1", seconds=5)
    >>> plan.command.split()[:3], plan.steps_per_s > 0
    (['millrace', 'train', 'Pendulum-v1'], True)
    """
    probed = ProbedEnv(env, dict(env_kwargs or {}), tuple(wrappers))
    return plan_of(probed, max_env_copies=max_env_copies, seconds=seconds, say=lambda line: None)


def plan_of(env: ProbedEnv, *, max_env_copies: int, seconds: float, say: Callable[[str], None]) -> RunPlan:
    """Does the work of `plan`. `say` is called with a line about what is measured next."""
    if seconds < LEAST_S:
        raise UsageError(f"plan: seconds: expected at least {LEAST_S:g}, got {seconds:g}")
    if max_env_copies < 0:
        raise UsageError(f"plan: max_env_copies: expected at least 0, got {max_env_copies}")
    allowed = AllowedCopies.of(max_env_copies, copies_per_machine())
    if allowed.here == 1:
        raise UsageError("plan: expected at least 2 env copies that may run, of which one plays evaluations, got 1")
    machine = Machine(
        cores=usable_cores(),
        free_bytes=available_bytes(),
        most_copies=allowed.training,
        load=os.getloadavg()[0],
    )
    say(f"stepping {env.name}, with random actions")
    probed = probe(env, machine, OF_PROBE * seconds)
    measured = probed.measured
    allowed = allowed.after(measured)
    machine = msgspec.structs.replace(machine, most_copies=allowed.training)
    algorithm = choose_algorithm(measured, machine)
    config = resolve(env.name, algo=algorithm.value)
    others = allowed.settings
    if measured.masks_in_info:
        others.append(ChosenSetting("action_masks", "info", "the infos contain masks of the allowed actions"))
    if config.algorithm.replays:
        replay_size = choose_replay_size(config.algorithm.replay_size, measured, machine)
        others += [] if replay_size is None else [replay_size]
    step_timeout = choose_step_timeout(config.step_timeout_s, measured)
    failures = choose_max_env_failures(config.max_env_failures, measured)
    others += [each for each in (step_timeout, failures) if each is not None]
    say(f"updating with {config.algo}, and an environment that does nothing")
    stood_for = StoodFor(probed.observation_space, probed.action_space, probed.seats, measured.alone.wait_s)
    situation = Situation(measured=measured, overheads=overheads(config, stood_for), machine=machine)
    return _decided(env, config, situation, [algorithm], others)


def _decided(
    env: ProbedEnv,
    config: Config,
    situation: Situation,
    first: Sequence[ChosenSetting],
    others: Sequence[ChosenSetting],
) -> RunPlan:
    """The plan that follows from the measurements.

    It lists the settings in `first`, then the numbers of workers, copies and lanes, and the lag, then the settings in
    `others`.
    """
    default_steps = config.algorithm.rollout_steps
    acting_bytes = situation.overheads.acting_bytes
    learning = Learning(config.envs, default_steps, config.algorithm.least_rollout, acting_bytes)

    sizes = best({each: _rate(each, situation) for each in candidates(learning, situation.measured, situation.machine)})
    chosen = [*first, *reasons(sizes, learning, situation, _rate)]
    if sizes.rollout_steps != default_steps:
        chosen.append(ChosenSetting("rollout_steps", sizes.rollout_steps, why_rollout_steps(sizes, learning)))
    chosen += others
    needed = NEEDED_STEPS[config.algo]
    advice = about_measurements(sizes, situation, _rate)
    if config.algorithm.learning_starts:
        no_updates = msgspec.structs.replace(situation.overheads, update_s=0.0)
        before = msgspec.structs.replace(situation, overheads=no_updates)
        if line := about_first_steps(config.algo, config.algorithm.learning_starts, _rate(sizes, before)):
            advice.append(line)
    if line := added_by_preset(env.name, env.kwargs, config.algo):
        advice.append(line)
    return RunPlan(
        env=env.name,
        chosen=tuple(chosen),
        expected=tuple(_expected(sizes, learning, situation, needed)),
        needed_steps=needed,
        advice=tuple(advice),
        command=train_command(env.name, env.kwargs, wrapper_names(env.wrappers), tuple(chosen)),
        measured=situation.measured,
        overheads=situation.overheads,
        machine=situation.machine,
    )


def _rate(sizes: Sizes, situation: Situation) -> float:
    """The env steps/s to expect."""
    return steps_per_s(sizes, situation, generator(1, Purpose.ROUNDS))


def _expected(sizes: Sizes, learning: Learning, situation: Situation, needed: int) -> list[ExpectedSpeed]:
    found = []
    fastest = 0.0
    for machines in MACHINES:
        here = on_machines(sizes, machines, learning)
        there = msgspec.structs.replace(situation, machines=machines)
        fastest = max(fastest, _rate(here, there))
        gathering_s = situation.overheads.gathering_s(here.lanes, here.steps_per_round)
        busy_s = situation.overheads.update_s + gathering_s / here.steps_per_round
        found.append(
            ExpectedSpeed(
                machines=machines,
                workers=here.workers,
                envs=here.envs,
                steps_per_s=fastest,
                learner_share=min(1.0, fastest * busy_s),
                needed_s=needed / fastest,
            )
        )
    return found
