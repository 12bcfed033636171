"""millrace: worker processes step a gymnasium environment, one PyTorch learner learns. User code imports this alone.

import millrace
run = millrace.train("CartPole-v1", seed=1)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from learner.metrics import Progress

__all__ = ["__version__", "train"]


def train(
    env: str | Callable[..., object] = "",
    *,
    config: str | Path | None = None,
    resume: str | Path | None = None,
    preset: str = "auto",
    watch: Callable[[Progress], None] | None = None,
    **keywords: Any,
) -> Path:
    """Train on this machine; the run folder.

    `env` is anything `gymnasium.make` takes, or a callable that returns an environment. `config` is a TOML file, `resume` a
    run folder to go on with. Every flag of `millrace train` is a keyword argument of the same name: `learning_rate=1e-3`.
    `watch` is called after each update. Guard the call with `if __name__ == "__main__":` in a script. Raises `OurError`.
    """
    from learner.config import resolve
    from millrace.launch import local

    name = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
    file, run = (None if path is None else Path(path) for path in (config, resume))
    settings = resolve(name, file=file, resume=run, preset=preset, **keywords)
    return local.train(settings, run, watch or (lambda progress: None), factory=None if isinstance(env, str) else env)


def __getattr__(name: str) -> str:
    """`__version__`, looked up when it is asked for: that costs more than the rest of this file."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import metadata

    try:
        return metadata.version("millrace")
    except metadata.PackageNotFoundError:
        return "0+uninstalled"
