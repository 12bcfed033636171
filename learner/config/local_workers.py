"""How many worker processes a run starts on this machine, and whether its lanes keep them busy.

Rule: results don't depend on the number of workers, so this number may be chosen to suit the machine. Results do depend on
the number of lanes, so a better number of lanes is only suggested. Pure, except for counting this machine's cores.
"""

from __future__ import annotations

from millrace.learner.config.config import Config
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.config.update_size import rollout_with
from millrace.protocol.machine.cpu_cores import usable_cores


def enough_workers(lanes: int, workers: int) -> int:
    """The smallest number of workers with which the busiest worker has no more lanes than with `workers` workers."""
    return -(-lanes // -(-lanes // workers))


def local_workers(config: RolloutConfig, cores: int | None = None) -> int:
    """The number of worker processes. Unless the settings give it, one for each core, but at most one for each lane.

    The number is lower if fewer workers are as fast. For example, with 4 lanes, 2 workers are as fast as 3, because one of
    the 3 would step two lanes. `cores` is the number of cores; None means all cores that this process may use.
    """
    if config.workers is not None:
        return config.workers
    most = min(config.lanes, usable_cores() if cores is None else cores)
    return enough_workers(config.lanes, most)


def chosen_workers(config: Config, cores: int) -> str:
    """A clause that tells the user how many workers were chosen and why; empty if the settings give the number."""
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


def uneven_lanes(config: Config) -> str:
    """A line for the user if the number of workers in the settings doesn't divide the number of lanes; otherwise empty."""
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
    fewer = enough_workers(config.lanes, workers)
    as_fast = f"--workers {fewer} is as fast, and " if fewer < workers else ""
    return (
        f"{config.lanes} lanes don't divide among {workers} workers: some step {most} of them while others wait; {as_fast}"
        f"{better} keeps all busy"
    )


def _envs(config: Config, lanes: int) -> str:
    """The `--envs` flag to use with this many lanes, if the number of env copies isn't a multiple of them; else empty.

    With it, the flag that keeps the size of an update, or the new size if it must be larger.
    """
    envs = -(-config.envs // lanes) * lanes
    if envs == config.envs:
        return ""
    steps = config.algorithm.rollout_steps
    size = config.envs * steps
    kept = rollout_with(envs, size, config.algorithm.least_rollout)
    shorter = f" --rollout-steps {kept}" if kept != steps else ""
    larger = f" (updates of {envs * kept:,} env steps instead of {size:,})" if envs * kept > size else ""
    return f" --envs {envs}{shorter}{larger}"
