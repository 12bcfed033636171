"""The messages, as small frozen records. `README.md` says who may send which message, and when.

A session lasts from the `Welcome` of a worker until it leaves or is given up. A message of another session is counted and
not used. Every field has a bound (`protocol/bounds.py`), which decoding checks.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import msgspec
from msgspec import Meta

from millrace.protocol.alive import Alive, WorkerActivity, WorkerExit
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import (
    MAX_SEEDS,
    MAX_TICKETS,
    Count,
    Line,
    Name,
    Natural,
    Pid,
    Stages,
    Text,
    Tickets,
    Versions,
    Whole,
)
from millrace.protocol.call_timeouts import Doing
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.lane_past import LanePast
from millrace.protocol.message_base import Message
from millrace.protocol.progress import RunProgress
from millrace.protocol.rollout import Episode, Rollout
from millrace.protocol.space_spec import EnvDescription
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec

PROTOCOL_VERSION = 14
TOLD_TO_STOP = "told to stop"
"""The reason in the Goodbye of a worker that got a signal. With any other reason it declines what it was asked for."""


class Hello(Message, frozen=True, array_like=False):  # a map, as in every version, so that any two can part politely
    """May I join? Repeated with backoff until it is answered."""

    protocol: Natural
    worker: Name
    """the worker's name; also its routing id (rule HELLO)"""
    host: Line
    pid: Pid
    process_nonce: Natural
    """drawn at random for each process, for pids repeat in containers; a secret of the worker, its supervisor and learner
    (rule REAPPEARS)"""
    software: Line
    attempt: Natural
    """`process_nonce` + 1 when the process first joins, and one more each time that it starts to join again. A repeated
    Hello keeps the number. So it also tells which process a Welcome answers (rules HELLO, HELLO_AGAIN)"""
    evaluates: bool = False
    """true: the worker only plays evaluations, and gets no lane (rule EVALUATES)"""
    continues: bool = False
    """true: the worker can continue a lane that another one had, from its past (rule PAST)"""

    @property
    def is_first_attempt(self) -> bool:
        """Whether the process has not joined before."""
        return self.attempt <= self.process_nonce + 1


class Welcome(Message, frozen=True):
    """You may join. It says what to do: collect rollouts, step env copies on order, or wait until that is known.

    A worker that waits is welcomed a second time, in the same session, by the run.
    """

    session: Natural
    attempt: Natural
    """`attempt` of the Hello that this answers"""
    run: WaitSpec | RunSpec | StepSpec


class Refuse(Message, frozen=True, array_like=False):  # a map, as Hello is
    """Leave, with exit code 2."""

    reason: Line


class Rejoin(Message, frozen=True):
    """I do not know this session, because I restarted or gave you up: say Hello again."""

    session: Natural


class Weights(Message, frozen=True):
    """Weights that an order names. They carry no session, so that one encoding serves all workers."""

    version: Natural
    parameters: Array
    """[P] the parameters needed to act: float32, or rounded to bfloat16 (which is sent as uint16)"""
    buffers: Array
    """[B] float32, observation mean and standard deviation if observations are normalized; then ε for action values, or the
    scale of the noise (deterministic actions); last, for actions in [-1, 1], 1 while they are drawn uniformly, else 0"""
    env_attributes: Array | None = None
    """[bytes] uint8, `plain_values`: attributes by name, which the copies of a lane get before its next
    rollout under these weights, new copies before their first reset. They keep them until other weights name them. Copies
    that play evaluations get none (rule ATTRIBUTES)
    """


def versions_of(version: int, opponents: Iterable[int | None]) -> set[int]:
    """The versions of the weights that act, and of those opponents that are weights."""
    return {version, *(number for number in opponents if number is not None and number >= 0)}


class Permit(msgspec.Struct, frozen=True, array_like=True):
    """A ticket as it travels: permission for one rollout, on this lane and incarnation."""

    ticket: Natural
    lane: Natural
    incarnation: Natural
    sequence: Natural
    """number of the rollout: they are collected in this order, from 0 in every incarnation"""
    round: Natural
    """which update the rollout is for, counted since the run began: it decides the random numbers of the actions"""
    opponent: Whole | None = None
    """who plays the other teams in the episodes that begin in it: the version of these weights, or −1 − k for
    `RunSpec.scripted[k]` (rule OPPONENT)"""
    past: LanePast | None = None
    """with sequence 0: what to continue. None: new episodes begin, as the first ones of the lane do (rule PAST)"""

    def of_new_episodes(self, copies: int) -> Permit:
        """The ticket, for a lane of this many copies that begin new episodes after their first ones."""
        return msgspec.structs.replace(self, past=LanePast.unknown(self.lane, copies))


