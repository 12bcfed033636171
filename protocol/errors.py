"""Every error millrace knows, in two families.

    MillraceError
    ├── UserFacingError         raised: this side cannot go on; the command line prints its one line, exits with `exit_code`
    │   ├── UsageError            2   bad flag, unknown environment, unsupported space, folder that exists, …
    │   ├── Refused               2   the learner refused this worker
    │   ├── RunTakenOver          1   another process trains this run now; this one must write nothing more
    │   └── RunError              1   the run cannot go on
    │       ├── CheckpointError   1   a checkpoint is missing, broken or of another format
    │       ├── NoWorkers         1   no worker is left, or none ever joined
    │       ├── WorkerLost        1   a worker is gone, and env copies with it, where none may be lost
    │       ├── Stalled           1   a deadline passed; the text says what was waited for
    │       ├── PolicyFailed      1   on a worker: a policy that the user wrote raised, or returned something unusable
    │       └── EnvironmentFailed 1   the environment, or that policy, raised too often; the text carries its traceback
    └── PeerError             counted and answered, never raised into the loop: a peer sent something wrong
        ├── BadMessage            not a valid message: shape, size, type or version
        └── BadRollout            a rollout that breaks the row format

A message is one line: who, what, expected, got, what to do next.
"""


def first_line(error: BaseException, otherwise: str = "no message") -> str:
    """The first line of an exception's message; `otherwise` if it has none."""
    return (str(error).strip().splitlines() or [otherwise])[0].strip()


class MillraceError(Exception):
    """Base of all errors of millrace."""


class UserFacingError(MillraceError):
    """One side cannot go on. The command line prints the one line and exits with `exit_code`."""

    exit_code = 1

    def __init__(self, line: str, detail: str = "") -> None:
        """`line` is the whole message, in one line; `detail` (a traceback, as text) is shown below it."""
        super().__init__(line)
        self.detail = detail


class UsageError(UserFacingError):
    """What the user asked for cannot be done; the text says what can."""

    exit_code = 2


class Refused(UserFacingError):
    """The learner refused this worker."""

    exit_code = 2


class RunTakenOver(UserFacingError):
    """Another process trains this run now, because this one seemed dead. Nothing more may be written."""


class RunError(UserFacingError):
    """The run cannot go on."""


class CheckpointError(RunError):
    """A checkpoint is missing, broken or of another format."""


class NoWorkers(RunError):
    """No worker is left, or none ever joined."""


class WorkerLost(RunError):
    """A worker was lost, and its env copies with it."""


class Stalled(RunError):
    """A deadline passed."""


class EnvironmentFailed(RunError):
    """The environment raised; `detail` is the traceback where it happened."""


class PolicyFailed(RunError):
    """A policy that the user wrote raised, or returned what no rollout can hold; `detail` is its traceback, if it raised."""


class PeerError(MillraceError):
    """A peer sent something wrong."""


class BadMessage(PeerError):
    """Bytes that are not a valid message."""


class BadRollout(PeerError):
    """A rollout that breaks the row format or does not fit the run."""
