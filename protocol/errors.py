"""Every error millrace knows, in two families.

    MillraceError
    ├── OurError              raised: this side cannot go on; the command line prints its one line, exits with `exit_code`
    │   ├── UsageError            2   bad flag, unknown environment, unsupported space, folder that exists, …
    │   ├── Refused               2   the learner told this worker to leave
    │   └── RunError              1   the run cannot go on
    │       ├── CheckpointError   1   a checkpoint is missing, broken or of another format
    │       ├── NoWorkers         1   nobody is left (or came) to step the environment
    │       ├── WorkerLost        1   a worker is gone, and env copies with it, where none may be lost
    │       ├── Stalled           1   a deadline passed; the text says what was waited for
    │       └── EnvironmentFailed 1   the environment raised too often; the text carries the worker's own traceback
    └── TheirError            counted and answered, never raised into the loop: a peer sent something wrong
        ├── BadMessage            not a message of ours: shape, size, type or version
        └── BadRollout            a rollout that breaks the law of a row

A message is one line: who, what, expected, got, what to do next.
"""


def first_line(error: BaseException, otherwise: str = "no message") -> str:
    """The first line of an exception's message; `otherwise` if it has none."""
    return (str(error).strip().splitlines() or [otherwise])[0].strip()


class MillraceError(Exception):
    """Base of all errors of millrace."""


class UserFacingError(MillraceError):
    """We cannot go on."""

    exit_code = 1

    def __init__(self, line: str, detail: str = "") -> None:
        """`line` says all in one line; `detail` (a traceback, as text) is shown beneath it."""
        super().__init__(line)
        self.detail = detail


class UsageError(UserFacingError):
    """What the user asked for cannot be done; the text says what can."""

    exit_code = 2


class Refused(UserFacingError):
    """The learner told this worker to leave."""

    exit_code = 2


class RunError(UserFacingError):
    """The run cannot go on."""


class CheckpointError(RunError):
    """A checkpoint is missing, broken or of another format."""


class NoWorkers(RunError):
    """Nobody is left, or came, to step the environment."""


class WorkerLost(RunError):
    """A worker is gone, and env copies with it."""


class Stalled(RunError):
    """A deadline passed."""


class EnvironmentFailed(RunError):
    """The environment raised; `detail` is the traceback where it happened."""


class PeerError(MillraceError):
    """A peer sent something wrong."""


class BadMessage(PeerError):
    """Bytes that are not a message of ours."""


class BadRollout(PeerError):
    """A rollout that breaks the law of a row or does not fit the run."""
