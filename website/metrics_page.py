"""Makes reference/metrics.md: every number in metrics.jsonl, TensorBoard and Prometheus, from the code that logs it."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client.metrics_core import Metric

from benchmarks.markdown_tables import table
from millrace.extras.monitoring.metric_names import METRICS, label
from millrace.extras.monitoring.prometheus import MetricsCollector, Observed
from millrace.learner.config.config import Config
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import FactMean
from website.tables import anchored

HEAD = """# Metrics

What each number in a log means. `metrics.jsonl` in the [run folder](run_folder.md) has a row for each update;
`millrace.Run(path).metrics` reads it. TensorBoard shows the same numbers under the same names, and so do the
[W&B and MLflow callbacks](../how-to/callbacks.md#weights--biases). Names are those of Stable-Baselines3 where it has one.
A number that does not exist yet is missing or null. `ledger/…` and `stage/…` count from the beginning of the run.

In a name, NAME stands for a name that you chose.

"""
EVERY_NUMBER = Progress(return_mean=1.0, length_mean=1.0, facts={"NAME": FactMean(mean=1.0, missing=0)})
SAMPLE = Observed(1.0, EVERY_NUMBER, Ledger().counts())
"""A hub in which every metric has a value."""
PROMETHEUS = """## Prometheus

A learner with `--metrics-bind 127.0.0.1:9464` shows these at `http://127.0.0.1:9464/metrics`. Prometheus itself adds
`process_…` (memory and CPU of the learner).

"""


def page() -> str:
    """The page as Markdown."""
    parts = [HEAD]
    for title, names in METRICS.items():
        rows = ((anchored(name, f"`{name}`"), label(name), each.unit, each.text) for name, each in names.items())
        parts.append(f"## {title}\n\n{table(('name', 'in the dashboard', 'unit', 'meaning'), rows)}\n")
    shown = ((anchored(name, f"`{name}`"), kind, labels, text) for name, kind, labels, text in prometheus())
    return "".join([*parts, PROMETHEUS, table(("name", "type", "labels", "meaning"), shown)])


def prometheus() -> Iterator[tuple[str, str, str, str]]:
    """For each metric of a learner that trains: its name in Prometheus, its type, its labels and its text."""
    for metric in MetricsCollector(Config(env="CartPole-v1"), observed=SAMPLE).collect():
        labels = {label for sample in metric.samples for label in sample.labels} - {"le"}
        shown = "" if metric.type == "info" else ", ".join(f"`{label}`" for label in sorted(labels))
        yield _shown_name(metric), metric.type, shown or "–", metric.documentation


def _shown_name(metric: Metric) -> str:
    return metric.name + {"counter": "_total", "info": "_info"}.get(metric.type, "")
