"""`--inference learner`: worker processes only step env copies; the policy acts here, in one pass for all of them at once.

What the loop gathers from is one worker, in a thread of this process; the env copies that it collects on are those of a
vector environment, whose workers are processes of their own. So tickets, ledger, the law of a row, checkpoints and errors
are those of every run, and a lane gets the seeds and the random numbers that it would get anywhere.

The law: whatever happens, no worker, thread, socket file or folder of ours is left behind.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import zmq

from learner.config.config import Config
from learner.members.endpoint import Bind
from learner.members.worker_processes import WorkerProcesses
from learner.run import Run, Watch, looking
from learner.vector_env.env import ZmqVectorEnv
from millrace.launch.local_workers import StartFlags, flags_of, own_address
from millrace.launch.vector import make_vec
from protocol.policy.policy import Policy, make_policy
from protocol.specs import EnvSpec, ImagesDtype, PolicySpec, RunSpec
from protocol.wire.link import LearnerLink
from workers.collect.collector import Collector
from workers.collect.env_copies import Pulse
from workers.collect.split_vector_env import SideBySide
from workers.host import Host, Thread


def train(
    config: Config,
    resume: Path | None,
    watch: Watch,
    factory: Callable[..., object] | None = None,
    *,
    elsewhere: bool = False,
) -> Path:
    """A whole run; its folder. `factory` makes the environment, if its id does not; `elsewhere`: workers come from there.

    Raises `OurError`, or `Interrupted` when the user stopped it.
    """
    with ExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(own_address("inproc", stack), context)
        stack.callback(link.close, 0.5)
        made: list[Run] = []

        def ended() -> list[tuple[str, str]]:
            if parts.nobody is not None:
                nobody, parts.nobody = parts.nobody, None
                raise nobody
            return host.poll()

        processes = WorkerProcesses(ended, lambda: env.workers)

        def begin() -> StartFlags:
            spec = EnvSpec.of(config.env if factory is None else factory, config.env_kwargs)
            observer = stack.enter_context(looking(config))
            made.append(Run(config, spec, link, resume, watch, observer, lambda folder: processes))
            return flags_of(config, made[0].folder.path)

        env = _vector_env(config, factory, elsewhere, begin)
        stack.callback(env.close)
        (run,) = made
        workers = config.min_workers or (1 if elsewhere else min(config.workers, config.envs))
        parts = SideBySide(env, config.lanes, _patience(env, workers, config.no_workers_timeout_s))

        def collector(spec: RunSpec) -> Collector:
            return Collector(spec, acting(spec.policy, run.device, spec.images_dtype), parts.open, parts.begin)

        host = Host(lambda name: Thread(link.address, name, context, collector), 1, called="inference")
        stack.callback(host.stop)
        stack.callback(host.ask_to_leave)  # and once more: at once, whatever it waits for

        run.journal.workers_expected = 0 if elsewhere else config.workers
        run.go(1)
        return run.folder.path


def acting(spec: PolicySpec, device: str, images: ImagesDtype) -> Policy:
    """What acts: as on a worker, to the same bits, where that is numpy on the CPU; else torch on the device, in one pass."""
    if device == "cpu" and not spec.needs_torch:
        return make_policy(spec)
    from protocol.policy.torch_policy import TorchPolicy

    return TorchPolicy(spec, device, together=True, images=images)


def _vector_env(
    config: Config, factory: Callable[..., object] | None, elsewhere: bool, begin: Callable[[], StartFlags]
) -> ZmqVectorEnv:
    return make_vec(
        config.env if factory is None else factory,  # type: ignore[arg-type]  # what it returns is checked when it is made
        config.envs,
        workers=None if elsewhere else config.workers,
        lanes=config.lanes,
        where=Bind(config.bind if elsewhere else "", config.keys, config.insecure, config.advertise),
        transport=config.transport,
        shared_memory=True,
        autoreset_mode="NextStep",
        on_worker_loss="truncate",
        # A worker of ours that hangs in one copy's step ends itself; one elsewhere may be gone without a word.
        timeout_s=config.step_timeout_s * (1 if elsewhere else config.envs),
        copy=False,
        render_mode=None,
        kwargs=config.env_kwargs,
        begin=begin,
    )


def _patience(env: ZmqVectorEnv, workers: int, timeout_s: float) -> Callable[[Pulse], None]:
    """Before each wait: who is to be told that this thread is alive; and before the first, that all workers are there."""
    waited = False

    def before(pulse: Pulse) -> None:
        nonlocal waited
        env.watch(pulse)
        if not waited:
            env.wait_for(workers, timeout_s)
            waited = True

    return before
