"""`send` and `recv`: in any order of completion each copy has the rows of lock-step; a loss costs the others nothing."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import CodeType, FrameType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import millrace
from millrace.learner.members.lane_placement import LanePlacement, PlacedLane
from millrace.learner.members.membership import Membership
from millrace.learner.vector_env import calls, order_coordinator, send_recv, sent_lanes, shared_steps, step_hub
from millrace.learner.vector_env import env as env_module
from millrace.learner.vector_env.batch_layout import BatchLayout
from millrace.learner.vector_env.env import ZmqVectorEnv
from millrace.learner.vector_env.lane_orders import packed, step_order
from millrace.learner.vector_env.order_coordinator import MakeOrder, OrderCoordinator, OrderedLane
from millrace.learner.vector_env.sent_lanes import LONGEST_GAP_S, Asked, AskedReset, Sent, SentLanes, WatchedTime
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.learner.vector_env.shared_steps import SharedSteps
from millrace.learner.vector_env.step_hub import StepHub
from millrace.protocol.errors import EnvironmentFailed, NoWorkers, UsageError, WorkerLost
from millrace.protocol.messages import LaneIncarnation, Reset, Step, Stepped, WorkerExit
from millrace.protocol.wire.plain_values import unpack
from millrace.protocol.wire.wake_up import WakeReason
from tests.support.conversation.example_messages import example
from tests.support.examples import examples
from tests.support.in_process.any_order import AnyOrder, any_order
from tests.support.in_process.rows_of_copies import Row, info_of, of_copies, received
from tests.support.numbers.bit_equality import bit_equal

INFORMS = "tests.support.envs.toy:Informs-v0"
COUNTDOWN = "tests.support.envs.toy:Countdown-v0"
BOTH_WAYS = pytest.mark.parametrize("shared", [True, False], ids=["shared memory", "messages"])


@contextmanager
def made(
    env: str = COUNTDOWN, copies: int = 3, lanes: int = 3, workers: int = 3, *, shared: bool = True, **changes: Any
) -> Iterator[tuple[ZmqVectorEnv, AnyOrder]]:
    """A vector environment whose workers do what the test says."""
    with any_order(VectorEnvSettings(env, copies, lanes=lanes, **changes), workers, shared=shared) as pair:
        yield pair


# ---------------------------------------------------------------- the same rows as in lock-step


def rows_in_lock_step(env: SyncVectorEnv[Any, Any], mode: AutoresetMode, actions: Sequence[Any]) -> list[list[Row]]:
    """The rows of each copy: of the reset, of each step and, with `Disabled`, of each reset after an episode's end."""

    def of_reset(batch: Any, infos: dict[str, Any], n: int) -> Row:
        return Row(of_copies(env, batch)[n], np.float64(0), np.False_, np.False_, info_of(infos, n))

    copies = range(env.num_envs)
    first = env.reset(seed=5)
    found = [[of_reset(*first, n)] for n in copies]
    for action in actions:
        observation, reward, terminated, truncated, infos = env.step(action)
        each = of_copies(env, observation)
        for n in copies:
            found[n].append(Row(each[n], reward[n], terminated[n], truncated[n], info_of(infos, n)))
        ended = terminated | truncated
        if mode is AutoresetMode.DISABLED and ended.any():
            again = env.reset(options={"reset_mask": ended.copy()})
            for n in np.flatnonzero(ended).tolist():
                found[n].append(of_reset(*again, n))
    return found


def rows_apart(env: ZmqVectorEnv, actions: Sequence[Any], draw: Any) -> list[list[Row]]:
    """The rows of each copy when each lane is sent its next action whenever `draw` likes."""
    layout, found = env._layout, list[list[Row]]([] for _ in range(env.num_envs))
    sent = dict.fromkeys(layout.lanes, 0)  # how many actions each lane was sent
    idle: set[int] = set()

    def ended(lane: int) -> list[int]:
        """Copies of the lane that only the caller resets."""
        disabled = env.autoreset_mode is AutoresetMode.DISABLED
        return [n for n in layout.copies(lane) if disabled and (found[n][-1].terminated or found[n][-1].truncated)]

    env.reset_async(seed=5)
    while env.outstanding or any(sent[lane] < len(actions) or ended(lane) for lane in idle):
        if env.outstanding:
            for n, row in received(env, draw(0 if idle else 1, len(env.outstanding))).items():
                found[n].append(row)
                idle.add(layout.lane_of(n))
        for lane in sorted(idle):
            if (over := ended(lane)) and draw(0, 1):
                env.reset_async(env_ids=over)
                idle.remove(lane)
        ready = [lane for lane in sorted(idle) if sent[lane] < len(actions) and not ended(lane)]
        chosen = ready[draw(0, len(ready)) :]
        ids = [n for lane in chosen[::-1] for n in layout.copies(lane)]  # not in the order of the copies
        if ids:
            each = [(n, actions[sent[layout.lane_of(n)]]) for n in ids]
            env.send({key: np.stack([action[key][n] for n, action in each]) for key in actions[0]}, ids)
        for lane in chosen:
            sent[lane] += 1
            idle.remove(lane)
    return found


@settings(examples(40), phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink))
@given(
    st.sampled_from(list(AutoresetMode)), st.booleans(), st.sampled_from([(3, 3), (3, 1), (2, 2)]), st.integers(2, 12),
    st.data(),
)  # fmt: skip
def test_each_copy_has_the_rows_of_lock_step_in_any_order_of_completion(
    mode: AutoresetMode, shared: bool, lanes_and_workers: tuple[int, int], steps: int, data: st.DataObject
) -> None:
    def draw(least: int, most: int) -> int:
        return data.draw(st.integers(least, most))

    lanes, workers = lanes_and_workers
    theirs = SyncVectorEnv([lambda: gymnasium.make(INFORMS, disable_env_checker=True)] * 3, autoreset_mode=mode)
    theirs.action_space.seed(3)
    actions = [theirs.action_space.sample() for _ in range(steps)]
    wanted = rows_in_lock_step(theirs, mode, actions)
    theirs.close()
    with made(INFORMS, 3, lanes, workers, shared=shared, autoreset_mode=mode.value) as (env, link):
        link.choose = lambda count: draw(0, count - 1)
        found = rows_apart(env, actions, draw)
        for mine, other in zip(found, wanted, strict=True):
            assert len(mine) == len(other)
            for t, (row, wanted_row) in enumerate(zip(mine, other, strict=True)):
                assert bit_equal(tuple(row), tuple(wanted_row)), f"row {t}: {row} is not {wanted_row}"


def rows_in_parts(env: ZmqVectorEnv, actions: Sequence[Any], parts: Sequence[Sequence[int]]) -> list[list[Row]]:
    """The rows of each copy when the lanes of a part are waited for together, while those of the others step."""
    layout = env._layout
    first, infos = env.reset(seed=5)
    each = of_copies(env, first)
    found = [[Row(each[n], np.float64(0), np.False_, np.False_, info_of(infos, n))] for n in range(env.num_envs)]
    for action in [*actions, None]:
        for lanes in parts:
            if env.outstanding and layout.copies(lanes[0])[0] in env.outstanding:
                observation, reward, terminated, truncated, infos = env.end_step(lanes)
                each = of_copies(env, observation)
                for n in layout.copies_of(lanes):
                    found[n].append(Row(each[n], reward[n], terminated[n], truncated[n], info_of(infos, n)))
            if action is not None:
                env.begin_step(lanes, action)
    return found


