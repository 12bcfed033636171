"""What `millrace plan` chooses, by measurements that nobody made."""

from __future__ import annotations

import itertools
import shlex
from typing import Any

import msgspec
import pytest

from millrace.cli.plan import PlanFlags
from millrace.flags.parse import parse_flags
from millrace.learner.config.command_line import read_config
from millrace.learner.config.layers import resolve
from millrace.learner.config.validation import check_copies
from millrace.learner.members.failure_count import FailureCount
from millrace.planning.allowed_copies import AllowedCopies
from millrace.planning.expected_rate import Sizes
from millrace.planning.in_words import number_in_words
from millrace.planning.measurements import ActionKind, Machine, Measurements, Overheads
from millrace.planning.recommendation import (
    ChosenSetting,
    Learning,
    about_first_steps,
    candidates,
    choose_algorithm,
    choose_max_env_failures,
    choose_replay_size,
    choose_step_timeout,
    copies_at_once,
    on_machines,
    reasons,
    why_rollout_steps,
)
from millrace.planning.run_plan import added_by_preset, train_command
from millrace.protocol.env_spec import Scalar
from tests.millrace.planning.made_up import MACHINE, OVERHEADS, PPO, REPLAY, TRIED, chosen, measured, rate, situation

WAITS_S = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)


@pytest.mark.parametrize("learning", [PPO, REPLAY])
def test_more_waiting_never_means_fewer_copies_or_workers(learning: Learning) -> None:
    found = [chosen(situation(measured(wait_s=wait_s, cpu_s=1e-4)), learning) for wait_s in WAITS_S[3:]]
    assert [each.envs for each in found] == sorted(each.envs for each in found)
    assert [each.workers for each in found] == sorted(each.workers for each in found)


def test_steps_that_wait_get_a_worker_and_a_lane_for_each_copy_that_was_tried() -> None:
    where = situation(measured(wait_s=0.01))
    found = chosen(where)
    assert (found.workers, found.envs, found.lanes) == (TRIED, TRIED, TRIED)
    assert max(each.envs for each in candidates(PPO, where.measured, where.machine)) == TRIED


@pytest.mark.parametrize("cores", [1, 2, 5, 16])
@pytest.mark.parametrize("cpu_s", [1e-5, 1e-3, 1e-1])
def test_steps_that_compute_never_get_more_workers_than_cores(cores: int, cpu_s: float) -> None:
    where = situation(measured(cpu_s=cpu_s, tried=cores), machine=Machine(cores=cores))
    assert chosen(where).workers <= cores
    assert chosen(where, REPLAY).workers <= cores


def test_short_steps_get_many_copies_in_few_lanes_and_long_ones_the_usual_number_in_a_lane_each() -> None:
    quick = msgspec.structs.replace(OVERHEADS, update_s=1e-5)
    short = chosen(situation(measured(cpu_s=1e-5, tried=2), quick))
    assert short.envs >= 32
    assert short.lanes < short.envs
    long = chosen(situation(measured(cpu_s=1e-2, tried=2)))
    assert (long.envs, long.lanes) == (8, 8)


@pytest.mark.parametrize(("wait_s", "cpu_s"), [(0.01, 1e-4), (0.0, 0.01)])
def test_memory_bounds_copies(wait_s: float, cpu_s: float) -> None:
    free = 8 << 30
    for gigabytes in (1, 2, 3, 6):
        machine = Machine(cores=2, free_bytes=free)
        found = chosen(situation(measured(wait_s=wait_s, cpu_s=cpu_s, worker_bytes=gigabytes << 30), machine=machine))
        assert found.envs * (gigabytes << 30) <= free or found.envs == 1
        assert found.envs >= int(0.7 * 8 / gigabytes)  # and no less than that


@pytest.mark.parametrize(("wait_s", "cpu_s"), [(0.01, 1e-4), (0.0, 1e-5)])
@pytest.mark.parametrize("licences", [1, 3, 6])
def test_licences_bound_copies(wait_s: float, cpu_s: float, licences: int) -> None:
    machine = msgspec.structs.replace(MACHINE, most_copies=licences)
    found = chosen(situation(measured(wait_s=wait_s, cpu_s=cpu_s, tried=licences), machine=machine))
    assert found.envs == licences
    assert found.envs % found.lanes == 0
    assert found.workers <= found.lanes