class Received(msgspec.Struct, frozen=True, array_like=True):
    """The rollouts of this lane and incarnation that the learner has."""

    lane: Natural
    incarnation: Natural
    next_sequence: Natural
    """every rollout with a smaller sequence number has arrived"""
    out_of_order: Tickets = ()
    """larger sequence numbers that have arrived although an earlier one is missing"""


class Collect(Message, frozen=True):
    """Permission for one rollout on each of these lanes, under weights of this version."""

    session: Natural
    version: Natural
    permits: Annotated[tuple[Permit, ...], Meta(max_length=MAX_TICKETS)]
    received: tuple[Received, ...]
    """one entry for each lane of this worker; a lane that is not listed belongs to another worker"""
    keep: Versions
    """the weights that the learner counts as held from now on, ascending: drop all others, except those that unfinished
    tickets name"""

    @property
    def versions(self) -> set[int]:
        """The versions of the weights that it names."""
        return versions_of(self.version, [permit.opponent for permit in self.permits])


class LaneIncarnation(msgspec.Struct, frozen=True, array_like=True):
    """A lane, and how often it has been started on new env copies."""

    lane: Natural
    incarnation: Natural
    """the lane is closed if its incarnation is this one or a lower one"""


class Release(Message, frozen=True):
    """These lanes belong to other workers now: close them."""

    session: Natural
    lanes: tuple[LaneIncarnation, ...]


class Heartbeat(Message, frozen=True):
    """What the worker holds. The learner compares it with its own records and sends again what was lost."""

    session: Natural
    replies: Natural
    """number of the last HeartbeatReply received; what the learner sent before that has arrived or is lost
    (rule HEARTBEAT_REPLIES)"""
    versions: Versions
    """of the weights held, ascending (rule HEARTBEAT_VERSIONS)"""
    tickets: Tickets
    """tickets that are held and not finished: those that wait, and those of the work in progress
    (rule HEARTBEAT_TICKETS)"""
    steps: Natural
    """env steps since the worker started, in all sessions: of rollouts and evaluations, best counted as they are made, and
    with `StepSpec` those of each copy that a Step steps; a copy that it only resets may count too (rule HEARTBEAT_STEPS)
    """
    stages: Stages
    """seconds spent in each stage since the worker started"""
    resident_bytes: Natural
    """resident memory of the worker's process; 0 if it is not known"""
    late_actions: Natural = 0
    """how often since the worker started a program that owns its loop chose its own action, because none had arrived"""
    note: Line = ""
    """what the user should know about the environment, if the worker has noticed something; the learner logs it once"""
    waits: bool = False
    """true: the worker knows of no run, because its `Welcome` brought a `WaitSpec`, and no second one has come
    (rule HEARTBEAT_WAITS)"""


class HeartbeatReply(Message, frozen=True):
    """The learner is alive, and this is what it has received of each of your lanes."""

    session: Natural
    number: Natural
    received: tuple[Received, ...]


class Drain(Message, frozen=True):
    """Finish the current rollout, send it, and leave."""

    reason: Line


class Goodbye(Message, frozen=True):
    """I leave on purpose, and did not finish these tickets."""

    session: Natural
    reason: Line
    tickets: Tickets


class Failure(Message, frozen=True):
    """My environment, my policy, or my own code raised an exception; I leave."""

    session: Natural
    error: Line
    """one line, which names the lane if there is one"""
    traceback: Text
    lane: Natural | None
    of_policy: bool = False
    """true: a policy that the user wrote raised, or returned what no rollout can hold; no environment is to blame"""


class Describe(Message, frozen=True):
    """Make one copy of this environment, and say what it is. Answered by `Described`. Sent before there is a run."""

    session: Natural
    ticket: Natural
    env: EnvSpec
    vector: str = "loop"
    """the kind of env copies that must have the same spaces as a single copy, which the worker checks"""
    render_mode: str | None = None
    """passed to the copy"""


class Described(Message, frozen=True):
    """The environment of a `Describe`."""

    session: Natural
    ticket: Natural
    """of the order"""
    description: EnvDescription


