"""What tells which run a folder holds: without run.json it holds none, a newer format is rejected, nothing is imported."""

import errno
import json
import site
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from millrace.extras.monitoring.report.page import write_page
from millrace.extras.monitoring.report.picture import draw
from millrace.learner.config.command_line import read_config
from millrace.learner.config.layers import config_of_run, resolve
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.run_format import CONFIG_FILE, RUN_FILE, RUN_FORMAT, check_format, parse_toml
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import RunError, UsageError
from millrace.protocol.own_module import refuse_modules_in
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.specs import PolicySpec
from tests.support.in_process.saved_policies import load_policy, policy_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with a policy and two rows of metrics."""
    folder = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path)))
    env = EnvSpec("CartPole-v1")
    made = env.make()
    spec = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space), net=(4,))
    folder.write_policy(policy_run(spec, env), np.zeros(acting_size(spec), np.float32), np.zeros(0, np.float32))
    log = MetricsLog(folder.path)
    for steps in (100, 200):
        log.write(Progress(env_steps=steps, return_mean=1.0), {})
    log.close()
    return folder.path


READERS: list[Callable[[Path], object]] = [
    load_policy,
    lambda run: draw([run]),
    lambda run: write_page([run], run / "report.html"),
    lambda run: read_config("train", ["--resume", str(run)]),
    lambda run: resolve(resume=run),
]


def test_a_new_folder_carries_the_format_and_the_version_that_wrote_it(run: Path) -> None:
    written = json.loads((run / RUN_FILE).read_text())
    assert written["format"] == RUN_FORMAT == check_format(run).format
    assert written.keys() == {"format", "millrace", "workers_elsewhere", "started_from", "callbacks"}


@pytest.mark.parametrize("read", READERS[1:])
def test_a_folder_without_a_format_is_no_run_folder(run: Path, read: Callable[[Path], object]) -> None:
    (run / RUN_FILE).unlink()
    with pytest.raises(UsageError, match=r"expected a run folder, got one without run\.json"):
        read(run)
    assert load_policy(run)[2].id == "CartPole-v1", "the files of the policy are enough to act"


@pytest.mark.parametrize(("found_from", "module"), [("", "run.evil"), ("", "run"), ("", "run.package.evil")])
@pytest.mark.parametrize("named", ["env", "module as env", "wrappers", "algo", "callbacks"])
def test_a_module_in_a_run_folder_is_not_imported(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str, found_from: str, module: str
) -> None:
    """Whatever of the search path leads there, and whatever names it."""
    run = run.rename(tmp_path / "run")
    (run / "package").mkdir()
    for folder in (run, run / "package"):
        for file in ("evil.py", "evil_v0.py"):
            (folder / file).write_text("raise AssertionError('it was imported')")
    monkeypatch.syspath_prepend(str(tmp_path / found_from))
    name = f"{module}:Evil"
    if named == "module as env":  # `make_env` imports a module of PettingZoo's form without a colon
        named, name = "env", f"{module}_v0" if "." in module else f"{module}.evil_v0"
    text = (run / "config.toml").read_text()
    given = {"env": "CartPole-v1", "algo": "ppo", "wrappers": [], "callbacks": []} | {named: name}
    for key, old in {"env": '"CartPole-v1"', "algo": '"ppo"', "wrappers": "[]", "callbacks": "[]"}.items():
        new = json.dumps([given[key]] if old == "[]" and given[key] else given[key])
        assert text.count(f"\n{key} = {old}\n") == 1
        text = text.replace(f"\n{key} = {old}\n", f"\n{key} = {new}\n")
    (run / "config.toml").write_text(text)
    readers: list[Callable[[Path], object]] = [
        config_of_run,
        lambda run: resolve(resume=run),
        lambda run: write_page([run], run / "report.html"),
    ]
    if named in ("env", "wrappers"):
        card = json.loads((run / "policy.json").read_text())
        (run / "policy.json").write_text(json.dumps(card | ({"env": name} if named == "env" else {"wrappers": [name]})))
        readers.append(load_policy)
    for read in readers:
        with pytest.raises(UsageError, match=f"{name} would be imported from the run folder, which is refused"):
            read(run)


@pytest.mark.parametrize("found_from", ["run", "run/package", "link", "run/zipped.zip", "."])
@pytest.mark.parametrize("read", [config_of_run, load_policy])
def test_nothing_is_found_in_a_run_folder_that_is_on_the_search_path(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    found_from: str,
    read: Callable[[Path], object],
) -> None:
    """Not even by those who import what no setting names: a namespace's registrar, and the plugins of packages."""
    run = run.rename(tmp_path / "run")
    (tmp_path / "link").symlink_to(run)
    (run / "package").mkdir()
    monkeypatch.chdir(run)
    entry = "" if found_from == "." else str(tmp_path / found_from)
    monkeypatch.setattr(sys, "path", [entry, *sys.path, str(tmp_path)])
    expected = sys.path[1:]
    read(run)
    assert sys.path == expected
    removed = (run if entry == "" else Path(entry)).resolve()
    assert [each.message for each in caplog.records] == [
        f"run {run}: nothing is imported from a run folder, so {removed} is taken off the search path"
    ]


