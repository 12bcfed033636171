"""The settings for collecting rollouts, such as the environment, the env copies, the workers and the timeouts. Pure.

A training run also has the settings of `Config`. A `RolloutService` for your own training loop has only these.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from millrace.flags.fields import Flag, NotNegative, Positive
from millrace.learner.config.resume_rules import Adaptable, Fixed, Free
from millrace.protocol.bounds import Count, Natural
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.env_spec import Scalar
from millrace.protocol.envs.kinds_of_copies import KINDS
from millrace.protocol.envs.seats import STATE
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.specs import SessionTerms, session_terms
from millrace.protocol.wire.weight_dtypes import ActingDtype

SEAT_ID = "millrace.protocol.envs.seats:seat_id"
WITH_STATE = "millrace.protocol.envs.seats:with_state"
STALL_TIMEOUT_S = 600.0


class RolloutConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The settings for collecting rollouts."""

    # ------------------------------------------------------------------------------------------------------------ basics

    env: Annotated[Fixed[str], Flag(positional=True)] = ""
    """Environment id for gymnasium.make, such as CartPole-v1, ALE/Pong-v5 or my_package.envs:MyEnv-v0."""
    env_kwargs: Fixed[dict[str, Scalar]] = {}
    """Keyword arguments for gymnasium.make: NAME VALUE NAME VALUE ... Values are numbers, true, false or text. In text, each
    env copy's number, slot, lane and copy can be used, as in port "{5000 + slot}".
    """
    eval_env_kwargs: Fixed[dict[str, Scalar]] = {}
    """Additional keyword arguments for evaluation copies. They override arguments of the same name in env_kwargs."""
    wrappers: Annotated[Fixed[tuple[str, ...]], Flag("MODULE:CLASS ...")] = ()
    """Wrappers for every env copy, including evaluation copies, such as gymnasium.wrappers:FlattenObservation. Arguments
    must be literals: "my_module:Scale(by=0.5)". The first wrapper is the innermost.
    """
    seat_id: Fixed[bool] = False
    """In a multi-agent environment, add the number of the agent's seat to its observations."""
    critic_keys: Annotated[Fixed[tuple[str, ...]], Flag("KEY ...")] = ()
    """Keys of a Dict observation that only the critic sees: the policy acts without them (ppo, a2c, impala, reinforce). For
    PettingZoo, the key state is the environment's state().
    """
    seed: Fixed[Annotated[int, Meta(ge=0)]] = 1
    """Seed of all the run's random numbers."""
    workers: Free[Count | None] = None
    """Number of worker processes on this machine (train only). none: one for each core, but at most one for each lane. Use
    more if env steps wait for something other than the CPU; a run without this setting tells you when they do.
    """
    envs: Adaptable[Count] = 8
    """Number of env copies, summed over all workers. Must be a multiple of lanes."""

    # ----------------------------------------------------------------------------------------------------------- workers

    lanes: Adaptable[Count] = 4
    """Number of groups of env copies. The copies of a lane are stepped together, on one worker at a time. Lanes are
    distributed over the workers. Results depend on lanes and envs, not on the number of workers.
    """
    max_lag: Free[Natural] = 0
    """Lag of the rollouts: after the first updates, rollouts are collected with weights that are exactly this many versions
    older than the learner's. 0: workers and learner take turns. Above 0: they work at the same time; impala, dqn, sac and
    td3 are designed for this. Runs are reproducible with any lag.
    """
    vector: Annotated[Free[str], Flag(f"{{{','.join(KINDS)}}}|NAME")] = "loop"
    """How the env copies of a lane are stepped. loop: one after another. native: by the environment's own vector version.
    envpool: by envpool (pip install envpool). native and envpool don't use the same random numbers as loop. Packages can
    add other kinds.
    """
    acting_dtype: Free[ActingDtype] = "float32"
    """Precision in which workers compute actions; the learner always computes in float32. bfloat16 halves the size of the
    weights that are sent. With images, it also halves the time to compute actions on CPUs with AMX; on other CPUs, it is
    slower than float32.
    """
    info_keys: Free[tuple[str, ...]] = ()
    """Names of numbers that the environment reports in info at the end of an episode, such as is_success distance. Their
    means are logged.
    """
    action_masks: Fixed[Literal["auto", "info", "none"]] = "auto"
    """Where the environment says which Discrete or MultiDiscrete actions are allowed. auto: in the key action_mask of a Dict
    observation, if it has one. info: in info["action_mask"] of each reset and step, unless the Dict observation has the key.
    none: all actions are allowed, and the key is an observation.
    """
    max_env_copies: Free[Natural] = 0
    """Largest number of env copies that the run has on all machines together, for example because of floating licences. It
    includes evaluation copies; evaluations are then played on as few workers as needed. 0: no limit. To limit the env copies
    on one machine, set the environment variable MILLRACE_COPIES_PER_MACHINE.
    """
    min_workers: Free[Natural] = 0
    """Start training when this many workers have joined. 0: wait for all local workers (train) or one worker
    (learner).
    """
    launched_workers: Free[Natural] = 0
    """Number of workers that a launcher starts for this learner (learner only; `millrace launch` sets it). If this many
    different workers report that they can't create the environment, the run ends and prints their reason. 0: wait for
    another worker.
    """

    # ----------------------------------------------------------------------------------------------------------- network

    transport: Free[Literal["inproc", "ipc", "tcp"]] = "ipc"
    """How local workers are connected (train only). inproc: as threads of this process, which then also runs the
    environment. ipc: by local sockets. tcp: by TCP on 127.0.0.1.
    """
    bind: Free[str] = "tcp://127.0.0.1:5555"
    """Address at which the learner listens for workers (learner only). With tcp://0.0.0.0:5555, workers on other machines
    can join; this needs keys.
    """
    advertise: Free[str] = ""
    """Host name or IP address of this machine for workers on other machines (learner only). Default: the name of this
    machine.
    """
    keys: Free[str] = ""
    """Key folder. Default: MILLRACE_KEYS, else ~/.config/millrace/keys. TCP connections on this machine need keys too if a
    folder is named here or in MILLRACE_KEYS, or if workers must call a function or class that the run names, such as an
    encoder or a wrapper.
    """
    insecure: Free[bool] = False
    """Accept workers on other machines without keys. Anyone who can reach the port can then read, disturb and stop the run.
    """
    metrics_bind: Free[str] = ""
    """HOST:PORT at which Prometheus can read the metrics, such as 127.0.0.1:9464 (pip install prometheus-client). With
    0.0.0.0:9464, anyone on the network can read them. Default: no metrics are served.
    """
    dashboard: Free[bool] = False
    """Show the run in a browser while it trains. This machine serves the page, and the learner prints its address."""

    # --------------------------------------------------------------------------------------------- timeouts and failures

    worker_timeout_s: Free[Positive] = 5.0
    """A worker that has been silent for this many seconds counts as lost, and other workers take over its lanes. A worker
    doesn't count as silent while its supervisor reports that the environment, or your policy, is busy, however long that
    takes.
    """
    lost_lanes: Free[Literal["continue", "restart"]] = "continue"
    """What happens to running episodes when their worker is lost, when lanes move to another worker, and when the run is
    resumed. continue: each episode is replayed on another env copy from its beginning, with the same seed and actions, and
    then continues. If the environment is deterministic given its seed, results then don't depend on which workers were lost.
    restart: new episodes begin.
    """
    replay_limit: Free[Natural] = 1000
    """Longest episode, in steps, that is replayed so that it can continue. A longer one is replaced by a new episode.
    Replaying an episode takes as long as its steps took, without the time to compute actions.
    """
    restart_episodes: Free[Natural] = 0
    """Number of episodes after which each env copy, including evaluation copies, is closed and created again. Use it for
    simulators that need more memory or slow down the longer they run. The new copy continues with the seed and the random
    numbers of the old one, and with its saved state if the environment has save_state. If the environment is deterministic
    given its seed, results don't change. 0: never.
    """
    no_workers_timeout_s: Free[Positive] = 600.0
    """Write a checkpoint and end the run if there has been no worker for this many seconds. If all workers are local, the
    run ends as soon as none is left.
    """
    start_timeout_s: Free[NotNegative] = 600.0
    """A worker process, on any machine, is restarted if it takes longer than this many seconds to create or reset one env
    copy, or to create the policy with everything that it imports. 0: never.
    """
    step_timeout_s: Free[NotNegative] = 600.0
    """A worker process, on any machine, is restarted if one step of an env copy, or one call to a policy that you wrote (an
    `OwnPolicy`, an opponent, an encoder), takes longer than this many seconds. 0: never.
    """
    max_env_failures: Free[Natural] = 3
    """How many failures the run survives. A failure is an exception or an unusable result from the environment or an
    `OwnPolicy`. The unexpected end of a worker process counts too, because the environment may have caused it. Either of two
    counts ends the run. In a row: one lane has more failures than this, or more than 10, without a rollout in between; a
    failure after env steps counts as a quarter. Within an hour: there are more failures after env steps than
    this × (1 + env copies × h + w / 30). Here h is the number of hours since the learner began, at most 1, and w is the
    number of seconds that the failed workers had worked before.
    """

    def all_wrappers(self, given: Sequence[WrapperLike] | None = None) -> list[WrapperLike]:
        """The wrappers of every env copy: `given`, or `wrappers` if it is None, and then those that other settings need."""
        return [
            *(self.wrappers if given is None else given),
            *([SEAT_ID] if self.seat_id else []),
            *([WITH_STATE] if STATE in self.critic_keys else []),
        ]

    def call_timeouts(self) -> CallTimeouts:
        """How long one call to an env copy may take."""
        return CallTimeouts(self.start_timeout_s, self.step_timeout_s)

    def most_repeated_steps(self) -> int:
        """The length, in steps, of the longest episode that is replayed; -1 if none is."""
        return self.replay_limit if self.lost_lanes == "continue" else -1

    def stall_timeout_s(self) -> float:
        """The run ends if no env step, reset or construction finishes for this many seconds. Each one takes less time."""
        return max(STALL_TIMEOUT_S, self.call_timeouts().longest_s())

    def terms(self) -> SessionTerms:
        """The terms of all workers, before the run begins and in the run."""
        return session_terms(self.call_timeouts(), self.worker_timeout_s)
