"""A run is a folder, and the folder is everything: what stands in it, and where.

    runs/<env>-<algo>-s<seed>-<time>/
      config.toml           the resolved configuration
      run.json              the format of the folder (run_format.py)
      metrics.jsonl         a row per update                       } metrics_log.py
      tensorboard/                                                 }
      checkpoints/          checkpoint.py
      policy.safetensors    the arrays that act, by name           } all that another program needs to act,
      best.safetensors      those of the best evaluation           }
      policy.json           what they mean                         } the same bytes for the same policy
      summary.json          how the run went

The law: a file here is whole or not there. Nothing is pickled.
"""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path
from typing import Any, Literal, Protocol

import msgspec
import numpy as np

from learner.run_folder.atomic_write import write_atomically
from learner.run_folder.results import Summary
from learner.run_folder.run_format import RUN_FILE, check_format, write_format
from protocol.arrays import Floats
from protocol.env_spec import EnvSpec, Scalar
from protocol.errors import RunError, UsageError
from protocol.policy.layout import Field, buffer_layout, named_views, parameter_layout, total_size
from protocol.specs import PolicySpec

POLICY_FORMAT = 1
Which = Literal["final", "best"]
POLICY_ARRAYS = {"final": "policy.safetensors", "best": "best.safetensors"}
POLICY_CARD = "policy.json"


class Interrupted(KeyboardInterrupt):
    """The user stopped the run; it was drained and checkpointed, and can be resumed from its folder."""

    def __init__(self, run: Path) -> None:
        super().__init__(str(run))
        self.run = run


class ArrayCard(msgspec.Struct, frozen=True):
    """Where one array of the policy stands in the flat buffer of parameters, counted in float32s."""

    name: str
    shape: tuple[int, ...]
    offset: int


class PolicyCard(msgspec.Struct, frozen=True, kw_only=True):
    """policy.json: what the arrays of policy.safetensors mean."""

    format: int
    env: str
    env_kwargs: dict[str, Scalar]
    policy: PolicySpec
    arrays: tuple[ArrayCard, ...]
    buffers: tuple[str, ...]
    """arrays that are not parameters: the mean and standard deviation that observations are normalised with"""


