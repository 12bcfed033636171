"""An actor-critic whose updates are divided among learner processes. Its state is identical in all of them, bit for bit.

Law of an update: rank 0 sends the batch to the others. Every process passes its own shards through the network, one shard at
a time, and gathers the numbers and the gradients of all shards. From then on, all processes do the same computations. The
gradient is that of a mean over a minibatch's rows, so the loss must be a mean over the rows that it receives.

If something other than an update changes rank 0's state (a resume, `--from`, cloning, or the undoing of an update), rank 0
sends the whole state along with the next batch.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from millrace.learner.algorithms import Algorithm, algorithm_class
from millrace.learner.algorithms.actor_critic import ActorCritic, Estimates
from millrace.learner.algorithms.algorithm import Start
from millrace.learner.algorithms.gradient_descent import ADVICE, UpdateMetrics, check_finite
from millrace.learner.algorithms.minibatches import Minibatch, Observations, UpdateRows, WholeBatch
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import WITHOUT_REPLAY
from millrace.learner.shards.division import narrowed, pairwise_sum, part_of, widened
from millrace.learner.shards.learners import Learners
from millrace.learner.shards.messages import Learn
from millrace.learner.shards.reports import Report, averaged
from millrace.learner.shards.rows import ShardObservations, ShardRows
from millrace.protocol.arrays import Bytes, Floats
from millrace.protocol.errors import RunError, UsageError, first_line
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

COMPARE_EVERY = 50  # number of updates after which all processes compare their states


class Sharded(ActorCritic):
    """The base class of algorithms with shards. `sharded` derives a class from this one and from the algorithm."""

    learners: Learners
    """set before the first update"""

    _others_know_state = False
    _stopped: BaseException | None = None
    """the exception that `pulse` raised in this update"""
    _failed: Exception | None = None
    """the exception that this process raised in the current minibatch"""

    # ---------------------------------------------------------------- how the processes do the same update

    def update(self, batch: Batch, pulse: Callable[[], None]) -> UpdateMetrics:
        """See `ActorCritic`. If `pulse` raises, all processes stop the update at its next gradient step, or at its end."""
        self._stopped = None
        self.learners.others_wait = False
        if self.learners.leads:
            self._tell(batch)

        def noted() -> None:
            try:
                pulse()
            except BaseException as error:
                self._stopped = self._stopped or error

        metrics = super().update(batch, noted)
        self.learners.others_wait = True
        if self._stopped is not None:
            raise self._stopped
        return metrics

    def _tell(self, batch: Batch) -> None:
        state = None if self._others_know_state else _packed(self.state_dict())
        compares = state is None and self.version % COMPARE_EVERY == 0
        digest = self.digest() if compares and self.learners.others else ""
        for rank in self.learners.others:
            columns = self.learners.division.columns_of_process(batch.lane, rank)
            self.learners.tell(rank, Learn(narrowed(batch, columns), self.statistics, state, digest))
        self._others_know_state = True

    def follow(self, learn: Learn) -> None:
        """Do the same update that rank 0 is doing now, from rank 0's message."""
        division = self.learners.division
        if learn.state is not None:
            self.load_state_dict(_unpacked(learn.state))
        elif learn.digest and learn.digest != self.digest():
            self._failed = RunError(
                f"learner: rank {division.rank}: its state differs from that of rank 0 after update {self.version}; use "
                "machines with the same processors and the same packages, and a loss that changes nothing"
            )
        self.statistics = learn.statistics
        columns = division.columns_of_process(learn.batch.lane, division.rank)
        self.update(widened(learn.batch, columns), lambda: None)

    def digest(self) -> str:
        """SHA-256 of the state without the observation statistics, which only rank 0 maintains."""
        found = hashlib.sha256()
        for content in _contents({**self.state_dict(), "observations": None}):
            found.update(content)
        return found.hexdigest()

    # ---------------------------------------------------------------- an update

    def rows(self, batch: Batch) -> UpdateRows:
        """See `ActorCritic`."""
        division = self.learners.division
        columns = division.columns(batch.lane)
        parts = [part_of(batch, columns[shard]) for shard in division.own]
        observed = [WholeBatch(part, self.observations(part)) for part in parts]
        observations = ShardObservations(batch, columns, division.own, observed, self.learners.gather)
        return ShardRows(observations, self.standardizes_advantages())

    def estimate(self, batch: Batch, observations: Observations, reward: Floats, pulse: Callable[[], None]) -> Estimates:
        """See `ActorCritic`. The batch is passed without observations and episodes, because only rank 0 has all of them."""
        return super().estimate(replace(batch, obs=(), episodes=()), observations, reward, pulse)

    def gradient(self, minibatch: Sequence[Minibatch]) -> UpdateMetrics:
        """See `ActorCritic`. Adds the gradients of all shards, each weighted by its number of rows, in a fixed order."""
        flat = self.net.flat
        assert flat.grad is not None
        own = torch.zeros(len(minibatch), len(flat), device=flat.device)
        reports = [self._learned_from(part, gradient) for part, gradient in zip(minibatch, own, strict=True)]
        reports = self._reports(reports)
        rows = sum(report.rows for report in reports)
        flat.grad.copy_(pairwise_sum(list(self.learners.gather(own))) / rows)
        metrics = averaged(reports) | {"grad_norm": flat.grad.norm().item()}
        check_finite(metrics, self.version, ADVICE)
        return metrics

    def _learned_from(self, rows: Minibatch, gradient: Tensor) -> Report:
        """Write a shard's gradient, times its number of rows, to `gradient`. If this fails, `_reports` raises the error."""
        count = len(rows.action)
        if not count or self._failed is not None:
            return Report(0)
        try:
            loss, numbers = self.checked_loss(rows)
            metrics = self.differentiate(loss * count, self.optimizers["optimizer"], {**numbers, "loss": loss})
            assert self.net.flat.grad is not None
            gradient.copy_(self.net.flat.grad)
            del metrics["grad_norm"]  # the gradient norm of one part says nothing about the whole minibatch
            return Report(count, metrics)
        except Exception as error:
            self._failed = error
            return Report(0)

    def _reports(self, own: list[Report]) -> list[Report]:
        """The reports of all shards. Raises this process's own exception, or `RunError` if another process failed."""
        try:
            encoded = [each.encoded() for each in own]
        except Exception as error:
            self._failed = error
        wrong = self._failed or self._stopped
        if wrong is not None:
            who = f"learner: rank {self.learners.division.rank}: "
            text = first_line(wrong, type(wrong).__name__).removeprefix(who).removeprefix("learner: ")
            encoded = [Report(0, error=who + text).encoded()] * len(own)
        padded = self.learners.gather(torch.stack(encoded))
        if wrong is not None:
            raise wrong
        reports = [Report.of(each) for each in padded]
        if errors := [report.error for report in reports if report.error]:
            raise RunError(errors[0])
        return reports

    # ---------------------------------------------------------------- the state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Algorithm`."""
        self._others_know_state = False
        super().load_state_dict(state)

    def start_from(self, start: Start) -> None:
        """See `Algorithm`."""
        self._others_know_state = False
        super().start_from(start)


