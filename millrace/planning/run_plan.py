"""The plan of a run: the measurements, the recommended settings with reasons, the expected speed, and the command to type.

Rule: the text for a terminal and the record for programs have the same content.
"""

from __future__ import annotations

import io
import shlex
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from millrace.learner.config.presets import added, environment_presets
from millrace.planning.in_words import counted, number_in_words, time_in_words
from millrace.planning.measurements import Machine, Measurements, Overheads
from millrace.planning.recommendation import ChosenSetting
from millrace.protocol.env_spec import Scalar

WIDTH = 110  # columns of the plan as text
LEARNER_IS_THE_LIMIT = 0.8
INDENTED = (0, 0, 0, 2)
BLOCK = (0, 0, 1, 2)  # padding (top, right, bottom, left) of a block, which is indented and followed by an empty line


class ExpectedSpeed(msgspec.Struct, frozen=True, kw_only=True):
    """The speed to expect on one or more machines like this one."""

    machines: int
    """number of machines"""
    workers: int
    """number of workers on all machines together"""
    envs: int
    """number of env copies on all machines together"""
    steps_per_s: float
    """env steps/s of all machines together"""
    learner_share: float
    """share of the time in which the learner is busy; if it is about 1, more env copies don't help"""
    needed_s: float
    """seconds that `RunPlan.needed_steps` env steps take"""


class RunPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Recommended settings for an environment, and the speed to expect. `print` shows it as `millrace plan` does.

    >>> import millrace
    >>> plan = millrace.plan("Pendulum-v1", seconds=5)
    >>> isinstance(plan, millrace.RunPlan), sorted(plan.settings)
    (True, ['algo', 'envs', 'lanes', 'max_lag', 'workers'])
    """

    env: str
    """the environment's name"""
    chosen: tuple[ChosenSetting, ...]
    """the recommended settings, each with its `name`, its `value` and the reason `why`"""
    expected: tuple[ExpectedSpeed, ...]
    """the expected speed on one, two and ten machines like this one"""
    needed_steps: int
    """about how many env steps tasks such as MuJoCo's took with this algorithm; yours may take more or fewer"""
    advice: tuple[str, ...]
    """problems that were found, and further advice; one line each"""
    command: str
    """the command that trains with these settings"""
    measured: Measurements
    """measurements of the environment"""
    overheads: Overheads
    """measurements of millrace itself"""
    machine: Machine
    """the resources of this machine"""

    @property
    def settings(self) -> dict[str, Any]:
        """The recommended settings as keyword arguments of `millrace.train`."""
        return {each.name: each.value for each in self.chosen}

    @property
    def steps_per_s(self) -> float:
        """Env steps/s to expect on this machine."""
        return self.expected[0].steps_per_s

    def __str__(self) -> str:
        text = io.StringIO()
        show(self, Console(file=text, width=WIDTH, color_system=None))
        return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def train_command(
    env: str, env_kwargs: Mapping[str, Scalar], wrappers: tuple[str, ...], chosen: tuple[ChosenSetting, ...]
) -> str:
    """The command that trains with the chosen settings."""
    words = ["millrace", "train", env]
    if env_kwargs:
        words += ["--env-kwargs", *added(env_kwargs, {})]
    if wrappers:
        words += ["--wrappers", *wrappers]
    for each in chosen:
        words += [f"--{each.name.replace('_', '-')}", str(each.value)]
    return shlex.join(words)


def added_by_preset(env: str, env_kwargs: Mapping[str, Scalar], algo: str) -> str:
    """A line if the command trains with keyword arguments of a preset that the environment was measured without."""
    preset: dict[str, Scalar] = environment_presets(algo).get(env, {}).get("env_kwargs", {})
    words = added({name: value for name, value in preset.items() if name not in env_kwargs}, {})
    if not words:
        return ""
    return (
        f"the command also uses keyword arguments of the preset of {algo}, without which the environment was measured; "
        f"to measure it with them, plan with --env-kwargs {shlex.join([*added(env_kwargs, {}), *words])}"
    )


