"""The settings of `--resume auto`, which continues the newest run with these settings, or starts a new run.

Rule: settings from the file, and from flags or keyword arguments, override those in the run's config.toml. An edited value
therefore takes effect, and a change that a resumed run can't make is refused wherever it comes from. A setting that is no
longer given keeps the run's value, because config.toml doesn't say where its values came from. The file is read once,
because it may be a pipe.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from millrace.learner.config.config import Config
from millrace.learner.config.layers import LowerLayers, layers_of_run
from millrace.learner.run_folder.newest_run import newest_run


def settings_with_newest_run(lower: LowerLayers, above: Callable[[LowerLayers], Config]) -> tuple[Config, Path | None]:
    """The settings, and the run to resume; None instead of a run if a new one must begin.

    `lower` are the lower layers of a new run. `above` merges the given lower layers with the flags or keyword arguments.
    Raises `UsageError` if a setting or a file is not valid.
    """
    config = above(lower)
    run = newest_run(config)
    if run is None:
        return config, None
    return above(layers_of_run(run, lower.algo)._replace(over_run=lower.file)), run
