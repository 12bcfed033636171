"""Everything that an extra in your own package may import, to add callbacks, commands or kinds of env copies.

Rule: an extra imports only names from `millrace`, `millrace.algorithms` and this file, so that the rest of millrace may
change. This file exports at most forty names: functions and classes, but no modules.

    commands            `Flag`, `parse_flags`, `one_line`; a command is an entry point of the group `millrace.commands`
    runs on the disk    `find_runs`, `read_line`, `RunLine`, `read_rows`, `read_summary`
    callbacks           `Rollout`, `Batch`, `Episode`, `AcceptedRollout`, in addition to `millrace.Callback` and
                        `millrace.Progress`
    kinds of env copies `CopiesKind`, `EnvCopies`, `StepResult`, `CopyFailed`, `EnvSpec`, `RunSpec`; a kind is an entry point
                        of the group `millrace.copies`
    other data          `PriorData`, from which an algorithm learns in addition to its own rollouts

This module doesn't import torch.
"""

from __future__ import annotations

from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.learner.algorithms.prior_data import PriorData
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.results import read_summary
from millrace.learner.run_lines import RunLine, find_runs, read_line
from millrace.protocol.bounds import one_line
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.kinds_of_copies import CopiesKind
from millrace.protocol.rollout import Batch, Episode, Rollout
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import EnvCopies, StepResult
from millrace.workers.copies.env_errors import CopyFailed

__all__ = [
    "AcceptedRollout",
    "Batch",
    "CopiesKind",
    "CopyFailed",
    "EnvCopies",
    "EnvSpec",
    "Episode",
    "Flag",
    "PriorData",
    "Rollout",
    "RunLine",
    "RunSpec",
    "StepResult",
    "find_runs",
    "one_line",
    "parse_flags",
    "read_line",
    "read_rows",
    "read_summary",
]
