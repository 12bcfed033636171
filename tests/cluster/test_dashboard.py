"""The dashboard in a real browser: its curve grows while a run trains, and it asks nobody else for anything."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.cluster.chromium import Page
from tests.system.stage.processes import wait_for

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium (make packages)"),
]
WITHIN_S = 120.0
MILLRACE = (sys.executable, "-m", "millrace")
TRAIN = ("train", "CartPole-v1", "--steps", "100000000", "--workers", "1", "--rollout-steps", "32", "--eval-every", "0")
POINTS = "(document.querySelector('#curve path.line')?.getAttribute('d') ?? '').split('L').length"


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """The first page of a dashboard beside a run that trains."""
    with (
        (tmp_path / "log").open("w+") as log,
        subprocess.Popen([*MILLRACE, *TRAIN], cwd=tmp_path, stdout=log, stderr=log) as learner,
        subprocess.Popen([*MILLRACE, "dashboard"], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as dashboard,
    ):
        try:
            assert dashboard.stdout is not None
            found = re.search(r"http://\S+", dashboard.stdout.readline())
            assert found is not None
            yield found[0]
        finally:
            for process in (dashboard, learner):
                process.send_signal(signal.SIGINT)
                process.wait(timeout=WITHIN_S)


def test_a_curve_grows_and_no_other_host_is_asked(address: str) -> None:
    with Page() as page:
        page.ask("Page.navigate", url=address)
        run = "document.querySelector('table.all a')?.href"
        wait_for(lambda: page.value(run) is not None, WITHIN_S, lambda: "the run appears in the list")
        page.ask("Page.navigate", url=page.value(run))
        wait_for(lambda: page.value(POINTS) > 5, WITHIN_S, lambda: "a curve")
        page.value(
            "document.querySelector('details').open = true; scrollTo(0, 100); document.querySelector('select').focus()"
        )
        before = page.value(POINTS)
        wait_for(lambda: page.value(POINTS) > before, WITHIN_S, lambda: "the curve grows")
        wait_for(lambda: page.value("document.querySelectorAll('#lanes svg.bar').length") > 1, WITHIN_S, lambda: "lanes")
        assert page.value("[document.querySelector('details').open, scrollY, document.activeElement.name]") == [
            True,
            100,
            "metric",
        ], "what the reader opened, scrolled to and chose stays"
        assert "training" in page.value("document.querySelector('.now').className")
        assert page.value("document.body.className") == ""
        assert page.errors == []
        assert {urlsplit(url).netloc for url in page.requests} == {urlsplit(address).netloc}
