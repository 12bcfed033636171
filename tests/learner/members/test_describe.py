"""The conversation in which a worker describes the environment: its pure half, and the shell's deadlines on a fake clock."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import cast

import msgspec
import numpy as np
import pytest
from gymnasium import spaces

from millrace.learner.members.describe import DescribeSettings, described_by_workers
from millrace.learner.members.describe_coordinator import Accept, DescribeCoordinator, accept_any
from millrace.learner.members.events import EnvironmentRaised, Failed, WorkerProcessFailed
from millrace.learner.members.membership import Outgoing
from millrace.learner.members.process_callbacks import ProcessCallbacks
from millrace.protocol.alive import NO_SLOT, WorkerActivity
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import EnvironmentFailed, NoWorkers, Stalled, UsageError
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    TOLD_TO_STOP,
    Alive,
    Described,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Refuse,
    Rejoin,
    ToLearner,
    Welcome,
    WorkerExit,
)
from millrace.protocol.space_spec import BoxSpace, DiscreteSpace, EnvDescription
from millrace.protocol.specs import DescribeSpec
from millrace.protocol.wire.codec import decode_to_worker
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.plain_values import pack
from tests.support.conversation.fake_link import FakeLink

SPEC = DescribeSpec(EnvSpec("Fake-v0"))
A, B = b"w0", b"w1"
NOTHING = np.frombuffer(pack({}), np.uint8)
DESCRIPTION = EnvDescription(DiscreteSpace(3, 0, "int64"), DiscreteSpace(2, 0, "int64"), NOTHING, "", 7, "")
OF_NINE = msgspec.structs.replace(DESCRIPTION, observation=DiscreteSpace(9, 0, "int64"))
BROKEN = msgspec.structs.replace(DESCRIPTION, observation=BoxSpace((2,), "float32", np.ones(3), np.ones(())))
SETTINGS = DescribeSettings(worker_timeout_s=5, no_workers_timeout_s=60, stall_timeout_s=100, max_env_failures=1)


def coordinator(*, decliners_to_end: int = 1, accept: Accept = accept_any) -> DescribeCoordinator:
    return DescribeCoordinator(SPEC, 10, worker_timeout_s=5, decliners_to_end=decliners_to_end, accept=accept)


def of_three(env: DescribedEnv) -> None:
    """Accepts environments with three observations."""
    if env.observation_space != spaces.Discrete(3):
        raise UsageError(f"expected Discrete(3), got {env.observation_space}")


def hello(name: bytes, nonce: int = 1, attempt: int = 1) -> Hello:
    return Hello(PROTOCOL_VERSION, name.decode(), "host", 1, nonce, "fake", nonce + attempt)


def join(made: DescribeCoordinator, name: bytes, nonce: int = 1) -> int:
    ((_, welcome),) = made.receive(name, hello(name, nonce), 0.0)
    assert isinstance(welcome, Welcome)
    assert welcome.run == SPEC
    return welcome.session


# -------------------------------------------------------------------------------------------------- the pure half


def test_the_first_description_is_the_run_s_and_all_members_say_hello_again() -> None:
    made = coordinator()
    one, two = join(made, A), join(made, B)
    assert made.receive(A, Described(one, DESCRIPTION), 1.0) == []
    assert made.receive(B, Described(two, OF_NINE), 1.0) == []
    assert made.described is not None
    assert made.described.observation_space == spaces.Discrete(3)
    assert made.described.max_episode_steps == 7
    assert made.finish() == [(A, Rejoin(one)), (B, Rejoin(two))]


def test_a_description_that_cannot_be_read_gets_its_sender_refused_and_another_is_used() -> None:
    made = coordinator(decliners_to_end=0)
    ((peer, refusal),) = made.receive(A, Described(join(made, A), BROKEN), 1.0)
    assert peer == A
    assert isinstance(refusal, Refuse)
    assert "low: expected float32(2,)" in refusal.reason
    assert made.described is None
    assert made.receive(A, hello(A), 1.0) == [(A, refusal)]  # the same process does not come back
    made.receive(B, Described(join(made, B), DESCRIPTION), 2.0)
    assert made.described is not None


def test_a_description_of_a_worker_of_ours_that_cannot_be_read_ends_the_start_with_the_reason() -> None:
    made = coordinator()
    made.receive(A, Described(join(made, A), BROKEN), 1.0)
    assert "its description of the environment: " in str(made.unsuitable)
    assert "low: expected float32(2,)" in str(made.unsuitable)


def test_a_message_that_exceeds_the_bounds_gets_its_sender_refused() -> None:
    made = coordinator()
    join(made, A)
    ((_, refusal),) = made.reject_message(A, "observation space: expected at most 16777216 elements, got 99999999", 1.0)
    assert isinstance(refusal, Refuse)
    assert not made.membership.members


def test_a_worker_of_ours_that_declines_ends_the_start_with_its_reason() -> None:
    made = coordinator()
    made.receive(A, Goodbye(join(made, A), "environment Fake-v0 is not registered", ()), 1.0)
    assert isinstance(made.unsuitable, UsageError)
    assert str(made.unsuitable) == "environment Fake-v0 is not registered"
    assert not made.membership.take_events()  # the error's line is the only one


def test_a_worker_from_elsewhere_that_declines_is_refused_and_the_learner_waits_on() -> None:
    made = coordinator(decliners_to_end=0)
    made.receive(A, Goodbye(join(made, A), "environment Fake-v0 is not registered", ()), 1.0)
    assert made.unsuitable is None
    ((_, refusal),) = made.receive(A, hello(A), 2.0)
    assert refusal == Refuse("environment Fake-v0 is not registered")
    made.receive(B, Described(join(made, B), DESCRIPTION), 2.0)
    assert made.described is not None


def test_a_description_that_is_not_accepted_ends_the_start_if_the_worker_is_ours() -> None:
    made = coordinator(accept=of_three)
    made.receive(A, Described(join(made, A), OF_NINE), 1.0)
    assert made.described is None
    assert isinstance(made.unsuitable, UsageError)
    assert str(made.unsuitable) == "expected Discrete(3), got Discrete(9)"
    assert not made.membership.take_events()  # the error's line is the only one


def test_a_worker_from_elsewhere_whose_description_is_not_accepted_is_refused_and_another_is_used() -> None:
    made = coordinator(decliners_to_end=0, accept=of_three)
    ((peer, refusal),) = made.receive(A, Described(join(made, A), OF_NINE), 1.0)
    assert (peer, refusal) == (A, Refuse("expected Discrete(3), got Discrete(9)"))
    assert (made.described, made.unsuitable) == (None, None)
    made.receive(B, Described(join(made, B), DESCRIPTION), 2.0)
    assert made.described is not None
    assert made.unsuitable is None


def test_once_the_environment_is_described_a_worker_that_declines_ends_nothing() -> None:
    made = coordinator()
    one, two = join(made, A), join(made, B)
    made.receive(A, Described(one, DESCRIPTION), 1.0)
    made.receive(B, Goodbye(two, "environment Fake-v0 is not registered", ()), 1.0)
    assert made.unsuitable is None


def test_the_start_ends_once_all_workers_of_the_launcher_have_declined() -> None:
    made = coordinator(decliners_to_end=2)
    for nonce in (1, 2):  # the first is started again, and counts once
        answer = made.receive(A, Goodbye(join(made, A, nonce), "environment Fake-v0 is not registered", ()), 1.0)
        assert answer == [(A, Refuse("environment Fake-v0 is not registered"))]
        assert made.unsuitable is None
    made.receive(B, Goodbye(join(made, B), "environment Fake-v0 is not registered", ()), 1.0)
    assert isinstance(made.unsuitable, UsageError)
    assert str(made.unsuitable) == "environment Fake-v0 is not registered"


@pytest.mark.parametrize("decliners_to_end", [0, 1])
@pytest.mark.parametrize("reason", [TOLD_TO_STOP, f"{NO_SLOT} on here"])
def test_a_worker_that_must_leave_says_nothing_of_the_environment(decliners_to_end: int, reason: str) -> None:
    made = coordinator(decliners_to_end=decliners_to_end)
    made.receive(A, Goodbye(join(made, A), reason, ()), 1.0)
    assert made.unsuitable is None
    assert isinstance(made.receive(A, hello(A), 2.0)[0][1], Welcome)


def test_failures_are_told_and_the_worker_may_come_back() -> None:
    made = coordinator()
    for nonce in (1, 2):
        made.receive(A, Failure(join(made, A, nonce), "OSError: no display", "where\nit was", None), 1.0)
    failed = EnvironmentRaised("w0", "host", "OSError: no display", "where\nit was")
    assert [event for event in made.events if isinstance(event, Failed)] == [failed, failed]
    assert made.unsuitable is None


def test_a_process_that_ends_while_it_describes_is_a_failure() -> None:
    made = coordinator()
    why = "ended with exit code 0 in the construction of its environment"
    join(made, A, 1)
    made.process_ended(WorkerExit("w0", 1, why, failed=True))  # a process of this program
    made.process_ended(WorkerExit("w0", 1, why, failed=True))
    made.process_ended(WorkerExit("w1", 1, "ended with exit code 3", failed=True))  # it had not joined
    join(made, A, 2)
    made.receive(b"supervisor", Alive((), (WorkerExit("w0", 3, why, failed=True),)), 1.0)  # not the member's nonce
    failed = WorkerProcessFailed("w0", "host", f"its process {why}")
    assert [event for event in made.events if isinstance(event, Failed)] == [failed]
    made.receive(b"supervisor", Alive((), (WorkerExit("w0", 2, why, failed=True),)), 1.0)
    assert [event for event in made.events if isinstance(event, Failed)] == [failed, failed]


def test_the_status_says_who_is_here() -> None:
    made = coordinator()
    join(made, A)
    answer = made.status(500, 1.0)
    assert (answer.env, answer.version, answer.progress.total_steps) == ("Fake-v0", -1, 500)
    assert [worker.worker for worker in answer.workers] == ["w0"]


# -------------------------------------------------------------------------------------------------- the shell


class Ends(Exception):
    """What a test's interrupt raises."""