@pytest.mark.parametrize("prefix", ["prefix", "exec_prefix", "base_prefix", "base_exec_prefix", "user"])
def test_the_libraries_of_a_python_that_is_installed_in_a_run_folder_stay_on_the_search_path(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, prefix: str
) -> None:
    """For example, a policy that is saved in the folder of a project."""
    (tmp_path / "link").symlink_to(run)
    if prefix == "user":
        monkeypatch.setattr(site, "ENABLE_USER_SITE", True)
        monkeypatch.setattr(site, "USER_BASE", str(tmp_path / "link" / ".venv"))
    else:
        monkeypatch.setattr(sys, prefix, str(tmp_path / "link" / ".venv"))
    libraries = [str(run / ".venv" / "lib" / each) for each in ("python311.zip", "python3.11", "python3.11/site-packages")]
    others = [str(run / each) for each in ("", "src", ".venv", ".venv2/lib")]
    monkeypatch.setattr(sys, "path", [others[0], *libraries, *others, *sys.path])
    expected = [*libraries, *sys.path[8:]]
    load_policy(run)
    assert sys.path == expected
    assert len(caplog.records) == 5


def test_a_run_folder_inside_a_python_s_installation_is_not_searched(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a container, Python may be installed in /usr, and the run folder may be below it."""
    monkeypatch.setattr(sys, "prefix", str(run.parent))
    monkeypatch.setattr(sys, "path", [str(run), str(run / "package"), *sys.path])
    expected = sys.path[2:]
    load_policy(run)
    assert sys.path == expected


def test_a_module_beside_a_run_folder_is_the_user_s_own(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run.parent / "mine.py").write_text("")
    monkeypatch.syspath_prepend(str(run.parent))
    refuse_modules_in(run, ["mine:Env-v0", "gymnasium.wrappers:FlattenObservation", "CartPole-v1", "ALE/Pong-v5", ":", ""])


@pytest.mark.parametrize("read", READERS)
def test_a_folder_of_a_newer_format_is_rejected_with_advice(run: Path, read: Callable[[Path], object]) -> None:
    (run / RUN_FILE).write_text(json.dumps({"format": RUN_FORMAT + 1, "millrace": "9.9", "and": "more"}))
    with (run / "config.toml").open("a") as config:
        config.write("a_setting_of_the_future = 1\n")
    with pytest.raises(UsageError) as caught:
        read(run)
    assert str(caught.value) == (
        f"run {run}: its format is {RUN_FORMAT + 1}, and this millrace reads formats up to {RUN_FORMAT}; "
        "install the millrace that wrote it (9.9) or a newer one"
    )


def test_a_damaged_format_is_said_in_one_line(run: Path) -> None:
    (run / RUN_FILE).write_text("{")
    with pytest.raises(UsageError, match=r"run\.json cannot be read: Input data was truncated"):
        RunFolder.open(run)


def test_settings_that_would_take_minutes_to_read_are_refused(run: Path) -> None:
    nested = f"[{'.'.join(['a'] * 4_000)}]\n" + "".join(f"k{i} = 1\n" for i in range(1_000))
    for settings, why in (
        (nested, "has tables in tables in tables"),
        (".".join(["a"] * 8_000) + " = 1\n", "has tables in tables in tables"),
        ("".join(f"a{n}{'.a' * 330} = 1\n" for n in range(180)), "has tables in tables in tables"),
        (f"[{'.'.join(['a'] * 1_826)}]\n" + "".join(f"b{n}{'.b' * 107} = 1\n" for n in range(546)), "has tables in tables"),
        ('x = {a = """\n""", b' + ".b" * 8_000 + ' = "x"}\n', "has tables in tables in tables"),
        ('x = {a = """""""", b' + ".b" * 8_000 + ' = "x"}\n', "has tables in tables in tables"),
        ("1.1" + ".1" * 8_000 + " = 1\n", "has tables in tables in tables"),
        ("[" + '"".' * 8_000 + '""]\n', "has tables in tables in tables"),
        ('"' + '\\"' * 130_000, "is not TOML"),
        ('"""' + '\\"""' * 65_000 + "\\", "is not TOML"),
        ("x = 1\n" * 100_000, "expected at most 262,144 bytes"),
    ):
        (run / CONFIG_FILE).write_text(settings)
        with pytest.raises(UsageError, match=why):
            config_of_run(run)


def test_settings_with_many_dots_are_read() -> None:
    assert parse_toml("\n".join([f"x = [{', '.join(['0.25'] * 2_000)}]", *["# ..."] * 300]), "x")["x"] == [0.25] * 2_000


@pytest.mark.parametrize(
    "value",
    ["0.25 " * 3_300, "# a.b " * 3_000, 'a"b\\.' * 3_000, "it's 0.5\n" * 3_000, [0.25, -1.5e-3] * 1_000],
    ids=["numbers", "comments", "escapes", "lines", "list"],
)
def test_settings_with_many_dots_in_values_are_read(value: object) -> None:
    table = {"x": value, "table": {"y": value}}
    assert parse_toml(tomli_w.dumps(table), "x") == table
    assert parse_toml(tomli_w.dumps(table, multiline_strings=True), "x") == table


def test_settings_that_no_resume_could_read_are_refused_before_training(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"settings: no resume could read them: .*expected at most 262,144 bytes"):
        RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path / "runs"), env_kwargs={"a": "x" * 300_000}))
    assert not (tmp_path / "runs").exists()


def test_a_resumed_folder_gets_the_current_format(run: Path) -> None:
    (run / RUN_FILE).write_text('{"format": 1, "millrace": "0.1"}')
    folder = RunFolder.open(run)
    folder.write_config(config_of_run(run))
    assert check_format(run).format == RUN_FORMAT


def test_a_folder_that_is_made_again_knows_where_its_workers_were_started(run: Path) -> None:
    folder, config = RunFolder.open(run), config_of_run(run)
    folder.write_config(config, workers_elsewhere=True)
    (run / "config.toml").unlink()
    assert folder.make_again(config) == f"{run / 'config.toml'} was deleted; it is written again"
    assert check_format(run).workers_elsewhere


def test_a_folder_that_the_system_does_not_show_is_not_gone(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after `chmod 000`, or with a network file system whose ticket has expired: a line, which costs no training."""
    folder = RunFolder.open(run)

    def refuse(path: Path, **_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "stat", refuse)
    with pytest.raises(RunError, match=f"run folder {run} cannot be read: Permission denied"):
        folder.is_gone()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("seed = inf", "seed"), ("seed = 1.5", "seed"), (f"seed = {'1' * 5000}", "is not TOML"),
        (f"seed = 0x{'1' * 5000}", "is not TOML"), ("env = 1", "env"),
        ("algo = []", "algo"), ("env_kwargs = 3", "env_kwargs"), (f"deep = {'[' * 2000}{']' * 2000}", "is not TOML"),
    ],
)  # fmt: skip
def test_settings_of_the_wrong_kind_are_one_line_for_every_reader(run: Path, wrong: str, said: str) -> None:
    text = (run / "config.toml").read_text()
    name = wrong.partition(" = ")[0]
    kept = [line for line in text.splitlines() if not line.startswith((f"{name} =", f"[{name}"))]
    (run / "config.toml").write_text("\n".join([kept[0], wrong, *kept[1:]]) + "\n")
    for read in READERS[1:]:
        with pytest.raises(UsageError, match=rf"config\.toml.*{said}"):
            read(run)
