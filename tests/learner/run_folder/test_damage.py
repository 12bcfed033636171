"""Every file of a run folder, damaged in every way: each reader works, or says one line. Generated, and counted.

The ways: emptied, cut (small files at every byte, large ones at every byte of the head and at a sample), one bit flipped (at
every byte or a sample), filled with rubbish; valid JSON, TOML, safetensors and checkpoints whose structure is another one
(values of the wrong kind, extreme numbers, keys that are missing or too many, deep nesting); and in the place of the file a
link, a folder or a FIFO. The readers run in this process, as their commands call them.
"""

from __future__ import annotations

import base64
import copy
import io
import itertools
import json
import logging
import math
import os
import random
import shutil
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tomli_w
import torch

import millrace
from millrace.extras.monitoring.report.page import page
from millrace.extras.monitoring.report.picture import draw
from millrace.launch.training import train
from millrace.learner.algorithms import algorithm_class
from millrace.learner.config.layers import resolve
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.resume_checks import naming_run, unless_finished
from millrace.learner.rollouts.past_rollouts import packed
from millrace.learner.run_folder.json_log import kept_log
from millrace.learner.run_folder.lease import Owner
from millrace.learner.run_folder.living_owner import learner_of_run
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.newest_run import newest_run
from millrace.learner.run_folder.progress_file import last_progress
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.run_format import END, HEAD
from millrace.learner.run_folder.run_lock import LOCK_FILE, Pace, RunLock
from millrace.learner.run_folder.sentences import bottleneck, lag_in_words, went_wrong
from millrace.learner.run_lines import RunLine, headline, in_sentences
from millrace.learner.run_spec import run_spec
from millrace.learner.run_state import SavedRun, restore
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError, UserFacingError
from tests.support.in_process.described import described
from tests.support.in_process.saved_policies import load_policy

ENV = "tests.support.envs.toy:Identity-v0"
SETTINGS: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 2, "rollout_steps": 16, "n_epochs": 1, "net": (4,),
    "steps": 200, "eval_episodes": 2, "eval_every": 60, "checkpoint_every_s": 0.0,
    "tensorboard": True,
}  # fmt: skip
HEAD_BYTES = 200  # bytes of a large file of which each is a place to cut


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("whole") / "runs"
    folder = train(resolve(ENV, run_dir=str(runs), **SETTINGS), None, lambda progress: None)
    (folder / "workers").mkdir(exist_ok=True)
    (folder / "workers" / "w0.log").write_text("a line of a worker\n")
    (folder / "videos").mkdir()
    with kept_log(folder):
        logging.getLogger("millrace").warning("a worker was lost\n%s", "a line of its traceback\n" * 20)
    for picture in ("observation.png", "videos/a.mp4"):
        (folder / picture).write_bytes(b"a picture")
    owner = Owner(host="there", pid=1, boot_id="another", token="t", address="tcp://127.0.0.1:1")
    (folder / LOCK_FILE).write_bytes(owner.encoded())
    return folder


def resume(run: Path) -> tuple[SavedRun, bytes]:
    """All that `--resume` reads before it trains."""
    config = resolve(resume=run)
    unless_finished(config, run, lambda checked: run)
    folder = RunFolder.open(run)
    env = EnvSpec.of(config.env, config.env_kwargs)
    saved = folder.policy_description()
    spaces = EnvSpaces.of_description(DESCRIBED) if saved is None else EnvSpaces.of_policy(saved.policy)
    with naming_run(run):
        policy = run_spec(config, env, spaces).policy
    algorithm = algorithm_class(config.algo)(config.algorithm, policy, total_steps=config.steps, seed=1)
    found = restore(folder, algorithm)
    MetricsLog(run, found.state.env_steps).close()
    return found, algorithm.weights()[0].tobytes()