@pytest.mark.parametrize("learning", [PPO, REPLAY])
@pytest.mark.parametrize(("wait_s", "cpu_s"), [(0.01, 1e-4), (0.0, 0.003), (0.0, 1e-5)])
@pytest.mark.parametrize("worked", [2, 3, 16])
def test_after_a_failure_a_run_needs_no_more_copies_than_have_worked_even_when_it_evaluates(
    worked: int, wait_s: float, cpu_s: float, learning: Learning
) -> None:
    tried = (1, worked, worked + 1, worked + 2)
    found = measured(
        wait_s=wait_s, cpu_s=cpu_s, tried=worked, copies_worked=worked, copies_failed=worked + 1, copies_tried=tried
    )
    allowed = AllowedCopies.of(0, 0).after(found)
    where = situation(found, machine=Machine(cores=32, free_bytes=64 << 30, most_copies=allowed.training))
    sizes = chosen(where, learning)
    settings = (*reasons(sizes, learning, where, rate), *allowed.settings)
    values: dict[str, Any] = {each.name: each.value for each in settings}
    config = resolve("CartPole-v1", algo="ppo", **values)
    check_copies(config, "worked", worked)
    assert config.max_env_copies == worked
    assert config.workers is not None
    assert config.workers <= config.lanes <= config.envs
    why = {each.name: each.why for each in settings}
    said = f"{worked} copies worked at the same time, {worked + 1} and {worked + 2} did not, and evaluations need copies too"
    assert why["max_env_copies"] == f"{said}; if you know how many may run, plan with --max-env-copies"
    assert "may train here" in why["envs"] or config.envs < allowed.training


def test_if_only_one_copy_has_worked_it_trains_and_evaluations_have_as_few_as_possible() -> None:
    allowed = AllowedCopies.of(0, 0).after(measured(copies_worked=1, copies_failed=2))
    assert allowed.training == 1
    assert [(each.name, each.value) for each in allowed.settings] == [("eval_copies", 1)]


def test_a_failure_limits_copies_only_if_there_were_more_of_them_than_worked_and_are_allowed() -> None:
    one_failed = measured(copies_worked=16, findings=("one copy, after 400 calls: it raised",))
    assert AllowedCopies.of(0, 0).after(one_failed) == AllowedCopies.of(0, 0)
    assert AllowedCopies.of(0, 0).training == 0
    assert AllowedCopies.of(0, 0).settings == []
    failed = measured(copies_worked=4, copies_failed=16)
    assert AllowedCopies.of(3, 0).after(failed) == AllowedCopies.of(3, 0)
    assert AllowedCopies.of(8, 6).after(failed).settings[0].value == 4
    assert AllowedCopies.of(8, 6).after(failed).training == 3


@pytest.mark.parametrize("learning", [PPO, REPLAY])
@pytest.mark.parametrize(("wait_s", "cpu_s"), [(0.01, 1e-4), (0.0, 0.003), (0.0, 1e-5)])
@pytest.mark.parametrize(("cores", "failed"), [(8, 0), (16, 0), (4, 8)])
def test_if_several_copies_failed_in_one_worker_each_copy_that_trains_has_a_worker_of_its_own(
    cores: int, failed: int, wait_s: float, cpu_s: float, learning: Learning
) -> None:
    found = measured(
        wait_s=wait_s, cpu_s=cpu_s, tried=cores, copies_worked=cores, copies_failed=failed, failed_in_one_worker=8
    )
    allowed = AllowedCopies.of(0, 0).after(found)
    where = situation(found, machine=Machine(cores=cores, free_bytes=64 << 30, most_copies=allowed.training))
    sizes = chosen(where, learning)
    assert sizes.workers == sizes.lanes == sizes.envs > 1
    assert sizes.workers <= cores
    settings = (*reasons(sizes, learning, where, rate), *allowed.settings)
    values = {each.name: each.value for each in settings}
    assert values["eval_copies"] == 1
    assert "worker of its own" in {each.name: each.why for each in settings}["workers"]


