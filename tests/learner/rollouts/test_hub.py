"""The shell round the coordinator, over a link and a clock that are not real: when silence counts, and what is sent."""

from __future__ import annotations

import logging
from typing import cast

import msgspec
import numpy as np
import pytest

from millrace.learner.members.held_up import LONG_S
from millrace.learner.members.member import Member
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.rollouts.hub import PULSE_S, Hub, HubSettings, StageTimes
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.opponent_pool import OpponentPool, PoolSettings, PoolState, Snapshot
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.bounds import MAX_SAVED_BYTES
from millrace.protocol.errors import RunError
from millrace.protocol.logs.long_wait import AGAIN_S, FIRST_S
from millrace.protocol.messages import Evaluated, Heartbeat, Hello, ToLearner, Weights
from millrace.protocol.rollout import Episode, rollout_bytes, saved_bytes
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.wire.codec import decode_to_learner, decode_to_worker, encode
from millrace.protocol.wire.compression import Packing
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.weight_dtypes import ActingDtype, to_float32
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rollout, run_spec
from tests.support.conversation.fake_link import FakeLink
from tests.support.conversation.rules import pending_evaluation
from tests.support.in_process.fake_processes import FakeProcesses

WORKER_TIMEOUT_S = 3.0


def hub_with_a_worker(
    acting_dtype: ActingDtype = "float32", processes: WorkerProcesses | None = None, lanes: int = 1
) -> tuple[FakeLink, Hub, Heartbeat]:
    link = FakeLink()
    coordinator = TicketCoordinator(
        run_spec(lanes), RolloutDealer(lanes, Rounds(0)), worker_timeout_s=WORKER_TIMEOUT_S, first_session=1
    )
    hub = Hub(
        cast(LearnerLink, link),
        coordinator,
        HubSettings(no_workers_timeout_s=60.0, stall_timeout_s=600.0, max_env_failures=0, acting_dtype=acting_dtype),
        processes,
        clock=lambda: link.now,
    )
    link.inbox.append((b"w0", example(Hello)))
    hub.wait_for(1)
    return link, hub, example(Heartbeat, session=1)


def test_a_message_may_unpack_to_a_rollout_of_the_run_and_no_more() -> None:
    link, hub, _ = hub_with_a_worker()
    run = hub.coordinator.run
    assert link.packed_bytes_limit == rollout_bytes(run) + saved_bytes(run.copies)


def test_a_rollout_may_be_packed_together_with_the_states_that_environments_have_saved() -> None:
    link, hub, _ = hub_with_a_worker()
    state = np.zeros(MAX_SAVED_BYTES, np.uint8)
    rollout = msgspec.structs.replace(fake_rollout(1, 0, 1, 0, 0), memory=(state,), saved=(0,))
    validate(rollout, hub.coordinator.run)
    read = decode_to_learner(encode(rollout, Packing(zstd=True)), link.packed_bytes_limit)
    assert encode(read) == encode(rollout)


@pytest.mark.parametrize(("dtype", "sent"), [("float32", "<f4"), ("bfloat16", "<u2")])
def test_weights_are_rounded_and_encoded_once_for_all_workers(dtype: ActingDtype, sent: str) -> None:
    link, hub, _ = hub_with_a_worker(dtype, lanes=2)
    link.inbox.append((b"w1", example(Hello, worker="w1", pid=2, process_nonce=2)))
    hub.wait_for(2)
    parameters = np.array([1.00001, -2.0], np.float32)
    link.sent.clear()
    hub.publish(0, parameters, np.zeros(0, np.float32))
    first, second = (frames for frames in link.sent if len(frames) > 1)
    assert first is second
    weights = decode_to_worker(first)
    assert isinstance(weights, Weights)
    assert weights.parameters.dtype.str == sent
    assert (
        to_float32(weights.parameters).tobytes()
        == (parameters if sent == "<f4" else np.array([1, -2], np.float32)).tobytes()
    )


def test_weights_that_do_not_fit_are_not_published() -> None:
    link, hub, _ = hub_with_a_worker("bfloat16")
    link.sent.clear()
    with pytest.raises(RunError, match="acting_dtype bfloat16: parameter 1: expected an absolute value below"):
        hub.publish(0, np.array([1, -3.4e38], np.float32), np.zeros(0, np.float32))
    assert (hub.coordinator.version, link.sent) == (-1, [])


