"""The messages, as small frozen records. `README.md` says who may send which message, and when.

A session lasts from the `Welcome` of a worker until it leaves or is given up. A message of another session is counted and
not used.
"""

from __future__ import annotations

import msgspec

from protocol.arrays import Array
from protocol.rollout import Rollout
from protocol.specs import RunSpec, StepSpec

PROTOCOL_VERSION = 3


class Message(msgspec.Struct, frozen=True, tag=True, array_like=True, forbid_unknown_fields=True):
    """Base of all messages except `Rollout`, which has its own file. Fields travel by position, without their names."""


class Hello(Message, frozen=True, array_like=False):  # a map, as in every version, so that any two can part politely
    """May I join? Repeated with backoff until it is answered."""

    protocol: int
    worker: str
    """the worker's name; also its routing id"""
    host: str
    pid: int
    life: int
    """drawn at random by each process (pids repeat in containers)"""
    software: str
    attempt: int
    """counts how often this process has started to join: a repeated Hello keeps the number, a new start raises it"""


class Welcome(Message, frozen=True):
    """You may join. It says what to do: collect rollouts (`RunSpec`) or step env copies (`StepSpec`)."""

    session: int
    attempt: int
    """`attempt` of the Hello that this answers"""
    run: RunSpec | StepSpec


class Refuse(Message, frozen=True, array_like=False):  # a map, as Hello is
    """Leave, with exit code 2."""

    reason: str


class Rejoin(Message, frozen=True):
    """I do not know this session, because I restarted or gave you up: say Hello again."""

    session: int


class Weights(Message, frozen=True):
    """The newest weights. They carry no session, so that one encoding serves all workers."""

    version: int
    parameters: Array
    """[P] the parameters needed to act: float32, or rounded to float16 or bfloat16 (which is sent as uint16)"""
    buffers: Array
    """[B] float32, observation mean and standard deviation if observations are normalized, and ε for action values"""


class Permit(msgspec.Struct, frozen=True, array_like=True):
    """A ticket as it travels: permission for one rollout, on this lane and incarnation."""

    ticket: int
    lane: int
    incarnation: int


class Received(msgspec.Struct, frozen=True, array_like=True):
    """The learner has all rollouts of this lane and incarnation whose sequence is below `below`, and those in `ahead`."""

    lane: int
    incarnation: int
    below: int
    ahead: tuple[int, ...] = ()
    """sequences that have arrived although an earlier one is missing"""


class Collect(Message, frozen=True):
    """Permission for one rollout on each of these lanes, under weights at least as new as `version`."""

    session: int
    version: int
    permits: tuple[Permit, ...]
    received: tuple[Received, ...]
    """one entry for each lane of this worker; a lane that is not listed belongs to another worker"""


class LaneLife(msgspec.Struct, frozen=True, array_like=True):
    """A lane, and how often it has been started on new env copies."""

    lane: int
    incarnation: int


class Release(Message, frozen=True):
    """These lanes belong to other workers now: close them."""

    session: int
    lanes: tuple[LaneLife, ...]


class Heartbeat(Message, frozen=True):
    """What the worker holds. The learner compares it with its own records and sends again what was lost."""

    session: int
    replies: int
    """number of the last HeartbeatReply received; what the learner sent before that has arrived or is lost"""
    version: int
    """version of the newest weights held; -1 before the first"""
    tickets: tuple[int, ...]
    """tickets that are held and not finished"""
    steps: int
    """env steps since the worker started"""
    stages: dict[str, float]
    """seconds spent in each stage since the worker started"""
    resident_bytes: int
    """resident memory of the worker's process; 0 if it is not known"""


class HeartbeatReply(Message, frozen=True):
    """The learner is alive, and this is what it has received of each of your lanes."""

    session: int
    number: int
    received: tuple[Received, ...]


class Drain(Message, frozen=True):
    """Finish the current rollout, send it, and leave."""

    reason: str


class Goodbye(Message, frozen=True):
    """I leave on purpose, and did not finish these tickets."""

    session: int
    reason: str
    tickets: tuple[int, ...]


class Failure(Message, frozen=True):
    """My environment, or my own code, raised an exception; I leave."""

    session: int
    error: str
    traceback: str
    lane: int | None


class Reset(Message, frozen=True):
    """Start episodes in these copies of the lane. Answered by `Stepped`. A new incarnation starts on new copies."""

    session: int
    ticket: int
    """rises with every order; an order is executed once, and answered again if it is repeated"""
    lane: int
    incarnation: int
    copies: tuple[int, ...]
    """which of the lane's copies, from 0"""
    seeds: tuple[int | None, ...]
    """one seed for each of `copies`"""
    options: Array
    """[bytes] uint8, `protocol.wire.plain_values`: the options of `Env.reset`, or None"""