@pytest.mark.parametrize(("failed_in_one_worker", "why"), [(0, "each worker plays one episode"), (2, "as few as possible")])
def test_if_steps_wait_a_worker_plays_one_episode_at_a_time(failed_in_one_worker: int, why: str) -> None:
    waits = measured(wait_s=0.01, failed_in_one_worker=failed_in_one_worker)
    (eval_copies,) = AllowedCopies.of(0, 0).after(waits).settings
    assert (eval_copies.name, eval_copies.value) == ("eval_copies", 1)
    assert eval_copies.why.startswith(why)
    assert AllowedCopies.of(100, 0).after(waits).training == 99
    assert AllowedCopies.of(0, 0).after(measured(cpu_s=0.01)).settings == []


def test_an_update_keeps_its_size_with_any_number_of_copies_unless_rollouts_became_too_short() -> None:
    assert {envs: PPO.steps(envs) for envs in (1, 4, 8, 16, 32, 160)} == {1: 1024, 4: 256, 8: 128, 16: 64, 32: 32, 160: 32}
    assert {envs: REPLAY.steps(envs) for envs in (1, 16, 160)} == {1: 64, 16: 4, 160: 1}
    where = situation(measured(wait_s=0.01))
    found = chosen(where)
    assert (found.envs, found.steps_per_round) == (TRIED, PPO.rows_of_update)


@pytest.mark.parametrize(
    ("learning", "envs", "why"),
    [
        (PPO, 16, "after 1,024 env steps, as with 8 env copies and the usual rollouts"),
        (PPO, 160, "after 5,120 env steps; with shorter rollouts, advantages would depend more on the critic"),
        (REPLAY, 160, "after 160 env steps, one of each copy"),
    ],
)
def test_the_number_of_steps_of_a_rollout_has_its_reason(learning: Learning, envs: int, why: str) -> None:
    sizes = Sizes(workers=envs, envs=envs, lanes=envs, max_lag=0, rollout_steps=learning.steps(envs))
    assert why_rollout_steps(sizes, learning) == f"the policy is updated {why}"


def test_if_the_learner_is_the_limit_no_more_copies_are_chosen_than_it_can_use() -> None:
    slow = msgspec.structs.replace(OVERHEADS, update_s=0.02)
    found = chosen(situation(measured(wait_s=0.05), slow), REPLAY)
    assert found.envs == 8
    assert found.max_lag == 1
    assert found.rollout_steps * found.envs == REPLAY.rows_of_update


@pytest.mark.parametrize("learning", [PPO, REPLAY])
@pytest.mark.parametrize("update_s", [0.025, 0.04, 1.0])
def test_steps_that_wait_get_a_worker_for_each_lane_even_if_updates_take_most_of_the_time(
    update_s: float, learning: Learning
) -> None:
    where = situation(measured(wait_s=0.05), msgspec.structs.replace(OVERHEADS, update_s=update_s))
    found = chosen(where, learning)
    assert (found.workers, found.envs, found.lanes) == (8, 8, 8)
    why = {each.name: each.why for each in reasons(found, learning, where, rate)}
    assert "each copy waits in a worker of its own" in why["workers"]


