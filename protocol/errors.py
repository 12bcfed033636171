"""All millrace errors, in two families.

    MillraceError
    ├── UserFacingError         raised: this side cannot continue; the command line prints the line, exits with `exit_code`
    │   ├── UsageError            2   bad flag, unknown environment, unsupported space, folder that exists, …
    │   ├── Refused               2   the learner refused this worker
    │   ├── RunTakenOver          1   another process trains this run now; this one must write nothing more
    │   └── RunError              1   the run cannot continue
    │       ├── CheckpointError   1   a checkpoint is missing, broken or of another format
    │       ├── NoWorkers         1   no worker is left, or none ever joined
    │       ├── WorkerLost        1   a worker is gone with its env copies, in a run that must not lose any
    │       ├── LearnerLost      75   another process of a run with shards is gone; start all of them again
    │       ├── Stalled           1   a deadline passed; the text says what was waited for
    │       ├── PolicyFailed      1   a user-defined policy raised in a worker, hung, or returned something unusable
    │       └── EnvironmentFailed 1   the environment raised too often; `detail` is its traceback
    └── PeerError             counted and answered, never raised into the loop: a peer sent something wrong
        ├── BadMessage            not a valid message: shape, size, type or version
        └── BadRollout            a rollout that breaks the row format

An error's message is one line: who, what, expected, got, what to do next. `WorkerTraceback` is in neither family, because it
is only the `__cause__` of other errors.
"""

from __future__ import annotations

import builtins
import difflib
import errno
import resource
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from itertools import dropwhile
from typing import ParamSpec

from millrace.protocol.bounds import MAX_TEXT, escaped, one_line

WordedFrom = ParamSpec("WordedFrom")


def first_line(error: BaseException, otherwise: str = "no message") -> str:
    """The first line of an exception's message; `otherwise` if it has none, or if its user-defined `__str__` raises."""
    try:
        text = str(error)
    except Exception:
        return otherwise
    return (text.strip().splitlines() or [otherwise])[0].strip()


def safe_repr(value: object) -> str:
    """The `repr` of a value, or another text if that raises, because an error may quote a user-defined object."""
    try:
        return repr(value)
    except Exception as error:
        return f"<{type(value).__name__}, whose repr raised {type(error).__name__}>"


def words_an_error(words: Callable[WordedFrom, str]) -> Callable[WordedFrom, str]:
    """Decorates a function that composes an error message or advice, so that it returns an empty string instead of raising.

    Such a function inspects arbitrary objects from the user or from other packages, and must not hide the original error by
    failing itself.
    """

    @wraps(words)
    def unable_to_raise(*args: WordedFrom.args, **kwargs: WordedFrom.kwargs) -> str:
        try:
            return words(*args, **kwargs)
        except Exception:
            return ""

    return unable_to_raise


def joined(line: str, advice: str) -> str:
    """The line, followed by the advice if that isn't empty."""
    return f"{line}; {advice}" if advice else line


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """`; did you mean NAME?` if a known name is similar, else an empty string. `prefix` is put before the suggestion."""
    similar = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {prefix}{similar[0]}?" if similar else ""


class MillraceError(Exception):
    """Base of all millrace errors. `str(error)` is one line: who, what, expected, got, what to do next.

    >>> import millrace
    >>> try:
    ...     millrace.Run("runs/no-such-run")
    ... except millrace.MillraceError as error:
    ...     print(error)
    run runs/no-such-run: no such folder
    """


class UserFacingError(MillraceError):
    """The learner or a worker cannot continue: the base class of all errors that a user sees.

    The command line prints the line and exits with `exit_code`: 2 for a wrong request, 1 for a failure. `detail` is text to
    show below the line, such as a worker's traceback; often empty.

    >>> import millrace
    >>> try:
    ...     millrace.train("CartPole-v1", steps=0)
    ... except millrace.UserFacingError as error:
    ...     error.exit_code
    2
    """

    exit_code = 1
    """exit code of the command line"""

    def __init__(self, line: str, detail: str = "") -> None:
        """`line` is the whole message; control characters in it are escaped, so that it stays one line. `detail` is shown
        below it.
        """
        super().__init__(one_line(line))
        self.detail = detail


class UsageError(UserFacingError):
    """The user's request can't be fulfilled; the text says what is possible.

    Causes are an unknown setting or environment, a value out of range, an unsupported space, a folder that isn't a run, or a
    call that comes too early. Most are raised before a worker starts.

    >>> import millrace
    >>> millrace.train("CartPole-v1", learning_rat=1e-3)
    Traceback (most recent call last):
    millrace.protocol.errors.UsageError: train: unknown setting learning_rat; did you mean learning_rate?
    """

    exit_code = 2


