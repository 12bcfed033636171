"""The border between the core and the extras: the core imports no extra. An extra may import the core, never another extra.

`STILL` lists the places where the core does: they may only become fewer.
"""

from __future__ import annotations

from functools import cache

import pytest

from tests.test_architecture import PACKAGES, module, modules_imported, sources

STILL = {
    ("learner/between_updates/run_files.py", "monitoring"),
    ("learner/run_lines.py", "monitoring"),
    ("learner/run_setup.py", "monitoring"),
    ("millrace/__init__.py", "datasets"),  # the face: it names `record` for type checkers, and imports it when it is used
    ("millrace/__init__.py", "monitoring"),
    ("millrace/launch/learner_inference.py", "monitoring"),
    ("millrace/launch/training.py", "monitoring"),
    ("millrace/runs.py", "monitoring"),
}
FOLDER = "millrace/extras/"
ELSEWHERE = {  # files of an extra that do not yet stand in its folder
    "monitoring": (
        "learner/report/",
        "learner/metric_names.py",
        "learner/prometheus.py",
        "learner/run_folder/metrics_log.py",
        "millrace/dashboard/",
        "millrace/integrations/",
        "millrace/launch/page_beside.py",
        "millrace/cli/dashboard.py",
        "millrace/cli/look.py",
    ),
}


def extra_of(source: str) -> str | None:
    """The extra that a file belongs to; None if it belongs to the core."""
    if source.startswith(FOLDER):
        return source.removeprefix(FOLDER).split("/")[0].removesuffix(".py")
    return next((extra for extra, places in ELSEWHERE.items() if source.startswith(places)), None)


@pytest.mark.parametrize("extra", ELSEWHERE)
def test_the_files_of_an_extra_are_known(extra: str) -> None:
    """So that a file which has moved is not taken for one of the core."""
    for place in ELSEWHERE[extra]:
        assert any(source.startswith(place) for source in sources(*PACKAGES)), place


@cache
def extra_of_each_module() -> dict[str, str]:
    return {module(source): extra for source in sources(*PACKAGES) if (extra := extra_of(source)) is not None}


def extras_imported(source: str) -> set[str]:
    """The extras that a file imports anything of."""
    extras = extra_of_each_module()
    owners = {owner for name in modules_imported(source) for owner in (name, name.rpartition(".")[0])}
    return {extras[owner] for owner in owners & extras.keys()}


def test_the_core_imports_no_extra() -> None:
    crossings = {
        (source, extra) for source in sources(*PACKAGES) if extra_of(source) is None for extra in extras_imported(source)
    }
    assert crossings == STILL


def test_no_extra_imports_another() -> None:
    for source in sources(*PACKAGES):
        extra = extra_of(source)
        if extra is not None:
            assert extras_imported(source) <= {extra}, source
