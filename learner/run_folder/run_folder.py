"""The folder of a run: which files it has, and how they are written and read.

    runs/<env>-<algo>-s<seed>-<time>/       with a number after the time if several runs began in one second
      config.toml           all settings of the run
      run.json              the format of the folder (run_format.py)
      metrics.jsonl         a row per update (metrics_log.py)
      tensorboard/          the same for TensorBoard, if requested
      checkpoints/          from which the run can be resumed (checkpoint.py)
      policy.safetensors    the arrays of the acting policy, by name (policy_files.py)
      best.safetensors      the same for the best policy in the run's own evaluations
      observation*.png      what the policy sees, if that is an image (image_sample.py)
      policy.json           the meaning of the policy's arrays, with which other programs can act
      progress.json         the progress, written once a second while the run trains (progress_file.py)
      summary.json          the results of the run (results.py)
      log.jsonl             warnings and notices of the learner (json_log.py)
      workers/              the logs of local worker processes
      run.lock              who trains the run now (run_lock.py)

Rule: files are written atomically. Nothing is pickled.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import stat
import time
from collections.abc import Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Literal, Protocol

import msgspec

from millrace.learner.run_folder.atomic_write import TEMPORARY, Writes, write_file
from millrace.learner.run_folder.policy_files import (
    PolicyDescription,
    StoredPolicy,
    decode_arrays,
    decode_description,
    encode_arrays,
    encode_description,
    stored_policy,
)
from millrace.learner.run_folder.regular_files import MOST_BYTES, read, reason
from millrace.learner.run_folder.results import SUMMARY_FILE, Summary, read_summary
from millrace.learner.run_folder.run_format import (
    CONFIG_FILE,
    END,
    HEAD,
    POLICY_ARRAYS,
    POLICY_JSON,
    RUN_FILE,
    check_format,
    is_run_folder,
    read_config,
    write_format,
)
from millrace.learner.run_folder.run_lock import RunLock
from millrace.protocol.arrays import Floats
from millrace.protocol.bounds import INVALID, one_line
from millrace.protocol.errors import RunError, UsageError
from millrace.protocol.own_module import refuse_modules_in
from millrace.protocol.specs import RunSpec

Which = Literal["final", "best"]
UNREADABLE = (OSError, *INVALID)  # the exceptions that reading a damaged file raises

log = logging.getLogger("millrace.learner")


class Interrupted(KeyboardInterrupt):
    """The user stopped the run. Its checkpoint has been written, and it can be resumed from its folder.

    `complete`: training had ended by then, so nothing is left to resume.
    """

    def __init__(self, run: Path, *, complete: bool = False) -> None:
        super().__init__(str(run))
        self.run = run
        self.complete = complete


class RunSettings(Protocol):
    """The settings that a run folder needs. `Config` has them."""

    @property
    def env(self) -> str:
        """The environment's id."""
        ...

    @property
    def algo(self) -> str:
        """The name of the algorithm."""
        ...

    @property
    def seed(self) -> int:
        """The seed of the run."""
        ...

    @property
    def run_dir(self) -> str:
        """The folder in which run folders are made."""
        ...

    def to_toml(self) -> str:
        """All settings as TOML."""
        ...


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path, made: Path | None = None) -> None:
        """For a new folder, `made` is the topmost folder that was created for it."""
        self.path = path
        self._made = made
        self._is_relative = False
        self._workers_elsewhere = False  # the value of this argument in the last call to `write_config`
        self.started_from = ""
        """See `RunFormat`."""
        self.callbacks: tuple[str, ...] = ()
        """See `RunFormat`."""
        self.writes = Writes()
        """Writes the files of the run, and retries writes that fail."""
        self.lock: RunLock | None = None
        """The lock of the run, while this process trains it."""

    @staticmethod
    def create(config: RunSettings, started_s: float | None = None) -> RunFolder:
        """Make a new folder with its config.toml. If the name is taken, a number follows the time: -2, -3, ….

        `started_s` is wall-clock time; by default, the current time. Raises `UsageError` if no folder can be made, or if a
        resume could not read the settings.
        """
        stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(started_s))
        name = f"{as_folder_name(config.env)}-{as_folder_name(config.algo)}-s{config.seed}"
        path = first = Path(config.run_dir) / f"{name}-{stamp}"
        try:
            os.fsencode(path).decode()
        except UnicodeError as error:
            raise UsageError(f"run-dir {config.run_dir!r}: expected a name in UTF-8; choose another --run-dir") from error
        made = [folder for folder in (path, *path.parents) if not folder.exists()]
        for number in count(2):
            try:
                path.mkdir(parents=True)
                break
            except FileExistsError:
                path = first.with_name(f"{first.name}-{number}")
            except OSError as error:
                raise UsageError(f"run folder {path} cannot be made: {error.strerror}; choose another --run-dir") from error
        folder = RunFolder(path, made[-1] if made else path)
        folder.write_config(config)
        try:
            read_config(path)
        except UsageError as error:
            folder.remove()
            raise UsageError(f"settings: no resume could read them: {error}") from error
        return folder

    @staticmethod
    def open(path: Path) -> RunFolder:
        """Open an existing folder.

        Raises `UsageError` if it is not a run folder, or has a newer format than this code knows.
        """
        if not path.is_dir():
            raise UsageError(f"run {path}: no such folder")
        if not (path / CONFIG_FILE).is_file():
            hint = ""
            with suppress(OSError):
                if inside := sorted(filter(is_run_folder, path.iterdir())):
                    hint = f"; it holds runs: name one of them, such as {one_line(str(inside[-1]))}"
            raise UsageError(f"run {path}: expected a run folder, got one without {CONFIG_FILE}{hint}")
        folder = RunFolder(path)
        run_format = check_format(path)
        folder.started_from = run_format.started_from
        folder.callbacks = run_format.callbacks
        return folder

    @staticmethod
    def open_policy(path: Path) -> RunFolder:
        """Open an existing folder to read its policy. A folder with only policy.json and policy.safetensors will do.

        Raises what `open` raises.
        """
        if not (path / POLICY_JSON).is_file():
            return RunFolder.open(path)
        if (path / RUN_FILE).exists():
            check_format(path)
        return RunFolder(path)

    def stay(self) -> None:
        """Make the path absolute, because the program, or an environment in it, may change the working directory."""
        self._is_relative = not self.path.is_absolute()
        self.path = self.path.absolute()
        self._made = None if self._made is None else self._made.absolute()

    @property
    def shown(self) -> Path:
        """The path to show to the user: relative if a relative path was given and still leads to the folder."""
        try:
            here = Path.cwd()
        except OSError:  # raised if the working directory was deleted
            return self.path
        return self.path.relative_to(here) if self._is_relative and self.path.is_relative_to(here) else self.path

    def remove(self) -> None:
        """Remove the folder, and the parent folders that were made for it if they are empty.

        Does nothing if the folder existed before, or once `keep` was called.
        """
        if self._made is None:
            return
        shutil.rmtree(self.path, ignore_errors=True)
        for parent in self.path.parents:
            if not parent.is_relative_to(self._made):
                break
            with suppress(OSError):  # raised if another run has a folder there, or has removed this one
                parent.rmdir()

    def remove_temporary(self) -> None:
        """Remove incomplete files that a killed process has left behind."""
        for left in self.path.glob(f"*{TEMPORARY}"):
            with suppress(OSError):
                left.unlink()

    def remove_summary(self) -> None:
        """Remove the summary, because a run that had ended now continues. Raises `RunError` if that fails."""
        path = self.path / SUMMARY_FILE
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise RunError(f"{path} cannot be removed: {reason(error)}; remove it, then resume the run") from error

    def keep(self) -> None:
        """Record that the run has begun, so that `remove` does nothing from now on."""
        self._made = None

    def is_gone(self) -> bool:
        """Whether the folder or its config.toml was deleted or renamed. Raises `RunError` if it can't be read."""
        try:
            return not stat.S_ISREG((self.path / CONFIG_FILE).stat().st_mode)
        except (FileNotFoundError, NotADirectoryError):
            return True
        except OSError as error:
            raise RunError(f"run folder {self.path} cannot be read: {error.strerror}") from error

    def make_again(self, config: RunSettings) -> str:
        """Recreate the folder or its config.toml. Returns one line that says so. Raises `RunError` if that fails."""
        line = f"{self.path / 'config.toml'} was deleted; it is written again"
        if not self.path.is_dir():
            line = f"run folder {self.path} was deleted or renamed; the run continues there in a new folder"
            try:
                self.path.mkdir(parents=True)
            except OSError as error:
                raise RunError(f"run folder {self.path} is gone, and cannot be made again: {error.strerror}") from error
        self.write_config(config, workers_elsewhere=self._workers_elsewhere)
        return line

    def confirm_lock(self) -> None:
        """Read the run's lock, if this process has one. Raises `RunTakenOver` if another process trains this run now."""
        if self.lock is not None:
            self.lock.confirm()

    def write_config(self, config: RunSettings, *, workers_elsewhere: bool = False) -> None:
        """Write config.toml and run.json, at the start and again when a run is resumed, perhaps with other settings."""
        self._workers_elsewhere = workers_elsewhere
        write_format(
            self.path, workers_elsewhere=workers_elsewhere, started_from=self.started_from, callbacks=self.callbacks
        )
        self._write(CONFIG_FILE, f"{HEAD}{config.to_toml()}{END}".encode("utf-8", "surrogateescape"))

    def write_policy(self, run: RunSpec, parameters: Floats, buffers: Floats, which: Which = "final") -> None:
        """Write the arrays and policy.json. For `parameters` and `buffers`, see `encode_arrays`."""
        self._write(POLICY_ARRAYS[which], encode_arrays(run.policy, parameters, buffers))
        self._write(POLICY_JSON, encode_description(run))

    def read_policy(self, which: Which = "final") -> StoredPolicy:
        """Read policy.json and the arrays.

        Raises `UsageError`, with a one-line message, if they cannot be read.
        """
        if not (self.path / POLICY_JSON).is_file():
            raise UsageError(f"run {self.path}: expected a {POLICY_JSON}, got none; has the run saved its policy yet?")
        if which == "best" and not (self.path / POLICY_ARRAYS[which]).is_file():
            expected = f"expected the best policy, {POLICY_ARRAYS[which]}, got none"
            raise UsageError(f"run {self.path}: {expected}; only a run with eval_every has one: take the final policy")
        try:
            description = decode_description(read(self.path / POLICY_JSON))
            arrays = decode_arrays(read(self.path / POLICY_ARRAYS[which], MOST_BYTES), POLICY_ARRAYS[which])
        except UNREADABLE as error:
            raise UsageError(f"policy of run {self.path} cannot be read: {one_line(reason(error))}") from error
        if (encoder := description.policy.encoder) is not None:
            refuse_modules_in(self.path, [encoder.factory])
        try:
            return stored_policy(description, arrays)
        except UsageError as error:
            raise UsageError(f"policy of run {self.path}: {error}") from error

    def policy_description(self) -> PolicyDescription | None:
        """The content of policy.json; None if that file is missing or cannot be read."""
        try:
            return decode_description(read(self.path / POLICY_JSON))
        except UNREADABLE:
            return None

    def write_summary(self, summary: Summary) -> None:
        """Write summary.json."""
        self._write(SUMMARY_FILE, msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")

    def summary(self) -> Summary | None:
        """Read summary.json. Returns None if it is missing or damaged; logs a warning if it is damaged."""
        try:
            return read_summary(self.path)
        except FileNotFoundError:
            return None
        except UNREADABLE as error:
            log.warning(
                "%s cannot be read: %s; the run counts as not finished", self.path / SUMMARY_FILE, one_line(reason(error))
            )
            return None

    def write_images(self, files: Mapping[str, bytes]) -> None:
        """Write pictures into the folder. `files` has the content of each picture, by file name."""
        for name, content in files.items():
            self._write(name, content)

    def _write(self, name: str, content: bytes) -> None:
        write_file(self.path / name, lambda file: file.write(content))


def as_folder_name(env: str) -> str:
    """The name of an environment or an algorithm as part of a folder's name."""
    return re.sub(r"[^A-Za-z0-9._]+", "-", env.removeprefix("__main__:")).strip("-.") or "env"
