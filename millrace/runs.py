"""Runs in Python: `millrace.train` makes a run, and `millrace.Run` reads the run folder at each access.

Rule: parts that a run folder lacks are None or empty, and an unreadable file is a one-line error. The repr never raises.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from html import escape
from pathlib import Path
from typing import Any, Protocol, TypeVar, Unpack

import numpy as np

from millrace.arguments import checked
from millrace.keywords import TrainKeywords
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.config.config import Config
from millrace.learner.config.layers import config_of_run, layers_of_keywords, resolve, settings_of_run
from millrace.learner.config.resume_auto import settings_with_newest_run
from millrace.learner.extras import started_by
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_and_count_rows
from millrace.learner.run_folder.newest_run import AUTO
from millrace.learner.run_folder.progress import ENV_STEPS_KEY, RETURN_KEY
from millrace.learner.run_folder.results import Evaluation, RecordedDataset, Summary
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.run_format import read_config
from millrace.playing import RunEvaluateKeywords, RunRecordKeywords, evaluate, record
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvLike, EnvSpec, remembered_name
from millrace.protocol.envs.wrappers import WrapperLike, wrapper_names
from millrace.protocol.errors import UsageError, UserFacingError
from millrace.terminal import progress_view

NOT_FINISHED = "not finished"


class ResumeKeywords(TrainKeywords, total=False):
    """Keywords of `Run.resume`."""

    env: EnvLike
    wrappers: Sequence[WrapperLike] | None
    callbacks: Sequence[object]
    progress: bool


_Played = TypeVar("_Played", RunEvaluateKeywords, RunRecordKeywords)


class Metrics(dict[str, Array]):
    """The metrics of a run: a numpy array [updates] for each name, such as `metrics["rollout/ep_rew_mean"]`.

    Columns of whole numbers are int64. Other columns are float64, with NaN where an update lacks the number, for example
    because it had no evaluation. The names are those in metrics.jsonl. A number that Stable-Baselines3 also logs has the
    same name there.

    >>> import millrace
    >>> metrics = millrace.Run(run).metrics
    >>> bool((metrics["time/total_timesteps"] <= 64).all())
    True
    >>> isinstance(metrics, millrace.Metrics), metrics.unreadable
    (True, 0)
    """

    unreadable: int
    """Number of rows that are left out because they are unreadable."""

    def __init__(self, rows: list[dict[str, Any]], unreadable: int = 0) -> None:
        names = dict.fromkeys(name for row in rows for name in row)
        super().__init__({name: _column([row.get(name) for row in rows]) for name in names})
        self.unreadable = unreadable
        self._updates = len(rows)

    def __repr__(self) -> str:
        lost = f", {self.unreadable} more cannot be read" if self.unreadable else ""
        return f"<metrics of {self._updates} updates{lost}: {', '.join(self)}>"


class Picture(Protocol):
    """Learning curves as a picture that notebooks display."""

    svg: str
    """the picture as SVG text"""

    def _repr_svg_(self) -> str:
        """The representation in a notebook."""

    def png(self) -> bytes:
        """The picture as the bytes of a PNG file. Raises `UsageError` if the packages for this are not installed."""

    def save(self, out: str | os.PathLike[str]) -> Path:
        """Write the picture to a file, whose name ends in .svg or .png. Raises `UserFacingError` with a one-line message."""


class Run(os.PathLike[str]):
    """A run folder: its results, and methods that use its policy. `millrace.train` returns one.

    Everything is read from the folder at each access, so you can follow a run that is still training. `os.fspath(run)` is
    the folder: you can pass a `Run` wherever a path is expected. Raises `UsageError`, with a one-line message, if `path`
    isn't a run folder.

    >>> import millrace
    >>> millrace.Run(run).summary.env
    'CartPole-v1'
    """

    @checked
    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = RunFolder.open(Path(path)).path
        """The run folder."""
        self._given: dict[str, Any] = {}

    @classmethod
    def _trained(cls, path: Path, given: Mapping[str, Any]) -> Run:
        """The `Run` of a run that was just trained. `given`: the environment, wrappers and algorithm that were passed to
        `train` as objects instead of names.
        """
        run = cls.__new__(cls)
        run.path = path
        run._given = dict(given)
        return run

    @property
    def config(self) -> Config:
        """All settings of the run. Raises `UsageError` if config.toml cannot be read.

        >>> import millrace
        >>> millrace.Run(run).config.seed
        1
        """
        return config_of_run(self.path)

    @property
    def summary(self) -> Summary | None:
        """The results of the run; None if it has not ended.

        >>> import millrace
        >>> millrace.Run(run).summary.stop_reason
        'all steps done'
        """
        return RunFolder(self.path).summary()

    @property
    def metrics(self) -> Metrics:
        """The metrics of every update, as columns. Unreadable rows are left out, and counted in `metrics.unreadable`.

        >>> import millrace
        >>> millrace.Run(run).metrics["rollout/ep_rew_mean"].dtype
        dtype('float64')
        """
        try:
            return Metrics(*read_and_count_rows(self.path / METRICS_FILE))
        except FileNotFoundError:
            return Metrics([])
        except OSError as error:
            raise UsageError(f"{self.path / METRICS_FILE} cannot be read: {error.strerror}") from error

    @checked
    def evaluate(self, episodes: int | None = None, **keywords: Unpack[RunEvaluateKeywords]) -> Evaluation:
        """Play greedy episodes with the newest policy: `millrace.evaluate(run, …)`, with the same keywords.

        >>> import millrace
        >>> result = millrace.Run(run).evaluate(episodes=2, workers=1)
        >>> result.episodes
        2
        """
        return evaluate(self, episodes, **self._with_given(keywords))

    @checked
    def record(self, out: str, steps: int = 50_000, **keywords: Unpack[RunRecordKeywords]) -> RecordedDataset:
        """Write episodes played by the newest policy as a Minari dataset: `millrace.record(run, …)`, with the same keywords.

        >>> import millrace
        >>> millrace.Run(run).record("cartpole/of-a-run-v0", steps=20).dataset_id
        'cartpole/of-a-run-v0'
        """
        return record(self, out, steps, **self._with_given(keywords))

    @checked
    def resume(self, **keywords: Unpack[ResumeKeywords]) -> Run:
        """Continue the run from its newest checkpoint: `millrace.train(resume=run, …)`, with the same keywords.

        If you passed the environment, the wrappers or the algorithm to `train` as an object, this method passes it again.
        Returns a `Run` with the same folder. A run that has reached its `steps` ends at once, so pass a larger `steps`.

        >>> import millrace
        >>> millrace.Run(run).resume(steps=96, progress=False).summary.updates
        3
        """
        return train(resume=self, **{**self._given, **keywords})

    @checked
    def plot(self, out: str | os.PathLike[str] | None = None) -> Picture:
        """Plot the learning curve, as `millrace plot` does. Returns a picture that notebooks display.

        `out`: also write the picture to this file, whose name ends in .svg, or in .png (pip install pillow resvg_py). Raises
        `UsageError` if no episode has ended yet.

        >>> import millrace
        >>> picture = millrace.Run(run).plot("curve.svg")
        >>> picture.save("curve.png").name
        'curve.png'
        """
        picture: Picture = started_by("Run.plot")([self.path])
        if out is not None:
            picture.save(out)
        return picture

    def __fspath__(self) -> str:
        return os.fspath(self.path)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Run) and other.path.absolute() == self.path.absolute()

    def __hash__(self) -> int:
        return hash(self.path.absolute())

    def __repr__(self) -> str:
        facts = self._facts()
        return f"<run {self.path}: {', '.join(facts.values())}>"

    def _repr_html_(self) -> str:
        """The representation in a notebook: a small table."""
        rows = {**self._facts(), "folder": str(self.path)}
        cells = [(escape(name), escape(fact.removeprefix(f"{name} "))) for name, fact in rows.items()]
        left = "style='text-align:left'"
        return f"<table>{''.join(f'<tr><th {left}>{name}</th><td {left}>{fact}</td></tr>' for name, fact in cells)}</table>"

    def _with_given(self, keywords: _Played) -> _Played:
        """These keywords, plus the environment and wrappers that were passed to `train` unless the keywords replace them."""
        keywords.setdefault("env", self._given.get("env"))
        keywords.setdefault("wrappers", self._given.get("wrappers"))
        return keywords

    def _facts(self) -> dict[str, str]:
        """The most important facts about the run, by name. Never raises."""
        try:
            config = read_config(self.path)  # not `self.config`, which imports the algorithm
            summary = self.summary
            facts = {"environment": config["env"], "algorithm": config["algo"], "seed": f"seed {config['seed']}"}
            if summary is None:
                return facts | _newest_figures(self.metrics)
        except UserFacingError as error:
            return {"problem": str(error)}
        facts["env steps"] = f"{summary.env_steps:,} env steps in {summary.wall_s:,.1f} s"
        if summary.return_mean_100 is not None:
            facts["return"] = f"return {summary.return_mean_100:,.1f} (last 100 training episodes)"
        if summary.evaluation is not None:
            facts["greedy"] = f"greedy {summary.evaluation}"
        return {**facts, "ended": summary.stop_reason}


@checked
def train(
    env: EnvLike = "",
    *,
    wrappers: Sequence[WrapperLike] | None = None,
    config: str | os.PathLike[str] | None = None,
    resume: str | os.PathLike[str] | None = None,
    preset: str = "auto",
    callbacks: Sequence[object] = (),
    progress: bool = True,
    **settings: Unpack[TrainKeywords],
) -> Run:
    """Train a policy on this machine. The learner runs in this process, and starts worker processes.

    Arguments:
        env: An id that `gymnasium.make` accepts, a `gymnasium.envs.registration.EnvSpec`, or a callable that returns an
            environment. The environment may be defined in your script or notebook. A resumed run finds the environment by
            its name; if it has no importable name, pass it again.
        wrappers: Applied to every env copy, including evaluation copies, the first one innermost: classes, functions, or
            names such as "gymnasium.wrappers:FlattenObservation".
        config: A TOML file of settings.
        resume: A `Run` or run folder, to continue from its newest checkpoint; or "auto", to continue the newest run with
            this environment, algorithm and seed, or to start a new run if there is none. `config` then overrides the
            settings of the run.
        preset: The name of a preset (`millrace presets` lists them); "auto": the preset of `env`, if there is one; "none":
            no preset.
        callbacks: Called between updates; they may also end the run. A callback is an object with some of the methods of
            `Callback`; a name such as "my_module:factory", which a resumed run finds again; or a function, which gets a
            `Progress` after each update, and several times a second during an evaluation or a long wait.
        progress: Show the progress: in one display in a notebook, in place on a terminal, otherwise as a line every 5 s or
            less often.
        **settings: The flags of `millrace train`, with the same names, such as `learning_rate=1e-3`. `algo` may be your own
            class (`millrace.algorithms`). If the class is defined in a script or a notebook, pass it again on resume. Type
            checkers don't know settings that only your class has, so pass these as `**own`, a `dict[str, Any]`. `start_from`
            may be a `Run`: the new run begins with the policy of that run (`--from`).

    Returns the `Run`. If training fails, raises `UserFacingError` with a one-line message.

    >>> import millrace
    >>> run = millrace.train("CartPole-v1", seed=1, steps=64, envs=2, lanes=1, rollout_steps=16, workers=1, progress=False)
    >>> run.summary.updates
    2
    """
    from millrace.launch import training

    name = remembered_name(env)
    given = dict[str, Any](settings)
    if named := [each for each in callbacks if isinstance(each, str)]:
        given["callbacks"] = named
    if wrappers is not None:
        given["wrappers"] = list(wrapper_names(wrappers))
    file, run = (None if path is None else Path(path) for path in (config, resume))
    if run == AUTO:
        lower, keywords = layers_of_keywords(name, file=file, preset=preset, **given)
        resolved, run = settings_with_newest_run(lower, lambda lower: settings_of_run(lower, keywords))
    else:
        resolved = resolve(name, file=file, resume=run, preset=preset, **given)
    objects = {name: made for name, made in given.items() if callable(made)}
    objects |= {} if isinstance(env, str) else {"env": env}
    objects |= {} if wrappers is None else {"wrappers": wrappers}
    spec = None
    if not isinstance(env, str) or wrappers is not None:
        outer = resolved.all_wrappers(wrappers)
        spec = EnvSpec.of(
            resolved.env if isinstance(env, str) else env, resolved.env_kwargs, outer, resolved.eval_env_kwargs
        )
    with progress_view(may_fail=False) if progress else nullcontext() as view:
        shown = [] if view is None else [view]
        objects_alone = [each for each in callbacks if not isinstance(each, str)]
        folder = training.train(resolved, run, Callbacks(shown, objects_alone), spec)
    return Run._trained(folder, objects)


def _newest_figures(metrics: Metrics) -> dict[str, str]:
    """The newest figures of a run that has not ended, by name."""
    facts = {"env steps": f"{int(metrics[ENV_STEPS_KEY][-1]):,} env steps"} if ENV_STEPS_KEY in metrics else {}
    returns = metrics.get(RETURN_KEY)
    if returns is not None and np.isfinite(returns[-1]):
        facts["return"] = f"return {returns[-1]:,.1f} (last 100 training episodes)"
    return {**facts, "ended": NOT_FINISHED}


def _column(values: list[Any]) -> Array:
    if all(type(value) is int and abs(value) < 2**63 for value in values):
        return np.array(values, np.int64)
    return np.array([np.nan if value is None else value for value in values], np.float64)
