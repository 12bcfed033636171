"""The messages: small frozen records, nothing more. Who may say which, and when, stands in `README.md`.

A session is one stay of one worker with one learner; a message of another session is counted and not used.
"""

from __future__ import annotations

import msgspec

from protocol.arrays import Array
from protocol.rollout import Rollout
from protocol.specs import RunSpec, StepSpec

PROTOCOL_VERSION = 3


class Message(msgspec.Struct, frozen=True, tag=True, array_like=True, forbid_unknown_fields=True):
    """Base of all messages but `Rollout`, which has a file of its own. They travel by position, without names of fields."""


class Hello(Message, frozen=True, array_like=False):  # a map, as in every version, so that any two can part politely
    """I exist; may I join? Said again, with backoff, until answered."""

    protocol: int
    worker: str
    """the worker's name; also its routing id"""
    host: str
    pid: int
    life: int
    """drawn at random by each process (pids repeat in containers)"""
    software: str
    attempt: int
    """how often this process has begun to join: a repeated Hello keeps it, a new beginning raises it"""


class Welcome(Message, frozen=True):
    """Join: what to do, collect rollouts or step copies; the environment, the policy, T, N, the seed."""

    session: int
    attempt: int
    """of the Hello that is answered"""
    run: RunSpec | StepSpec


class Refuse(Message, frozen=True, array_like=False):  # a map, as Hello is
    """Leave, with exit code 2."""

    reason: str


class Rejoin(Message, frozen=True):
    """I do not know this session (I restarted, or gave you up): say Hello again."""

    session: int


class Weights(Message, frozen=True):
    """The newest weights. They name no session, so that they are encoded once however many workers there are."""

    version: int
    parameters: Array
    """[P] float32, the acting part of the flat parameter buffer; or rounded, float16 or bfloat16, the latter as uint16"""
    buffers: Array
    """[B] float32, what the learner keeps for the policy: observation mean and standard deviation"""


class Permit(msgspec.Struct, frozen=True, array_like=True):
    """A ticket as it travels: one rollout, on this lane, in this life of the lane."""

    ticket: int
    lane: int
    incarnation: int


class Received(msgspec.Struct, frozen=True, array_like=True):
    """The learner has the rollouts of this life of the lane whose sequence is below `below`, and those in `ahead`."""

    lane: int
    incarnation: int
    below: int
    ahead: tuple[int, ...] = ()
    """arrived although an earlier one was lost on the way"""


class Collect(Message, frozen=True):
    """Permission for one rollout on each of these lanes, under weights at least as new as `version`."""

    session: int
    version: int
    permits: tuple[Permit, ...]
    received: tuple[Received, ...]
    """one for each lane that is the worker's: a lane that is missing lives elsewhere"""


class LaneLife(msgspec.Struct, frozen=True, array_like=True):
    """A lane, and how often it has been started afresh."""

    lane: int
    incarnation: int


class Release(Message, frozen=True):
    """These lanes live elsewhere now: close them."""

    session: int
    lanes: tuple[LaneLife, ...]


class Heartbeat(Message, frozen=True):
    """The worker's account of itself. The learner compares it with its own, and says again what was lost."""

    session: int
    replies: int
    """number of the last HeartbeatReply seen: what the learner said before it has arrived, or is lost"""
    version: int
    """newest weights held; -1 before the first"""
    tickets: tuple[int, ...]
    """held and not finished"""
    steps: int
    """env steps since the worker started"""
    stages: dict[str, float]
    """seconds spent in each stage since the worker started"""
    resident_bytes: int
    """memory of the worker's process; 0 where that is not known"""


class HeartbeatReply(Message, frozen=True):
    """I am here too, and this is what I have of each of your lanes; a lane that is missing lives elsewhere."""

    session: int
    number: int
    received: tuple[Received, ...]


class Drain(Message, frozen=True):
    """Finish the rollout in hand, send it, leave."""

    reason: str


class Goodbye(Message, frozen=True):
    """I leave on purpose; these tickets I held and did not finish."""

    session: int
    reason: str
    tickets: tuple[int, ...]


class Failure(Message, frozen=True):
    """My environment (or I) broke; I leave."""

    session: int
    error: str
    traceback: str
    lane: int | None


class Reset(Message, frozen=True):
    """Begin episodes in these copies of the lane; answered by `Stepped`. A new life of the lane begins on new copies."""

    session: int
    ticket: int
    """rises with every order; each is obeyed once, and answered again if it is said again"""
    lane: int
    incarnation: int
    copies: tuple[int, ...]
    """which of the lane's copies, from 0"""
    seeds: tuple[int | None, ...]
    """one for each of them"""
    options: Array
    """[bytes] uint8, `protocol.wire.plain_values`: the options of `Env.reset`, or None"""


class Step(Message, frozen=True):
    """Step every copy of the lane; answered by `Stepped`."""

    session: int
    ticket: int
    lane: int
    incarnation: int
    actions: tuple[Array, ...]
    """one array [N, *leaf] for each leaf of the action"""


class Call(Message, frozen=True):
    """Call, read or set an attribute of these copies of the lane; answered by `Returned`."""

    session: int
    ticket: int
    lane: int
    incarnation: int
    copies: tuple[int, ...]
    """which of the lane's copies, from 0"""
    name: str
    """of the attribute, wherever among the wrappers it is; what is not callable is read"""
    assign: bool
    """set it, instead"""
    given: Array
    """[bytes] uint8, `protocol.wire.plain_values`: (arguments, keyword arguments), or one value for each of the copies"""


class Stepped(Message, frozen=True):
    """What a Reset or a Step gave, of every copy of the lane."""

    session: int
    ticket: int
    """of the order; below 0: a step through shared memory, whose infos were too long to be laid there"""
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
    """What a Call gave."""

    session: int
    ticket: int
    lane: int
    incarnation: int
    results: Array
    """[bytes] uint8, `protocol.wire.plain_values`: a list of what each copy gave"""
    error: str
    """the exception's type and text, in one line, if the call raised; else empty"""
    traceback: str
    """where it was raised, as text"""


class Inquire(Message, frozen=True):
    """How is the run, or the vector environment? From anybody who may connect; one who asks need not be a worker."""


class WorkerStatus(msgspec.Struct, frozen=True):
    """A worker as the learner sees it."""

    worker: str
    """its name"""
    host: str
    pid: int
    standing: str
    """active, or draining"""
    lanes: tuple[int, ...]
    """those that live there: none, if it is a spare"""
    tickets: int
    """dealt to it, and not back"""
    steps: int
    """env steps since it started"""
    steps_per_s: float
    """between its last two accounts of itself"""
    version: int
    """newest weights that it is known to hold; -1 before the first"""
    silent_s: float
    """seconds since its last message"""
    resident_bytes: int
    """memory of its process; 0 where that is not known"""
    strikes: int
    """messages and rollouts of it that could not be used"""


class Status(Message, frozen=True):
    """The answer to Inquire."""

    env: str
    version: int
    """how many updates the learner has made; -1 before the first weights"""
    env_steps: int
    """used by updates, since the run began"""
    total_steps: int
    """when it ends; 0: it is no run but a vector environment, and has neither updates nor an end"""
    steps_per_s: float
    """env steps used per second, since this learner started"""
    return_mean: float | None
    """of the last 100 episodes, raw rewards"""
    lag_mean: float
    """of the rollouts of the last update, in versions"""
    lag_max: int
    """of the rollouts of the last update, in versions"""
    workers: tuple[WorkerStatus, ...]
    """in the order in which they joined"""
    ledger: dict[str, int]
    """what became of every ticket, transition and message"""


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
