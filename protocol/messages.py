"""The messages, as small frozen records. `README.md` says who may send which message, and when.

A session lasts from a worker's `Welcome` until the worker leaves, or the learner gives up on it. A message from another
session is counted, but not used. Every field has a bound (`protocol/bounds.py`), which decoding checks.
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

PROTOCOL_VERSION = 16
TOLD_TO_STOP = "told to stop"
"""The reason in the Goodbye of a worker that got a signal. Any other reason says why the worker declines what it was asked
to do.
"""


class Hello(Message, frozen=True, array_like=False):  # a map in every version, so that any two versions can decode it
    """May I join? Repeated with backoff until it is answered."""

    protocol: Natural
    worker: Name
    """the worker's name; also its routing id (rule HELLO)"""
    host: Line
    pid: Pid
    process_nonce: Natural
    """drawn at random for each process, because pids repeat in containers; a secret of the worker, its supervisor and its
    learner (rule REAPPEARS)"""
    software: Line
    attempt: Natural
    """`process_nonce` + 1 when the process first joins; it rises by one each time the process starts to join again. A
    repeated Hello keeps the number, which therefore also shows which process a Welcome answers (rules HELLO, HELLO_AGAIN)
    """
    evaluates: bool = False
    """true: the worker only plays evaluations, and gets no lane (rule EVALUATES)"""
    continues: bool = False
    """true: the worker can continue a lane that another worker had, from the lane's history (rule PAST)"""

    @property
    def is_first_attempt(self) -> bool:
        """Whether the process has not joined before."""
        return self.attempt <= self.process_nonce + 1


class Welcome(Message, frozen=True):
    """You may join. The message says what to do: collect rollouts, step env copies on order, or wait until that is known.

    A worker that waits gets a second Welcome in the same session, when the run begins.
    """

    session: Natural
    attempt: Natural
    """`attempt` of the Hello that this answers"""
    run: WaitSpec | RunSpec | StepSpec


class Refuse(Message, frozen=True, array_like=False):  # a map, as Hello is
    """Leave, with exit code 2."""

    reason: Line


class Rejoin(Message, frozen=True):
    """I do not know this session, because I restarted or gave up on you: say Hello again."""

    session: Natural


class Weights(Message, frozen=True):
    """Weights that an order names. The message contains no session, so it is encoded only once for all workers."""

    version: Natural
    parameters: Array
    """[P] the parameters needed to act: float32, or rounded to bfloat16 (which is sent as uint16)"""
    buffers: Array
    """[B] float32: first, the mean and standard deviation of observations, if these are normalized; then ε, if the policy
    has action values, or the scale of the noise, if its actions are deterministic; last, for actions in [-1, 1], 1 while
    they are drawn uniformly, else 0"""
    env_attributes: Array | None = None
    """[bytes] uint8, `plain_values`: attribute values by name. They are set on a lane's copies before its next rollout under
    these weights, and on new copies before their first reset. The copies keep the values until other weights name the same
    attributes. The values are not set on evaluation copies (rule ATTRIBUTES)
    """


def versions_of(version: int, opponents: Iterable[int | None]) -> set[int]:
    """All versions of the weights that are needed: `version`, and those of opponents that are weights of the policy."""
    return {version, *(number for number in opponents if number is not None and number >= 0)}


class Permit(msgspec.Struct, frozen=True, array_like=True):
    """A ticket as it is sent: permission for one rollout, on this lane and incarnation."""

    ticket: Natural
    lane: Natural
    incarnation: Natural
    sequence: Natural
    """number of the rollout; rollouts are collected in this order, starting from 0 in every incarnation"""
    round: Natural
    """which update the rollout is for, counted since the run began; it determines the random numbers of the actions"""
    opponent: Whole | None = None
    """who plays the other teams in the episodes that begin in this rollout: the version of some weights, or −1 − k for
    `RunSpec.scripted[k]` (rule OPPONENT)"""
    past: LanePast | None = None
    """with sequence 0: the history from which to continue the lane; null: new episodes begin, as they do when a lane first
    starts (rule PAST)
    """

    def of_new_episodes(self, copies: int) -> Permit:
        """The same ticket for a lane of `copies` copies that can't be continued: each begins a new episode, which differs
        from its first one.
        """
        return msgspec.structs.replace(self, past=LanePast.unknown(self.lane, copies))


class Received(msgspec.Struct, frozen=True, array_like=True):
    """Which rollouts of this lane and incarnation the learner has received."""

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
    """the versions that the learner counts as held from now on, ascending; the worker drops all others, except those that
    unfinished tickets name
    """

    @property
    def versions(self) -> set[int]:
        """The versions of all weights that this order needs."""
        return versions_of(self.version, [permit.opponent for permit in self.permits])