@settings(examples(30), phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink))
@given(st.booleans(), st.sampled_from([((0,), (1, 2)), ((2, 0), (1,)), ((1,), (0,), (2,))]), st.integers(2, 12), st.data())
def test_parts_that_step_by_turns_have_the_rows_of_lock_step(
    shared: bool, parts: Sequence[Sequence[int]], steps: int, data: st.DataObject
) -> None:
    theirs = SyncVectorEnv([lambda: gymnasium.make(INFORMS, disable_env_checker=True)] * 3)
    theirs.action_space.seed(3)
    actions = [theirs.action_space.sample() for _ in range(steps)]
    wanted = rows_in_lock_step(theirs, AutoresetMode.NEXT_STEP, actions)
    theirs.close()
    with made(INFORMS, 3, 3, 3, shared=shared) as (env, link):
        link.choose = lambda count: data.draw(st.integers(0, count - 1))
        found = rows_in_parts(env, actions, parts)
    for mine, other in zip(found, wanted, strict=True):
        assert len(mine) == len(other)
        for t, (row, wanted_row) in enumerate(zip(mine, other, strict=True)):
            assert bit_equal(tuple(row), tuple(wanted_row)), f"row {t}: {row} is not {wanted_row}"


@BOTH_WAYS
def test_actions_go_to_their_copies_also_where_shared_memory_would_round_them(shared: bool) -> None:
    """The results of `recv` are the caller's own: later steps do not change them."""
    with made("Pendulum-v1", 2, 2, 2, shared=shared) as (env, link):
        theirs = SyncVectorEnv([lambda: gymnasium.make("Pendulum-v1")] * 2)
        theirs.reset(seed=1)
        env.reset_async(seed=1)
        env.recv(2)
        kept = []
        for t in range(6):
            actions = np.random.default_rng(t).uniform(-2, 2, (2, 1)).astype(np.float64 if t % 2 else np.float32)
            env.send(actions[::-1], [1, 0])
            wanted, (*mine, infos) = theirs.step(actions), env.recv(2)
            assert infos["env_id"].tolist() == [0, 1]
            kept += [(one, np.copy(two)) for one, two in zip(mine, wanted[:4], strict=True)]
            assert all(bit_equal(one, two) for one, two in kept)
        assert [type(order) for order in link.orders] == [Reset, Reset, *[Step] * (6 if shared else 12)]
        theirs.close()


def test_a_worker_wakes_the_learner_when_its_lane_is_done_although_others_are_not() -> None:
    with made() as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.frozen = {"w0", "w2"}
        send(env, [0, 1, 2])
        link.execute()
        assert link.memory is not None
        assert link.memory.unanswered_orders() == 2
        assert env.hub.shared is not None
        assert env.hub.shared._to_learner.wait(0.0) is WakeReason.STEP


def test_infos_too_long_for_shared_memory_are_those_of_the_step_under_way() -> None:
    with made(copies=1, lanes=1, workers=1) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0"}
        env.step_async(zeros([0]))
        hub = env.hub
        assert hub.shared is not None
        assert link.memory is not None
        number = hub.shared.under_way[0]
        link.memory.answer(0, number, bytes(link.memory.info_bytes[0] + 1))
        lane = hub.coordinator.lanes[0]
        for other in (number - 1, number + 1):
            lane.long_infos = example(Stepped, ticket=-other)
            assert hub.take() == {}
        lane.long_infos = example(Stepped, ticket=-number, infos=np.frombuffer(b"words", np.uint8))
        assert hub.take() == {0: b"words"}
        assert hub.take() == {}


def test_the_example_of_send_runs() -> None:
    _, _, example = (inspect.getdoc(ZmqVectorEnv.send) or "").partition("envs = ")
    names: dict[str, Any] = {"millrace": millrace, "policy": lambda observation: np.zeros(len(observation), np.int64)}
    exec("envs = " + example, names)
    assert names["envs"].outstanding
    names["envs"].close()


# ---------------------------------------------------------------- losses

NEXT, SAME, DISABLED = "NextStep", "SameStep", "Disabled"
LEFT = "worker w1 (host) left: killed"


def zeros(ids: Sequence[int]) -> Any:
    return np.zeros(len(ids), np.int64)


def send(env: ZmqVectorEnv, ids: Sequence[int]) -> None:
    env.send(zeros(ids), ids)