class Evaluate(Message, frozen=True):
    """Play one episode for each seed, on copies of their own, under weights of this version. Answered by `Evaluated`.

    (rule EVALUATE)
    """

    session: Natural
    ticket: Natural
    version: Natural
    seeds: Annotated[tuple[Natural, ...], Meta(min_length=1, max_length=MAX_SEEDS)]
    """reset seed of each episode; all are stepped together, and those that ended stay in the batch, unused"""
    greedy: bool
    """true: take the most probable actions; false: draw them, from random numbers that follow from the first seed and that
    no environment with this seed draws (rule GREEDY)"""
    most_steps: Count
    """an episode that reaches this number of steps without an end is cut"""
    send_rows: bool
    """also send every row, as `EpisodeRows`"""
    send_frames: bool
    """also send what the environment renders, as `EpisodeRows`"""
    opponents: Annotated[tuple[Whole, ...], Meta(max_length=MAX_SEEDS)] = ()
    """with `RunSpec.teams`: who plays the other teams, as in a `Permit`, one for each seed"""
    teams: Annotated[tuple[Natural, ...], Meta(max_length=MAX_SEEDS)] = ()
    """the team that the weights play, one for each of `opponents`"""
    keep: Versions = ()
    """as in `Collect`"""

    @property
    def versions(self) -> set[int]:
        """The versions of the weights that it names."""
        return versions_of(self.version, self.opponents)


class EpisodeRows(Message, frozen=True):
    """Some consecutive rows of one episode of an `Evaluate`. L is their number. They come before their `Evaluated`."""

    session: Natural
    ticket: Natural
    episode: Natural
    """index of its seed"""
    first_step: Natural
    """step of the episode at which the first row stands, from 0"""
    obs: tuple[Array, ...]
    """one array [L+1, *leaf] for each leaf of the observation (rule EPISODE_ROWS)"""
    action: Array
    """[L, *action]"""
    reward: Array
    """[L] float64, raw (rule EPISODE_ROWS)"""
    terminated: Array
    """[L] bool"""
    truncated: Array
    """[L] bool; also set in the last row of an episode that was cut (rule EPISODE_ROWS)"""
    frames: Array | None = None
    """[L+1, H, W, 3] uint8, what the environment rendered"""


class Evaluated(Message, frozen=True):
    """The episodes of an `Evaluate`, in the order of its seeds."""

    session: Natural
    ticket: Natural
    episodes: Annotated[tuple[Episode, ...], Meta(max_length=MAX_SEEDS)]
    """one for each seed"""
    cut: Annotated[tuple[bool, ...], Meta(max_length=MAX_SEEDS)]
    """for each episode whether it was cut at `most_steps`; one that ends at this step was not (rule CUT)"""


class Reset(Message, frozen=True):
    """Start episodes in these copies of the lane. Answered by `Stepped`. A new incarnation starts on new copies."""

    session: Natural
    ticket: Natural
    """rises with every order; an order is executed once, and answered again if it is repeated"""
    lane: Natural
    incarnation: Natural
    copies: tuple[Natural, ...]
    """which of the lane's copies, from 0"""
    seeds: tuple[int | None, ...]
    """one seed for each of `copies`; null: go on with the random numbers that the copy has"""
    options: Array
    """[bytes] uint8, `plain_values`: the options of `Env.reset`, or None; a list has those of each copy (rule OPTIONS)"""


class Step(Message, frozen=True):
    """Step every copy of the lane. Answered by `Stepped`."""

    session: Natural
    ticket: Natural
    lane: Natural
    incarnation: Natural
    actions: tuple[Array, ...]
    """one array [N, *leaf] for each leaf of the action; see `StepSpec.seats` for N with seats"""


DESCRIPTION = "<description>"
"""Name in a `Call` that asks what each copy is. A client that cannot say it answers as for an unknown name."""


class Call(Message, frozen=True):
    """Call, read or set an attribute of these copies of the lane. Answered by `Returned`."""

    session: Natural
    ticket: Natural
    lane: Natural
    incarnation: Natural
    copies: tuple[Natural, ...]
    """which of the lane's copies, from 0"""
    name: Line
    """name of the attribute, which any of the wrappers may have; an attribute that is not callable is read. With
    `<description>`, the result for each copy is a list of the frames of a `Described`
    """
    assign: bool
    """true: set the attribute"""
    given: Array
    """[bytes] uint8, `plain_values`: a pair of the arguments, a list or a tuple, and the keyword arguments, a
    dict; with `assign`, a list of one value for each of `copies`
    """


