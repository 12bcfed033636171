"""How many worker processes a run starts on this machine, and whether its lanes keep them busy. Pure, except for its cores.

Rule: results don't depend on the number of workers, so it may be chosen for the machine. A number of lanes would change
results, so a better one is only named.
"""

from __future__ import annotations

from millrace.learner.config.rollout_config import RolloutConfig
from millrace.protocol.machine.cpu_cores import usable_cores


def local_workers(config: RolloutConfig, cores: int | None = None) -> int:
    """The number of worker processes. Unless the settings name one, as many as cores, lanes permitting.

    Fewer if these are as fast: with 4 lanes, 3 workers are as fast as 2, because one of them steps two lanes. `cores`: None
    for those that this process may use.
    """
    if config.workers is not None:
        return config.workers
    most = min(config.lanes, usable_cores() if cores is None else cores)
    return _as_fast(config.lanes, most)


def _as_fast(lanes: int, workers: int) -> int:
    """The least number of workers that has no more lanes for each of them than so many have."""
    return -(-lanes // -(-lanes // workers))


def chosen_workers(config: RolloutConfig, cores: int) -> str:
    """A clause for the user about a number of workers that was chosen; empty if the settings name one."""
    if config.workers is not None:
        return ""
    workers = local_workers(config, cores)
    each = "each lane" if workers == config.lanes else "each core"
    said = f"{workers} worker{'s' if workers > 1 else ''}, one for {each}"
    if workers < cores and workers < config.lanes:
        said = f"{workers} workers, because {cores} would be no faster with {config.lanes} lanes"
    more = cores // config.lanes * config.lanes
    if more > config.lanes:
        said += f"; {cores} cores could step --lanes {more}{_envs(config, more)}"
    return said


def uneven_lanes(config: RolloutConfig) -> str:
    """A line for the user if the number of workers that the settings name doesn't divide the lanes; else empty."""
    workers = config.workers
    if workers is None or config.lanes % workers == 0:
        return ""
    lanes = -(-config.lanes // workers) * workers
    better = f"--lanes {lanes}{_envs(config, lanes)}"
    idle = workers - config.lanes
    if idle > 0:
        return (
            f"{idle} of {workers} workers have nothing to collect, because there are {config.lanes} lanes; to use all, take "
            f"{better}"
        )
    most = -(-config.lanes // workers)
    fewer = _as_fast(config.lanes, workers)
    as_fast = f"--workers {fewer} is as fast, and " if fewer < workers else ""
    return (
        f"{config.lanes} lanes don't divide among {workers} workers: some step {most} of them while others wait; {as_fast}"
        f"{better} keeps all busy"
    )


def _envs(config: RolloutConfig, lanes: int) -> str:
    """The flag that goes with so many lanes, if the number of env copies isn't a multiple."""
    envs = -(-config.envs // lanes) * lanes
    return f" --envs {envs}" if envs != config.envs else ""
