"""`millrace plan`: measures an environment on this machine, and recommends settings, with the speed to expect."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta
from rich.console import Console

from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.planning.plan import LEAST_S, SECONDS, plan_of
from millrace.planning.probe import ProbedEnv
from millrace.planning.run_plan import show
from millrace.protocol.bounds import Natural
from millrace.protocol.env_spec import Scalar


class PlanFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Measure an environment on this machine for about as long as --seconds, then say what to choose and what to expect,
    with reasons.
    """

    env: Annotated[str, Flag(positional=True)]
    """Environment id for gymnasium.make, or a name, as for train"""
    env_kwargs: dict[str, Scalar] = {}
    """keyword arguments of the environment, as for train"""
    wrappers: Annotated[tuple[str, ...], Flag("MODULE:CLASS ...")] = ()
    """wrappers of every env copy, as for train"""
    max_env_copies: Natural = 0
    """maximum number of env copies that may run at the same time, for example because of floating licences. 0: no limit"""
    seconds: Annotated[float, Meta(ge=LEAST_S)] = SECONDS
    """about how long it takes on an idle machine; two to four times as long if other programs use the cores, and longer if
    a step or a start of the environment takes seconds
    """
    json: bool = False
    """print all measurements as one line of JSON"""


def run(argv: list[str]) -> int:
    """Print the plan. Returns the exit code."""
    flags = parse_flags(PlanFlags, argv, "plan")
    env = ProbedEnv(flags.env, flags.env_kwargs, flags.wrappers)
    with Console(stderr=True).status("") as shown:
        plan = plan_of(env, max_env_copies=flags.max_env_copies, seconds=flags.seconds, say=shown.update)
    if flags.json:
        print(msgspec.json.encode({"type": type(plan).__name__, **msgspec.structs.asdict(plan)}).decode())
    elif (console := Console()).is_terminal:
        show(plan, console)
    else:
        print(plan)
    return 0
