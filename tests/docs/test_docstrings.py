"""Every public name of millrace, and every public method of its classes, has an example in its docstring, and it works.

Rule: an example is in doctest's style. It finds `run`, the folder of a run that has ended, and otherwise what the blocks
of a page find (`surroundings.py`). It shares this process with the others, because each would take seconds to start.
"""

import doctest
import inspect
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import millrace
from tests.docs.surroundings import missing_extra, variables
from tests.support.variants import variants

SMALL: dict[str, Any] = {
    "envs": 2, "lanes": 1, "rollout_steps": 16, "n_epochs": 1, "eval_episodes": 2, "workers": 1, "transport": "inproc",
}  # fmt: skip
OF_A_PLAN = ("plan", "RunPlan")
"""Names whose example measures an environment for some seconds, as the whole run of `millrace plan` does."""
CLASSES_WITH_METHODS = ("LoadedPolicy", "PolicyParameters", "RolloutService", "Run")
"""Classes whose objects a user calls. The methods of the others are called by millrace."""


def documented() -> Iterator[tuple[str, str]]:
    """The public names, and the docstring of each. `__version__` is a text: the docstring of millrace shows it."""
    for name in millrace.__all__:
        found = getattr(millrace, name)
        yield name, inspect.cleandoc((millrace.__doc__ if name == "__version__" else found.__doc__) or "")
        if name in CLASSES_WITH_METHODS:
            for method, value in vars(found).items():
                if method == "__call__" or not method.startswith("_"):
                    yield f"{name}.{method}", inspect.cleandoc(value.__doc__ or "")


DOCSTRINGS = dict(documented())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small run that has ended. Do not write into it."""
    folder = tmp_path_factory.mktemp("runs")
    return millrace.train("CartPole-v1", seed=1, steps=64, run_dir=str(folder), progress=False, **SMALL).path


@pytest.mark.parametrize("name", variants(DOCSTRINGS, default=DOCSTRINGS.keys() - set(OF_A_PLAN)))
def test_its_example_works(name: str, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for variable, value in variables(tmp_path).items():
        monkeypatch.setenv(variable, value)
    run = shutil.copytree(trained, tmp_path / "runs" / "a-run")
    # `__main__`: what a script defines is sent to workers by value.
    test = doctest.DocTestParser().get_doctest(DOCSTRINGS[name], {"run": run, "__name__": "__main__"}, name, None, None)
    assert test.examples, f"{name} has no example in its docstring"
    if name == "__version__":
        assert any("__version__" in example.source for example in test.examples)
    said: list[str] = []
    doctest.DocTestRunner().run(test, out=said.append)
    if extra := missing_extra("".join(said)):
        pytest.skip(f"{name} needs {extra}")
    assert not said, "".join(said)


def test_the_examples_of_a_name_mention_it() -> None:
    parser = doctest.DocTestParser()
    for name, text in DOCSTRINGS.items():
        last = name.rpartition(".")[2].removeprefix("__call__")
        assert last in "".join(one.source + (one.exc_msg or "") for one in parser.get_examples(text)), name