@pytest.mark.parametrize(
    ("found", "machine", "workers", "envs"),
    [
        (
            measured(wait_s=20.0, tried=1, no_more="time"),
            Machine(cores=8),
            (1, "a step waits for 100% of its time, so each copy waits in a worker of its own"),
            (1, "the time was up before more of them could be tried side by side"),
        ),
        (
            measured(wait_s=0.05, cpu_s=0.001, tried=4, no_more="no faster"),
            Machine(cores=2),
            (4, "a step waits for 98% of its time, so each copy waits in a worker of its own"),
            (4, "more of them were tried side by side, and were hardly faster; 4 made 4.0 times the env steps of one"),
        ),
        (
            measured(wait_s=0.02, cpu_s=0.01),
            Machine(cores=1),
            (8, "a step waits for 67% of its time, so each copy waits in a worker of its own"),
            (8, "more would hardly be faster, because the cores are busy"),
        ),
        (
            measured(cpu_s=0.05, tried=7),
            Machine(cores=64, most_copies=7),
            (7, "a step computes for 100% of its time, so each copy has a worker of its own"),
            (7, "at most 7 copies may train here"),
        ),
        (
            measured(cpu_s=0.05, tried=16),
            Machine(cores=16),
            (16, "a step computes for 100% of its time, so there is one for each core"),
            (16, "the usual number, 8, rounded up to a multiple of the 16 cores"),
        ),
        (
            measured(cpu_s=0.05, tried=96),
            Machine(cores=96),
            (64, "a step computes for 100% of its time, so each copy has a worker of its own"),
            (64, "a plan recommends at most 64 copies of an environment that computes"),
        ),
        (
            measured(cpu_s=0.05, tried=4),
            Machine(cores=4),
            (4, "a step computes for 100% of its time, so there is one for each core"),
            (8, "the usual number"),
        ),
        (
            measured(cpu_s=0.05, tried=2, worker_bytes=4 << 30),
            Machine(cores=8, free_bytes=12 << 30),
            (2, "a step computes for 100% of its time, so each copy has a worker of its own"),
            (2, "a copy takes 4,046 MB, and no more of them fit into the memory"),
        ),
    ],
)
def test_workers_and_copies_have_the_limit_that_binds_as_their_reason(
    found: Measurements, machine: Machine, workers: tuple[int, str], envs: tuple[int, str]
) -> None:
    quick = msgspec.structs.replace(OVERHEADS, update_s=1e-6)
    where = situation(found, quick, machine)
    why = {each.name: (each.value, each.why) for each in reasons(chosen(where), PPO, where, rate)}
    assert (why["workers"], why["envs"]) == (workers, envs)


def test_more_copies_than_usual_are_compared_with_the_best_run_of_the_usual_number() -> None:
    quick = msgspec.structs.replace(OVERHEADS, update_s=1e-6)
    where = situation(measured(cpu_s=1e-5, tried=2), quick)
    sizes = chosen(where)
    assert (sizes.envs, sizes.lanes) == (64, 2)
    usual = msgspec.structs.replace(sizes, envs=8, rollout_steps=PPO.steps(8))
    why = {each.name: each.why for each in reasons(sizes, PPO, where, rate)}["envs"]
    assert f"with 8, {number_in_words(rate(usual, where))} env steps/s in place of" in why


def test_updates_are_the_reason_for_few_workers_only_if_more_would_be_faster_without_them() -> None:
    for cpu_s, of_step in itertools.product((1e-5, 1e-4, 1e-3, 1e-2), (0.0, 0.1, 100.0)):
        overheads = msgspec.structs.replace(OVERHEADS, update_s=of_step * cpu_s)
        where = situation(measured(cpu_s=cpu_s, tried=4), overheads, Machine(cores=4))
        sizes = chosen(where)
        why = {each.name: each.why for each in reasons(sizes, PPO, where, rate)}["workers"]
        assert (sizes.workers, why.endswith("because of the updates")) == ((1, True) if of_step == 100.0 else (4, False))


def test_lag_is_chosen_only_if_it_is_faster() -> None:
    quick = Overheads(row_s=0, lane_row_s=0, copy_row_s=0, sent_s=0, round_s=0, rollout_s=0, received_s=0, update_s=1e-7)
    assert chosen(situation(measured(wait_s=0.01, cpu_s=0), quick)).max_lag == 0
    assert chosen(situation(measured(wait_s=0.01, cpu_s=0))).max_lag == 1


def test_all_that_is_chosen_is_nearly_the_best_of_all_sizes() -> None:
    for wait_s, uneven, learning in itertools.product(WAITS_S, (0.0, 1.0), (PPO, REPLAY)):
        where = situation(measured(wait_s=wait_s, std_s=uneven * wait_s))
        found = chosen(where, learning)
        for changes in (
            {"max_lag": 2},
            {"workers": 1},
            {"lanes": found.workers},
            {"workers": found.envs, "lanes": found.envs},
        ):
            other = msgspec.structs.replace(found, **changes)
            if other.workers <= other.lanes and other.envs % other.lanes == 0:
                assert rate(found, where) > 0.94 * rate(other, where), (wait_s, uneven, changes)


