"""`millrace launch ray`: the learner runs in this process, on a node of a Ray cluster, and workers run in Ray actors.

Rule: an actor runs nothing but the worker program. Ray alone restarts actors and chooses their nodes. Actors end with the
learner.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import ray

from millrace.extras.launchers.command_line import learner_flags
from millrace.extras.launchers.flags import RayFlags
from millrace.extras.launchers.ray_worker import WorkerHost
from millrace.launch.training import train
from millrace.learner.callbacks.callbacks import Watch
from millrace.learner.config.command_line import read_config
from millrace.learner.members.who_may_connect import keyring_for
from millrace.protocol.errors import UsageError, first_line, refusals_of
from millrace.protocol.keys.key_folder import Keyring
from millrace.protocol.keys.worker_token import read_token


def launch(flags: RayFlags, rest: Sequence[str], watch: Watch) -> Path:
    """Train a policy. Returns the run folder. Raises `UserFacingError` if that fails.

    `rest`: the user's flags for the learner.
    """
    for name in ("processes", "port"):
        if getattr(flags, name) < 1:
            raise UsageError(f"{name}: expected int >= 1, got {getattr(flags, name)}")
    with _ray_cluster(flags.address) as host:
        bind = f"tcp://{f'[{host}]' if ':' in host else host}:{flags.port}"
        workers = flags.workers * flags.processes
        config, resume = read_config("learner", learner_flags(flags.env, rest, workers, bind=bind, runs="runs"))
        if config.inference == "learner":
            raise UsageError("launch ray does not take --inference learner; use millrace learner")
        token = _token_text(keyring_for(config, datetime.now(UTC).replace(microsecond=0)))
        with refusals_of("ray"):
            actor = ray.remote(
                num_cpus=flags.processes, max_restarts=-1, max_task_retries=-1, scheduling_strategy="SPREAD"
            )(WorkerHost)  # fmt: skip
            actors = [actor.options(name=f"{flags.name}-{number}").remote() for number in range(flags.workers)]
            for each in actors:
                each.run.options(retry_exceptions=True).remote(config.bind, token, flags.processes)
        return train(config, resume, watch, elsewhere=True)


def _token_text(keyring: Keyring | None) -> str:
    """The key folder's first join token; empty if the learner needs no keys. Raises `UsageError` if there is none."""
    if keyring is None or keyring.folder is None:
        return ""
    files = [keyring.folder.token_path(name) for name in keyring.allowed.names()]
    token = next((read_token(str(file)) for file in files if file.is_file()), None)
    if token is None:
        raise UsageError(f"no token of an allowed client is in {keyring.folder.path}; `millrace keys new NAME` makes one")
    return token.to_text()


@contextmanager
def _ray_cluster(address: str) -> Iterator[str]:
    """A context manager that connects to the cluster, and yields the IP address by which other nodes reach this node."""
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
    except (ConnectionError, RuntimeError, ValueError) as error:
        says = first_line(error, type(error).__name__)
        raise UsageError(f"no Ray cluster at {address}: {says}; `ray start --head` starts one") from error
    try:
        here = ray.get_runtime_context().get_node_id()
        yield next(node["NodeManagerAddress"] for node in ray.nodes() if node["NodeID"] == here)
    finally:
        ray.shutdown()
