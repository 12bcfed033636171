"""`millrace launch ray`: the learner here, on a node of a Ray cluster; each worker host an actor.

The law: what an actor runs is the worker program. Ray's own restarts and retries are all that brings it back, and Ray's
resources all that says where; when the learner has ended, the actors have too.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import ray

from learner.config.command_line import read_config
from learner.members.endpoint import keyring_for
from learner.run import Watch, serve
from millrace.cli.flags import RayFlags
from millrace.launch.cluster_flags import learner_flags
from millrace.launch.ray_actor import WorkerHost
from protocol.errors import UsageError, first_line
from protocol.keys.key_folder import Keyring, read_token


def launch(flags: RayFlags, rest: Sequence[str], watch: Watch) -> Path:
    """Train; the run folder. `rest` are the learner's own flags. Raises `OurError`."""
    for name in ("processes", "port"):
        if getattr(flags, name) < 1:
            raise UsageError(f"{name} expected int >= 1, got {getattr(flags, name)}")
    with _cluster(flags.address) as host:
        bind = f"tcp://{f'[{host}]' if ':' in host else host}:{flags.port}"
        config, resume = read_config("learner", learner_flags(flags.env, rest, bind, "runs"))
        token = _token(keyring_for(config, datetime.now(UTC).replace(microsecond=0)))
        actor = ray.remote(
            num_cpus=flags.processes, max_restarts=-1, max_task_retries=-1, scheduling_strategy="SPREAD"
        )(WorkerHost)  # fmt: skip
        actors = [actor.options(name=f"{flags.name}-{number}").remote() for number in range(flags.workers)]
        for each in actors:
            run = each.run.options(retry_exceptions=True)
            run.remote(config.bind, token, flags.processes)
        return serve(config, resume, watch)


def _token(keyring: Keyring | None) -> str:
    """What lets the actors in: the text of the first token that is in the key folder; empty where nobody needs one."""
    if keyring is None or keyring.folder is None:
        return ""
    files = [keyring.folder.token_path(name) for name in keyring.allowed.names()]
    token = next((read_token(str(file)) for file in files if file.is_file()), None)
    if token is None:
        raise UsageError(f"no token of an allowed client is in {keyring.folder.path}; `millrace keys new NAME` makes one")
    return token.to_text()


@contextmanager
def _cluster(address: str) -> Iterator[str]:
    """The address of this node of the cluster, as its other nodes know it."""
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
