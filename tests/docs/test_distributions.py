"""What `make dist` finds wrong with the files of a distribution, and that changelog and citation have the version."""

from __future__ import annotations

import re
import tomllib

import pytest

from tests.distributions import PACKAGES, ROOT, data_files, mistakes


def test_the_packages_have_data_that_must_travel() -> None:
    assert {*(f"{package}/py.typed" for package in PACKAGES), "millrace/learner/config/presets.toml"} <= data_files()


@pytest.mark.parametrize(
    "lost", ["millrace/py.typed", "millrace/learner/config/presets.toml", "millrace/workers/__init__.py"]
)
def test_a_file_that_is_missing_is_named(lost: str) -> None:
    whole = {*data_files(), *(f"{package}/__init__.py" for package in PACKAGES)}
    assert mistakes(whole, data_files()) == []
    assert mistakes(whole - {lost}, data_files()) == [f"{lost} is missing"]


def test_tests_in_a_distribution_are_named() -> None:
    whole = {*data_files(), *(f"{package}/__init__.py" for package in PACKAGES)}
    (line,) = mistakes({*whole, "tests/conftest.py", "tests/versions.py"}, data_files())
    assert line.startswith("tests/conftest.py: expected no tests")


def test_a_package_that_is_not_below_millrace_is_named() -> None:
    whole = {*data_files(), *(f"{package}/__init__.py" for package in PACKAGES)}
    assert mistakes({*whole, "learner/__init__.py"}, data_files()) == [
        "learner/__init__.py: expected it below millrace/ alone"
    ]


def version() -> str:
    found: str = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    return found


def test_the_citation_has_this_version() -> None:
    assert f"\nversion: {version()}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_changelog_has_this_version_below_what_is_unreleased() -> None:
    headings = re.findall(r"^## \[(.+?)\](.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == ("Unreleased", "")
    assert headings[1][0] == version()
    assert re.fullmatch(r" - \d{4}-\d{2}-\d{2}", headings[1][1])
