"""The pages: what they say of runs, and that nothing in a run folder or of a learner becomes part of their markup."""

import json
import logging
import os
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from millrace.extras.monitoring.dashboard import run_page, site
from millrace.extras.monitoring.dashboard.http import PageAnswer, answer_parts, parsed
from millrace.extras.monitoring.dashboard.known_runs import KnownRuns, key_of, newest_logs
from millrace.extras.monitoring.dashboard.lookout import LaneSample, Seen, sample
from millrace.extras.monitoring.dashboard.run_page import Choice, smoothed
from millrace.extras.monitoring.dashboard.site import Site
from millrace.extras.monitoring.metric_names import METRICS, described, label
from millrace.learner.run_folder.json_log import kept_log
from millrace.learner.run_folder.lease import Owner
from millrace.learner.run_folder.metrics_log import METRICS_FILE
from millrace.learner.run_folder.results import Best, Evaluation
from millrace.learner.run_folder.run_lock import RunLock
from millrace.protocol.logs.notices import log_notice
from millrace.protocol.messages import Status, WorkerStatus
from millrace.protocol.progress import RunProgress
from tests.extras.monitoring.report.test_page import Reader
from tests.support.run_folders import a_run, write_progress

log = logging.getLogger("millrace.learner")

HOSTILE = "</option></svg></title>\"'><script>alert(1)</script><img src=x onerror=alert(1)>"


class Pages:
    """The pages over these folders, without sockets."""

    def __init__(self, *folders: Path, seen: Seen | None = None) -> None:
        self.looked: list[Path] = []
        self._seen, self.now = seen or Seen(), os.stat(folders[0]).st_mtime
        self._site = Site(KnownRuns(folders, lambda: self.now), self._look)

    def _look(self, run: Path) -> Seen:
        self.looked.append(run)
        return self._seen

    def answer(self, path: str) -> PageAnswer:
        request = parsed(f"GET /token/{path} HTTP/1.1".encode())
        assert request is not None
        return self._site.answer(request)

    def text(self, path: str = "") -> str:
        answer = self.answer(path)
        assert answer.status == 200
        assert isinstance(answer.body, bytes)
        return answer.body.decode()

    def said(self, path: str = "") -> str:
        return Safe(self.text(path)).text


class Safe(Reader):
    """A page with no markup but ours: no script in it, no style, no handler, no address elsewhere."""

    VOID = Reader.VOID | {"link", "input", "img"}

    def __init__(self, text: str) -> None:
        super().__init__(text)
        assert self.tags.count("script") <= 1
        for name, value in self.attributes:
            assert not name.startswith("on"), value
            assert name != "style", value
            if name in ("src", "href", "action"):
                assert value.startswith(("/token/", "data:,")) or value == "#history", value


def worker(
    name: str = "w0", host: str = "box", lanes: tuple[int, ...] = (0,), doing: str = "stepping", **more: object
) -> WorkerStatus:
    known = {"pid": 1, "state": "active", "tickets": 1, "steps": 5, "steps_per_s": 7.0, "version": 3, "silent_s": 0.1,
             "resident_bytes": 2**20, "strikes": 0, "doing_s": 1.0} | more  # fmt: skip
    return WorkerStatus(worker=name, host=host, lanes=lanes, doing=doing, **known)  # type: ignore[arg-type]


def status(*workers: WorkerStatus, waiting: str = "", phase: str = "gathering", wanted: int = 2) -> Status:
    return Status("CartPole-v1", RunProgress(waiting=waiting, phase=phase), workers, wanted, version=3)