def same(one: tuple[SavedRun, bytes], other: tuple[SavedRun, bytes]) -> bool:
    """Whether two runs go on alike."""
    return one[1] == other[1] and packed(one[0]).tobytes() == packed(other[0]).tobytes()


def look(run: Path) -> list[Any]:
    """All that a `millrace.Run` reads."""
    found = millrace.Run(run)
    return [repr(found), found._repr_html_(), found.summary, found.metrics, found.config]


def told(run: Path) -> list[str]:
    """All that is said of a run without a summary."""
    progress = last_progress(run, None)
    lines = [RunLine(run, state, progress=progress) for state in ("training", "dead")]
    said = [f"{headline(line)} {line.done} {line.left_s}" for line in lines]
    return [*said, in_sentences(lines[1]), bottleneck(progress), went_wrong(progress.ledger), lag_in_words(progress)]


def locked(run: Path) -> None:
    with RunLock(run, PACE, clock=lambda: 0.0, sleep=lambda seconds: None):
        pass


PACE = Pace(rewrite_every=100.0, dead_after=0.0)
DESCRIBED = described(EnvSpec(ENV), "loop")
OBSERVED = [np.zeros((1, 1, 4), np.float32)]
READERS: dict[str, Callable[[Path], Any]] = {
    "resume": resume,
    "resume auto": lambda run: newest_run(resolve(ENV, run_dir=str(run.parent), **SETTINGS)),
    "is_finished": lambda run: unless_finished(resolve(ENV, run_dir=str(run.parent), **SETTINGS), run, lambda checked: run),
    "evaluate": lambda run: load_policy(run, "final"),
    "evaluate --best": lambda run: load_policy(run, "best"),
    "report": lambda run: page([run]),
    "plot": lambda run: draw([run]).svg,
    "load": lambda run: millrace.load(run)(OBSERVED[0][0]),
    "Run": look,
    "told": told,
    "lock": locked,
    "status": learner_of_run,
}
FILES = {
    "config.toml": ("resume", "resume auto", "is_finished", "evaluate", "report", "plot", "Run"),
    "run.json": ("resume", "resume auto", "is_finished", "evaluate", "report", "plot"),
    "metrics.jsonl": ("resume", "report", "plot", "Run"),
    "progress.json": ("told", "report"),
    "log.jsonl": ("report", "resume"),
    "summary.json": ("resume", "is_finished", "report", "Run"),
    "policy.json": ("resume", "evaluate", "evaluate --best", "load"),
    "policy.safetensors": ("evaluate", "resume", "load"),
    "best.safetensors": ("evaluate --best", "resume"),
    "newest checkpoint": ("resume", "resume auto"),
    "all checkpoints": ("resume", "resume auto"),
    "events": ("resume", "report"),
    "workers/w0.log": ("resume", "report"),
    "run.lock": ("lock", "status"),
    "observation.png": ("report",),
    "videos/a.mp4": ("report",),
}
"""The readers that open a file, and one that does not."""


def named(run: Path, name: str) -> list[Path]:
    checkpoints = sorted((run / "checkpoints").glob("*.pt"))
    match name:
        case "newest checkpoint":
            return checkpoints[-1:]
        case "all checkpoints":
            return checkpoints
        case "events":
            return sorted((run / "tensorboard").iterdir())[:1]
        case _:
            return [run / name]


