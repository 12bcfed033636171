"""The help of `millrace train`: every setting is in one group and has a text, and the choices are named."""

import re

import msgspec
import pytest

from millrace.flags.field_texts import field_texts
from millrace.learner.config.command_line import BASIC, GROUPS, RunFlags, read_config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS


def help_text(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    with pytest.raises(SystemExit) as stop:
        read_config("train", [*argv, "--help"])
    assert not stop.value.code
    return capsys.readouterr().out


def flags_in(text: str) -> list[str]:
    return re.findall(r"^  (?:--from, )?(?:--|\[)([\w-]+)", text, re.M)


def test_every_setting_is_in_one_group() -> None:
    grouped = [*BASIC, *(name for names in GROUPS.values() for name in names), "algorithm"]
    assert sorted(grouped) == sorted(RunFlags.__struct_fields__)


@pytest.mark.parametrize("record", [RunFlags, *HYPERPARAMETERS.values()])
def test_every_setting_has_a_text_in_sentences(record: type[msgspec.Struct]) -> None:
    texts = field_texts(record)
    assert texts.keys() == set(record.__struct_fields__)
    for name, text in texts.items():
        assert text[-1] in ".)" or name == "env_kwargs", name


@pytest.mark.parametrize(
    ("algo", "columns"),
    [
        *(("ppo", columns) for columns in ("60", "80", "100", "140", "300")),
        *((algo, "80") for algo in HYPERPARAMETERS if algo != "ppo"),
    ],
)
def test_groups_stand_below_each_other_the_basic_one_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, algo: str, columns: str
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    text = help_text(capsys, "--algo", algo)
    titles = re.findall(r"^(\w[\w ]*):$", text, re.M)
    assert titles == ["arguments", "basics", algo, *GROUPS]
    settings = [name.replace("-", "_") for name in flags_in(text)]
    algorithm = list(field_texts(HYPERPARAMETERS[algo]))
    assert settings == ["ENV", *BASIC[1:], *algorithm, *(name for names in GROUPS.values() for name in names)]
    assert max(map(len, text.splitlines())) <= min(max(int(columns), 80), 120)


def test_the_algorithms_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    text = "".join(help_text(capsys).split())  # they go on in a second line
    assert "--algo{ppo,a2c,dqn,rainbow,impala,reinforce,sac,td3,tqc,crossq,xqc}" in text


def test_a_setting_that_may_be_none_is_written_so_on_the_command_line_and_in_a_file() -> None:
    flags = ["CartPole-v1", "--core", "none", "--clip-range-vf", "none", "--torch_threads", "none", "--action-masks", "none"]
    config, _ = read_config("train", flags)
    expected = msgspec.structs.replace(read_config("train", ["CartPole-v1"])[0], action_masks="none")
    assert config == expected
    assert read_config("train", ["CartPole-v1", "--core", "None", "--action-masks", "none"])[0] == config
    signs = ["CartPole-v1", "--core=none", "--clip-range-vf=none", "--torch_threads=none", "--action-masks=none"]
    assert read_config("train", signs)[0] == config