def a_hostile_run(folder: Path) -> Path:
    """A run folder, all of whose texts are hostile."""
    run = a_run(folder, env_kwargs={HOSTILE: HOSTILE}, failure=HOSTILE)
    with (run / METRICS_FILE).open("a") as file:
        row = {"time/total_timesteps": 9_000, f"custom/{HOSTILE}": 1.0, HOSTILE: 1e308, "ledger/lost": 10**15}
        file.write(json.dumps(row) + "\n")
    with kept_log(run):
        log.warning("%s\n%s\x1b[2J", HOSTILE, HOSTILE)
    (run / "workers").mkdir()
    (run / "workers" / f"{HOSTILE.replace('/', '')}.log").write_bytes(HOSTILE.encode() + b"\x00\xff\x1b[2J\n")
    (run / "videos").mkdir()
    (run / "videos" / f"{HOSTILE.replace('/', '')}.mp4").write_bytes(b"film")
    return run.rename(folder / HOSTILE.replace("/", ""))


def test_all_runs_are_listed_the_newest_first(tmp_path: Path) -> None:
    a_run(tmp_path).rename(tmp_path / "CartPole-v1-ppo-s1-20200101-000000")
    a_run(tmp_path, "Pendulum-v1", finished=False)
    said = Pages(tmp_path).said()
    assert "2 runs, 0 training" in said
    assert (
        said.index("Pendulum-v1, PPO, seed 1")
        < said.index("dead")
        < said.index("CartPole-v1, PPO, seed 1")
        < said.index("finished")
    )
    (tmp_path / "empty").mkdir()
    assert "No run is here yet" in Pages(tmp_path / "empty").said()


def test_a_run_that_begins_later_appears(tmp_path: Path) -> None:
    pages = Pages(tmp_path, tmp_path / "not-there-yet")
    assert "No run is here yet" in pages.said()
    a_run(tmp_path / "not-there-yet")
    assert "1 run, 0 training" in pages.said()


def test_a_finished_run_shows_its_last_state_and_no_learner_is_asked(tmp_path: Path) -> None:
    run, pages = a_run(tmp_path), Pages(tmp_path)
    said = pages.said(f"run/{key_of(run)}")
    assert "Finished: all steps done." in said
    assert "Final policy, 100 greedy episodes −1,233.6 ± 7.5" in said
    assert "What happened" in said
    assert pages.looked == []


@pytest.mark.parametrize("address", ["tcp://*:5555", "tcp://box:5555;touch x", "tcp://$(id):1", "tcp://box:1' x"])
def test_the_command_for_one_more_worker_is_words_that_a_shell_leaves_alone(address: str) -> None:
    owner = Owner(host="box", pid=1, boot_id="", token="t", address=address)
    page = Reader(run_page.join(SimpleNamespace(owner=owner)))  # type: ignore[arg-type]
    (command,) = re.findall("millrace worker .*", page.text)
    assert shlex.split(command) == ["millrace", "worker", address, "--insecure"]
    assert command.split("worker ")[1].startswith("'")


def test_the_newest_evaluations_are_a_table_that_marks_the_best() -> None:
    rows = np.array([(10 * i, 9.0 if i == 4 else i % 4, 7.0) for i in range(30)])
    rows[29, 0] = 285
    said = Safe(run_page.evaluations(rows)).text
    assert "The best of 30 was at 40 env steps, with a mean return of 9.0." in said
    assert "285 1.0 7.0 280 0.0 7.0" in said
    assert "the best" not in said.partition("Return")[2]
    assert "40 9.0 7.0 the best" in Safe(run_page.evaluations(rows[:6])).text
    again = Evaluation(episodes=10, return_mean=9.0, return_std=0.0, length_mean=7.0)
    of_all = Safe(run_page.evaluations(rows[:6], Best(env_steps=60, chosen_by=9.5, evaluation=again))).text
    assert "The best of all, that at the end included, was at 60 env steps, with a mean return of 9.5." in of_all
    assert "7.0 the best" not in of_all
    assert run_page.evaluations(np.empty((0, 3))) == ""