# ------------------------------------------------------------------------------------------------------------ the algorithm


@pytest.mark.parametrize(
    ("each_ms", "action", "others", "algo"),
    [  # the table of docs/how-to/algorithms.md
        (4, "box", {}, "xqc"),
        (60, "box", {"images": True}, "sac"),
        (40, "box", {"images": True}, "ppo"),
        (4, "discrete", {}, "rainbow"),
        (4, "discrete", {"images": True}, "rainbow"),
        (4, "other", {}, "ppo"),
        (4, "box", {"agents": 3}, "ppo"),
        (2, "box", {}, "ppo"),
        (2, "discrete", {}, "ppo"),
    ],
)
def test_the_algorithm_is_that_of_the_manual(each_ms: float, action: ActionKind, others: dict[str, Any], algo: str) -> None:
    found = choose_algorithm(measured(wait_s=each_ms * TRIED / 1e3, cpu_s=0, action=action, **others), MACHINE)
    assert (found.name, found.value) == ("algo", algo)
    assert found.why
    if each_ms > 3 and "agents" in others:
        assert "it has 3 agents, but the settings of algorithms with a replay buffer were not measured" in found.why


def test_the_share_of_a_reset_counts_as_time_of_a_step() -> None:
    assert choose_algorithm(measured(wait_s=0.04, cpu_s=0), MACHINE).value == "ppo"
    assert choose_algorithm(measured(wait_s=0.04, cpu_s=0, reset_s=10.0, episode_steps=100.0), MACHINE).value == "xqc"


def test_a_line_tells_how_long_actions_are_random_if_it_is_long() -> None:
    line = about_first_steps("xqc", 5000, 100.0)
    assert line.startswith("xqc begins to learn after 5,000 env steps (learning_starts): until then, for about 50 s, ")
    assert about_first_steps("xqc", 5000, 1000.0) == ""
    assert about_first_steps("xqc", 0, 1.0) == ""


def test_a_replay_buffer_that_takes_too_much_memory_is_smaller() -> None:
    images = measured(observation_bytes=84 * 84 * 4)
    assert choose_replay_size(1_000_000, measured(observation_bytes=32), MACHINE) is None
    assert choose_replay_size(1_000_000, images, Machine(cores=2)) is None
    smaller = choose_replay_size(1_000_000, images, MACHINE)
    assert smaller is not None
    assert isinstance(smaller.value, int)
    assert smaller.value * 84 * 84 * 4 < (MACHINE.free_bytes or 0) / 2
    assert smaller.value == 200_000


@pytest.mark.parametrize(
    ("wait_s", "slowest_step_s", "start_s", "reset_s", "expected"),
    [
        (0.04, 0.06, 0.5, 0.1, 30),
        (0.04, 0.5, 0.5, 0.1, 60),
        (0.04, 2.9, 0.5, 0.1, 300),
        (0.04, 3.1, 0.5, 0.1, None),
        (0.04, 0.06, 8.0, 0.1, 120),
        (0.04, 0.06, 0.5, 8.0, 120),
        (1e-4, 0.06, 0.5, 0.1, None),
    ],
)
def test_a_step_timeout_is_far_above_all_measured_times_and_far_below_the_default(
    wait_s: float, slowest_step_s: float, start_s: float, reset_s: float, expected: int | None
) -> None:
    found = measured(wait_s=wait_s, slowest_step_s=slowest_step_s, start_s=start_s, reset_s=reset_s)
    chosen_timeout = choose_step_timeout(600.0, found)
    assert (None if chosen_timeout is None else chosen_timeout.value) == expected
    assert choose_step_timeout(40.0, found) is None


def test_a_run_survives_failures_that_are_twice_as_frequent_as_in_the_measurement() -> None:
    found = measured(wait_s=0.04, cpu_s=0, failures=4, calls=800, calls_s=32.0)  # a failure every 8 s
    (more,) = [choose_max_env_failures(3, found)]
    assert more is not None
    assert (more.name, more.value) == ("max_env_failures", 8)
    now_s, failures = 0.0, FailureCount(int(more.value), copies=1)
    for _ in range(500):
        now_s += 4.0
        assert not failures.failed([0], 4.0, now_s)
        failures.collected(0)
    assert choose_max_env_failures(8, found) is None


