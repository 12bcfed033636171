"""The file that `RolloutService.save` writes: the service's state and the user's own arrays in one .npz."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from millrace.learner.rollouts.ledger import Past
from millrace.learner.rollouts.past_rollouts import PastRollouts, packed, unpacked
from millrace.learner.run_folder.atomic_write import write_file
from millrace.learner.run_folder.regular_files import open_regular, reason
from millrace.protocol.arrays import Array, Bytes
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import CheckpointError, UsageError
from millrace.protocol.specs import PolicySpec

OURS = "millrace"  # name of the entry with the state, packed as bytes; the user's arrays must have other names
OF_NUMPY = ("file", "allow_pickle")  # parameters of numpy.savez, so the user's arrays can't have these names
FORMAT = 2


class ServiceState(msgspec.Struct, frozen=True, kw_only=True):
    """The state from which a restored service continues."""

    env: str
    """id or name of the environment"""
    policy: str
    """digest of the policy's specification"""
    version: Past
    """the version that a restored service publishes first"""
    env_steps: Past
    rollouts: PastRollouts
    normalizer: dict[str, Any] | None = None
    """the state of the normalizer, as plain data; None if it was not used"""
    format: int = FORMAT


class _OfAnyFormat(msgspec.Struct):
    """The only part of a state that each format has."""

    format: int


def digest(policy: PolicySpec) -> str:
    """A hash of the policy's specification, as 32 hexadecimal digits.

    For a user-defined policy, it covers the name and the declared arrays, but not the code.
    """
    if policy.own is not None:
        policy = msgspec.structs.replace(policy, own=msgspec.structs.replace(policy.own, code=None))
    return hashlib.sha256(msgspec.msgpack.encode(policy)).hexdigest()[:32]


def write(path: Path, state: ServiceState, arrays: Mapping[str, Any]) -> None:
    """Write the state and the user's arrays, atomically.

    Raises `UsageError` for unsupported arrays, and `RunError` if the file can't be written.
    """
    kept = {}
    for name, value in arrays.items():
        array = np.asarray(value)
        if name == OURS or name in OF_NUMPY or array.dtype.hasobject:
            taken = ", ".join((OURS, *OF_NUMPY))
            raise UsageError(f"save: {name}: expected an array of numbers, not called {taken}; got {array.dtype}")
        kept[name] = array
    ours = packed(state)
    write_file(path, lambda file: np.savez(file, **{OURS: ours}, **kept))  # type: ignore[arg-type]


def read(path: Path) -> tuple[ServiceState, dict[str, Array]]:
    """Read the state, and the user's arrays by name. The ledger of the state has no outstanding tickets.

    Raises `CheckpointError` if the file is missing, damaged or of another format.
    """
    try:
        descriptor = open_regular(path.resolve())
        # The file is opened here, because numpy wouldn't close a damaged one.
        with os.fdopen(descriptor, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in file.zip.infolist()):
                raise ValueError("it is compressed, which millrace never does")  # a few of its bytes could fill the memory
            arrays = {name: file[name] for name in file.files}
        ours = arrays.pop(OURS)
        if (got := _format(ours)) != FORMAT:
            raise CheckpointError(f"{path}: expected format {FORMAT}, got {got}; use the millrace that wrote it")
        state = unpacked(ServiceState, ours)
        state.rollouts.ledger.end_outstanding()
    except CheckpointError:
        raise
    except Exception as error:  # zipfile, numpy and msgspec raise a dozen exception types for damaged files
        raise unreadable(path, error) from error
    return state, arrays


def _format(ours: Bytes) -> int:
    """The format of a packed state. Format 1 was JSON."""
    if ours.tobytes().startswith(b"{"):
        return msgspec.json.decode(ours.tobytes(), type=_OfAnyFormat).format
    return unpacked(_OfAnyFormat, ours).format


def unreadable(path: Path | str, error: Exception) -> CheckpointError:
    """The error for a file that `RolloutService.save` did not write."""
    why = one_line(reason(error))
    return CheckpointError(
        f"{path}: expected a file that RolloutService.save wrote, cannot read it: {why}; restore an older one"
    )