def test_of_equally_good_evaluations_the_newest_is_the_best_as_in_the_run() -> None:
    rows = np.array([(10, 1.0, 7.0), (20, 9.0, 7.0), (30, 9.0, 7.0), (40, 8.0, 7.0)])
    assert "The best of 4 was at 30 env steps, with a mean return of 9.0." in Safe(run_page.evaluations(rows)).text


def test_a_running_run_says_first_what_holds_it_up(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    waits = "waiting 12 s for lane 1 (worker w1 on far: in reset for 11 s)"
    write_progress(run, RunProgress(env_steps=2_000, total_steps=100_000, updates=20, waiting=waits))
    two = status(worker(), worker("w1", "far", (1,), "resetting", doing_s=11.0))
    with RunLock(run):
        pages = Pages(tmp_path, seen=Seen(two, (sample(two, 5.0),)))
        said = pages.said(f"run/{key_of(run)}")
        silent = Pages(tmp_path, seen=Seen(problem="its learner does not answer")).said(f"run/{key_of(run)}")
    assert f"The learner has been {waits}." in said
    assert said.index(waits) < said.index("Env steps")
    assert "box 1 worker, 7 env steps per second w0 1 in step" in said
    assert "far 1 worker, 7 env steps per second w1 1 in reset for 11 s" in said
    assert "waiting learner waiting lane 0 collecting lane 1 resetting" in said
    assert pages.looked == [run]
    assert "Who waits for whom is not known: its learner does not answer." in silent


def test_before_the_first_update_it_shows_what_workers_have_made(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    write_progress(run, RunProgress(total_steps=100_000))
    waits = "waiting 23 s for lane 0 (worker w0 on box: 1.0 steps/s); first rollouts: 45 of 512 env steps, about 4 min left"
    with RunLock(run):
        pages = Pages(tmp_path, seen=Seen(status(worker())))
        all_runs = pages.said()
        silent = Pages(tmp_path, seen=Seen(problem="its learner does not answer")).said(f"run/{key_of(run)}")
        write_progress(run, RunProgress(collected=45, total_steps=100_000, wall_s=23.4, steps_per_s=1.9, waiting=waits))
        said = pages.said(f"run/{key_of(run)}")
    assert "training – before its first update – " in all_runs
    assert "Training: before its first update. Who waits for whom is not known" in silent
    assert f"1.9 env steps per second, about 14 h 36 min left. The learner has been {waits}." in said
    assert "Env steps of 100,000 45 Env steps per second 1.9 Updates 0 Time of training 23.4 s" in said


def test_it_shows_no_more_env_steps_than_the_run_has(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    write_progress(run, RunProgress(env_steps=99_900, collected=512, total_steps=100_000))
    assert "Env steps of 100,000 100,000 Env steps per second" in Pages(tmp_path).said(f"run/{key_of(run)}")


def test_where_nobody_waits_long_the_slowest_part_is_named(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    with RunLock(run):
        said = Pages(tmp_path, seen=Seen(status(worker()))).said(f"run/{key_of(run)}")
    slowest = "Updates are the slowest part: the learner updates for 75% of the time, and workers wait for 50%."
    assert f"{slowest} 6 rollouts were lost and dealt again, " in said


def test_any_metric_can_be_chosen(tmp_path: Path) -> None:
    run, pages = a_run(tmp_path), Pages(tmp_path)
    page = f"run/{key_of(run)}"
    assert 'aria-label="return over env steps"' in pages.text(page)
    assert 'class="dots' in pages.text(page)
    assert 'aria-label="return over minutes of training"' in pages.text(f"{page}?over=time&smooth=10")
    assert 'aria-label="learner update over env steps"' in pages.text(f"{page}?metric=stage/learner_update")
    assert '<optgroup label="Progress and speed"><option value="time/fps">env steps per second<' in pages.text(page)
    for odd in ("metric=no/such", "smooth=-1", "smooth=%C2%B2", "smooth=99999999999", "over="):
        assert 'aria-label="return over env steps"' in pages.text(f"{page}?{odd}")


def test_a_moving_mean_is_of_the_rows_so_far() -> None:
    assert smoothed(np.array([1.0, 3.0, 5.0, 7.0]), 2) == pytest.approx([1.0, 2.0, 4.0, 6.0])


def test_every_metric_has_a_label_of_words_and_no_other_has_the_same() -> None:
    names = [name for group in METRICS.values() for name in group if "NAME" not in name]
    assert len({label(name) for name in names}) == len(names)
    for name in names:
        assert label(name)
        assert not {"/", "_"} & {*label(name)}, name


def test_a_number_of_the_user_s_own_has_its_name_as_label_and_the_meaning_of_its_kind() -> None:
    title, meaning = described("eval/is_success")
    assert (title, meaning.label) == ("Evaluations", "is success")
    assert meaning.text == METRICS["Evaluations"]["eval/NAME"].text
    assert described("rollout/x_missing")[1].unit == "episodes"
    assert described("no such\n")[1].label == "no such\n"


def test_what_happened_is_told_with_its_time_the_newest_first(tmp_path: Path) -> None:
    run, pages = a_run(tmp_path), Pages(tmp_path)
    assert "There were no warnings." in pages.said(f"run/{key_of(run)}")
    with kept_log(run):
        log.warning("w0 was lost")
        log.warning("an environment raised: ValueError: no\nTraceback\n  line 3")
        log_notice(log, "the run goes on")
    said = pages.said(f"run/{key_of(run)}")
    assert re.search(r"20\d\d-\d\d-\d\d [\d:]{8} the run goes on .* raised: ValueError: no .*line 3 .* w0 was lost", said)
    assert said.index("Newest of 2 warnings") < said.index("raised: ValueError: no") < said.index("Env steps")
    text = pages.text(f"run/{key_of(run)}")
    assert text.count('<li class="warning">') == 2
    assert text.count('<li class="notice">') == 1


def test_several_runs_are_compared_as_a_report_does(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, seed=seed) for seed in (1, 2)]
    pages = Pages(tmp_path)
    said = pages.said("compare?" + "&".join(f"run={key_of(run)}" for run in runs))
    assert "PPO, mean of 2 seeds" in said
    assert "Choose runs in the list" in pages.said("compare?run=no-such")


def test_a_row_of_the_picture_is_what_a_lane_did(tmp_path: Path) -> None:
    seen = status(worker(lanes=(0, 2)), worker("w1", lanes=(1,), doing="waiting"), phase="learning", wanted=4)
    assert sample(seen, 7.0) == LaneSample(7.0, "updating", {0: "collecting", 1: "waiting", 2: "collecting", 3: "no worker"})
    without_supervisor = status(worker(doing=""), worker("w1", lanes=(1,), doing="", tickets=0))
    assert sample(without_supervisor, 0.0).lanes == {0: "collecting", 1: "waiting"}
    samples = tuple(LaneSample(float(at_s), "waiting", {0: "collecting" if at_s < 5 else "resetting"}) for at_s in range(10))
    picture = run_page.who_waits(Seen(samples=samples))
    assert picture.count("<title>collecting</title>") == picture.count("<title>resetting</title>") == 1
    far_apart = (LaneSample(0.0, "waiting", {}), LaneSample(100.0, "waiting", {}))
    assert run_page.who_waits(Seen(samples=far_apart)).count("<title>waiting</title>") == 2, "nobody looked between them"


def test_nothing_in_a_run_folder_becomes_markup(tmp_path: Path) -> None:
    run, pages = a_hostile_run(tmp_path), Pages(tmp_path)
    for path in ("", f"run/{key_of(run)}", f"run/{key_of(run)}?metric=custom/%3C/option%3E", f"compare?run={key_of(run)}"):
        assert "alert(1)" in pages.said(path)
    Safe(pages.text(f"run/{key_of(run)}?metric={HOSTILE[:9]}&over=%22%3E"))


def test_nothing_of_a_learner_becomes_markup(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    hostile = status(
        worker(HOSTILE, HOSTILE, (0,), HOSTILE, state=HOSTILE),
        worker("w1", lanes=(), state=HOSTILE),
        phase=HOSTILE,
    )
    write_progress(run, RunProgress(updates=1, waiting=HOSTILE))
    with RunLock(run):
        seen = Seen(hostile, (sample(hostile, 1.0),))
        assert "alert(1)" in Pages(tmp_path, seen=seen).said(f"run/{key_of(run)}")
        assert "alert(1)" in Pages(tmp_path, seen=Seen(problem=HOSTILE)).said(f"run/{key_of(run)}")


def test_only_films_and_pictures_of_a_run_are_served(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    (tmp_path / "secret.mp4").write_bytes(b"secret")
    (run / "videos").mkdir()
    (run / "videos" / "a.mp4").write_bytes(b"film")
    (run / "videos" / "link.mp4").symlink_to(tmp_path / "secret.mp4")
    os.mkfifo(run / "videos" / "fifo.mp4")
    pages, of_run = Pages(tmp_path), f"file/{key_of(run)}"
    film = pages.answer(f"{of_run}/videos/a.mp4")
    assert b"".join(answer_parts(None, film)).endswith(b"\r\n\r\nfilm")
    assert film.content_type == "video/mp4"
    assert f"/token/{of_run}/videos/a.mp4" in pages.text(f"run/{key_of(run)}")
    for path in (
        "videos/link.mp4",
        "videos/fifo.mp4",
        "config.toml",
        "../secret.mp4",
        "videos/..%2F..%2F..%2Fsecret.mp4",
        "/etc/passwd",
        "",
        "%00",
    ):
        assert pages.answer(f"{of_run}/{path}").status == 404, path
    for path in ("no-such", "run/no-such", "run/..", "run", "style.css/x", "file/no-such/videos/a.mp4"):
        assert pages.answer(path).status == 404, path


def test_files_that_are_no_files_are_left_out(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    (run / "workers").mkdir()
    os.mkfifo(run / "workers" / "w0.log")
    (run / "workers" / "w1.log").symlink_to("/etc/passwd")
    huge = run / "workers" / "w2.log"
    huge.touch()
    os.truncate(huge, 1 << 40)
    with huge.open("ab") as file:
        file.write(b"\nthe end\n")
    assert newest_logs(run)[0][1].endswith("the end")
    assert len(newest_logs(run)) == 1
    (run / METRICS_FILE).unlink()
    os.mkfifo(run / METRICS_FILE)
    assert "Dead" in Pages(tmp_path).said(f"run/{key_of(run)}")


def test_the_page_grows_with_its_run(tmp_path: Path) -> None:
    run, pages = a_run(tmp_path, finished=False), Pages(tmp_path)
    before = pages.text(f"run/{key_of(run)}?part=main")
    assert before.startswith("<main>")
    assert pages.text(f"run/{key_of(run)}?part=main") == before
    write_progress(run, RunProgress(env_steps=2_100, total_steps=100_000, return_mean=500.0))
    after = pages.said(f"run/{key_of(run)}?part=main")
    assert "Env steps of 100,000 2,100" in after
    assert "500.0" in after


def test_a_picture_that_is_deleted_is_gone_from_the_page(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    (run / "observation.png").write_bytes(b"picture")
    pages = Pages(tmp_path)
    assert "What the policy sees" in pages.said(f"run/{key_of(run)}")
    (run / "observation.png").unlink()
    assert "What the policy sees" not in pages.said(f"run/{key_of(run)}")


def test_a_choice_of_the_reader_is_bounded() -> None:
    assert Choice.of({"smooth": ["100000"]}).smooth == 1
    assert Choice.of({"smooth": ["999"]}).smooth == run_page.MOST_SMOOTHED
    assert len(site.MEDIA) == 2