@BOTH_WAYS
def test_a_worker_lost_under_way_comes_back_truncated_and_costs_no_other_its_results(
    shared: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with made(shared=shared) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        send(env, [0, 1, 2])
        env.recv(3)
        link.frozen = {"w1"}
        send(env, [0, 1, 2])
        assert sorted(received(env, 2)) == [0, 2]
        send(env, [0])
        link.leave("w1")
        rows = received(env, 2)
        assert {n: row.truncated for n, row in rows.items()} == {0: False, 1: True}
        assert caplog.messages[-1] == f"{LEFT}; its lane 1 comes back truncated (copies 1 to 1)"
        assert rows[1].observation == np.float32(0.8), "the newest that arrived"
        assert (rows[1].reward, rows[1].terminated, rows[1].info) == (0.0, False, {"worker_lost": True})
        send(env, [1, 0])
        rows = received(env, 2)
        assert rows[1].observation == 1.0, "this step resets the new copy"
        assert (rows[1].reward, rows[1].truncated, rows[1].info) == (0.0, False, {})
        assert rows[0].observation == np.float32(0.2), "the other episode went on"
        (reset,) = [order for order in link.orders if isinstance(order, Reset)][3:]
        assert (reset.lane, reset.seeds[0] in (None, 2)) == (1, False), "with a seed of the new copy's own"
        send(env, [1])
        assert received(env)[1].observation == np.float32(0.8)


@BOTH_WAYS
def test_a_worker_lost_while_its_copies_are_here_is_reported_for_the_next_step(shared: bool) -> None:
    with made(shared=shared) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.leave("w2")
        send(env, [0, 2])
        rows = received(env, 2)
        assert (rows[2].truncated, rows[2].info) == (True, {"worker_lost": True})
        send(env, [2])
        row = received(env)[2]
        assert (row.observation, row.truncated) == (1.0, False)


def test_a_copy_that_is_reset_after_its_loss_is_not_reported() -> None:
    with made(shared=False) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.leave("w2")
        send(env, [0])
        env.recv()  # hears of the loss
        env.reset_async(env_ids=[2])
        assert received(env)[2].observation == 1.0
        send(env, [2])
        row = received(env)[2]
        assert (row.observation, row.info) == (np.float32(0.8), {})


def test_a_loss_after_the_answer_to_a_reset_is_reported_although_a_step_of_another_lane_noticed_it_first() -> None:
    with made(copies=2, lanes=2, workers=2, shared=False) as (env, link):
        env.reset(seed=1)
        env.reset_async(env_ids=[0])
        link.execute()
        env.hub.listen()
        link.leave("w0")
        env.hub.listen()
        send(env, [1])
        assert [row.truncated for row in received(env, 2).values()] == [False, False]
        send(env, [0])
        assert received(env)[0].info == {"worker_lost": True}


@BOTH_WAYS
def test_a_worker_lost_in_one_part_truncates_its_copies_and_no_others(shared: bool) -> None:
    with made(shared=shared) as (env, link):
        env.reset(seed=1)
        env.begin_step([0, 1], zeros(range(3)))
        env.begin_step([2], zeros(range(3)))
        link.frozen = {"w1", "w2"}
        link.leave("w1")
        _, _, _, truncated, infos = env.end_step([0, 1])
        assert truncated[:2].tolist() == [False, True]
        assert infos["worker_lost"][:2].tolist() == [False, True]
        link.frozen = set()
        observation, reward, _, truncated, infos = env.end_step([2])
        assert (observation[2, 0], reward[2], truncated[2]) == (np.float32(0.8), 1.0, False)
        assert "worker_lost" not in infos, "it was reported before"


@BOTH_WAYS
def test_attributes_are_set_while_other_lanes_step(shared: bool) -> None:
    with made(INFORMS, shared=shared) as (env, _):
        env.reset(seed=1)
        actions = env.action_space.sample()
        env.begin_step([2], actions)
        env.calls.assign([0, 1], "level", [3, 4])
        env.begin_step([0, 1], actions)
        env.end_step([2])
        env.end_step([0, 1])
        assert env.get_attr("level")[:2] == (3, 4)


@BOTH_WAYS
def test_a_worker_lost_in_a_call_costs_lanes_that_step_meanwhile_nothing(shared: bool) -> None:
    with made(shared=shared) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0", "w2"}
        env.begin_step([2], zeros(range(3)))
        gone = iter([lambda: link.leave("w0")])
        env.hub.while_waiting = lambda: next(gone, lambda: None)()
        with pytest.raises(WorkerLost, match=r"worker w0 \(host\) left: killed: lane 0 \(copies 0 to 0\) is lost"):
            env.calls.call([0, 1], "render_mode", (), {})
        assert env.outstanding == [2]
        env.begin_step([0, 1], zeros(range(3)))
        link.frozen = set()
        observation, reward, _, truncated, infos = env.end_step([2])
        assert (observation[2, 0], reward[2], truncated[2], infos) == (np.float32(0.8), 1.0, False, {})
        observation, reward, _, truncated, infos = env.end_step([0, 1])
        assert (reward[:2].tolist(), truncated[:2].tolist()) == ([0.0, 1.0], [True, False])
        assert infos["worker_lost"].tolist() == [True, False, False]


def test_a_step_ends_only_once_it_has_begun() -> None:
    with made() as (env, _):
        env.reset(seed=1)
        env.begin_step([0, 1], zeros(range(3)))
        with pytest.raises(NoAsyncCallError, match=r"lanes \[2\] are not under way: expected an order to them first"):
            env.end_step([1, 2])
        env.end_step([0, 1])
        with pytest.raises(NoAsyncCallError, match=r"lanes \[0\] are not under way"):
            env.end_step([0])


@BOTH_WAYS
def test_what_was_abandoned_does_not_come_back(shared: bool) -> None:
    with made(shared=shared) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0", "w1", "w2"}
        env.begin_step([0], zeros(range(3)))
        env.begin_step([1, 2], zeros(range(3)))
        env.abandon()
        assert env.outstanding == []
        link.frozen = set()
        observation, _ = env.reset(seed=1)
        assert observation[:, 0].tolist() == [1.0, 1.0, 1.0], "the first observations of new episodes"


@BOTH_WAYS
def test_a_step_that_was_abandoned_before_its_worker_saw_it_is_not_made_after_a_reset(shared: bool) -> None:
    with made(copies=1, lanes=1, workers=1, shared=shared) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0"}
        env.begin_step([0], zeros([0]))
        env.abandon()
        env.reset_async(seed=1)
        link.frozen = set()  # the worker now gets both orders
        env.reset_wait()
        observation, reward, *_ = env.step(zeros([0]))
        assert (observation.tolist(), reward.tolist()) == ([[pytest.approx(0.8)]], [1.0]), "of one step"


def interrupt_after(env: ZmqVectorEnv, *calls: Callable[[], None], error: type[BaseException] = InterruptedError) -> None:
    """While the environment waits, each of these is called, and then this error ends the wait."""
    steps = iter(calls)

    def stop() -> None:
        if (call := next(steps, None)) is None:
            raise error("stop")
        call()

    env.hub.while_waiting = stop


@contextmanager
def interrupted_after(env: ZmqVectorEnv, *calls: Callable[[], None]) -> Iterator[None]:
    """The body waits, and is interrupted as by `interrupt_after`. Later waits aren't."""
    interrupt_after(env, *calls)
    with pytest.raises(InterruptedError):
        yield
    env.hub.while_waiting = lambda: None


def test_the_answer_to_an_order_for_which_nobody_waits_any_more_is_not_taken_for_a_later_one() -> None:
    with made(shared=False) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0", "w1", "w2"}
        env.step_async(zeros(range(3)))
        with interrupted_after(env):
            env.step_wait()
        env.reset_async(seed=1)
        link.frozen = set()
        abandoned = [0, 0, 0]
        link.choose = lambda count: abandoned.pop() if abandoned else count - 1  # only the old orders at first
        assert {n: float(row.observation[0]) for n, row in received(env, 3).items()} == {0: 1.0, 1: 1.0, 2: 1.0}


@BOTH_WAYS
def test_results_that_came_before_the_loss_are_returned_first(shared: bool) -> None:
    with made(shared=shared) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        send(env, [0, 1, 2])
        link.frozen = {"w0"}
        assert sorted(received(env, 2)) == [1, 2]
        link.frozen = set()
        link.execute()
        link.leave("w0")
        rows = received(env)
        assert (rows[0].observation, rows[0].truncated, rows[0].info) == (np.float32(0.8), False, {})
        send(env, [0])
        assert received(env)[0].info == {"worker_lost": True}


@BOTH_WAYS
def test_with_same_step_the_row_of_a_lost_copy_has_its_last_observation_and_a_new_first_one(
    shared: bool, caplog: pytest.LogCaptureFixture
) -> None:
    with made(shared=shared, autoreset_mode=SAME) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        send(env, [0, 1, 2])
        env.recv(3)
        link.frozen = {"w1"}
        send(env, [1])
        link.leave("w1")
        row = received(env)[1]
        assert (row.observation, row.reward, row.truncated) == (1.0, 0.0, True)
        assert row.info["final_obs"] == np.float32(0.8)
        assert row.info["worker_lost"]
        assert row.info["final_info"] == {"worker_lost": True}
        assert caplog.messages[-1] == f"{LEFT}; its lane 1 comes back truncated (copies 1 to 1)"
        resets = [order for order in link.orders if isinstance(order, Reset)]
        assert len(resets) == 4
        assert resets[-1].seeds[0] not in (None, 2), "a seed of its own, but the same whenever this loss is repeated"
        send(env, [1])
        assert received(env)[1].observation == np.float32(0.8)


def test_with_disabled_the_caller_resets_a_lost_copy() -> None:
    with made(autoreset_mode=DISABLED) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.frozen = {"w1"}
        send(env, [1])
        link.leave("w1")
        assert received(env)[1].truncated
        with pytest.raises(UsageError, match=r"copies \[1\] have ended: .* expected reset_async\(env_ids=\[1\]\) or reset"):
            send(env, [1])
        env.reset_async(env_ids=[1])
        assert received(env)[1].observation == 1.0
        send(env, [1])
        assert received(env)[1].observation == np.float32(0.8)


def test_a_reset_is_repeated_when_its_worker_is_lost() -> None:
    with made() as (env, link):
        link.frozen = {"w1"}
        env.reset_async(seed=7)
        assert sorted(received(env, 2)) == [0, 2]
        link.leave("w1")
        row = received(env)[1]
        assert (row.observation, row.truncated, row.info) == (1.0, False, {})
        assert [order.seeds for order in link.orders if isinstance(order, Reset) and order.lane == 1] == [(8,), (8,)]
        send(env, [1])
        assert received(env)[1].observation == np.float32(0.8)


def test_copies_are_made_again_when_a_worker_is_lost_over_it() -> None:
    with made() as (env, link):
        link.frozen, leaving = {"w1"}, ["w1"]

        def watch() -> None:
            while leaving:
                link.leave(leaving.pop())

        env.hub.while_waiting = watch
        env.calls.make()
        env.reset(seed=7)
        assert not env.step(np.zeros((3, 1), np.float32))[3].any(), "no episode had begun"


def test_where_no_worker_is_left_the_error_says_what_became_of_the_last_one() -> None:
    with made(copies=1, lanes=1, workers=1) as (env, link):
        link.frozen = {"w0"}
        env.reset_async(seed=1)
        with pytest.raises(NoWorkers, match=r"0 joined \(the last one did not answer within 5 s\)"):
            env.reset_wait(5.0)


def test_after_three_lost_resets_the_loss_is_raised() -> None:
    with made(copies=1, lanes=1, workers=4) as (env, link):
        link.frozen = {f"w{n}" for n in range(4)}
        env.reset_async(seed=7)
        for n in range(3):
            assert not env.recv(0)[1].size
            link.leave(f"w{n}")
        with pytest.raises(WorkerLost, match=r"worker w2 \(host\) left: killed: lane 0 \(copies 0 to 0\) is lost"):
            env.recv()
        assert env.outstanding == []
        link.frozen = set()
        env.reset_async(env_ids=[0], seed=7)
        assert received(env)[0].observation == 1.0


def test_copies_of_a_lane_that_were_not_asked_for_a_reset_are_reported_when_it_is_lost() -> None:
    with made(copies=2, lanes=1, workers=2, autoreset_mode=DISABLED) as (env, link):
        env.reset_async(seed=1)
        env.recv(2)
        send(env, [0, 1])
        env.recv(2)
        link.frozen = {"w0"}
        env.reset_async(env_ids=[1])
        link.leave("w0")
        assert {n: row.observation for n, row in received(env).items()} == {1: 1.0}
        send(env, [0, 1])
        rows = received(env, 2)
        assert [row.info for row in rows.values()] == [{"worker_lost": True}] * 2, "never hidden: the lane is new"


@pytest.mark.parametrize("mode", [NEXT, DISABLED])
def test_also_a_reset_in_lock_step_of_some_copies_does_not_hide_that_the_others_of_the_lane_were_lost(mode: str) -> None:
    with made(copies=2, lanes=1, workers=2, autoreset_mode=mode) as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        link.frozen = {"w0"}
        gone = iter([lambda: link.leave("w0")])
        env.hub.while_waiting = lambda: next(gone, lambda: None)()
        env.reset(options={"reset_mask": np.array([False, True])})
        _, reward, _, truncated, infos = env.step(zeros([0, 1]))
        assert (reward.tolist(), truncated.tolist()) == ([0.0, 0.0], [True, True])
        assert infos["worker_lost"].tolist() == [True, True]


@pytest.mark.parametrize("mode", [NEXT, SAME, DISABLED])
def test_a_loss_that_was_noticed_before_a_reset_of_some_copies_is_not_hidden_either(mode: str) -> None:
    with made(copies=2, lanes=1, workers=2, autoreset_mode=mode) as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        link.leave("w0")
        link.join("w2")
        link.join("w3")
        env.hub.wait_for(3, 1.0)  # notices it
        env.reset(options={"reset_mask": np.array([True, False])})
        _, reward, _, truncated, infos = env.step(zeros([0, 1]))
        assert (reward.tolist(), truncated.tolist()) == ([0.0, 0.0], [True, True])
        assert infos["worker_lost"].tolist() == [True, True]


def test_copies_that_were_lost_are_reset_together_with_same_step_autoreset() -> None:
    with made(copies=2, lanes=1, workers=2, autoreset_mode=SAME, on_worker_loss="raise") as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        link.leave("w0")
        with pytest.raises(WorkerLost, match=r"lane 0 \(copies 0 to 1\) is lost"):
            env.step(zeros([0, 1]))
        expected = r"reset of copies \[1\]: expected all copies of lane 0 \(0 to 1\), which were lost with their worker"
        with pytest.raises(UsageError, match=expected):
            env.reset(options={"reset_mask": np.array([False, True])})
        with pytest.raises(UsageError, match=expected):
            env.reset_async(env_ids=[1])
        env.reset(options={"reset_mask": np.array([True, True])})
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]
        env.reset(options={"reset_mask": np.array([False, True])})  # of copies that were reset since