def usage_error(error: OSError) -> UsageError | None:
    """The `UsageError` for an operating system error that the user's request caused; None for any other error."""
    match error.errno:
        case errno.ENAMETOOLONG:
            return UsageError(f"path {one_line(str(error.filename), 500)}: {error.strerror}; choose a shorter one")
        case errno.EMFILE:
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            return UsageError(
                f"a process may have {most} files open here, which is too few: `ulimit -n 4096`, or fewer workers"
            )
    return None


class Refused(UserFacingError):
    """The learner refused this worker."""

    exit_code = 2


class RunTakenOver(UserFacingError):
    """Another process is now training this run, because this one seemed dead. Nothing more may be written."""


class RunError(UserFacingError):
    """The run cannot continue, or a file cannot be written.

    Its subclasses are more specific. A training run has kept its newest undamaged checkpoint, from which
    `millrace.train(resume=run)` continues.

    >>> import millrace
    >>> millrace.Run(run).plot("no-such-folder/curve.svg")
    Traceback (most recent call last):
    millrace.protocol.errors.RunError: no-such-folder/curve.svg not written: No such file or directory
    """


@contextmanager
def refusals_of(package: str) -> Iterator[None]:
    """A context that turns errors raised by another package into a `RunError`: one line with the package and its message.

    Use it for packages that do a separate job for the user, such as logging elsewhere, writing a video or starting machines.
    Don't use it for torch or numpy, whose errors mostly mean a mistake in millrace.
    """
    try:
        yield
    except MillraceError:
        raise
    except Exception as error:
        raise RunError(f"{package}: {type(error).__name__}: {_whole_message(error)}") from error


def _whole_message(error: Exception) -> str:
    """The error's message with all its lines joined into one, because the first line may only introduce the rest."""
    try:
        return one_line(" ".join(str(error).split()), MAX_TEXT) or "no message"
    except Exception:  # its __str__ raised
        return "no message"


class CheckpointError(RunError):
    """A checkpoint, or a file that `RolloutService.save` wrote, is missing, broken, of another format or of another policy.

    A resumed run uses its newest undamaged checkpoint; this error is raised if there is none.

    >>> import millrace, pathlib
    >>> _ = pathlib.Path("state.npz").write_bytes(b"not a saved state")
    >>> try:
    ...     millrace.RolloutService("CartPole-v1", restore="state.npz")
    ... except millrace.CheckpointError as error:
    ...     print("the state cannot be restored")
    the state cannot be restored
    """


class NoWorkers(RunError):
    """There has been no worker for `no_workers_timeout_s` seconds. The line says how to start one.

    Either no worker is left, or none ever joined. If this program started the workers and no others can join, the error is
    raised as soon as none of them is left, and says why the last one ended. A training run that had begun has written a
    checkpoint. A vector environment waits a minute for workers that it starts itself, and `timeout` for those that join from
    elsewhere.

    >>> import millrace
    >>> try:
    ...     millrace.RolloutService("CartPole-v1", bind="tcp://127.0.0.1:*", no_workers_timeout_s=0.2)
    ... except millrace.NoWorkers as error:
    ...     print("start a worker: millrace worker ADDRESS")
    start a worker: millrace worker ADDRESS
    """


class LearnerLost(RunError):
    """Another learner process of a run with shards is gone, or doesn't answer in time. The state was saved by rank 0.

    Exit code 75 says that trying again may help: start all processes of the run again, with `--resume auto`.

    >>> import millrace
    >>> millrace.LearnerLost("learner: rank 1 is gone").exit_code
    75
    """

    exit_code = 75


class WorkerLost(RunError):
    """A worker was lost, and its env copies with it: its process ended, or it did not answer in time.

    Only a vector environment with `on_worker_loss="raise"` raises this; after `reset`, it continues with new copies.
    Training and `RolloutService` give the lanes of a lost worker to other workers.

    >>> import gymnasium, millrace, os
    >>> class Dies(gymnasium.Wrapper):
    ...     def step(self, action):
    ...         os._exit(1)
    >>> envs = millrace.make_vec(lambda: Dies(gymnasium.make("CartPole-v1")), 1, on_worker_loss="raise")
    >>> _ = envs.reset()
    >>> try:
    ...     envs.step([0])
    ... except millrace.WorkerLost as error:
    ...     print("its worker is gone")
    its worker is gone
    >>> envs.close()
    """