class RunSettings(Protocol):
    """What a run folder needs of the settings of its run: `Config` has it."""

    @property
    def env(self) -> str:
        """Environment id."""
        ...

    @property
    def algo(self) -> str:
        """Name of the algorithm."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the run."""
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
        """`made`: the topmost folder that was made for it, if it is new."""
        self.path, self._made = path, made

    @staticmethod
    def create(config: RunSettings, started_s: float | None = None) -> RunFolder:
        """A new folder with its config.toml. Raises `UsageError` if it exists. `started_s` is wall-clock time."""
        stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(started_s))
        path = Path(config.run_dir) / f"{sanitised(config.env)}-{config.algo}-s{config.seed}-{stamp}"
        made = [folder for folder in (path, *path.parents) if not folder.exists()]
        try:
            path.mkdir(parents=True)
        except FileExistsError as error:
            raise UsageError(f"run folder {path} exists; wait a second, or choose another --run-dir or --seed") from error
        except OSError as error:
            raise UsageError(f"run folder {path} cannot be made: {error.strerror}; choose another --run-dir") from error
        folder = RunFolder(path, made[-1])
        folder.write_config(config)
        return folder

    @staticmethod
    def open(path: Path) -> RunFolder:
        """A folder that is there. Raises `UsageError` if it is not one of ours."""
        if not path.is_dir():
            raise UsageError(f"run {path}: no such folder")
        check_format(path)
        if not (path / "config.toml").is_file():
            raise UsageError(f"run {path}: expected a run folder, got one without config.toml")
        return RunFolder(path)

    def remove(self) -> None:
        """Remove the folder, and the parent folders made for it. Does nothing if it was there before, or after `keep`."""
        if self._made is not None:
            shutil.rmtree(self._made, ignore_errors=True)

    def keep(self) -> None:
        """The run has begun: `remove` does nothing from now on."""
        self._made = None

    def write_config(self, config: RunSettings) -> None:
        """Write config.toml and run.json: at the start, and again when a run is resumed, perhaps with other settings."""
        try:
            write_format(self.path)
        except OSError as error:
            raise RunError(f"{self.path / RUN_FILE} not written: {error.strerror}") from error
        self._write("config.toml", f"# Repeat this run: millrace train --config THIS_FILE\n{config.to_toml()}".encode())

    def write_policy(
        self, spec: PolicySpec, env: EnvSpec, parameters: Floats, buffers: Floats, which: Which = "final"
    ) -> None:
        """The arrays and policy.json. `parameters` starts with the acting part; the critic's is left out."""
        from safetensors.numpy import save

        acting, _ = parameter_layout(spec)
        arrays = named_views(parameters[: total_size(acting)], acting) | named_views(buffers, buffer_layout(spec))
        card = PolicyCard(
            format=POLICY_FORMAT,
            env=env.id,
            env_kwargs=env.kwargs,
            policy=spec,
            arrays=_array_cards(acting),
            buffers=tuple(named_views(buffers, buffer_layout(spec))),
        )
        self._write(POLICY_ARRAYS[which], save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))
        self._write(POLICY_CARD, msgspec.json.format(msgspec.json.encode(card), indent=2) + b"\n")

    def read_policy(self, which: Which = "final") -> tuple[PolicyCard, Floats, Floats]:
        """The card, and the parameters and buffers as `Policy.load` takes them. Raises `UsageError` in one line."""
        from safetensors import SafetensorError
        from safetensors.numpy import load

        if not (self.path / POLICY_CARD).is_file():
            raise UsageError(f"run {self.path}: expected a {POLICY_CARD}, got none; has the run saved its policy yet?")
        try:
            card = _read_card((self.path / POLICY_CARD).read_bytes())
            arrays = load((self.path / POLICY_ARRAYS[which]).read_bytes())
        except (OSError, msgspec.MsgspecError, SafetensorError) as error:
            raise UsageError(f"policy of run {self.path} cannot be read: {error}") from error
        if card.format != POLICY_FORMAT:
            raise UsageError(f"policy of run {self.path}: expected format {POLICY_FORMAT}, got {card.format}")
        acting, _ = parameter_layout(card.policy)
        wanted = {field.name: field.shape for field in acting}
        wanted |= {field.name: field.shape for field in buffer_layout(card.policy)}
        for name in sorted(arrays.keys() | wanted.keys()):
            shape = arrays[name].shape if name in arrays else "nothing"
            if name not in wanted or shape != wanted[name] or arrays[name].dtype != np.float32:
                expected = f"float32 {wanted[name]}" if name in wanted else "no such array"
                raise UsageError(f"policy of run {self.path}: {name} expected {expected}, got {shape}")
        parameters = _flat([arrays[field.name] for field in acting])
        return card, parameters, _flat([arrays[name] for name in card.buffers])

    def write_summary(self, summary: Summary) -> None:
        """summary.json."""
        self._write("summary.json", msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n")

    def summary(self) -> Summary | None:
        """What `write_summary` wrote, or None if there is nothing whole."""
        try:
            return msgspec.json.decode((self.path / "summary.json").read_bytes(), type=Summary)
        except (OSError, msgspec.MsgspecError):
            return None

    def _write(self, name: str, content: bytes) -> None:
        try:
            write_atomically(self.path / name, lambda file: file.write(content))
        except OSError as error:
            raise RunError(f"{self.path / name} not written: {error.strerror}") from error


def _read_card(text: bytes) -> PolicyCard:
    """JSON has no infinities: a bound that is not there is null."""
    plain = msgspec.json.decode(text, type=dict[str, Any])
    match plain:
        case {"policy": {"action": {"low": list(low), "high": list(high)} as action}}:
            action["low"] = [-np.inf if bound is None else bound for bound in low]
            action["high"] = [np.inf if bound is None else bound for bound in high]
    return msgspec.convert(plain, PolicyCard)


def sanitised(env: str) -> str:
    """An environment's name as part of a folder's name."""
    return re.sub(r"[^A-Za-z0-9._]+", "-", env).strip("-.") or "env"


def _array_cards(fields: tuple[Field, ...]) -> tuple[ArrayCard, ...]:
    starts = [total_size(fields[:i]) for i in range(len(fields))]
    return tuple(ArrayCard(field.name, field.shape, start) for field, start in zip(fields, starts, strict=True))


def _flat(arrays: list[Floats]) -> Floats:
    return np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0, np.float32)