@contextmanager
def loses_w0_in_a_call(loss: str) -> Iterator[ZmqVectorEnv]:
    """Two lanes of one copy; the worker of the first was lost in a `call`, which has raised that."""
    with made(copies=2, lanes=2, workers=2, on_worker_loss=loss) as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        link.frozen = {"w0"}
        gone = iter([lambda: link.leave("w0")])
        env.hub.while_waiting = lambda: next(gone, lambda: None)()
        with pytest.raises(WorkerLost, match=r"worker w0 \(host\) left: killed: lane 0 \(copies 0 to 0\) is lost"):
            env.call("render_mode")
        yield env


@pytest.mark.parametrize("loss", ["raise", "truncate"])
def test_a_loss_that_a_call_has_raised_is_over_when_its_copies_are_reset(loss: str) -> None:
    with loses_w0_in_a_call(loss) as env:
        env.reset(options={"reset_mask": np.array([True, False])})
        _, reward, _, truncated, infos = env.step(zeros([0, 1]))
        assert (reward.tolist(), truncated.tolist(), infos) == ([1.0, 1.0], [False, False], {})


def test_a_loss_that_a_call_has_raised_is_not_raised_anew_by_a_step() -> None:
    again = r"^lanes \[0\] were lost with their worker; call reset\(\) or reset_async\(env_ids=\[0\]\) first$"
    with loses_w0_in_a_call("raise") as env, pytest.raises(WorkerLost, match=again):
        env.step(zeros([0, 1]))


def test_with_truncate_the_step_after_a_call_that_lost_a_worker_truncates() -> None:
    with loses_w0_in_a_call("truncate") as env:
        assert env.step(zeros([0, 1]))[3].tolist() == [True, False]


def test_with_raise_recv_names_the_lost_copies_once_and_the_others_can_be_received() -> None:
    with made(on_worker_loss="raise") as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.frozen = {"w1"}
        send(env, [0, 1, 2])
        link.leave("w1")
        with pytest.raises(WorkerLost, match=r"worker w1 \(host\) left: killed: lane 1 \(copies 1 to 1\) is lost"):
            env.recv(3)
        assert env.outstanding == [0, 2]
        assert sorted(received(env, 2)) == [0, 2]
        with pytest.raises(
            WorkerLost,
            match=r"lanes \[1\] were lost with their worker; call reset\(\) or reset_async\(env_ids=\[1\]\) first",
        ):
            send(env, [1])
        env.reset_async(env_ids=[1])
        assert received(env)[1].observation == 1.0
        send(env, [1])
        assert received(env)[1].observation == np.float32(0.8)


