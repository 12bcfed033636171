"""Every command, flag, file, exit code and metric that a page names exists.

In the two pages about the code, every file exists that is named without its folder, and every name between backticks.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pkgutil import resolve_name

import gymnasium
import pytest

from millrace.cli.commands import COMMANDS
from millrace.extras.monitoring.metric_names import METRICS
from tests.docs import pages
from tests.docs.commands import all_flags, mistake, shown_in
from website.metrics_page import prometheus
from website.pages import ROOT

FLAGS_OF_OTHERS = {
    "--build", "--scale", "--constraint", "--editable", "--gpus", "--rm", "--network", "--no-deps", "--processes",
    "--without-pip", "--runs", "--minutes", "--rounds", "--peers", "--seconds", "--numprocesses", "--quick", "--account",
    "--mem-per-cpu", "--gres", "--requeue", "--save", "--layer",
}  # fmt: skip
"""Flags of pip, pytest, Docker, Slurm, the examples and the benchmarks that pages name"""
NAMES_OF_OTHERS = "docs/how-to/moving_from"
"""Pages that set flags of other libraries beside ours"""
OWN_METRICS = {"is_success", "distance", "is_success_missing", "success", "NAME"}
"""Names that examples choose for numbers of their own"""
EXIT_CODES = {0, 1, 2, 75, 130, 137, 143}
FILE = re.compile(r"^(?:learner|workers|protocol|millrace|tests|docs|examples|benchmarks|docker|website)/[\w./-]*[\w/]$")
ENVIRONMENT = re.compile(r"-v\d+$")
MADE_BY_COMMANDS = {"benchmarks/results", "benchmarks/results/", "benchmarks/peers/envs"}
COMMANDS_OF_EXTRAS = {"csv": "docs/how-to/extras.md writes it"}
MODULE = re.compile(r"^python3? -m (\w[\w.]*)")
OBJECT = re.compile(r"\b(millrace(?:\.\w+)+):(\w[\w-]*)")
PUBLIC_NAME = re.compile(r"^millrace(?:\.\w+)+")
NO_MODULES = {"millrace.commands", "millrace.copies", "millrace.run"}
"""Groups of entry points, and a tag of MLflow"""
EXIT_CODE = re.compile(r"exit codes? (\d+)|exits? with (?:code )?(\d+)\b")
ABOUT_THE_CODE = ("CONTRIBUTING.md", "docs/explanation/architecture.md")
FILE_OR_FOLDER = re.compile(r"[\w./-]+\.(?:py|md|toml|txt|yml|yaml|cff)|[\w./-]+/|[\w-]+(?:/[\w-]+)+")
NAME = re.compile(r"[A-Za-z]\w*")
MADE_BY_MAKE = {"site/", "dist/"}
PICTURES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs" / "images").glob("*.svg"))
TEXT_IN_A_PICTURE = re.compile(r">([^<>]+)<")
METRIC = re.compile(r"^(rollout|eval|time|lag|drop|ledger|stage|train|replay)/\w+$")
PROMETHEUS = re.compile(r"^millrace_[a-z_]+$")


def wrong_commands(path: str, text: str) -> Iterator[str]:
    """Commands in blocks that their own parser refuses."""
    for block in pages.blocks(text):
        for shown in shown_in(block):
            if shown.words and (complaint := mistake(shown.words)):
                yield f"{path}:{shown.line}: millrace {' '.join(shown.words)}: {complaint}"


def is_there(module: str, name: str) -> bool:
    """Does a module have this class or function, or register this environment?"""
    try:
        return hasattr(import_module(module), name) or name in gymnasium.registry
    except ModuleNotFoundError:
        return False


def resolves(name: str) -> bool:
    """Is there a module, class, function or attribute of this name?"""
    try:
        resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def wrong_names(path: str, text: str, flags: set[str]) -> Iterator[str]:
    """Names between backticks that do not exist."""
    metrics = {name for group in METRICS.values() for name in group}
    of_prometheus = {name for name, *_ in prometheus()}
    for line, code in pages.code_spans(text):
        words = code.split()
        if (
            words[0] == "millrace"
            and len(words) > 1
            and words[1].isalpha()
            and words[1].islower()
            and words[1] not in COMMANDS | COMMANDS_OF_EXTRAS
        ):
            yield f"{path}:{line}: {code}: no such command"
        about_others = path.startswith(NAMES_OF_OTHERS) and words[0] != "millrace"
        if (words[0] == "millrace" and words[1:2] != ["bench"]) or (words[0].startswith("--") and not about_others):
            for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", code):
                if flag not in flags | FLAGS_OF_OTHERS:
                    yield f"{path}:{line}: {code}: no such flag: {flag}"
        if FILE.match(code) and code not in MADE_BY_COMMANDS and not ENVIRONMENT.search(code) and not (ROOT / code).exists():
            yield f"{path}:{line}: there is no file {code}"
        if (module := MODULE.match(code)) and module[1].startswith(("benchmarks.", "tests.", "millrace.")):
            file = ROOT / module[1].replace(".", "/")
            if not (file.with_suffix(".py").is_file() or (file / "__main__.py").is_file()):
                yield f"{path}:{line}: there is no module {module[1]}"
        for where, name in OBJECT.findall(code):
            if not is_there(where, name):
                yield f"{path}:{line}: there is no {where}:{name}"
        if (dotted := PUBLIC_NAME.match(code)) and dotted[0] not in NO_MODULES and not resolves(dotted[0]):
            yield f"{path}:{line}: there is no {dotted[0]}"
        if METRIC.match(code) and code not in metrics and code.partition("/")[2] not in OWN_METRICS:
            yield f"{path}:{line}: there is no metric {code}"
        if PROMETHEUS.match(code) and not any(name.startswith(code) for name in of_prometheus):
            yield f"{path}:{line}: there is no metric {code}"
    for match in EXIT_CODE.finditer(text):
        if (number := int(match[1] or match[2])) not in EXIT_CODES:
            yield f"{path}:{text.count(chr(10), 0, match.start()) + 1}: there is no exit code {number}"


@cache
def files() -> tuple[str, ...]:
    """The paths of the repository's files, new ones too. Those of the parts of millrace are at the top, not behind links."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return tuple(path for path in listed if (ROOT / path).exists())


