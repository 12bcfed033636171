"""The dashboard in a real browser: what it shows of a run whose workers and learner fail, how soon, and to whom."""

from __future__ import annotations

import logging
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from millrace.extras.monitoring.dashboard.known_runs import key_of
from millrace.learner.run_folder.json_log import kept_log
from tests.cluster.chromium import Page
from tests.extras.monitoring.dashboard.test_site import HOSTILE, a_hostile_run
from tests.system.stage.preloaded import workers_of
from tests.system.stage.processes import WORKER_TIMEOUT_S, Learner, Stage, Worker, free_port, wait_for

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium (make packages)"),
]
WITHIN_S = 120.0
SHOWN_WITHIN_S = 2.0
WIDTH = 390  # of a phone
SETTINGS = {"env-kwargs": "seconds 0.01 k 3", "envs": 4, "lanes": 4, "min-workers": 2}
PAGES = ("all", "run", "hostile", "comparison")
USABLE = "a, button, select, input, summary"
POINTS = "(document.querySelector('#curve path.line')?.getAttribute('d') ?? '').split('L').length"
REACHED = """(() => {
  const at = document.activeElement, style = getComputedStyle(at);
  (window.reached ??= new Set()).add(at);
  return at === document.body || (style.outlineStyle !== 'none' && parseFloat(style.outlineWidth) >= 2);
})()"""
NOT_REACHED = f"""[...document.querySelectorAll('{USABLE}')].filter(each => each.checkVisibility() && !reached.has(each))
.map(each => each.outerHTML)"""


@dataclass
class Scene:
    """A run that trains on two workers, one that has ended and is hostile, and the addresses of their pages."""

    stage: Stage
    bind: str
    learner: Learner
    workers: dict[str, Worker]
    hostile: Path
    pages: dict[str, str]

    @property
    def run(self) -> Path:
        return self.learner.folder


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    with closing(Stage(tmp_path)) as stage:
        bind, ended = f"tcp://127.0.0.1:{free_port()}", tmp_path / "ended"
        hostile, learner = a_hostile_run(ended), stage.learner(bind, SETTINGS)
        workers = {name: stage.worker(bind, name) for name in ("killed", "frozen")}
        command = [sys.executable, "-m", "millrace", "dashboard", str(stage.runs), str(ended)]
        home = re.findall(r"http://\S+", stage.start(command, "dashboard").hears("http://"))[0]
        learner.trains()
        run, other = key_of(learner.folder), key_of(hostile)
        addresses = (home, f"{home}run/{run}", f"{home}run/{other}", f"{home}compare?run={run}&run={other}")
        yield Scene(stage, bind, learner, workers, hostile, dict(zip(PAGES, addresses, strict=True)))


@pytest.fixture
def page() -> Iterator[Page]:
    with Page() as made:
        yield made


def shown(page: Page, css: str) -> str:
    text: str = page.value(f"document.querySelector('{css}')?.innerText ?? ''")
    return text


def shows(page: Page, css: str, pattern: str, within_s: float = WITHIN_S) -> None:
    wait_for(lambda: re.search(pattern, shown(page, css)), within_s, lambda: f"{pattern!r} in {shown(page, css)!r}")


def test_a_curve_grows_and_what_the_reader_chose_stays(scene: Scene, page: Page) -> None:
    page.open(scene.pages["all"])
    page.open(page.value(f"document.querySelector('#run-{key_of(scene.run)} a').href"))
    wait_for(lambda: page.value(POINTS) > 5, WITHIN_S, "a curve")
    page.value("document.querySelector('details').open = true; scrollTo(0, 100); document.querySelector('select').focus()")
    before = page.value(POINTS)
    wait_for(lambda: page.value(POINTS) > before, WITHIN_S, "the curve grows")
    wait_for(lambda: page.value("document.querySelectorAll('#lanes svg.bar').length") > 1, WITHIN_S, "lanes")
    chosen = page.value("[document.querySelector('details').open, scrollY, document.activeElement.name]")
    assert chosen == [True, 100, "metric"]
    assert "training" in page.value("document.querySelector('.now').className")
    assert page.value("document.body.className") == ""


def test_a_killed_worker_shows_at_once_and_its_replacement_later(scene: Scene, page: Page) -> None:
    page.open(scene.pages["run"])
    supervisor = scene.workers["killed"].pid
    (worker,) = workers_of(supervisor)
    shows(page, "#workers", rf"killed\s+{worker.pid}\s")
    worker.kill()
    shows(page, "#history", "worker killed .*was killed by SIGKILL", SHOWN_WITHIN_S)
    wait_for(lambda: str(worker.pid) not in shown(page, "#workers"), SHOWN_WITHIN_S, "it is not in the table any more")
    (replacement,) = wait_for(lambda: workers_of(supervisor), WITHIN_S, "a replacement")
    shows(page, "#workers", rf"killed\s+{replacement.pid}\s.*\d, \d")


def test_a_frozen_worker_shows_within_its_timeout(scene: Scene, page: Page) -> None:
    page.open(scene.pages["run"])
    shows(page, "#workers", "frozen")
    scene.workers["frozen"].pause()
    shows(page, "#history", "worker frozen silent", WORKER_TIMEOUT_S + SHOWN_WITHIN_S)
    wait_for(lambda: "frozen" not in shown(page, "#workers"), SHOWN_WITHIN_S, "it is not in the table any more")
    scene.workers["frozen"].go_on()
    shows(page, "#workers", "frozen")


def test_a_page_says_that_the_learner_was_killed_and_goes_on_with_the_resumed_run(scene: Scene, page: Page) -> None:
    page.open(scene.pages["run"])
    page.value("window.same = true")
    scene.learner.kill()
    shows(page, ".now", "Dead: .* continue it with: .*millrace learner --resume", 2 * SHOWN_WITHIN_S)
    before = page.value(POINTS)
    scene.learner = scene.stage.learner(scene.bind, resume=scene.run)
    shows(page, ".now", "Training: ")
    wait_for(lambda: page.value(POINTS) > before, WITHIN_S, "the curve grows")
    assert page.value("window.same"), "it was not loaded again"


def test_hostile_text_is_text_and_no_other_host_is_asked(scene: Scene, page: Page) -> None:
    for name, address in scene.pages.items():
        page.open(address)
        if name == "hostile":
            with kept_log(scene.hostile):
                logging.getLogger("millrace.learner").warning("later %s", HOSTILE)
            shows(page, "#history", r"later .*alert\(1\)")
        assert ("alert(1)" in shown(page, "main")) == (name != "run"), name
        assert page.value("[document.scripts.length, document.querySelectorAll('[onerror]').length]") == [1, 0], name
        assert page.errors == [], name
    assert {urlsplit(url).netloc for url in page.requests} == {urlsplit(scene.pages["all"]).netloc}


def test_no_page_is_wider_than_a_phone(scene: Scene, page: Page) -> None:
    page.ask("Emulation.setDeviceMetricsOverride", width=WIDTH, height=844, deviceScaleFactor=2, mobile=True)
    for name, address in scene.pages.items():
        page.open(address)
        assert page.value("document.documentElement.scrollWidth") == WIDTH, name


def test_tab_reaches_all_that_can_be_used_and_shows_where_it_is(scene: Scene, page: Page) -> None:
    for name, address in scene.pages.items():
        page.open(address)
        for _ in range(page.value(f"document.querySelectorAll('{USABLE}, .scroll, figure').length")):
            page.press("Tab", 9)
            assert page.value(REACHED), page.value("document.activeElement.outerHTML")
        assert page.value(NOT_REACHED) == [], name