@BOTH_WAYS
def test_a_worker_that_takes_too_long_is_given_up_while_the_others_go_on(shared: bool) -> None:
    with made(shared=shared, timeout_s=10.0) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        send(env, [0, 1, 2])
        link.frozen = {"w1"}
        began_s, others = link.now, 0
        while True:
            link.now += 0.1
            rows = received(env)
            if 1 in rows:
                break
            others += len(rows)
            send(env, list(rows))
        assert rows[1].info == {"worker_lost": True}
        assert 9.9 < link.now - began_s < 10.5
        assert others > 150


def test_time_in_which_the_caller_did_other_things_counts_little() -> None:
    with made(timeout_s=10.0) as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.frozen = {"w1"}
        send(env, [0, 1, 2])
        assert sorted(received(env, 2)) == [0, 2]
        link.now += 3600.0
        assert not env.recv(0)[1].size
        link.frozen = set()
        assert received(env)[1].observation == np.float32(0.8)


def test_an_error_of_an_environment_is_raised_and_costs_the_others_nothing() -> None:
    with made("tests.support.envs.toy:Raises-v0", kwargs={"after": 1, "only_seed": 2}) as (env, _):
        env.reset_async(seed=1)
        env.recv(3)
        send(env, [0, 1, 2])
        env.recv(3)
        send(env, [0, 1, 2])
        with pytest.raises(EnvironmentFailed, match="lane 1, copy 0, step 1: its environment raised ValueError"):
            env.recv(3)
        rows = received(env, 3)
        assert {n: row.info for n, row in rows.items()} == {0: {}, 1: {"worker_lost": True}, 2: {}}
        send(env, [0, 1, 2])
        assert {n: float(row.observation[0]) for n, row in received(env, 3).items()} == pytest.approx(
            {0: 0.4, 1: 1.0, 2: 0.4}
        )


def test_an_error_that_a_step_in_lock_step_has_raised_is_not_told_again_by_the_next() -> None:
    with made("tests.support.envs.toy:Raises-v0", kwargs={"after": 1, "only_seed": 2}) as (env, _):
        env.reset(seed=1), env.step(zeros([0, 1, 2]))
        with pytest.raises(EnvironmentFailed, match="lane 1, copy 0, step 1: its environment raised ValueError"):
            env.step(zeros([0, 1, 2]))
        assert not env.step(zeros([0, 1, 2]))[3].any(), "this step resets the new copy"


def test_a_copy_that_was_never_reset_is_not_stepped_although_another_of_its_lane_was() -> None:
    with made(copies=2, lanes=1, workers=1) as (env, _):
        env.reset_async(env_ids=[0])
        env.recv(1)
        with pytest.raises(UsageError, match=r"step before reset of copies \[1\]"):
            env.step(zeros([0, 1]))


def test_a_loss_of_which_an_interrupted_step_did_not_tell_is_over_when_all_are_reset() -> None:
    with made(copies=2, lanes=2, workers=2, on_worker_loss="raise") as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0", "w1"}
        with interrupted_after(env, lambda: link.leave("w1"), lambda: None, lambda: None):
            env.step(zeros([0, 1]))
        link.frozen = set()
        env.reset()
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


@contextmanager
def interrupted_reset_of_lost_copies(lost: str, **changes: Any) -> Iterator[ZmqVectorEnv]:
    """Two lanes of one copy, which are lost before a reset or during it. The reset was interrupted while it waited for
    workers; now there are two.
    """
    with made(copies=2, lanes=2, workers=2, **changes) as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        link.frozen = {"w0", "w1"}
        leave = [lambda: link.leave("w0"), lambda: link.leave("w1")]
        if lost == "before":
            while leave:
                leave.pop()()
        if lost == "reported":
            interrupt_after(env, *leave, lambda: None)
            assert env.step(zeros([0, 1]))[3].all()
            leave.clear()
        with interrupted_after(env, *leave, lambda: None, lambda: None):
            env.reset(seed=2)
        link.frozen = set()
        for worker in ("w2", "w3"):
            link.join(worker)
        env.hub.wait_for(2, 1.0)
        yield env


@pytest.mark.parametrize("lost", ["before", "during"])
@pytest.mark.parametrize("mode", [NEXT, SAME, DISABLED])
def test_a_loss_is_reported_if_the_reset_that_would_have_ended_it_was_interrupted(mode: str, lost: str) -> None:
    with interrupted_reset_of_lost_copies(lost, autoreset_mode=mode) as env:
        observation, reward, _, truncated, infos = env.step(zeros([0, 1]))
        assert (reward.tolist(), truncated.tolist()) == ([0.0, 0.0], [True, True])
        assert infos["worker_lost"].tolist() == [True, True]
        if mode == NEXT:
            observation = env.step(zeros([0, 1]))[0]
        if mode == DISABLED:
            observation = env.reset(seed=3)[0]
        assert observation.tolist() == [[1.0], [1.0]], "the first observations of new episodes"
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


def test_with_raise_it_is_raised_if_the_reset_that_would_have_ended_it_was_interrupted() -> None:
    says = (
        r"^worker w1 \(host\) left: killed: lane 1 \(copies 1 to 1\) is lost; "
        r"worker w0 \(host\) left: killed: lane 0 \(copies 0 to 0\) is lost$"
    )
    with interrupted_reset_of_lost_copies("before", on_worker_loss="raise") as env:
        with pytest.raises(WorkerLost, match=says):
            env.step(zeros([0, 1]))
        assert env.reset(seed=3)[0].tolist() == [[1.0], [1.0]]
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


def test_a_loss_that_a_step_has_reported_is_not_reported_again_if_the_reset_after_it_was_interrupted() -> None:
    with interrupted_reset_of_lost_copies("reported") as env:
        observation, _, _, truncated, _ = env.step(zeros([0, 1]))
        assert (observation.tolist(), truncated.tolist()) == ([[1.0], [1.0]], [False, False])


@pytest.mark.parametrize("mode", [NEXT, SAME, DISABLED])
@pytest.mark.parametrize("sent", [0, 1])
def test_a_loss_is_reported_if_its_reset_was_interrupted_before_or_after_the_lane_got_it(
    mode: str, sent: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here, the lanes below `sent` have got their reset. The caller was not told that they were reset."""
    with made(copies=2, lanes=2, workers=2, autoreset_mode=mode) as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        for lost, new in (("w0", "w2"), ("w1", "w3")):
            link.leave(lost)
            link.join(new)
        env.hub.wait_for(2, 1.0)
        send_order = env.hub.send_order

        def interrupted_at(lane: int, make: MakeOrder) -> None:
            if lane == sent:
                raise InterruptedError("stop")
            send_order(lane, make)

        with monkeypatch.context() as patched, pytest.raises(InterruptedError):
            patched.setattr(env.hub, "send_order", interrupted_at)
            env.reset(seed=2)
        _, reward, _, truncated, _ = env.step(zeros([0, 1]))
        assert truncated.tolist() == [True, True]
        assert reward.tolist() == [0.0, 0.0]


@contextmanager
def one_lost_copy_of_two(**changes: Any) -> Iterator[tuple[ZmqVectorEnv, AnyOrder]]:
    """Two lanes of one copy. The first copy was lost, and has a new worker; the other's worker does nothing."""
    with made(copies=2, lanes=2, workers=2, **changes) as (env, link):
        env.reset(seed=1), env.step(zeros([0, 1]))
        link.leave("w0")
        link.join("w2")
        env.hub.wait_for(2, 1.0)
        link.frozen = {"w1"}
        yield env, link


@pytest.mark.parametrize("mode", [NEXT, SAME, DISABLED])
def test_a_loss_is_reported_if_its_reset_was_interrupted_while_it_waited_for_another_lane(mode: str) -> None:
    with one_lost_copy_of_two(autoreset_mode=mode) as (env, link):
        with interrupted_after(env, lambda: None, lambda: None):
            env.reset(seed=2)
        link.frozen = set()
        env.call("render_mode")  # its results are not those of the reset
        _, reward, _, truncated, _ = env.step(zeros([0, 1]))
        assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [True, False])