# ------------------------------------------------------------------------------------------------------------------ as text


def show(plan: RunPlan, console: Console) -> None:
    """Print the plan in a form that fits on one terminal screen.

    The command is one line, however long it is, so that it can be pasted. Only the terminal may wrap it.
    """
    console.print(_all_but_the_command(plan), highlight=False)
    console.print(Text("  " + plan.command), soft_wrap=True)


def _all_but_the_command(plan: RunPlan) -> RenderableType:
    found = Table.grid(padding=(0, 2))
    for name, value in _found(plan.measured):
        found.add_row(Text(name, style="dim"), Text(value))
    chosen = Table.grid(padding=(0, 2))
    for each in plan.chosen:
        chosen.add_row(f"--{each.name.replace('_', '-')}", Text(str(each.value), style="bold"), Text(each.why))
    parts: list[RenderableType] = [
        Text(f"{plan.env}, measured on {counted(plan.machine.cores, 'core')} with random actions", style="bold"),
        Padding(found, BLOCK),
        Text("choose", style="bold"),
        Padding(chosen, BLOCK),
        Text("expect", style="bold"),
        Padding(_expected(plan), INDENTED),
        Padding(Text(_about_steps(plan), style="dim"), BLOCK),
    ]
    if plan.advice:
        parts.append(Text("know", style="bold"))
        parts += [Padding(Text(line), INDENTED) for line in plan.advice]
        parts.append("")
    return Group(*parts, Text("type", style="bold"))


def _expected(plan: RunPlan) -> Table:
    table = Table.grid(padding=(0, 3))
    table.add_row("machines", "workers", "env copies", "env steps/s", f"{plan.needed_steps:,} env steps", style="dim")
    for each in plan.expected:
        limit = " (the learner is the limit)" if each.learner_share > LEARNER_IS_THE_LIMIT else ""
        table.add_row(
            str(each.machines),
            str(each.workers),
            str(each.envs),
            Text(number_in_words(each.steps_per_s), style="bold" if each.machines == 1 else ""),
            f"{time_in_words(each.needed_s)}{limit}",
        )
    return table


def _about_steps(plan: RunPlan) -> str:
    algo = {"rainbow": "Rainbow"}.get(plan.settings["algo"], plan.settings["algo"].upper())
    return (
        f"Tasks such as MuJoCo's took about {plan.needed_steps:,} env steps with {algo}; yours may take more or fewer. "
        "Evaluations come on top."
    )


def _found(measured: Measurements) -> Iterator[tuple[str, str]]:
    """The measurements, as names and values."""
    alone = measured.alone
    most = measured.side_by_side[-1]
    does = f"computes for {min(alone.cpu_share, 1):.0%}" if alone.computes else f"waits for {1 - alone.cpu_share:.0%}"
    yield (
        "a step",
        (
            f"{time_in_words(alone.mean_s)} (median {time_in_words(alone.median_s)}, 95 of 100 within "
            f"{time_in_words(alone.p95_s)}); {does} of it"
        ),
    )
    every = f"every {number_in_words(measured.episode_steps)} steps" if measured.episode_steps else "no episode has ended"
    yield "a reset", f"{time_in_words(measured.reset_s)}, {every}"
    if len(measured.side_by_side) > 1:
        uneven = (
            f"; the slowest copy takes {most.slowest_copy:.1f} times as long as the median one"
            if most.slowest_copy > 1.5 and alone.own_s > 1e-3
            else ""
        )
        yield (
            "side by side",
            (f"{most.workers} workers make {most.steps_per_s / alone.steps_per_s:.1f} times the env steps of one{uneven}"),
        )
    yield (
        "memory",
        f"{measured.worker_bytes / 2**20:,.0f} MB for a worker with a copy; an observation takes "
        f"{measured.observation_bytes:,} bytes",
    )
    yield "deterministic", {True: "yes", False: "no", None: "not known"}[measured.deterministic]
    yield "start", f"{time_in_words(measured.start_s)} for a worker with a copy"