def test_without_failures_or_with_too_many_of_them_the_default_number_stays() -> None:
    assert choose_max_env_failures(3, measured(wait_s=0.04)) is None
    assert choose_max_env_failures(3, measured(wait_s=0.04, failures=1, calls=2000, calls_s=80.0)) is None
    assert choose_max_env_failures(3, measured(wait_s=0.001, failures=3, calls=60, calls_s=0.06)) is None


def test_the_time_between_failures_is_that_of_steps_and_resets() -> None:
    """The run counts both as work. Here, 400 steps took 4 s and 20 resets 1,200 s."""
    found = measured(wait_s=0.01, cpu_s=0, reset_s=60.0, failures=1, calls=420, calls_s=1204.0)
    assert choose_max_env_failures(3, found) is None


def test_what_sets_the_number_of_copies_is_said() -> None:
    assert "side by side" in copies_at_once(measured(wait_s=0.01), MACHINE).why
    assert "2 cores" in copies_at_once(measured(cpu_s=0.01), MACHINE).why
    assert "may train" in copies_at_once(measured(wait_s=0.01), Machine(cores=2, most_copies=4)).why
    assert "memory" in copies_at_once(measured(wait_s=0.01), Machine(cores=2, free_bytes=1 << 30)).why


# -------------------------------------------------------------------------------------------------------------- the command


@pytest.mark.parametrize("learning", [PPO, REPLAY])
@pytest.mark.parametrize("wait_s", WAITS_S)
def test_each_setting_has_a_reason_and_the_command_is_one_that_train_takes(wait_s: float, learning: Learning) -> None:
    where = situation(measured(wait_s=wait_s))
    found = chosen(where, learning)
    settings = (ChosenSetting("algo", "ppo", "because"), *reasons(found, learning, where, rate))
    assert all(each.why and "\n" not in each.why for each in settings)
    env_kwargs: dict[str, Scalar] = {
        "render_mode": "rgb array",
        "number": "8",
        "port": "{5000 + slot}",
        "option": "-x",
        "wind": False,
        "g": 9.8,
    }
    command = train_command("CartPole-v1", env_kwargs, ("gymnasium.wrappers:FlattenObservation",), settings)
    program, train, *argv = shlex.split(command)
    assert (program, train) == ("millrace", "train")
    assert f"--max-lag {found.max_lag} " in f"{command} "
    config, _ = read_config("train", argv)
    assert (config.workers, config.envs, config.lanes) == (found.workers, found.envs, found.lanes)
    assert config.env_kwargs == env_kwargs
    assert config.env_kwargs["wind"] is False


def test_a_line_names_the_arguments_of_a_preset_that_were_not_measured() -> None:
    env_kwargs: dict[str, Scalar] = {"game": "Pong", "clip_rewards": False}
    line = added_by_preset("millrace/Atari-v0", env_kwargs, "ppo")
    planned = parse_flags(PlanFlags, ["millrace/Atari-v0", *shlex.split(line[line.index("--env-kwargs") :])], "plan")
    trained, _ = read_config("train", shlex.split(train_command("millrace/Atari-v0", env_kwargs, (), ()))[2:])
    assert planned.env_kwargs == trained.env_kwargs != env_kwargs
    assert added_by_preset("millrace/Atari-v0", trained.env_kwargs, "ppo") == ""
    assert added_by_preset("CartPole-v1", {"x": 1}, "ppo") == ""


def test_more_machines_have_as_many_of_all_and_updates_as_often_as_they_can() -> None:
    here = chosen(situation(measured(wait_s=0.5)), REPLAY)
    ten = on_machines(here, 10, REPLAY)
    assert (ten.workers, ten.envs, ten.lanes) == (10 * here.workers, 10 * here.envs, 10 * here.lanes)
    assert ten.rollout_steps == max(1, 64 // ten.envs)