def test_in_a_resumed_run_weights_that_still_act_keep_their_attributes_though_they_are_a_snapshot() -> None:
    """In self-play, the weights 0 are always a snapshot. They act in the first open round, and the weights 1 do not."""
    _, hub, _ = hub_with_a_worker()
    coordinator = hub.coordinator
    snapshots = [Snapshot(0, 0, 1200.0), Snapshot(1, 9, 1200.0)]
    coordinator.rollouts.opponents = OpponentPool(PoolSettings(1, 2, 1, 0.0, 1), PoolState(snapshots=snapshots))
    parameters, buffers = np.array([[1.0], [2.0]], np.float32), np.zeros((2, 0), np.float32)
    coordinator.keep(Weights(0, parameters[0], buffers[0], np.array([7], np.uint8)))
    hub.keep_opponents(parameters, buffers)
    kept = coordinator.weights.kept
    assert {version: each.parameters.tolist() for version, each in kept.items()} == {0: [1.0], 1: [2.0]}
    assert [None if each is None else each.tolist() for each in (kept[0].env_attributes, kept[1].env_attributes)] == [
        [7],
        None,
    ]


def test_a_flood_of_an_ended_session_is_one_line(caplog: pytest.LogCaptureFixture) -> None:
    """As after a restart of the learner, from every worker that went on saying Heartbeat."""
    link, hub, _ = hub_with_a_worker()
    caplog.set_level(logging.INFO)
    link.inbox += [(b"w1", example(Heartbeat, session=7, replies=number)) for number in range(100)]
    link.now += PULSE_S
    hub.pulse()
    assert [record.getMessage() for record in caplog.records] == ["worker w1 was told to join again: its session had ended"]
    link.now += 100
    link.inbox.append((b"w1", example(Heartbeat, session=7, replies=100)))
    hub.pulse()
    assert caplog.records[-1].getMessage().endswith("had ended (99 more like this since the last line)")


def test_it_warns_of_a_long_wait_only_while_no_worker_steps(caplog: pytest.LogCaptureFixture) -> None:
    """A rollout of a slow environment takes long, and nothing is wrong."""
    link, hub, heartbeat = hub_with_a_worker()
    hub.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32))
    steps_until_s = link.now + AGAIN_S
    arrives_s = link.now + 3 * AGAIN_S
    poll = link.poll

    def poll_while_it_works(timeout_s: float) -> bool:
        steps = int(10 * min(link.now, steps_until_s))
        link.inbox.append((b"w0", msgspec.structs.replace(heartbeat, versions=(0,), tickets=(0,), steps=steps)))
        if link.now > arrives_s:
            link.inbox.append((b"w0", fake_rollout(1, 0, 0, 0, 0)))
        link.now += timeout_s
        return poll(timeout_s)

    link.poll = poll_while_it_works  # type: ignore[method-assign]
    caplog.set_level(logging.INFO)
    hub.gather()
    said = [
        (record.levelname, record.getMessage()) for record in caplog.records if "worker w0 on host: " in record.getMessage()
    ]
    assert [level for level, _ in said] == ["INFO"] * 2 + ["WARNING"], "after 30, 90 and 150 s"
    assert said[-1][1] == "no env steps for 150 s: worker w0 on host: 0.0 steps/s"


@pytest.mark.parametrize("answers", [True, False], ids=["it stands still", "it was lost"])
def test_a_wait_for_an_evaluation_without_env_steps_names_who_is_waited_for(
    caplog: pytest.LogCaptureFixture, answers: bool
) -> None:
    link, hub, heartbeat = hub_with_a_worker()
    hub.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32), deal=False)
    hub.begin_evaluation(EvaluationPlan.of(1, seed=1, copies=1, max_steps=100))
    steps_until_s = link.now + 100.0
    ends_s = steps_until_s + FIRST_S + AGAIN_S / 2
    poll = link.poll

    def poll_while_it_works(timeout_s: float) -> bool:
        steps = int(10 * min(link.now, steps_until_s))
        if answers or link.now < steps_until_s:
            ticket = next(iter(pending_evaluation(hub.coordinator).playing))
            link.inbox.append((b"w0", msgspec.structs.replace(heartbeat, versions=(0,), tickets=(ticket,), steps=steps)))
        link.now += timeout_s
        return poll(timeout_s)

    def watch(played: int, env_steps: int) -> None:
        if link.now > ends_s:
            raise KeyboardInterrupt

    link.poll = poll_while_it_works  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        hub.end_evaluation(watch)
    said = [record.getMessage() for record in caplog.records if record.getMessage().startswith("no env steps")]
    lost = "waiting for a worker to join at fake (the last one silent for 3 s)"
    (line,) = said
    assert line.startswith(f"no env steps for 30 s: {'worker w0 on host: 0.' if answers else lost}")