class Stepped(Message, frozen=True):
    """The result of a Reset or a Step, for every copy of the lane."""

    session: Natural
    ticket: Whole
    """ticket of the order; below 0: a step through shared memory whose infos did not fit there"""
    lane: Natural
    incarnation: Natural
    obs: tuple[Array, ...]
    """one array [N, *leaf] for each leaf of the observation; with seats, three more (`StepSpec.seats`)
    (rule STEPPED_ARRAYS)"""
    reward: Array
    """[N] float64, raw (rule STEPPED_ARRAYS)"""
    terminated: Array
    """[N] bool (rule STEPPED_ARRAYS)"""
    truncated: Array
    """[N] bool (rule STEPPED_ARRAYS)"""
    infos: Array
    """[bytes] uint8: a list of pairs of copy and info, each pair a list or a tuple, packed by `plain_values`;
    empty infos are left out (rule STEPPED_ARRAYS)
    """


class Returned(Message, frozen=True):
    """The result of a Call."""

    session: Natural
    ticket: Natural
    lane: Natural
    incarnation: Natural
    results: Array
    """[bytes] uint8, `plain_values`: a list with one result for each of `copies`, an empty list with `assign`;
    no bytes if the call raised
    """
    error: Line
    """type and message of the exception, in one line, if the call raised; else empty"""
    traceback: Text
    """where it was raised, as text"""


class Inquire(Message, frozen=True):
    """How is the run, or the vector environment? Anybody who may connect may ask, without being a worker."""


class WorkerStatus(msgspec.Struct, frozen=True):
    """A worker as the learner sees it."""

    worker: str
    """its name"""
    host: str
    pid: int
    state: str
    """active, spare (it has no lane), evaluating (it does only that), or draining"""
    lanes: tuple[int, ...]
    tickets: int
    """tickets that were dealt to it and have not come back"""
    steps: int
    """env steps since the worker started"""
    steps_per_s: float
    """env steps per second between its last two heartbeats with more steps, until the next one is overdue"""
    version: int
    """version of the newest weights that it is known to hold; -1 before the first"""
    silent_s: float
    """seconds since its last message"""
    resident_bytes: int
    """resident memory of its process; 0 if it is not known"""
    strikes: int
    """how many of its messages and rollouts could not be used"""
    doing: str = ""
    """what it does, as its supervisor says; empty if it has none"""
    doing_s: float = 0.0
    """for how many seconds it has done that"""
    late_actions: int = 0
    """actions that came too late for a program that owns its loop, since the worker started"""


class Status(Message, frozen=True):
    """The answer to Inquire."""

    env: str
    progress: RunProgress
    """how far the run, or the vector environment, is"""
    workers: tuple[WorkerStatus, ...]
    """in the order in which they joined; of very many, the first"""
    workers_wanted: int = 0
    """number of workers with which each lane has its own, and none is spare; 0 while the environment is described"""
    workers_left_out: int = 0
    """number of workers that are not in `workers`, because the message would be too long"""
    version: int = -1
    """version of the newest weights; -1 before the first"""


ToLearner = (
    Hello | Alive | Described | Rollout | Heartbeat | Goodbye | Failure | EpisodeRows | Evaluated | Stepped | Returned
)
ToWorker = (
    Welcome
    | Refuse
    | Rejoin
    | Describe
    | Weights
    | Collect
    | Release
    | Evaluate
    | HeartbeatReply
    | Drain
    | Reset
    | Step
    | Call
)
Order = Reset | Step | Call
Answer = Stepped | Returned
ToObserver = Status

__all__ = [
    "PROTOCOL_VERSION", "TOLD_TO_STOP", "Alive", "Answer", "Array", "Call", "Collect", "Describe", "Described", "Doing",
    "Drain", "EpisodeRows", "Evaluate", "Evaluated", "Failure", "Goodbye", "Heartbeat", "HeartbeatReply", "Hello", "Inquire",
    "LaneIncarnation", "LanePast", "Message", "Order", "Permit", "Received", "Refuse", "Rejoin", "Release", "Reset",
    "Returned", "Rollout", "Status", "Step", "Stepped", "ToLearner", "ToObserver", "ToWorker", "Weights", "Welcome",
    "WorkerActivity", "WorkerExit", "WorkerStatus", "versions_of",
]  # fmt: skip
