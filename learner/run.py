"""Makes a learner of its parts: link, coordinator, hub, service, algorithm, recorder.

This takes two steps. `set_up` does what needs no PyTorch: it reads the environment's spaces and makes the run folder. Then a
launcher starts its worker processes; they start up while `Run` imports PyTorch. This file does not know who the workers are.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import zmq

from learner.config.config import Config
from learner.env_spaces import EnvSpaces, env_spaces
from learner.interrupts import Interrupts
from learner.members.endpoint import join_lines, keyring_for
from learner.members.process_callbacks import ProcessCallbacks
from learner.rollouts.hub import Hub, HubObserver, HubSettings
from learner.rollouts.ticket_coordinator import TicketCoordinator
from learner.run_folder.progress import Progress
from learner.run_folder.run_folder import Interrupted, RunFolder
from learner.service import RolloutService
from protocol.env_spec import EnvSpec
from protocol.errors import UsageError
from protocol.wire.learner_link import LearnerLink

log = logging.getLogger("millrace.learner")

Watch = Callable[[Progress], None]
"""Called with the progress of the run after each update."""


@dataclass(frozen=True)
class RunSetup:
    """The parts of a run that exist before the workers start."""

    config: Config
    env: EnvSpec
    spaces: EnvSpaces
    folder: RunFolder
    resumed: bool


@contextmanager
def set_up(config: Config, env: EnvSpec, resume: Path | None) -> Iterator[RunSetup]:
    """Read the environment's spaces and make the run folder, or open the folder of the run to `resume`.

    A new folder is removed again if no `Run` can be made of it. Raises `UsageError`.
    """
    spaces = env_spaces(env)
    folder = RunFolder.create(config) if resume is None else RunFolder.open(resume)
    try:
        yield RunSetup(config, env, spaces, folder, resume is not None)
    except BaseException:
        folder.remove()
        raise


class Run:
    """A learner that listens to workers and has not begun to train."""

    def __init__(
        self,
        setup: RunSetup,
        link: LearnerLink,
        processes: ProcessCallbacks,
        watch: Watch,
        observer: HubObserver,
    ) -> None:
        """`watch` is called after each update, `observer` each time the hub has listened. Raises `MillraceError`.

        `processes` are the worker processes that this program started.
        """
        import torch

        from learner.algorithms import algorithm_class
        from learner.run_recorder import RunRecorder
        from learner.run_spec import run_spec
        from learner.run_state import RunState, restore
        from learner.torch_setup import threads, torch_device

        config, self.folder = setup.config, setup.folder
        spec = run_spec(config, setup.env, setup.spaces)
        torch.set_num_threads(threads(config, spec.policy, processes.expected))
        self.algorithm = algorithm_class(config.algo)(
            config.algorithm, spec.policy, total_steps=config.steps, seed=config.seed, device=torch_device(config)
        )
        state = RunState()
        if setup.resumed:
            state = restore(self.folder, self.algorithm)
            self.folder.write_config(config)
        coordinator = TicketCoordinator(
            spec,
            rollouts_per_update=config.lanes,
            max_lag=config.max_lag,
            worker_timeout_s=config.worker_timeout_s,
            first_session=int.from_bytes(os.urandom(6), "little"),
            ledger=state.ledger,
            incarnations=state.incarnations,
        )
        settings = HubSettings(
            config.no_workers_timeout_s, config.stall_timeout_s, config.max_env_failures, config.weights_dtype
        )
        self._interrupts = Interrupts()
        hub = Hub(link, coordinator, settings, processes, self._check_interrupt, observer)
        self.service = RolloutService(hub, spec, processes.expected)
        self.recorder = RunRecorder(config, self.folder, spec, self.algorithm, self.service, state, watch)
        self.folder.keep()

    def train(self, workers: int) -> None:
        """Wait for this number of `workers`, then train to the end.

        Raises `Interrupted` if the user interrupts the run, and `MillraceError`, with a one-line message, if it fails.
        """
        from learner.train import train

        try:
            with self._interrupts:
                train(self.algorithm, self.service, self.recorder, workers)
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
            self.service.drain(reason, timeout_s=2.0)
            self.recorder.finish(reason)
            raise
        finally:
            self.recorder.close()

    def _check_interrupt(self) -> None:
        if self._interrupts.received:
            raise Interrupted(self.folder.path)


def serve(config: Config, resume: Path | None, watch: Watch) -> Path:
    """Train with workers that are started elsewhere and join at `config.bind`. Returns the run folder."""
    if config.inference == "learner":
        raise UsageError("--inference learner does not work with python -m learner; use millrace learner")
    keyring = keyring_for(config, datetime.now(UTC).replace(microsecond=0))
    with ExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(config.bind, context, keyring)
        stack.callback(link.close)
        observer = stack.enter_context(prometheus_observer(config))
        setup = stack.enter_context(set_up(config, EnvSpec.of(config.env, config.env_kwargs), resume))
        run = Run(setup, link, ProcessCallbacks(), watch, observer)
        for line in join_lines(link.address, config.advertise, keyring):
            log.warning("%s", line)
        run.train(config.min_workers or 1)
        return run.folder.path


def prometheus_observer(config: Config) -> AbstractContextManager[HubObserver]:
    """Serves metrics at `config.metrics_bind` while it is entered; without an address it imports no HTTP server."""
    if not config.metrics_bind:
        return nullcontext(lambda hub: None)
    from learner.prometheus import metrics_server

    return metrics_server(config)