def damages(content: bytes, cuts: int, flips: int, rng: random.Random) -> Iterator[tuple[str, bytes]]:
    """At most about so many cuts and flips, spread over the file, and all of the head's first cuts."""
    yield "emptied", b""
    size = len(content)
    every = sorted({*range(min(size, HEAD_BYTES if cuts >= size else cuts // 2)), *rng.sample(range(size), min(size, cuts))})
    lines = [at + 1 for at in range(size - 1) if content[at : at + 1] == b"\n"]
    for at in [*every, *rng.sample(lines, min(len(lines), cuts))]:
        yield f"cut at {at}", content[:at]
    for at in sorted(rng.sample(range(size), min(size, flips))):
        bit = rng.randrange(8)
        yield f"bit {bit} of byte {at} flipped", content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :]
    for length in (1, 100, size):
        yield f"{length} bytes of rubbish", rng.randbytes(length)
        yield f"{length} letters of rubbish", b"x" * length
    yield "JSON of another kind", b'[1, {"a": null}]\n'
    yield "deeply nested", b"[" * 100_000
    yield "a NUL byte", b"\x00"


DEEP: Any = {}
for _ in range(150):
    DEEP = {"deep": [DEEP]}
EXTREMES: list[Any] = [
    None, True, -1, 0, 1, 1.5, 2**31, 2**53 + 1, 2**64, 10**400, -(10**400), 1e308, -1e308, math.inf, -math.inf, math.nan,
    "x", "none", "", "x" * 100_000, "a\nmillrace: b\x1b[2J", "../../etc", "no_module:name", [], {}, [None], [[], {}],
    {"a": {}}, [0] * 10_000, [f"f{n}" for n in range(33)], DEEP,
]  # fmt: skip


def places(value: Any) -> list[tuple[Any, Any]]:
    """Each entry of nested dicts and lists, as the container and the key or the index."""
    match value:
        case dict():
            entries = list(value)
        case list():
            entries = list(range(min(len(value), 50)))
        case _:
            return []
    return [(value, entry) for entry in entries] + [place for entry in entries for place in places(value[entry])]


def otherwise(value: Any, rng: random.Random) -> Any:
    """The same data, with one to three changes of the structure."""
    value = copy.deepcopy(value)
    for _ in range(rng.randint(1, 3)):
        found = places(value)
        if not found:
            return copy.deepcopy(rng.choice(EXTREMES))
        container, key = rng.choice(found)
        other = copy.deepcopy(rng.choice(EXTREMES))
        match rng.randrange(6):
            case 0:
                del container[key]
            case 1 if isinstance(container, dict):
                container[rng.choice(["more", "", "a\nb", "\x1b", "x" * 5000])] = other
            case 2 if isinstance(container, dict):
                container["renamed"] = container.pop(key)
            case 3:
                container[key] = copy.deepcopy(rng.choice(found))[0]
            case _:
                container[key] = other
    return value


def structures(name: str, content: bytes, count: int, rng: random.Random) -> Iterator[tuple[str, bytes]]:
    """Contents in the file's own format with another structure."""
    made = 0
    while made < count:
        try:
            yield f"structure {made}", structured(name, content, rng)
        except (TypeError, ValueError, AttributeError, RecursionError):  # no such content can be written
            continue
        made += 1


def structured(name: str, content: bytes, rng: random.Random) -> bytes:
    match name.rpartition(".")[2]:
        case "toml":
            return f"{HEAD}{tomli_w.dumps(otherwise(tomllib.loads(content.decode()), rng))}{END}".encode()
        case "json" | "lock":
            return json.dumps(otherwise(json.loads(content), rng)).encode()
        case "jsonl":
            rows = [json.loads(line) for line in content.splitlines()]
            every = rng.random() < 0.5
            return b"".join(json.dumps(otherwise(row, rng) if every else row).encode() + b"\n" for row in rows[:-1]) + (
                json.dumps(otherwise(rows[-1], rng)).encode() + b"\n"
            )
        case "safetensors":
            begin = 8 + int.from_bytes(content[:8], "little")
            head = json.dumps(otherwise(json.loads(content[8:begin]), rng)).encode()
            return len(head).to_bytes(8, "little") + head + content[begin:]
        case "newest checkpoint" | "all checkpoints":
            file = io.BytesIO()
            torch.save(otherwise(torch.load(io.BytesIO(content), weights_only=True), rng), file)
            return file.getvalue()
        case _:
            raise AssertionError(f"{name} has no structure")


UNSTRUCTURED = ("events", "workers", "observation", "videos")
PRECIOUS = b"a key"


def things(outside: Path) -> Iterator[tuple[str, Callable[[Path], object]]]:
    """What else may be in the place of a file."""
    outside.write_bytes(PRECIOUS)
    yield "a link to a file outside", lambda path: path.symlink_to(outside)
    yield "a link to nothing", lambda path: path.symlink_to(outside.with_name("nothing"))
    yield "a link to itself", lambda path: path.symlink_to(path)
    yield "a link to a device", lambda path: path.symlink_to("/dev/zero")
    yield "a FIFO", os.mkfifo
    yield "a folder", Path.mkdir
    yield "a huge file", lambda path: os.truncate(os.open(path, os.O_WRONLY | os.O_CREAT), 1 << 40)


def put(target: Path, content: bytes | Callable[[Path], object]) -> None:
    if target.is_dir() and not target.is_symlink():
        target.rmdir()
    else:
        target.unlink(missing_ok=True)
    if isinstance(content, bytes):
        target.write_bytes(content)
    else:
        content(target)


def check(
    whole: Path, tmp_path: Path, name: str, cuts: int, flips: int, caplog: pytest.LogCaptureFixture, count: int = 0
) -> Counter[str]:
    """`count`: number of damaged structures."""
    caplog.set_level(logging.WARNING, "millrace")
    rng = random.Random(f"{name} 1")
    run = tmp_path / "runs" / whole.name
    counts: Counter[str] = Counter()
    shutil.copytree(whole, run)
    undamaged = resume(run)
    targets = named(run, name)
    contents = [target.read_bytes() for target in targets]
    newest = sorted((run / "checkpoints").glob("*.pt"))[-1]
    metrics = (run / "metrics.jsonl").read_bytes()
    outside = tmp_path / "outside"
    count = 0 if name.startswith(UNSTRUCTURED) else count
    every: list[Iterator[tuple[str, Any]]] = [
        structures(name, contents[-1], count, rng), things(outside), damages(contents[-1], cuts, flips, rng),
    ]  # fmt: skip
    for how, damaged in itertools.chain(*every):
        for reader in FILES[name]:
            put(run / "metrics.jsonl", metrics)
            for target in targets:
                put(target, damaged)
            caplog.clear()
            try:
                found = READERS[reader](run)
            except UserFacingError as error:
                counts[f"{reader}: one line"] += 1
                wrong = "\n" in str(error) or error.exit_code not in (1, 2) or run.name not in str(error)
                assert not wrong, (how, reader, str(error))  # noqa: PT017  # each of many errors is checked
            except BaseException as error:
                raise AssertionError(f"{name} {how}: {reader} raised {error!r:.500}") from error
            else:
                said = [record.getMessage() for record in caplog.records]
                assert len(said) <= 4, said
                assert all("\n" not in line for line in said)
                counts[f"{reader}: {'works, and says so' if said else 'works'}"] += 1
                assert base64.b64encode(PRECIOUS).decode() not in str(found), (how, reader)
                if name == "config.toml" and reader == "resume":
                    assert not how.startswith(("cut", "emptied")) or damaged.endswith(b"# end"), f"{how}: not noticed"
                if name.endswith("safetensors") and reader.startswith("evaluate"):
                    assert found[0](OBSERVED).tobytes() == READERS[reader](whole)[0](OBSERVED).tobytes(), how
                if name == "newest checkpoint" and reader == "resume" and not how.startswith("structure"):
                    older = any(str(newest) in line for line in said)
                    assert older or same(found, undamaged), "a damaged checkpoint was taken without a word"
                    assert not older or found[0].state.version < undamaged[0].state.version
    assert outside.read_bytes() == PRECIOUS
    assert not outside.with_name("nothing").exists()
    for target, content in zip(targets, contents, strict=True):
        put(target, content)
    put(run / "metrics.jsonl", metrics)
    READERS["resume"](run)
    return counts


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ('algo = "ppo"', 'algo = "`po"'),
        ("lanes = 2", "lanes = 6"),
        ("tcp://127.0.0.1:5555", "tcp:+/127.0.0.1:5555"),
        ("batch_size", "bathc_size"),
        ('encoder = "none"', 'encoder = "noje"'),
        ("wrappers = []", 'wrappers = ["gymnasium.wrappers"]'),
    ],
)
def test_a_value_that_no_run_can_have_is_one_line_with_the_name_of_the_file(
    whole: Path, tmp_path: Path, good: str, bad: str
) -> None:
    run = tmp_path / "runs" / whole.name
    shutil.copytree(whole, run)
    text = (run / "config.toml").read_text()
    assert text.count(good) == 1
    (run / "config.toml").write_text(text.replace(good, bad))
    for reader in ("resume", "is_finished"):
        with pytest.raises(UsageError) as why:
            READERS[reader](run)
        assert str(why.value).startswith(f"{run}/config.toml: ")
        assert "\n" not in str(why.value)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("env_steps",), torch.zeros(3)),
        (("version",), torch.zeros(2, 2)),
        (("version",), "x"),
        (("epochs",), torch.zeros(2)),
        (("optimizer", "param_groups", 0, "betas"), []),
        (("optimizer", "param_groups", 0, "eps"), [[]]),
        (("optimizer", "param_groups", 0), {"params": [0], "lr": 0.1}),
        (("optimizer", "param_groups", 0, "params"), ["x"]),
    ],
)
def test_a_whole_checkpoint_with_numbers_that_no_algorithm_has_is_one_line(
    whole: Path, tmp_path: Path, place: tuple[Any, ...], value: Any
) -> None:
    """Their checksums are right. It is noticed before the run goes on, and not in its next update."""
    run = tmp_path / "runs" / whole.name
    shutil.copytree(whole, run)
    for path in (run / "checkpoints").iterdir():
        record = torch.load(path, weights_only=True)
        inner = record["state"]["algorithm"]
        for step in place[:-1]:
            inner = inner[step]
        inner[place[-1]] = value
        torch.save(record, path)
    with pytest.raises(UserFacingError, match="expected the state of this configuration, got another") as why:
        READERS["resume"](run)
    assert "\n" not in str(why.value)


