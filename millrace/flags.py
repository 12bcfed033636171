"""The flags of the commands that look at runs."""

from __future__ import annotations

from pathlib import Path

import msgspec
from tyro.conf import Positional


class EvaluateFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Greedy episodes of a run's newest policy: mean and standard deviation of the return."""

    run: Positional[Path]
    """the run folder"""
    episodes: int | None = None
    """how many; if not given 100, and 3 with --video"""
    seed: int = 1_000_000
    """of the episodes; another seed, other episodes"""
    best: bool = False
    """of the policy that did best in the run's own evaluations (--eval-every), instead of the newest"""
    video: bool = False
    """film them: an mp4 of each in the run's videos folder (pip install 'millrace[video]')"""
    debug: bool = False
    """show the traceback of an error"""


class StatusFlags(msgspec.Struct, frozen=True, kw_only=True):
    """How a run is: its workers, their speed, memory and silence, and what was dropped."""

    address: Positional[str]
    """where the learner listens, as tcp://HOST:5555"""
    watch: bool = False
    """again every second, until Ctrl-C or the learner has gone"""
    json: bool = False
    """one line of JSON instead of a table"""
    timeout_s: float = 5.0
    """how long to wait for an answer"""
    debug: bool = False
    """show the traceback of an error"""


class PlotFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Learning curves as a PNG: a panel for each environment, a colour for each algorithm, seeds as a band."""

    runs: Positional[tuple[Path, ...]]
    """run folders"""
    out: Path | None = None
    """the PNG; curves.png in the first run folder if not given"""
    debug: bool = False
    """show the traceback of an error"""


class RecordFlags(msgspec.Struct, frozen=True, kw_only=True):
    """A Minari dataset of a run's newest policy: whole episodes, raw rewards (pip install 'millrace[record]')."""

    run: Positional[Path]
    """the run folder"""
    out: str
    """the dataset's id, as in cartpole/expert-v0; it is written where MINARI_DATASETS_PATH says, or to ~/.minari/datasets"""
    steps: int = 50_000
    """env steps; the last episode is finished, and cut only where that would double them"""
    best: bool = False
    """the policy that did best in the run's own evaluations (--eval-every), instead of the newest"""
    npy: Path | None = None
    """also write this file: an array of rows [observation, action], float32, flattened, one for each step"""
    stochastic: bool = False
    """draw actions from the policy, as in training, instead of taking the most probable"""
    seed: int = 2_000_000
    """of the episodes and of the drawn actions"""
    debug: bool = False
    """show the traceback of an error"""


class ReportFlags(msgspec.Struct, frozen=True, kw_only=True):
    """One HTML page about runs side by side: results, learning curves, settings, ledger, stages, films."""

    runs: Positional[tuple[Path, ...]]
    """run folders"""
    out: Path | None = None
    """the page; report.html in the first run folder if not given"""
    debug: bool = False
    """show the traceback of an error"""