@BOTH_WAYS
def test_a_step_reports_a_loss_at_once_although_the_worker_still_executes_the_reset_that_was_interrupted(
    shared: bool,
) -> None:
    with one_lost_copy_of_two(shared=shared, timeout_s=10.0) as (env, link):
        link.frozen = {"w2"}  # its simulator starts slowly
        with interrupted_after(env, lambda: None, lambda: None):
            env.reset(seed=2)
        began_s = link.now
        _, reward, _, truncated, _ = env.step(zeros([0, 1]))
        assert (reward.tolist(), truncated.tolist()) == ([0.0, 1.0], [True, False])
        assert link.now - began_s < 1.0
        link.frozen = set()
        observation, _, _, truncated, _ = env.step(zeros([0, 1]))
        assert (observation[0].tolist(), truncated.tolist()) == ([1.0], [False, False]), "w2 still has the lane"


@pytest.mark.parametrize("why", ["interrupt", "another loss"])
def test_with_raise_it_is_raised_if_its_reset_was_not_returned(why: str) -> None:
    with one_lost_copy_of_two(on_worker_loss="raise") as (env, link):
        if why == "interrupt":
            with interrupted_after(env, lambda: None, lambda: None):
                env.reset(seed=2)
        else:
            turns = iter(range(2))
            env.hub.while_waiting = lambda: link.leave("w1") if next(turns, None) == 1 else None
            with pytest.raises(WorkerLost, match=r"^worker w1 \(host\) left: killed: lane 1 \(copies 1 to 1\) is lost$"):
                env.reset(seed=2)
            env.reset_async(env_ids=[1])
            assert received(env)[1].observation == 1.0
        link.frozen = set()
        with pytest.raises(WorkerLost, match=r"^worker w0 \(host\) left: killed: lane 0 \(copies 0 to 0\) is lost$"):
            env.step(zeros([0, 1]))
        env.reset(seed=3)
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("mode", [NEXT, SAME, DISABLED])
def test_no_loss_is_reported_if_no_worker_had_the_copies(mode: str) -> None:
    with made(copies=2, lanes=1, workers=1, autoreset_mode=mode) as (env, link):
        link.leave("w0")
        with interrupted_after(env, lambda: None):
            env.reset(seed=1)
        link.join("w9")
        for copy in (0, 1):
            env.reset_async(env_ids=[copy])
            assert received(env)[copy].observation == 1.0
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


def test_a_loss_between_two_calls_is_over_when_all_are_reset() -> None:
    with made(on_worker_loss="raise") as (env, link):
        env.reset(seed=1)
        link.leave("w1")
        env.reset()
        assert env.step(zeros(range(3)))[1].tolist() == [1.0] * 3


def test_an_order_that_waited_for_a_worker_is_not_sent_once_nobody_waits_for_it() -> None:
    with made(copies=1, lanes=1, workers=1) as (env, link):
        link.leave("w0")
        with interrupted_after(env, lambda: None):
            env.reset(seed=1)
        link.join("w9")
        env.hub.wait(1.0, together=True)
        env.reset(seed=2)
        assert [order.seeds for order in link.orders if isinstance(order, Reset)] == [(2,)]


def test_a_lane_whose_results_had_come_has_them_although_its_worker_is_lost_before_another_is_done() -> None:
    with made(copies=2, lanes=2, workers=2) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0"}
        send(env, [0, 1])
        with interrupted_after(env, lambda: None, lambda: None):
            env.recv(2)
        link.leave("w1")
        with interrupted_after(env, lambda: None):
            env.recv(2)
        link.frozen = set()
        assert [row.truncated for row in received(env, 2).values()] == [False, False]


def test_each_copy_has_its_own_options_also_if_not_all_are_reset() -> None:
    with made(copies=2, lanes=1, workers=1) as (env, link):
        env.reset_async(options=[{"of": 0}, {"of": 1}], env_ids=[1])
        env.recv(1)
        (order,) = (order for order in link.orders if isinstance(order, Reset))
        assert (order.copies, unpack(order.options.data)) == ((1,), [{"of": 1}])


def test_a_reset_of_all_copies_keeps_their_attributes_and_random_generators_although_a_worker_has_none() -> None:
    with made(INFORMS, copies=2, lanes=2, workers=1) as (env, link):
        env.reset(seed=1)
        env.set_attr("level", 7)
        link.join("w9")
        env.reset()
        assert env.get_attr("level") == (7, 7)
        assert env.np_random_seed == (1, 2)


def test_a_copy_that_is_reset_without_a_seed_keeps_its_own_for_its_replacement() -> None:
    with made(autoreset_mode=SAME) as (env, link):
        for seed in (1, None):
            env.reset_async(seed=seed)
            env.recv(3)
        link.frozen = {"w1"}
        send(env, [1])
        link.leave("w1")
        received(env)
        last = [order for order in link.orders if isinstance(order, Reset)][-1]
        assert last.seeds[0] not in (None, 2)


def test_without_any_worker_the_wait_ends_and_goes_on_when_one_joins() -> None:
    with made(copies=1, lanes=1, workers=1, timeout_s=5.0) as (env, link):
        link.leave("w0")
        env.reset_async(seed=1)
        with pytest.raises(NoWorkers, match="waited 5 s for 1 worker"):
            env.recv()
        assert env.outstanding == [0]
        link.join("w9")
        assert received(env)[0].observation == 1.0


def test_long_infos_come_with_their_step_and_a_loss_before_they_came_is_reported_later() -> None:
    with made(INFORMS, 1, 1, 1, kwargs={"wordy": 1_500_000}) as (env, link):
        env.reset_async(seed=1)
        env.recv()
        action = {"move": np.zeros((1, 2), np.float32), "pick": np.zeros(1, np.int64)}
        env.send(action)
        assert len(received(env)[0].info["word"]) > 1_500_000
        env.send(action)
        link.execute()
        link.inbox.clear()
        link.leave("w0")
        link.join("w1")
        row = received(env)[0]
        assert row.info == {}
        assert row.observation["clock"] == 2
        env.send(action)
        assert received(env)[0].info == {"worker_lost": True}


# ---------------------------------------------------------------- wrong use loses nothing