@cache
def words_of_the_code() -> frozenset[str]:
    """Every word in the product, the tests and the settings of their tools."""
    texts = [(ROOT / path).read_text() for path in files() if path.endswith((".py", ".toml")) or path == "Makefile"]
    return frozenset(re.findall(r"\w+", "\n".join(texts)))


def is_in_the_repository(named: str) -> bool:
    """Whether there is a file or folder whose path is this, or ends so."""
    end = f"/{named.rstrip('/')}"
    return any(f"/{path}".endswith(end) or f"{end}/" in f"/{path}" for path in files())


def wrong_names_of_the_code(text: str) -> Iterator[str]:
    """Files, folders and names between backticks that are not in the repository."""
    for line, code in pages.code_spans(text):
        if FILE_OR_FOLDER.fullmatch(code):
            if code not in MADE_BY_MAKE and not is_in_the_repository(code):
                yield f"line {line}: there is no {code}"
        elif NAME.fullmatch(code) and code not in words_of_the_code():
            yield f"line {line}: nothing is called {code}"


@pytest.fixture(scope="module")
def flags() -> set[str]:
    return all_flags()


@pytest.mark.parametrize("path", pages.manuals())
def test_its_commands_parse(path: str) -> None:
    wrong = list(wrong_commands(path, pages.manuals()[path]))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("path", pages.manuals())
def test_what_it_names_exists(path: str, flags: set[str]) -> None:
    wrong = list(wrong_names(path, pages.manuals()[path], flags))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("path", ABOUT_THE_CODE)
def test_a_page_about_the_code_names_what_is_there(path: str) -> None:
    wrong = list(wrong_names_of_the_code(pages.manuals()[path]))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("path", PICTURES)
def test_the_files_in_a_picture_exist(path: str) -> None:
    texts = TEXT_IN_A_PICTURE.findall((ROOT / path).read_text())
    assert not [text for text in texts if text.endswith(".py") and not (ROOT / text).is_file()]