class Stalled(RunError):
    """Workers have joined, but have sent nothing for ten minutes, or for as long as one call to the environment may take.

    The line says what the learner was waiting for. The usual cause is an environment that hangs. If `step_timeout_s` is set,
    the worker of such an environment is ended.

    >>> import millrace
    >>> try:
    ...     run = millrace.train("CartPole-v1", steps=500, workers=1, progress=False)
    ... except millrace.Stalled as error:
    ...     print(error)  # no worker made progress for ten minutes; the run can be resumed
    """


class WorkerTraceback(Exception):
    """The traceback of an exception in a worker, shown as a cause, because this process's own traceback lacks its frames."""

    def __str__(self) -> str:
        return f'\n"""\n{super().__str__()}\n"""'  # the form in which the standard library shows another process's traceback


def worker_exception(traceback: str) -> Exception | None:
    """The exception for a traceback that a worker sent; None if it sent none.

    A built-in exception is rebuilt from its name, with its message as the only argument; its cause is the `WorkerTraceback`.
    For any other exception, the `WorkerTraceback` itself is returned. Nothing is unpickled or imported, and control
    characters are escaped.
    """
    if not traceback:
        return None
    traceback = escaped(traceback).rstrip()
    text = WorkerTraceback(traceback)
    lines = traceback.split("\n")
    last_frame = max((n for n, line in enumerate(lines) if line.startswith('  File "')), default=len(lines))
    raised = dropwhile(lambda line: line.startswith(" "), lines[last_frame:])
    name, colon, message = "\n".join(raised).partition(": ")
    kind = vars(builtins).get(name)
    if not isinstance(kind, type) or not issubclass(kind, Exception):
        return text
    try:
        error = kind(message) if colon else kind()
    except TypeError:  # an exception with other arguments, such as UnicodeDecodeError
        return text
    error.__cause__ = text
    return error


class EnvironmentFailed(RunError):
    """The environment raised too often. `detail` is the worker's traceback; in a worker, `lane` is the lane of the copy.

    `__cause__` is the environment's exception if that is a built-in one; otherwise, it is an exception that shows the
    traceback.

    >>> import millrace
    >>> def broken():
    ...     raise OSError("the simulator has no licence")
    >>> try:
    ...     millrace.make_vec(broken, 2)
    ... except millrace.EnvironmentFailed as error:
    ...     error.__cause__
    OSError('the simulator has no licence')
    """

    def __init__(self, line: str, detail: str = "", lane: int | None = None) -> None:
        super().__init__(line, detail)
        self.lane = lane
        self.__cause__ = worker_exception(detail)


class PolicyFailed(RunError):
    """A user-defined policy raised in a worker, did not return in time, or returned something unusable.

    The line names the worker and the policy. If the policy raised, `detail` is the worker's traceback, and `__cause__` is
    the exception, as in `EnvironmentFailed`.

    >>> import millrace
    >>> class Policy:
    ...     def load(self, arrays): ...
    ...     def act(self, obs, state, rng):
    ...         return obs @ self.weights, state, {}
    >>> policy = millrace.OwnPolicy(Policy, {"w": (4, 2)})
    >>> try:
    ...     with millrace.RolloutService("CartPole-v1", policy, workers=1, max_env_failures=0) as service:
    ...         version = service.publish({"w": [[0, 0]] * 4})
    ...         batch = service.gather()
    ... except millrace.PolicyFailed as error:
    ...     error.__cause__
    AttributeError("'Policy' object has no attribute 'weights'")
    """

    def __init__(self, line: str, detail: str = "") -> None:
        super().__init__(line, detail)
        self.__cause__ = worker_exception(detail)


class PeerError(MillraceError):
    """A peer sent something wrong."""

    def __init__(self, line: str) -> None:
        """`line` may quote what the peer sent: control characters in it are escaped."""
        super().__init__(one_line(line))


class BadMessage(PeerError):
    """Bytes that are not a valid message."""


class CannotUnpack(BadMessage):
    """A message whose packed arrays are larger than the run allows, or can't be unpacked here.

    Everything else in the message was read. So a message that was packed for another run can be told from a mistake: it is
    of another session.
    """

    def __init__(self, line: str, session: int) -> None:
        """`session` is the session of the message."""
        super().__init__(line)
        self.session = session


class BadRollout(PeerError):
    """A rollout that breaks the row format or does not fit the run."""


def unexpected_arguments(words: Sequence[str], *, one_run: bool) -> str:
    """The error message for a command that got these extra words. `one_run`: the command takes one run, which it has."""
    if one_run:
        return f"expected one run, got {1 + len(words)}; name one of them"
    return f"unexpected argument {words[0]}"


def check_at_least(name: str, value: int, least: int) -> None:
    """Raise `UsageError` if a number that the user gave, called `name`, is less than `least`."""
    if value < least:
        raise UsageError(f"{name}: expected int >= {least}, got {value}")