class LaneIncarnation(msgspec.Struct, frozen=True, array_like=True):
    """A lane, and how often it has been started on new env copies."""

    lane: Natural
    incarnation: Natural
    """the lane is closed if its incarnation at the worker is this one or a lower one"""


class Release(Message, frozen=True):
    """These lanes belong to other workers now: close them."""

    session: Natural
    lanes: tuple[LaneIncarnation, ...]


class Heartbeat(Message, frozen=True):
    """The weights and tickets that the worker holds. The learner compares them with its own records, and sends again what
    was lost.
    """

    session: Natural
    replies: Natural
    """number of the last HeartbeatReply received; everything that the learner sent before it has arrived or is lost
    (rule HEARTBEAT_REPLIES)
    """
    versions: Versions
    """of the weights held, ascending (rule HEARTBEAT_VERSIONS)"""
    tickets: Tickets
    """tickets that the worker holds and has not finished: those that are waiting, and those of the work in progress
    (rule HEARTBEAT_TICKETS)
    """
    steps: Natural
    """env steps since the worker started, in all sessions, including those of evaluations, and preferably counted as they
    are made. With `StepSpec`, each copy that a Step steps counts as one; a copy that a Step only resets may count too
    (rule HEARTBEAT_STEPS)
    """
    stages: Stages
    """seconds spent in each stage since the worker started"""
    resident_bytes: Natural
    """resident memory of the worker's process; 0 if it is not known"""
    late_actions: Natural = 0
    """how often, since the worker started, a program that runs its own loop has chosen an action itself, because none had
    arrived in time"""
    note: Line = ""
    """something about the environment that the worker has noticed and the user should know; the learner logs it once"""
    waits: bool = False
    """true: the worker knows of no run, because its `Welcome` contained a `WaitSpec`, and no second one has arrived
    (rule HEARTBEAT_WAITS)"""


class HeartbeatReply(Message, frozen=True):
    """I am alive, and these are the rollouts of each of your lanes that I have received."""

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
    """true: a user-defined policy raised, or returned what a rollout can't hold; no environment is to blame"""


class Describe(Message, frozen=True):
    """Make one copy of this environment, and describe it. Answered by `Described`. Sent before there is a run."""

    session: Natural
    ticket: Natural
    env: EnvSpec
    vector: str = "loop"
    """the kind of env copies that the run will use; the worker checks that they have the same spaces as a single copy"""
    render_mode: str | None = None
    """the render mode with which the copy is made"""


class Described(Message, frozen=True):
    """The description of the environment that a `Describe` named."""

    session: Natural
    ticket: Natural
    """ticket of the `Describe`"""
    description: EnvDescription


class Evaluate(Message, frozen=True):
    """Play one episode per seed, on env copies outside all lanes, under weights of this version. Answered by `Evaluated`.

    (rule EVALUATE)
    """

    session: Natural
    ticket: Natural
    version: Natural
    seeds: Annotated[tuple[Natural, ...], Meta(min_length=1, max_length=MAX_SEEDS)]
    """reset seed of each episode; all episodes are stepped as one batch, and those that have ended stay in it, unused"""
    greedy: bool
    """true: take the most probable actions; false: draw them, with random numbers that are derived from the first seed and
    differ from those that an environment with this seed draws (rule GREEDY)"""
    most_steps: Count
    """an episode that has not ended after this number of steps is cut"""
    send_rows: bool
    """also send every row, as `EpisodeRows`"""
    send_frames: bool
    """also send the rendered frames, as `EpisodeRows`"""
    opponents: Annotated[tuple[Whole, ...], Meta(max_length=MAX_SEEDS)] = ()
    """with `RunSpec.teams`: who plays the other teams, as in a `Permit`, one for each seed"""
    teams: Annotated[tuple[Natural, ...], Meta(max_length=MAX_SEEDS)] = ()
    """the team that the weights play, one for each of `opponents`"""
    keep: Versions = ()
    """as in `Collect`"""

    @property
    def versions(self) -> set[int]:
        """The versions of all weights that this order needs."""
        return versions_of(self.version, self.opponents)


class EpisodeRows(Message, frozen=True):
    """L consecutive rows of one episode of an `Evaluate`. They are sent before the `Evaluated`."""

    session: Natural
    ticket: Natural
    episode: Natural
    """index of the episode's seed in the `Evaluate`"""
    first_step: Natural
    """step of the episode, from 0, to which the first row belongs"""
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
    """[L+1, H, W, 3] uint8, the frames that the environment rendered"""