def shell(
    link: FakeLink, check: Callable[[], None] = lambda: None, processes: ProcessCallbacks | None = None
) -> tuple[object, list[Outgoing]]:
    found = described_by_workers(
        cast(LearnerLink, link), SPEC, SETTINGS, processes or ProcessCallbacks(expected=1), check, lambda: link.now
    )
    return found, [(b"", decode_to_worker([bytes(frame) for frame in frames])) for frames in link.sent]


def saying(link: FakeLink, *messages: Callable[[int], ToLearner], name: bytes = A, nonce: int = 1) -> None:
    """Puts a Hello into the inbox; once it is answered, what the worker says in the session that it was given."""

    def answer(peer: bytes, frames: list[bytes]) -> bool:
        link.sent.append(frames)
        message = decode_to_worker([bytes(frame) for frame in frames])
        if isinstance(message, Welcome):
            link.inbox += [(peer, make(message.session)) for make in messages]
        return True

    link.send = answer  # type: ignore[method-assign, assignment]
    link.inbox.append((name, hello(name, nonce)))


def test_the_shell_returns_the_description_and_asks_for_another_hello() -> None:
    link = FakeLink()
    saying(link, lambda session: Described(session, DESCRIPTION))
    found, sent = shell(link)
    assert found.action_space == spaces.Discrete(2)  # type: ignore[attr-defined]
    assert isinstance(sent[-1][1], Rejoin)