class Step(Message, frozen=True):
    """Step every copy of the lane. Answered by `Stepped`."""

    session: int
    ticket: int
    lane: int
    incarnation: int
    actions: tuple[Array, ...]
    """one array [N, *leaf] for each leaf of the action"""


class Call(Message, frozen=True):
    """Call, read or set an attribute of these copies of the lane. Answered by `Returned`."""

    session: int
    ticket: int
    lane: int
    incarnation: int
    copies: tuple[int, ...]
    """which of the lane's copies, from 0"""
    name: str
    """name of the attribute, which any of the wrappers may have; an attribute that is not callable is read"""
    assign: bool
    """true: set the attribute"""
    given: Array
    """[bytes] uint8, `protocol.wire.plain_values`: (arguments, keyword arguments); with `assign`, a value for each copy"""


class Stepped(Message, frozen=True):
    """The result of a Reset or a Step, for every copy of the lane."""

    session: int
    ticket: int
    """ticket of the order; below 0: a step through shared memory whose infos did not fit there"""
    lane: int
    incarnation: int
    obs: tuple[Array, ...]
    """one array [N, *leaf] for each leaf of the observation"""
    reward: Array
    """[N] float64, raw"""
    terminated: Array
    """[N] bool"""
    truncated: Array
    """[N] bool"""
    infos: Array
    """[bytes] uint8: a list of (copy, info), packed by `protocol.wire.plain_values`; empty infos are left out"""


class Returned(Message, frozen=True):
    """The result of a Call."""

    session: int
    ticket: int
    lane: int
    incarnation: int
    results: Array
    """[bytes] uint8, `protocol.wire.plain_values`: a list with one result for each copy"""
    error: str
    """type and message of the exception, in one line, if the call raised; else empty"""
    traceback: str
    """where it was raised, as text"""


class Inquire(Message, frozen=True):
    """How is the run, or the vector environment? Anybody who may connect may ask, without being a worker."""


class WorkerStatus(msgspec.Struct, frozen=True):
    """A worker as the learner sees it."""

    worker: str
    """its name"""
    host: str
    pid: int
    standing: str
    """active, or draining"""
    lanes: tuple[int, ...]
    """its lanes; none if it is a spare worker"""
    tickets: int
    """tickets that were dealt to it and have not come back"""
    steps: int
    """env steps since the worker started"""
    steps_per_s: float
    """env steps per second between its last two heartbeats"""
    version: int
    """version of the newest weights that it is known to hold; -1 before the first"""
    silent_s: float
    """seconds since its last message"""
    resident_bytes: int
    """resident memory of its process; 0 if it is not known"""
    strikes: int
    """how many of its messages and rollouts could not be used"""


class Status(Message, frozen=True):
    """The answer to Inquire."""

    env: str
    version: int
    """how many updates the learner has made; -1 before the first weights"""
    env_steps: int
    """env steps used by updates since the run began"""
    total_steps: int
    """env steps at which the run ends; 0 for a vector environment, which has no updates and no end"""
    steps_per_s: float
    """env steps used per second, since this learner started"""
    return_mean: float | None
    """mean return of the last 100 episodes, in raw rewards"""
    lag_mean: float
    """mean lag of the rollouts of the last update, in versions"""
    lag_max: int
    """largest lag of the rollouts of the last update, in versions"""
    workers: tuple[WorkerStatus, ...]
    """in the order in which they joined"""
    ledger: dict[str, int]
    """counts of what happened to every ticket, transition and message"""


ToLearner = Hello | Rollout | Heartbeat | Goodbye | Failure | Stepped | Returned
ToWorker = Welcome | Refuse | Rejoin | Weights | Collect | Release | HeartbeatReply | Drain | Reset | Step | Call
Order = Reset | Step | Call
Answer = Stepped | Returned
ToObserver = Status

__all__ = [
    "PROTOCOL_VERSION", "Answer", "Array", "Call", "Collect", "Drain", "Failure", "Goodbye", "Heartbeat", "HeartbeatReply",
    "Hello", "Inquire", "LaneLife", "Message", "Order", "Permit", "Received", "Refuse", "Rejoin", "Release", "Reset",
    "Returned", "Rollout", "Status", "Step", "Stepped", "ToLearner", "ToObserver", "ToWorker", "Weights", "Welcome",
    "WorkerStatus",
]  # fmt: skip
