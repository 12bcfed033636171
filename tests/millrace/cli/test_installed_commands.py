"""Commands that other packages install, and the extra of the manual: a callback with a command."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from millrace.cli.commands import COMMANDS, GROUP
from millrace.cli.main import main
from tests.docs.pages import blocks
from tests.support.installed_package import install_package
from tests.test_architecture import ROOT

Install = Callable[[str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs a package with this module, and these entry points of our group."""

    def installed(source: str, entry_points: str) -> None:
        install_package(tmp_path, monkeypatch, module="fake_extra", source=source, group=GROUP, entry_points=entry_points)

    yield installed
    sys.modules.pop("fake_extra", None)


def test_it_is_listed_without_an_import_and_runs(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("def run(argv):\n    print('ran', argv)\n    return 3\n", "csv = fake_extra:run")
    assert main(["--help"]) == 0
    assert re.search(r"^From other packages:\n  millrace csv … +from fake-extra$", capsys.readouterr().out, re.MULTILINE)
    assert "fake_extra" not in sys.modules
    assert main(["csv", "a", "--b"]) == 3
    assert capsys.readouterr().out == "ran ['a', '--b']\n"


def test_for_ours_no_entry_point_is_read(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delattr(metadata, "entry_points")
    assert main(["presets"]) == 0
    assert "millrace train" in capsys.readouterr().out


def test_none_can_take_the_place_of_ours(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("raise AssertionError\n", "presets = fake_extra:run")
    assert main(["presets"]) == 0
    assert main(["--help"]) == 0
    assert "From other packages" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("import no_such_module\n", "command csv from fake-extra: the import of fake_extra failed: ModuleNotFoundError"),
        ("", "command csv from fake-extra: module fake_extra has no run"),
        ("def run(argv):\n    raise KeyError('x')\n", "command csv from fake-extra failed: KeyError"),
        ("import millrace\ndef run(argv):\n    raise millrace.UsageError('csv: no run')\n", "csv: no run"),
    ],
)
def test_what_is_wrong_with_it_is_one_line_that_names_its_package(
    install: Install, capsys: pytest.CaptureFixture[str], source: str, says: str
) -> None:
    install(source, "csv = fake_extra:run")
    assert main(["csv"]) == 2
    first, *_ = capsys.readouterr().err.splitlines()
    assert first.startswith(f"millrace: {says}")


def test_a_name_like_that_of_an_installed_one_is_suggested(install: Install, capsys: pytest.CaptureFixture[str]) -> None:
    install("", "returns = fake_extra:run")
    assert main(["return"]) == 2
    assert capsys.readouterr().err == "millrace: unknown command return; did you mean returns?\n"
    assert "returns" not in COMMANDS


def test_the_manual_s_command_runs(install: Install, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = (ROOT / "docs" / "how-to" / "extras.md").read_text(encoding="utf-8")
    first = next(block for block in blocks(page) if block.text.startswith("# returns_csv.py"))
    install(first.text, "csv = fake_extra:run")
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["csv", "--help"])
    assert "Write the evaluations of each run to returns.csv" in capsys.readouterr().out
    assert main(["csv", str(tmp_path / "nowhere")]) == 2
    assert "nowhere" in capsys.readouterr().err