def test_a_long_wait_is_shown_while_it_lasts_and_told_to_who_asks() -> None:
    link, hub, heartbeat = hub_with_a_worker(
        processes=FakeProcesses(of_stepping=lambda: [Member(b"w9", w9, 1, 0, heard_s=link.now)])
    )
    w9 = example(Hello, worker="w9", host="far")
    hub.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32))
    began_s = link.now
    seen: list[str] = []
    poll = link.poll

    def poll_until_it_has_come(timeout_s: float) -> bool:
        link.now += timeout_s
        came = fake_rollout(1, 0, 0, 0, 0) if link.now > began_s + 5.0 else msgspec.structs.replace(heartbeat, tickets=(0,))
        link.inbox.append((b"w0", came))
        return poll(timeout_s)

    def watch() -> None:
        assert link.now - began_s >= LONG_S, "what is short is not shown"
        seen.append(hub.status(link.now).progress.waiting)

    link.poll = poll_until_it_has_come  # type: ignore[method-assign]
    hub.gather(watch)
    assert seen[0] == "waiting 2 s for lane 0 (worker w9 on far: no env step yet)", "that is who steps the copies"
    assert len(seen) > 20
    link.now += 7.0
    hub.publish(1, np.zeros(1, np.float32), np.zeros(0, np.float32))
    assert hub.waiting(link.now) == "learning for 7 s, 1 of 1 workers waiting for weights"


def test_the_time_of_each_stage_begins_and_ends_with_it() -> None:
    link, hub, heartbeat = hub_with_a_worker()
    began_s = link.now
    hub.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32))
    arrives: tuple[float, ToLearner] = 4.0, fake_rollout(1, 0, 0, 0, 0)

    def poll(timeout_s: float) -> bool:
        seconds, message = arrives
        link.now += seconds
        link.inbox += [(b"w0", message), (b"w0", msgspec.structs.replace(heartbeat, stages={"step": 3.0}))]
        return True

    link.poll = poll  # type: ignore[method-assign]
    hub.gather()
    link.now += 7.0
    hub.begin_evaluation(EvaluationPlan((1,), copies=1, most_steps=9))
    (ticket,) = pending_evaluation(hub.coordinator).playing
    arrives = 2.0, example(Evaluated, session=1, ticket=ticket, episodes=(Episode(0.0, 1, 0.0),), cut=(False,))
    hub.end_evaluation(lambda played, env_steps: None)
    link.now += 1.0
    assert hub.stage_times() == StageTimes(
        at_s=began_s + 14.0, wait_s=4.0, evaluate_s=2.0, learn_s=8.0, worker_stages={"step": 3.0}
    )


def test_between_short_minibatches_it_listens_now_and_then() -> None:
    link, hub, heartbeat = hub_with_a_worker()
    link.now += PULSE_S
    hub.pulse()
    link.inbox.append((b"w0", heartbeat))
    for _ in range(8):
        link.now += PULSE_S / 10
        hub.pulse()
    assert link.inbox, "it listened as often as it was asked"
    link.now += PULSE_S / 2
    hub.pulse()
    assert not link.inbox


def test_only_an_answer_that_is_used_shows_that_the_environment_works() -> None:
    """Else anybody who may join could keep a run alive whose environment fails again and again."""
    link, hub, _ = hub_with_a_worker()
    hub.publish(0, np.zeros(1, np.float32), np.zeros(0, np.float32), deal=False)
    shown = list[str | None]()
    hub._failures.evaluated = shown.append  # type: ignore[method-assign, assignment]
    hub.begin_evaluation(EvaluationPlan((1,), copies=1, most_steps=9))
    (ticket,) = pending_evaluation(hub.coordinator).playing
    answer = example(Evaluated, session=1, ticket=ticket, episodes=(Episode(0.0, 1, 0.0),), cut=(False,))
    strangers = [(b"w7", answer), (b"w0", msgspec.structs.replace(answer, ticket=ticket + 1))]
    for peer, message in [*strangers, (b"w0", answer)]:
        assert shown == []
        link.inbox.append((peer, message))
        link.now += PULSE_S
        hub.pulse()
    assert shown == [None]