@pytest.mark.parametrize("dtype", ["BF16", "F8_E5M2", "I64", "C64"])
def test_numbers_of_a_dtype_that_no_policy_has_are_one_line(whole: Path, tmp_path: Path, dtype: str) -> None:
    """The package safetensors raises KeyError for those that numpy lacks."""
    run = tmp_path / "runs" / whole.name
    shutil.copytree(whole, run)
    sizes = {"BF16": 2, "F8_E5M2": 1, "I64": 8, "C64": 8}
    head = msgspec.json.encode({"a": {"dtype": dtype, "shape": [1], "data_offsets": [0, sizes[dtype]]}})
    (run / "policy.safetensors").write_bytes(len(head).to_bytes(8, "little") + head + bytes(sizes[dtype]))
    for reader in ("evaluate", "load"):
        with pytest.raises(UsageError, match=f"policy of run {run}"):
            READERS[reader](run)


@pytest.mark.parametrize("name", FILES)
def test_a_sample_of_damages(whole: Path, tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    counts = check(whole, tmp_path, name, cuts=3, flips=3, caplog=caplog, count=4)
    sys.stdout.write(f"\n{name}: {dict(sorted(counts.items()))}\n")
    assert counts.total() >= 12 * len(FILES[name])


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", FILES)
def test_many_damages(whole: Path, tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    counts = check(whole, tmp_path, name, cuts=1000, flips=1000, caplog=caplog, count=2000)
    sys.stdout.write(f"\n{name}: {dict(sorted(counts.items()))}\n")