def test_a_wrong_name_of_the_code_is_found() -> None:
    wrong = ("no_such_file.py", "replay/no_such.py", "learner/no_such", "no_such_folder/", "NoSuch" + "Class")
    for code in wrong:
        assert len(list(wrong_names_of_the_code(f"See `{code}`."))) == 1, code
    assert not list(wrong_names_of_the_code("`replay/`, `replay_buffer.py`, `tests/learner`, `ReplayBuffer`, `_s`, `a b`"))


@pytest.mark.parametrize(
    "line",
    [
        "millrace trian CartPole-v1",
        "millrace train CartPole-v1 --stepz 3",
        "millrace train CartPole-v1 --steps many",
        "millrace train CartPole-v1 --algo pp0",
        "millrace train CartPole-v1 --algo dqn --n-epochs 3",
        "millrace train CartPole-v1 \\\n  --stepz 3",
        "$ millrace learner CartPole-v1 --bnd tcp://0.0.0.0:5555",
        "(sleep 1; FOO=1 .venv/bin/millrace worker tcp://host:5555 --proceses 4) &",
        "millrace worker",
        "millrace keys make laptop",
        "millrace keys new laptop --sever x",
        "millrace status runs/x --wach",
        "millrace launch kubernetes CartPole-v1 --worker 4",
        "millrace launch slurm CartPole-v1 -- --stepz 3",
        "millrace launch moon CartPole-v1",
        "millrace evaluate runs/x --bets",
        "millrace record runs/x",
        "millrace plot runs/x --output y",
        "millrace bench everything",
        "millrace presets now",
        "millrace --hepl",
        "ls && millrace report runs/* --bst > x",
    ],
)
def test_a_wrong_command_is_found(line: str) -> None:
    assert len(list(wrong_commands("page.md", f"text\n\n```bash\n{line}\n```\n"))) == 1


def test_right_commands_are_not_called_wrong() -> None:
    text = """```bash
millrace train CartPole-v1 --algo dqn --steps 1000 --target-return none   # a comment with --stepz
millrace train CartPole-v1 --algo my_module:Mine --penalty 0.2 --env-kwargs a 1 --net 8 8
millrace train --config runs/x/config.toml
millrace learner CartPole-v1 --bind tcp://0.0.0.0:5555 --core lstm &
millrace worker tcp://host:5555 --token laptop.token --processes 4 | tee log
millrace keys new laptop; millrace keys show
millrace launch kubernetes CartPole-v1 --workers 4 -- --steps 1000 > k8s.yaml
millrace status runs/x --watch
millrace evaluate runs/x --video && millrace plot runs/* --out c.png
millrace train --help
echo "it's not shell
```
```python
millrace trian
```
"""
    assert not list(wrong_commands("page.md", text))


@pytest.mark.parametrize(
    "text",
    [
        "`--eval-evry 3`", "`millrace train --stepz`", "`millrace trian x`", "`learner/no_such.py`", "`docs/how-to/no.md`",
        "`--callbacks millrace.no_such:Callback`", "`millrace.policies:CMM`", "`millrace.trian(1)`",
        "`python -m benchmarks.no_such`", "`train/value_los`", "`stage/learner_sleep`", "`millrace_env_stepz`",
        "It ends with exit code 3.", "It exits with 4.",
    ],
)  # fmt: skip
def test_a_wrong_name_is_found(text: str, flags: set[str]) -> None:
    assert len(list(wrong_names("page.md", text, flags))) == 1


def test_right_names_are_not_called_wrong(flags: set[str]) -> None:
    text = (
        "`--eval-every 3`, `millrace train --steps 3`, `learner/train.py`, `tests/`, `python -m benchmarks.two_hosts`, "
        "`train/value_loss`, `rollout/is_success`, `millrace_env_steps_total`, exit code 130"
    )
    assert not list(wrong_names("page.md", text, flags))


def test_no_message_says_to_install_millrace_from_an_index() -> None:
    for folder in ("learner", "workers", "protocol", "millrace", "examples", "benchmarks", "website"):
        for file in (ROOT / folder).rglob("*.py"):
            assert not re.search(r"pip install '?millrace", file.read_text()), f"{file}: it is on no index"