@cache
def sharded(algorithm: type[Algorithm], shards: int) -> type[Sharded]:
    """Make the class of an algorithm with shards. Raises `UsageError` if it can't have shards."""
    if not issubclass(algorithm, ActorCritic):
        raise UsageError(
            f"shards {shards}: {algorithm.__name__} learns in one process; expected {', '.join(WITHOUT_REPLAY)} or a "
            "subclass of millrace.algorithms.ActorCritic"
        )
    for name in ("step", "gradient", "rows"):
        if getattr(algorithm, name) is not getattr(ActorCritic, name):
            raise UsageError(
                f"shards {shards}: {algorithm.__name__} defines {name}, which differs in a run with shards; define loss or "
                "estimate, or train it without shards"
            )
    return type(algorithm.__name__, (Sharded, algorithm), {"__module__": algorithm.__module__})


def new_sharded(config: Config, policy: PolicySpec, device: str, learners: Learners) -> Sharded:
    """Make the algorithm of these settings, with the weights of version 0. Raises `UsageError` if it can't have shards."""
    cls: Any = sharded(algorithm_class(config.algo), config.shards)
    algorithm: Sharded = cls(config.algorithm, policy, total_steps=config.steps, seed=config.seed, device=device)
    if algorithm.optimizers.keys() != {"optimizer"}:
        raise UsageError(
            f"shards {config.shards}: {type(algorithm).__name__}: expected one optimizer, because the processes share one "
            f"gradient, got {', '.join(algorithm.optimizers)}; train it without shards"
        )
    algorithm.learners = learners
    return algorithm


def _contents(state: object) -> Iterator[bytes]:
    """Yield the content of a state, which consists of tensors and plain data, in a fixed order."""
    match state:
        case dict():
            for name in sorted(state, key=str):
                yield repr(name).encode()
                yield from _contents(state[name])
        case list() | tuple():
            for each in state:
                yield from _contents(each)
        case Tensor():
            yield state.detach().cpu().contiguous().numpy().tobytes()
        case _:
            yield repr(state).encode()


def _packed(state: dict[str, Any]) -> Bytes:
    """Encode a state as bytes."""
    file = io.BytesIO()
    torch.save(state, file)
    return np.frombuffer(bytearray(file.getvalue()), np.uint8)


def _unpacked(content: Bytes) -> dict[str, Any]:
    """Read the state from these bytes, without executing any code in them."""
    state: dict[str, Any] = torch.load(io.BytesIO(content.tobytes()), map_location="cpu", weights_only=True)
    return state
