"""Mistakes in the source of the C++ client: `millrace conform` catches each, by a sentence that names the rule it breaks.

`test_conform.py` shows that the client without a mistake passes every check.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from millrace.extras.conformance.conform import ClientCommand, conform
from millrace.extras.conformance.learner import Settings
from millrace.extras.conformance.profiles import PROFILES
from millrace.extras.conformance.report import explanation
from millrace.protocol.env_spec import EnvSpec
from tests.clients.conftest import CPP
from tests.clients.cpp_mutants import MUTANTS, Mutant

FLAGS = ["-std=c++17", "-O0", "-ffp-contract=off", "-lzmq", "-lsodium", "-pthread"]
BUILD_S = 300  # of one mutant, on a busy machine


def mutated(mutant: Mutant, include: Path) -> None:
    """Make the mistake in this copy of the headers."""
    header = include / "millrace" / mutant.header
    text = header.read_text()
    assert text.count(mutant.old) == 1, (
        f"{mutant.header}: expected {mutant.old!r} once, found it {text.count(mutant.old)} times"
    )
    header.write_text(text.replace(mutant.old, mutant.new))


def build(mutant: Mutant, folder: Path) -> Path:
    """The client with this mistake."""
    include, program = folder / "include", folder / mutant.program
    shutil.copytree(CPP / "include", include)
    mutated(mutant, include)
    (source,) = CPP.glob(f"*/{mutant.program}.cpp")
    command = ["g++", "-I", str(include), str(source), "-o", str(program), *FLAGS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S)
    assert done.returncode == 0, done.stderr
    return program


def test_every_mutant_changes_one_place(tmp_path: Path) -> None:
    for number, mutant in enumerate(MUTANTS):
        mutated(mutant, Path(shutil.copytree(CPP / "include", tmp_path / str(number))))


@pytest.mark.clients
@pytest.mark.timeout(600)  # it waits for the compiler, on a busy machine
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: f"{mutant.name}, {mutant.profile}")
def test_the_report_names_the_rule_that_a_mutant_breaks(mutant: Mutant, compiler: None, tmp_path: Path) -> None:
    checks = [check for check in PROFILES[mutant.profile] if mutant.check in check.name]
    assert checks, mutant.check
    client = ClientCommand((str(build(mutant, tmp_path)), "{address}"))
    env = "CartPole-v1" if mutant.program == "cartpole" else f"{mutant.program.title()}-v0"
    results = conform(client, checks, Settings(EnvSpec(env), patience_s=3.0), 100.0, lambda result: None)
    failed = [each for each in results if each.outcome == "failed"]
    assert failed, f"{mutant.name} was not caught"
    assert failed[0].rule == mutant.rule, explanation(failed[0])
    assert mutant.got in failed[0].got, explanation(failed[0])
    assert mutant.rule.text in " ".join(" ".join(explanation(failed[0])).split())
