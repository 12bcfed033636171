"""The content of the files of a policy: policy.json, and the arrays that it describes. Pure.

Rule: the same policy gives the same bytes. Nothing is pickled, and reading imports no module that the files name.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from safetensors import SafetensorError
from safetensors.numpy import load, save

from millrace.learner.run_folder.run_format import POLICY_JSON
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.bounds import MAX_FACTS, Line, Name, Natural, one_line
from millrace.protocol.env_spec import Scalar
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.layout import Field, buffer_layout, named_views, parameter_layout, total_size
from millrace.protocol.policy.possible import why_impossible
from millrace.protocol.space_spec import MAX_SEATS
from millrace.protocol.specs import PolicySpec, RunSpec

POLICY_FORMAT = 3


class ArrayPosition(msgspec.Struct, frozen=True):
    """The position of one array in the flat parameters of the policy. `offset` counts float32 numbers."""

    name: str
    shape: tuple[int, ...]
    offset: int


class PolicyDescription(msgspec.Struct, frozen=True, kw_only=True):
    """policy.json: the meaning of the arrays in policy.safetensors."""

    format: int
    env: Line
    env_kwargs: dict[str, Scalar]
    policy: PolicySpec
    arrays: tuple[ArrayPosition, ...]
    buffers: tuple[str, ...]
    """the names of the arrays that are not parameters: mean and standard deviation for observation normalization"""
    wrappers: tuple[Line, ...] = ()
    """the wrappers of every env copy, the innermost first"""
    info_keys: Annotated[tuple[Name, ...], Meta(max_length=MAX_FACTS)] = ()
    """names of numbers that the environment reports in `info` when an episode ends"""
    masked: bool = False
    """whether the environment says which actions are allowed"""
    eval_env_kwargs: dict[str, Scalar] = {}
    """keyword arguments of evaluation copies, in addition to `env_kwargs`; they override those of the same name"""
    seats: Annotated[tuple[Name, ...], Meta(max_length=MAX_SEATS)] = ()
    """the names of the environment's agents; empty for a gymnasium environment"""
    teams: Annotated[tuple[tuple[Natural, ...], ...], Meta(max_length=MAX_SEATS)] = ()
    """the seats of each team, if the policy was trained against opponents"""


class StoredPolicy(NamedTuple):
    """A policy read from its files. Reading imports no module that the files name; acting imports the encoder's module."""

    card: PolicyDescription
    parameters: Floats
    """the parameters [P] float32, for `Policy.load`"""
    buffers: Floats
    """the buffers, float32, for `Policy.load`"""


def encode_description(run: RunSpec) -> bytes:
    """The content of policy.json."""
    spec = run.policy
    env = run.env
    acting, _ = parameter_layout(spec)
    description = PolicyDescription(
        format=POLICY_FORMAT,
        env=env.id,
        env_kwargs=env.kwargs,
        policy=spec,
        arrays=_array_positions(acting),
        buffers=tuple(field.name for field in buffer_layout(spec)),
        wrappers=env.wrappers,
        info_keys=run.info_keys,
        masked=run.masked,
        eval_env_kwargs=env.eval_kwargs,
        seats=run.seats,
        teams=run.teams,
    )
    return msgspec.json.format(msgspec.json.encode(description), indent=2) + b"\n"


def encode_arrays(policy: PolicySpec, parameters: Floats, buffers: Floats) -> bytes:
    """The content of the file with the arrays.

    `parameters` [P] begins with the acting parameters; the rest, such as the critic's, is left out. The fields of `buffers`
    are those of `buffer_layout`.
    """
    acting, _ = parameter_layout(policy)
    arrays = named_views(parameters[: total_size(acting)], acting) | named_views(buffers, buffer_layout(policy))
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    checksum = str(zlib.crc32(_split(save(contiguous))[1]))
    return save(contiguous, metadata={"crc32": checksum})


def decode_description(text: bytes) -> PolicyDescription:
    """Decode policy.json. JSON has no infinity, so null stands for a missing bound. Raises one of `INVALID`."""
    fields = msgspec.json.decode(text, type=dict[str, Any])
    match fields:
        case {"policy": {"action": {"low": list(low), "high": list(high)} as action}}:
            action["low"] = [-np.inf if bound is None else bound for bound in low]
            action["high"] = [np.inf if bound is None else bound for bound in high]
    description = msgspec.convert(fields, PolicyDescription)
    if why := why_impossible(description.policy):
        raise ValueError(f"{POLICY_JSON}: {why}")
    return description


def decode_arrays(content: bytes, name: str) -> dict[str, Array]:
    """Decode the arrays, by name. Raises ValueError if that is impossible. `name` is the name of their file."""
    try:
        arrays: dict[str, Array] = load(content)
    except (SafetensorError, KeyError) as error:  # KeyError is raised for a dtype that numpy lacks
        raise ValueError(str(error)) from error
    if not _checksum_matches(content):
        raise ValueError(f"{name}: its checksum does not match")
    return arrays


def stored_policy(description: PolicyDescription, arrays: Mapping[str, Array]) -> StoredPolicy:
    """The policy in these arrays.

    Raises `UsageError` if the description has another format, or if the arrays don't match it.
    """
    if description.format != POLICY_FORMAT:
        raise UsageError(f"expected format {POLICY_FORMAT}, got {description.format}; install the millrace that wrote it")
    acting, _ = parameter_layout(description.policy)
    buffers = buffer_layout(description.policy)
    names = tuple(field.name for field in buffers)
    if description.buffers != names:
        raise UsageError(f"{POLICY_JSON}: buffers: expected {names}, got {one_line(repr(description.buffers))}")
    expected_shapes = {field.name: field.shape for field in (*acting, *buffers)}
    for name in sorted(arrays.keys() | expected_shapes.keys()):
        shape = arrays[name].shape if name in arrays else "nothing"
        if name not in expected_shapes or shape != expected_shapes[name] or arrays[name].dtype != np.float32:
            expected = f"float32 {expected_shapes[name]}" if name in expected_shapes else "no such array"
            raise UsageError(f"{name}: expected {expected}, got {shape}")
    parameters = _flat([arrays[field.name] for field in acting])
    return StoredPolicy(description, parameters, _flat([arrays[name] for name in names]))


def _split(content: bytes) -> tuple[bytes, bytes]:
    """Split a safetensors file into its head and its numbers."""
    begin = 8 + int.from_bytes(content[:8], "little")
    return content[8:begin], content[begin:]


def _checksum_matches(content: bytes) -> bool:
    """Whether the numbers of a safetensors file match its checksum. True for a file without a checksum."""
    head, numbers = _split(content)
    match msgspec.json.decode(head):
        case {"__metadata__": {"crc32": checksum}}:
            return bool(checksum == str(zlib.crc32(numbers)))
    return True


def _array_positions(fields: tuple[Field, ...]) -> tuple[ArrayPosition, ...]:
    starts = [total_size(fields[:i]) for i in range(len(fields))]
    return tuple(ArrayPosition(field.name, field.shape, start) for field, start in zip(fields, starts, strict=True))


def _flat(arrays: list[Floats]) -> Floats:
    return np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0, np.float32)
