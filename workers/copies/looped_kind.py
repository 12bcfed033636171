"""The default kind of env copies: a loop over single copies, with one agent or several."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium

from millrace.protocol.envs.kinds_of_copies import CopiesKind
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import CopySettings, LoopedCopies
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.seated_copies import SeatedCopies
from millrace.workers.copy_slots import EnvMaker


def open_loop(run: RunSpec, first: EnvCopy, pulse: Pulse) -> LoopedCopies:
    """Make the copies of a lane."""
    return loop_over(run, EnvMaker(run.env), run.copies, first, pulse)


def loop_over(
    run: RunSpec, make: Callable[[], gymnasium.Env[Any, Any]], count: int, first: EnvCopy, pulse: Pulse
) -> LoopedCopies:
    """Make `count` copies for a run."""
    makes = [make] * count
    settings = CopySettings.of(run)
    if run.seats:
        return SeatedCopies(makes, pulse, run.seats, settings, first)
    return LoopedCopies(makes, pulse, settings, first)


LOOP = CopiesKind(open_loop)
