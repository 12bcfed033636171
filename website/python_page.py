"""Makes reference/python.md, which lists the public names, and a page in reference/python/ for each group of them.

mkdocstrings replaces each `:::` line on a page with a signature and docstring.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import NamedTuple

from benchmarks.markdown_tables import table
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from website.tables import anchored

HEAD = """# Python

`import millrace` gives all names without a second dot. A name that is not in these tables is internal: it may change in any
version. `millrace.__version__` is the version of the installed package, as text.

"""


class Group(NamedTuple):
    """A page of public names."""

    title: str
    about: str
    names: str
    """names from `millrace` and its public modules, separated by spaces"""


BUILT_IN = [record.__name__.removesuffix("Config") for record in HYPERPARAMETERS.values()]
"""The classes of the built-in algorithms"""
GROUPS = {
    "training": Group(
        "Train and look at runs",
        "[Settings](../settings.md) has the meaning and the range of every keyword of `train`.",
        "plan RunPlan train Run Metrics Summary Evaluation evaluate record RecordedDataset "
        "extras.monitoring.dashboard.Dashboard",
    ),
    "policies": Group("Use a policy", "A saved policy acts without its environment or algorithm.", "load LoadedPolicy"),
    "callbacks": Group(
        "Callbacks",
        "`train(callbacks=[…])` takes any number of them. The last two are for other programs.",
        "Callback Progress extras.monitoring.wandb.WandbCallback extras.monitoring.mlflow.MlflowCallback",
    ),
    "environments": Group(
        "Environments",
        "The vector environment, and what helps to write an environment. `millrace.sb3` needs Stable-Baselines3.",
        "make_vec sb3.make_vec_env sb3.Sb3VecEnv EnvCopy env_copy ResetAhead StackImages TupleOfAgents",
    ),
    "rollouts": Group(
        "Rollouts for your own learner",
        "millrace collects rollouts, and a learner in any framework learns from them.",
        "RolloutService RolloutBatch Normalizer",
    ),
    "worker_policies": Group(
        "Policies that act in workers",
        "What `RolloutService` takes as its policy.",
        "MLP CNN Recurrent OwnPolicy PolicyParameters Piece",
    ),
    "algorithms": Group(
        "Algorithms",
        "What an algorithm of your own derives from. Importing `millrace.algorithms` imports PyTorch.",
        "algorithms.Algorithm algorithms.GradientDescent algorithms.ActorCritic algorithms.OffPolicy algorithms.Continuous "
        f"{' '.join(f'algorithms.{name}' for name in BUILT_IN)} "
        "testing.check_algorithm testing.AlgorithmMistakes",
    ),
    "algorithm_settings": Group(
        "Settings of algorithms",
        "The records to derive `Config` from. [Settings](../settings.md) lists what they hold.",
        "algorithms.AlgorithmConfig algorithms.ActorCriticConfig algorithms.OffPolicyConfig algorithms.ContinuousConfig "
        f"{' '.join(f'algorithms.{name}Config' for name in BUILT_IN)} "
        "algorithms.Free algorithms.Adaptable algorithms.Fixed",
    ),
    "algorithm_data": Group(
        "What algorithms learn from",
        "The arguments and results of an algorithm's methods.",
        "algorithms.Batch algorithms.LossInput algorithms.Observations algorithms.Estimates algorithms.Transitions "
        "algorithms.CriticLoss algorithms.PriorData algorithms.Start algorithms.UpdateMetrics "
        "algorithms.PolicySpec algorithms.ActionSpec algorithms.Leaf",
    ),
    "algorithm_tools": Group(
        "Tools of algorithms",
        "Networks, replay buffers, running statistics and functions that our algorithms use.",
        "algorithms.ActorCriticNetwork algorithms.QNetwork algorithms.ActorAndCritics algorithms.ReplayBuffer "
        "algorithms.Sample algorithms.MixedReplay algorithms.Hindsight algorithms.SequenceReplay "
        "algorithms.SequenceSample algorithms.Sequences algorithms.Encoder algorithms.RecurrentInput "
        "algorithms.ObservationNormalizer "
        "algorithms.RewardScaler algorithms.EpisodeEnds algorithms.gae algorithms.vtrace "
        "algorithms.log_prob_and_entropy algorithms.policy_log_prob algorithms.squashed_sample "
        "algorithms.trainable algorithms.features algorithms.normalize algorithms.random_shift "
        "algorithms.scheduled algorithms.check_finite algorithms.Purpose algorithms.torch_seed "
        "algorithms.UsageError",
    ),
    "errors": Group(
        "Errors",
        "Each message is one line that says what to do next.",
        "MillraceError UserFacingError UsageError RunError CheckpointError NoWorkers WorkerLost LearnerLost Stalled "
        "EnvironmentFailed PolicyFailed",
    ),
}
"""The groups, by the names of their pages"""
WITHOUT_MEMBERS = ("Config", *(f".{name}" for name in BUILT_IN))
"""Endings of names whose members are on another page, or are those of a base class"""
WITH_INHERITED_MEMBERS = {"millrace.Progress"}
"""Names whose base class isn't public"""


def pages() -> dict[str, Callable[[], str]]:
    """The function that makes each page, by the page's path in the site."""
    return {"reference/python.md": index} | {f"reference/python/{name}.md": partial(page, name) for name in GROUPS}


def index() -> str:
    """The page that lists all names. It has an anchor for each name, like the page that shows the name."""
    parts = [HEAD]
    for page, group in GROUPS.items():
        rows = [(anchored(name, f"[`{name}`](python/{page}.md#{name})"), about(name)) for name in names_of(group)]
        parts.append(f"## [{group.title}](python/{page}.md)\n\n{table(('name', 'what it is'), rows)}\n")
    return "".join(parts)


def page(name: str) -> str:
    """A group's page."""
    group = GROUPS[name]
    shown = (f"::: {each}\n{_options(each)}\n" for each in names_of(group))
    return f"# {group.title}\n\n{group.about}\n\n" + "".join(shown)


def _options(name: str) -> str:
    if name.endswith(WITHOUT_MEMBERS):
        return "    options: {members: false}\n"
    if name in WITH_INHERITED_MEMBERS:
        return "    options: {inherited_members: true}\n"
    return ""


def names_of(group: Group) -> list[str]:
    """A group's names, as full public names."""
    return [f"millrace.{name}" for name in group.names.split()]


def about(name: str) -> str:
    """The first sentence about a public name."""
    module, _, last = name.rpartition(".")
    found = getattr(import_module(module), last)
    if not inspect.isclass(found) and not inspect.isfunction(found):
        return "a name for a type"
    text = inspect.getdoc(found) or ""
    return " ".join(text.partition("\n\n")[0].split()).partition(". ")[0].removesuffix(".").replace("|", r"\|")


def anchors(page: str) -> set[str]:
    """The anchors that mkdocstrings makes on a page: the full name of each object."""
    group = GROUPS.get(page.removeprefix("reference/python/").removesuffix(".md"))
    return set() if group is None else set(names_of(group))
