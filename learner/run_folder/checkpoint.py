"""Checkpoints of a run: `checkpoints/<env steps>.pt`. `CheckpointSchedule` says when to write one.

Rule: a checkpoint is written atomically; a resumed run uses the newest undamaged one; and reading one executes no code
(`weights_only`). A state therefore consists of tensors and plain data; a numpy generator is stored as its
`bit_generator.state`. torch's loader does not detect damaged data, so the checksums of the file (a zip archive) are verified
first. The file must contain every element of a tensor, because a tensor with a stride of 0 has only a few bytes in the file,
but could grow to any size when copied. The loader's calls are also checked in advance, because they could fill the memory
(`learner/rehearsed_pickle.py`). `archive_directory.py` ensures that the loader reads the same pickle that was checked. A
file that would not pass these checks is not written (`learner/written_state.py`).
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

from millrace.learner.run_folder.archive_directory import check_directory
from millrace.learner.run_folder.atomic_write import TEMPORARY, write_atomically
from millrace.learner.run_folder.regular_files import open_regular, reason, regular_files, subfolder
from millrace.learner.written_state import check_memory, check_pickles, write_state
from millrace.protocol.errors import CheckpointError

FORMAT = 2
FOLDER = "checkpoints"
SUFFIX = ".pt"
ZIP_BEGINS = b"PK\x03\x04"  # if a file begins with anything else, torch reads a pickle before the archive


class Checkpoint(NamedTuple):
    """The content of a checkpoint file."""

    path: Path
    env_steps: int
    state: dict[str, Any]


class CheckpointSchedule:
    """Says when a checkpoint is due: at intervals, and after the first update, so that even a young run can be resumed."""

    def __init__(self, every_s: float, now: float) -> None:
        self._every_s = every_s
        self._began_s = now

    def is_due(self, updates: int, now: float) -> bool:
        """Whether a checkpoint is due after this number of `updates`."""
        return updates == 1 or now - self._began_s >= self._every_s

    def saved(self, began_s: float) -> None:
        """Record that a checkpoint was attempted at this time. With -inf, the next one is due at once."""
        self._began_s = began_s


class _Unreadable(Exception):
    """The checkpoint file is damaged. An older one may be intact."""


def save(folder: Path, state: dict[str, Any], env_steps: int, keep: int) -> Path:
    """Write a checkpoint into the run folder.

    Keeps the newest `keep` checkpoints up to this one. Later ones also stay: a resumed run has skipped them, because they
    are damaged. Raises `CheckpointError` if the checkpoint cannot be written; older ones are then untouched. Raises
    `UsageError` if the state contains something that could not be read back.
    """
    path = folder / FOLDER / f"{env_steps:012d}{SUFFIX}"
    record = {"format": FORMAT, "env_steps": env_steps, "state": state}
    try:
        subfolder(folder, FOLDER)
        for left in regular_files(folder, f"{FOLDER}/*{TEMPORARY}"):  # left by a process that was killed
            left.unlink()
        write_atomically(path, lambda file: write_state(file, record, state, "checkpoint: state"))
        for old in [each for each in _files(folder) if each <= path][:-keep]:
            old.unlink()
    except OSError as error:
        raise CheckpointError(f"checkpoint {path} not written: {reason(error)}; older checkpoints are untouched") from error
    return path


def newest(folder: Path) -> tuple[Checkpoint, list[str]]:
    """Read the newest undamaged checkpoint of a run folder. Also returns a warning for each damaged one that is newer.

    Raises `CheckpointError` if there is none, or if the newest undamaged one has another format.
    """
    paths = _files(folder)[::-1]
    if not paths:
        raise CheckpointError(f"run {folder}: expected a checkpoint in {FOLDER}/, got none; start afresh without it")
    warnings: list[str] = []
    for path in paths:
        try:
            return _read(path), warnings
        except _Unreadable as error:
            warnings.append(f"checkpoint {path} is broken ({error}); trying the one before")
    raise CheckpointError(f"run {folder}: expected a whole checkpoint, got {len(paths)} broken; start afresh without it")


def has_any(folder: Path) -> bool:
    """Whether a folder has checkpoints, damaged or not."""
    return bool(_files(folder))


def newest_env_steps(folder: Path) -> int:
    """The env steps of the newest checkpoint, according to its name; 0 if there is none."""
    return max((int(path.stem) for path in _files(folder) if path.stem.isascii() and path.stem.isdecimal()), default=0)


def _files(folder: Path) -> list[Path]:
    """The checkpoint files of a run folder, the oldest first."""
    return regular_files(folder, f"{FOLDER}/*{SUFFIX}")


def load(path: Path) -> Checkpoint:
    """Read one checkpoint file. Raises `CheckpointError`, with a one-line message, if it is broken."""
    try:
        return _read(path)
    except _Unreadable as error:
        raise CheckpointError(f"checkpoint {path}: expected a whole file, got one that is broken ({error})") from error


def _read(path: Path) -> Checkpoint:
    import torch

    try:
        with os.fdopen(open_regular(path), "rb") as file:
            if file.read(len(ZIP_BEGINS)) != ZIP_BEGINS:
                raise _Unreadable("it isn't an archive that torch.save wrote")
            check_directory(file)
            with zipfile.ZipFile(file) as archive:
                if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                    raise _Unreadable("it is compressed, which torch never does")  # decompressing it could fill the memory
                if (damaged := archive.testzip()) is not None:
                    raise _Unreadable(f"checksum of {damaged} does not match")
                check_pickles(archive)
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            record = torch.load(file, map_location="cpu", weights_only=True)
        check_memory(record, size)
    except _Unreadable:
        raise
    except Exception as error:  # zipfile and torch raise a dozen types for damaged files
        raise _Unreadable(reason(error)) from error
    if not isinstance(record, dict) or not isinstance(record.get("format"), int):
        raise CheckpointError(f"checkpoint {path}: expected one of millrace, got another program's file")
    if record["format"] != FORMAT:
        raise CheckpointError(
            f"checkpoint {path}: expected format {FORMAT}, got {record['format']}; use the millrace that wrote it"
        )
    match record:
        case {"env_steps": int(env_steps), "state": dict(state)}:
            return Checkpoint(path, env_steps, state)
        case _:
            raise _Unreadable("it has no state")