class Evaluated(Message, frozen=True):
    """The episodes of an `Evaluate`, in the order of its seeds."""

    session: Natural
    ticket: Natural
    episodes: Annotated[tuple[Episode, ...], Meta(max_length=MAX_SEEDS)]
    """one for each seed"""
    cut: Annotated[tuple[bool, ...], Meta(max_length=MAX_SEEDS)]
    """for each episode, whether it was cut at `most_steps`; an episode that ended at that step was not cut (rule CUT)"""


class Reset(Message, frozen=True):
    """Begin episodes in these copies of the lane. Answered by `Stepped`. A new incarnation gets new copies."""

    session: Natural
    ticket: Natural
    """rises with every new order; a repeated order is answered again, but not executed again"""
    lane: Natural
    incarnation: Natural
    copies: tuple[Natural, ...]
    """which of the lane's copies, from 0"""
    seeds: tuple[int | None, ...]
    """one seed for each of `copies`; null: reset without a seed, so that the copy's random generator continues"""
    options: Array
    """[bytes] uint8, `plain_values`: the options for `Env.reset`, or None; a list has one entry per copy (rule OPTIONS)"""


class Step(Message, frozen=True):
    """Step every copy of the lane. Answered by `Stepped`."""

    session: Natural
    ticket: Natural
    lane: Natural
    incarnation: Natural
    actions: tuple[Array, ...]
    """one array [N, *leaf] for each leaf of the action; see `StepSpec.seats` for N with seats"""


DESCRIPTION = "<description>"
"""Name in a `Call` that requests the description of each copy. A client that cannot describe copies answers as for an
unknown name.
"""


class Call(Message, frozen=True):
    """Call, read or set an attribute of these copies of the lane. Answered by `Returned`."""

    session: Natural
    ticket: Natural
    lane: Natural
    incarnation: Natural
    copies: tuple[Natural, ...]
    """which of the lane's copies, from 0"""
    name: Line
    """name of the attribute, which the environment or any of its wrappers may have; an attribute that is not callable is
    read. With `<description>`, the result for each copy is a list of the frames of a `Described`
    """
    assign: bool
    """true: set the attribute"""
    given: Array
    """[bytes] uint8, `plain_values`: a pair of the positional arguments (a list or tuple) and the keyword arguments (a
    dict); with `assign`, a list of one value for each of `copies`
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
    """[bytes] uint8, `plain_values`: a list of pairs (copy, info), each pair a list or a tuple; empty infos are left out
    (rule STEPPED_ARRAYS)
    """


class Returned(Message, frozen=True):
    """The result of a Call."""

    session: Natural
    ticket: Natural
    lane: Natural
    incarnation: Natural
    results: Array
    """[bytes] uint8, `plain_values`: a list with one result for each of `copies`; with `assign`, an empty list; no bytes if
    the call raised
    """
    error: Line
    """type and message of the exception, in one line, if the call raised; else empty"""
    traceback: Text
    """the traceback of that exception, as text"""


class Inquire(Message, frozen=True):
    """How is the run, or the vector environment, doing? Any client that may connect can ask, without being a worker."""


class WorkerStatus(msgspec.Struct, frozen=True):
    """A worker as the learner sees it."""

    worker: str
    """the worker's name"""
    host: str
    pid: int
    state: str
    """active, spare (it has no lane), evaluating (it does only that), or draining"""
    lanes: tuple[int, ...]
    tickets: int
    """number of tickets that were dealt to the worker and are not finished"""
    steps: int
    """env steps since the worker started"""
    steps_per_s: float
    """env steps per second between the last two heartbeats that reported new steps; falls once the next one is overdue"""
    version: int
    """version of the newest weights that the worker is known to hold; -1 before the first"""
    silent_s: float
    """seconds since the worker's last message"""
    resident_bytes: int
    """resident memory of the worker's process; 0 if it is not known"""
    strikes: int
    """how many of the worker's messages and rollouts could not be used"""
    doing: str = ""
    """the worker's current activity, as its supervisor reports it; empty without a supervisor"""
    doing_s: float = 0.0
    """for how many seconds the worker has been doing that"""
    late_actions: int = 0
    """actions that arrived too late for a program that runs its own loop, since the worker started"""


class Status(Message, frozen=True):
    """The answer to Inquire."""

    env: str
    progress: RunProgress
    """the progress of the run, or of the vector environment"""
    workers: tuple[WorkerStatus, ...]
    """the workers in the order in which they joined; if there are too many, only the first of them"""
    workers_wanted: int = 0
    """the number of workers at which each lane has a worker of its own and no worker is spare; 0 while the environment is
    being described"""
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