def test_wrong_arguments_are_refused_in_one_line_and_nothing_is_sent() -> None:
    with made(copies=4, lanes=2, workers=2) as (env, link):
        with pytest.raises(NoAsyncCallError, match="recv without send"):
            env.recv()
        with pytest.raises(UsageError, match=r"step before reset of copies \[0, 1, 2, 3\]: call reset\(\), or reset_async"):
            env.send(zeros(range(4)))
        env.reset_async(seed=1)
        for many in (5, -1):
            with pytest.raises(ValueError, match=f"min_envs: expected 0 to 4, the copies that .*; got {many}"):
                env.recv(many)
        env.recv(4)
        for wrong, line in (
            ([0], r"expected all copies of lane 0, 0 to 1, got \[0\]; with lanes=num_envs every copy is a lane"),
            ([0, 1, 1], "expected different numbers from 0 to 3, got"),
            ([3, 4], "expected different numbers from 0 to 3, got"),
            ([-1, 3], "expected different numbers from 0 to 3, got"),
            ([], "expected different numbers from 0 to 3, got"),
        ):
            with pytest.raises(ValueError, match=f"env_ids: {line}"):
                send(env, wrong)
        for not_numbers in (["a"], [0.5], 3, [[0, 1]]):
            with pytest.raises(TypeError, match="env_ids: expected a list of whole numbers"):
                env.send(zeros(range(2)), not_numbers)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="actions: expected one for each of 2 rows"):
            env.send(zeros(range(4)), [0, 1])
        with pytest.raises(ValueError, match="env_ids: expected different numbers"):
            env.reset_async(env_ids=[2, 2])
        with pytest.raises(ValueError, match="seed: expected one for each of 2 copies, got 3"):
            env.reset_async(env_ids=[2, 3], seed=[1, 2, 3])
        with pytest.raises(TypeError):
            env.reset_async(options={"what": object()})
        assert env.outstanding == []
        assert len(link.orders) == 2


def test_lock_step_and_send_do_not_mix() -> None:
    with made() as (env, _):
        env.reset(seed=1)
        send(env, [1])
        step, attribute = partial(env.step, zeros(range(3))), partial(env.set_attr, "x", 1)
        call: Callable[[], object]
        for call in (step, env.reset, attribute, partial(env.call, "level")):
            with pytest.raises(AlreadyPendingCallError, match=r"while copies \[1\] have not .* expected recv\(\) first"):
                call()
        for again in (partial(send, env, [0, 1]), partial(env.reset_async, env_ids=[1])):
            with pytest.raises(AlreadyPendingCallError, match=r"copies \[1\] have not come back: expected recv\(\)"):
                again()
        assert env.get_attr("spec") == (env.spec,) * 3
        assert sorted(received(env)) == [1]
        env.step_async(zeros(range(3)))
        for call in (env.recv, partial(send, env, [0]), env.reset_async):
            with pytest.raises(AlreadyPendingCallError, match=r"while a step is pending: expected step_wait\(\) first"):
                call()
        observation = env.step_wait()[0]
        assert observation[:, 0].tolist() == pytest.approx([0.8, 0.6, 0.8]), "each copy has made its own steps"
        env.close()
        for call in (env.recv, partial(send, env, [0]), env.reset_async):
            with pytest.raises(ClosedEnvironmentError):
                call()


def test_what_a_watch_raises_ends_the_wait_and_loses_nothing() -> None:
    with made() as (env, link):
        env.reset_async(seed=1)
        env.recv(3)
        link.frozen = {"w0", "w1", "w2"}
        send(env, [0, 1, 2])
        with interrupted_after(env):
            env.recv()
        link.frozen = set()
        assert sorted(received(env, 3)) == [0, 1, 2]


@BOTH_WAYS
def test_a_step_after_an_interrupted_reset_has_its_own_results(shared: bool) -> None:
    with made(copies=1, lanes=1, workers=1, shared=shared) as (env, link):
        env.reset(seed=1)
        assert env.step([0])[0].tolist() == [[pytest.approx(0.8)]]
        link.frozen = {"w0"}
        with interrupted_after(env, lambda: None):  # the second time, the order was sent
            env.reset()
        link.frozen = set()
        for left in 0.8, 0.6:
            observation, reward, *_ = env.step([0])
            assert (observation.tolist(), reward.tolist()) == ([[pytest.approx(left)]], [1.0])


@BOTH_WAYS
def test_an_order_whose_answer_nobody_wants_is_over_with_the_next_one(shared: bool) -> None:
    with made(copies=1, lanes=1, workers=1, shared=shared) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0"}
        with interrupted_after(env, lambda: None):
            env.reset(seed=1)
        link.frozen = set()
        env.reset(seed=1)
        assert not env.hub.coordinator.has_orders
        assert not any(member.tickets for member in env.hub.coordinator.members.values())
        assert env.hub.can_share(0) == shared


CALLER_SIDE = calls, env_module, order_coordinator, send_recv, sent_lanes, step_hub, shared_steps
FILES = {module.__file__ for module in CALLER_SIDE}
MOVES = {
    function.__code__
    for function in (
        *(Membership.remove, OrderCoordinator._removed, LanePlacement.removed, OrderedLane.restart, PlacedLane.restart),
        *(StepHub.happened, SharedSteps.worker_left, LanePlacement.assign, LanePlacement._give),
    )
}
"""What takes the lanes of a lost worker away, and gives them to another."""


def interrupted(call: Callable[[], object], at: int, only: Collection[CodeType] = ()) -> bool:
    """Call this, and raise KeyboardInterrupt before line number `at` that it executes in `only` these functions, or anywhere
    in the files of the caller's side. Returns whether there was such a line.
    """
    lines = iter(range(at))

    def trace(frame: FrameType, event: str, _: object) -> Any:
        if frame.f_code not in only if only else frame.f_code.co_filename not in FILES:
            return None
        if event == "line" and next(lines, None) is None:
            raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(before)
    return False


def step_in_two_calls(env: ZmqVectorEnv) -> None:
    env.step_async(zeros(range(4)))
    env.step_wait()


def reset_in_two_calls(env: ZmqVectorEnv) -> None:
    env.reset_async(seed=2)
    env.reset_wait()


def send_and_recv(env: ZmqVectorEnv) -> None:
    env.send(zeros(range(4)))
    env.recv(4)


CALLS: dict[str, Callable[[ZmqVectorEnv], object]] = {
    "step": lambda env: env.step(zeros(range(4))),
    "step_async": step_in_two_calls,
    "reset": lambda env: env.reset(seed=2),
    "reset_async": reset_in_two_calls,
    "send": send_and_recv,
    "call": lambda env: env.call("render_mode"),
    "set_attr": lambda env: env.set_attr("left", 1.0),
}


def was_cut_short(env: ZmqVectorEnv) -> bool:
    """Whether the last call was cut short. If not, an interrupt came before it, and what was sent before is received."""
    try:
        while env.outstanding:
            env.recv()
        env.recv()
    except UsageError:
        return True
    except AlreadyPendingCallError as error:
        getattr(env, f"{error.name}_wait")()
    except NoAsyncCallError:
        pass
    return False


