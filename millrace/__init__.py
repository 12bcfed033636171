"""millrace: worker processes step a gymnasium environment, one PyTorch learner learns. User code imports this alone.

import millrace
run = millrace.train("CartPole-v1", seed=1)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from millrace.import_conflict import check_imports

check_imports()

if TYPE_CHECKING:
    from gymnasium.vector import AutoresetMode

    from learner.run_folder.progress import Progress
    from learner.vector_env.env import ZmqVectorEnv
    from learner.vector_env.settings import EnvLike

__all__ = ["__version__", "make_vec", "train"]


def train(
    env: str | Callable[..., object] = "",
    *,
    config: str | Path | None = None,
    resume: str | Path | None = None,
    preset: str = "auto",
    watch: Callable[[Progress], None] | None = None,
    **keywords: Any,
) -> Path:
    """Train on this machine; the run folder.

    `env` is anything `gymnasium.make` takes, or a callable that returns an environment. `config` is a TOML file, `resume` a
    run folder to go on with, or "auto": the newest of this environment, algorithm and seed, or a new one. Every flag of
    `millrace train` is a keyword argument of the same name: `learning_rate=1e-3`.
    `watch` is called after each update. Guard the call with `if __name__ == "__main__":` in a script. Raises `OurError`.
    """
    from learner.config.layers import resolve
    from learner.run_folder.resume import AUTO, newest_run
    from millrace.launch import local

    name = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
    file, run = (None if path is None else Path(path) for path in (config, resume))
    if run == AUTO:
        run = newest_run(resolve(name, file=file, preset=preset, **keywords))
        file = None if run else file
    settings = resolve(name, file=file, resume=run, preset=preset, **keywords)
    return local.train(settings, run, watch or (lambda progress: None), factory=None if isinstance(env, str) else env)


def make_vec(
    env: EnvLike | Sequence[EnvLike],
    num_envs: int | None = None,
    *,
    workers: int | None = None,
    lanes: int | None = None,
    bind: str = "",
    keys: str = "",
    insecure: bool = False,
    advertise: str = "",
    transport: Literal["ipc", "tcp", "inproc"] = "ipc",
    shared_memory: bool = True,
    autoreset_mode: AutoresetMode | str = "NextStep",
    on_worker_loss: Literal["truncate", "raise"] = "truncate",
    timeout: float = 60.0,
    copy: bool = True,
    render_mode: str | None = None,
    **kwargs: bool | int | float | str,
) -> ZmqVectorEnv:
    """A `gymnasium.vector.VectorEnv` whose copies live in worker processes.

    `env` is anything `gymnasium.make` takes, a callable that returns an environment, or a list with one of these for each
    copy; `kwargs` are passed on to it. The copies are shared evenly among `workers` processes of this machine (one for each
    core), started and ended with the vector environment; with a `bind` address, among `lanes` workers that are started
    elsewhere, as the line says that is printed (`millrace worker ADDRESS`). Observations and actions go through shared
    memory, unless that is turned off, or a worker is elsewhere; what comes out is the same. `keys`, `insecure` and
    `advertise` are as in `millrace learner`: an address that other machines can reach needs keys, which are made by
    themselves, and a callable goes over TCP with keys only.

    Whoever does not answer within `timeout` seconds is given up; a worker elsewhere that gives no sign of life for 5 s while
    it is waited for, at once (a long step is no silence, unless it keeps Python's lock all the while). Between two calls you
    may think as long as you like: workers of this machine wait as long as this process lives, those elsewhere for ten
    minutes, after which they join anew, and their copies are lost. The copies of a worker that is lost come back truncated,
    on another or a new one, and the info says `worker_lost`; or, with `on_worker_loss="raise"`, `WorkerLost` is raised. What
    an environment raises is raised here, with the worker's traceback. Raises `OurError`.
    """
    from learner.members.endpoint import Bind
    from learner.vector_env.settings import VectorEnvSettings
    from millrace.launch import vector

    return vector.make_vec(
        VectorEnvSettings(
            env,
            num_envs,
            workers=workers,
            lanes=lanes,
            listen=Bind(bind, keys, insecure, advertise),
            transport=transport,
            shared_memory=shared_memory,
            autoreset_mode=autoreset_mode,
            on_worker_loss=on_worker_loss,
            timeout_s=timeout,
            copy=copy,
            render_mode=render_mode,
            kwargs=kwargs,
        )
    )


def __getattr__(name: str) -> str:
    """`__version__`, looked up when it is asked for: that costs more than the rest of this file."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import metadata

    try:
        return metadata.version("millrace-rl")
    except metadata.PackageNotFoundError:
        return "0+uninstalled"