def test_one_failure_too_many_ends_the_start() -> None:
    link = FakeLink()
    failure, again = ("OSError: no display", "where\nit was", None), [hello(A, 2)]
    goodbye = Goodbye(0, "of a session that has ended", ())
    saying(link, lambda session: Failure(session, *failure), lambda session: again.pop() if again else goodbye)
    line = "worker w0 (host): OSError: no display; failure 2 in a row; max_env_failures allows 1 in a row"
    with pytest.raises(EnvironmentFailed, match=f"^{re.escape(line)}$") as raised:
        shell(link)
    assert raised.value.detail == "where\nit was"


def test_nobody_comes() -> None:
    link = FakeLink()
    with pytest.raises(NoWorkers, match="waited 60 s for 1 worker at fake, 0 joined"):
        shell(link)
    assert 160.0 <= link.now <= 161.0


def test_a_worker_that_never_answers_stalls_the_start(caplog: pytest.LogCaptureFixture) -> None:
    link = FakeLink()
    saying(link)
    beat = ProcessCallbacks(lambda: _heartbeats(link), expected=1)
    with pytest.raises(Stalled, match=r"no description of the environment within 100 s; worker w0 on host: "):
        shell(link, processes=beat)
    lines = [record.getMessage() for record in caplog.records if "no env steps" in record.getMessage()]
    assert lines == [
        "no env steps for 30 s: worker w0 on host: no env step yet",
        "no env steps for 90 s: worker w0 on host: no env step yet",
    ]


def test_what_the_workers_do_and_write_is_told_before_any_has_joined(caplog: pytest.LogCaptureFixture) -> None:
    link = FakeLink()
    making = WorkerActivity("w0", 1, "making", 28.0, 0)
    processes = ProcessCallbacks(running=lambda: [making], said=lambda: {"w0": "no licence yet"}, expected=1)
    with pytest.raises(NoWorkers):
        shell(link, processes=processes)
    told = [record.getMessage() for record in caplog.records if "no env steps" in record.getMessage()]
    assert told[0] == "no env steps for 30 s: worker w0: in construction for 28 s; w0 wrote: no licence yet"


def _heartbeats(link: FakeLink) -> tuple[()]:
    """The worker's heartbeat, whenever the server looks."""
    for frames in link.sent:
        message = decode_to_worker([bytes(frame) for frame in frames])
        if isinstance(message, Welcome):
            link.inbox.append((A, Heartbeat(message.session, 0, (), (), 0, {}, 0)))
            link.now += 0.5
    return ()


def test_an_interrupt_ends_the_wait_at_once() -> None:
    link = FakeLink()

    def check() -> None:
        if link.now > 101.0:
            raise Ends

    with pytest.raises(Ends):
        shell(link, check)
    assert link.now <= 101.2


def test_the_error_of_a_worker_of_ours_is_raised() -> None:
    link = FakeLink()
    saying(link, lambda session: Goodbye(session, "environment Fake-v0: no such", ()))
    with pytest.raises(UsageError, match="environment Fake-v0: no such"):
        shell(link)