@BOTH_WAYS
@pytest.mark.parametrize("name", CALLS)
def test_after_an_interrupt_at_any_line_only_a_reset_of_all_copies_is_possible_and_no_worker_is_lost(
    name: str, shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("millrace.learner.vector_env.step_hub.POLL_S", 0.001)
    with made(copies=4, lanes=2, workers=2, shared=shared) as (env, _):
        env.reset(seed=1)
        lines = cut_short = 0
        while interrupted(lambda: CALLS[name](env), lines):
            cut_short += was_cut_short(env)
            if interrupted(lambda: env.reset(seed=1), lines):  # a second Ctrl-C
                cut_short += was_cut_short(env)
            lines += 1
            assert env.reset(seed=1)[0][:, 0].tolist() == [1.0] * 4
            observation, reward, _, truncated, infos = env.step(zeros(range(4)))
            assert observation[:, 0].tolist() == [pytest.approx(0.8)] * 4
            assert (reward.tolist(), truncated.tolist(), infos) == ([1.0] * 4, [False] * 4, {})
        assert cut_short > 20


@BOTH_WAYS
def test_after_an_interrupt_while_the_lanes_of_a_lost_worker_go_to_another_all_copies_can_be_reset(shared: bool) -> None:
    lines = 0
    interrupts = True
    while interrupts:
        with made(copies=2, lanes=2, workers=2, shared=shared, timeout_s=5.0) as (env, link):
            env.reset(seed=1), env.step(zeros([0, 1]))
            link.leave("w1")
            link.join("w2")
            interrupts = interrupted(lambda: env.reset(seed=2), lines, MOVES)
            env.hub.coordinator.process_ended(WorkerExit("w1", 2, "killed", False))
            assert env.reset(seed=3)[0].tolist() == [[1.0], [1.0]]
            began_s = link.now
            assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]
            assert link.now == began_s, "no worker waited in vain to be woken"
            assert env.incarnations()[1] > 0, "its copies are new"
            lines += 1
    assert lines > 20


@pytest.mark.parametrize(
    "refused",
    [
        *("step", "step_async", "step_wait", "send", "recv", "begin_step", "end_step"),
        *("call", "set_attr", "call of some", "reset of some", "reset_async"),
    ],
)
def test_after_an_interrupt_nothing_but_a_reset_of_all_copies_is_possible(refused: str) -> None:
    with made(copies=2, lanes=2, workers=2) as (env, link):
        env.reset(seed=1)
        link.frozen = {"w0", "w1"}
        interrupt_after(env, error=KeyboardInterrupt)
        env.step_async(zeros([0, 1]))
        with pytest.raises(KeyboardInterrupt):
            env.step_wait()
        env.hub.while_waiting = lambda: None
        link.frozen = set()
        calls: dict[str, Callable[[], object]] = {
            "step": lambda: env.step(zeros([0, 1])),
            "step_async": lambda: env.step_async(zeros([0, 1])),
            "step_wait": lambda: env.step_wait(),
            "begin_step": lambda: env.begin_step([0], zeros([0, 1])),
            "end_step": lambda: env.end_step([0]),
            "send": lambda: env.send(zeros([0, 1])),
            "recv": lambda: env.recv(),
            "call": lambda: env.call("render_mode"),
            "set_attr": lambda: env.set_attr("left", 1.0),
            "call of some": lambda: env.calls.call([0], "render_mode", (), {}),
            "reset of some": lambda: env.reset(options={"reset_mask": np.array([True, False])}),
            "reset_async": lambda: env.reset_async(env_ids=[0]),
        }
        with pytest.raises(UsageError, match="after an interrupted call: reset all copies first"):
            calls[refused]()
        assert env.get_attr("spec") == (env.spec,) * 2, "no worker is asked"
        with pytest.raises(UsageError, match="after an interrupted call: reset all copies first"):
            env.step(zeros([0, 1]))
        env.reset_async(seed=1)
        assert sorted(received(env, 2)) == [0, 1]
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("name", ["begin_step", "end_step", "call of some"])
def test_a_call_for_some_lanes_can_be_cut_short_too(name: str) -> None:
    with made(copies=2, lanes=2, workers=2) as (env, link):
        env.reset(seed=1)
        calls: dict[str, Callable[[], object]] = {
            "begin_step": lambda: env.begin_step([0], zeros([0, 1])),
            "end_step": lambda: env.end_step([0]),
            "call of some": lambda: env.calls.call([0], "render_mode", (), {}),
        }
        if name == "end_step":
            calls["begin_step"]()
        link.frozen = {"w0", "w1"}
        assert interrupted(calls[name], 25)
        link.frozen = set()
        with pytest.raises(UsageError, match="after an interrupted call: reset all copies first"):
            env.step(zeros([0, 1]))
        assert env.reset(seed=1)[0][:, 0].tolist() == [1.0, 1.0]


def test_a_reset_that_failed_before_it_sent_anything_does_not_count() -> None:
    with made(copies=2, lanes=2, workers=2) as (env, _):
        env.reset(seed=1)
        assert interrupted(lambda: env.step(zeros([0, 1])), 10)
        with pytest.raises(TypeError, match="expected plain data"):
            env.reset(options={"x": object()})
        with pytest.raises(UsageError, match="after an interrupted call: reset all copies first"):
            env.step(zeros([0, 1]))
        env.reset(seed=1)
        assert env.step(zeros([0, 1]))[1].tolist() == [1.0, 1.0]


# ---------------------------------------------------------------- the pure parts


def test_a_lane_comes_back_once_and_takes_no_other_order_before() -> None:
    lanes = SentLanes(BatchLayout([2, 2]))
    lanes.send([1], Sent(Asked.STEP, 0.0))
    lanes.send([0], Sent(Asked.STEP, 5.0))
    assert lanes.copies == [0, 1, 2, 3]
    with pytest.raises(ValueError, match=r"lanes \[1\]: expected some that have come back"):
        lanes.send([1], Sent(Asked.STEP, 1.0))
    assert lanes.overdue(4.0, 3.0) == [1]
    lanes.ready({1: b"infos"})
    assert (lanes.ready_copies, lanes.overdue(9.0, 3.0), lanes.among([0, 1, 2])) == ([2, 3], [0], [0, 1])
    lanes.ready({0: b""})
    assert list(lanes.take().results.items()) == [(0, b""), (1, b"infos")]
    assert (lanes.take().results, lanes.copies) == ({}, [])
    lanes.send([1], Sent(Asked.STEP, 1.0))


def test_a_lost_step_has_all_attempts_to_reset_its_new_copies_and_keeps_the_last_observations() -> None:
    lanes, reset = SentLanes(BatchLayout([1])), AskedReset((0,), (None,), packed(None))
    lanes.send([0], Sent(Asked.STEP, 0.0))
    lanes.reset_instead(0, reset, 1.0, {0: "last"})
    assert lanes.sent[0] == Sent(reset, 1.0, 1, {0: "last"})
    lanes.reset_instead(0, reset, 2.0, {})
    assert lanes.sent[0] == Sent(reset, 2.0, 2, {0: "last"})


def test_an_order_keeps_the_actions_of_its_step_whatever_the_caller_writes_afterwards() -> None:
    """It may wait for a worker, or be sent again."""
    actions = np.zeros(2, np.int64)
    make = step_order([actions])
    actions[:] = 1
    order = make(1, 1, LaneIncarnation(0, 0))
    assert isinstance(order, Step)
    assert order.actions[0].tolist() == [0, 0]


def test_a_long_time_between_two_looks_counts_as_a_short_one() -> None:
    watched = WatchedTime(100.0)
    assert watched.look(100.1) == pytest.approx(0.1)
    assert watched.look(4000.0) == pytest.approx(0.1 + LONGEST_GAP_S)
    assert watched.look(4000.2) == pytest.approx(0.3 + LONGEST_GAP_S)
