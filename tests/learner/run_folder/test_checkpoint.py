"""Checkpoints: whole or not at all, newest whole one wins, no code in them."""

import codecs
import errno
import os
import pickle
import re
import resource
import shutil
import signal
import struct
import zipfile
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch.storage import _dtype_to_storage_type_map

from millrace.learner.rehearsed_pickle import STORAGES, Unfit
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.archive_directory import ENTRY
from millrace.learner.written_state import check_pickles
from millrace.protocol.errors import CheckpointError, UsageError


def state(number: float) -> dict[str, Any]:
    return {
        "flat": torch.full((1000,), float(number)),
        "generator": np.random.default_rng(int(number)).bit_generator.state,
        "torch": torch.get_rng_state(),
        "episodes": [[1.5, 20, 0.1]],
        "best": None,
    }


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def test_what_was_saved_comes_back(tmp_path: Path) -> None:
    saved = state(3)
    path = checkpoint.save(tmp_path, saved, env_steps=2048, keep=3)
    assert path.name == "000000002048.pt"
    found, warnings = checkpoint.newest(tmp_path)
    assert (found.env_steps, found.path, warnings) == (2048, path, [])
    assert torch.equal(found.state["flat"], saved["flat"])
    generator = np.random.default_rng()
    generator.bit_generator.state = found.state["generator"]
    assert generator.random() == np.random.default_rng(3).random()
    assert found.state["episodes"] == [[1.5, 20, 0.1]]


def test_only_the_newest_stay(tmp_path: Path) -> None:
    for steps in (999_999, 1_000_000, 5, 2_000_000):
        checkpoint.save(tmp_path, state(1), steps, keep=2)
    assert files(tmp_path) == ["000001000000.pt", "000002000000.pt"]


def test_a_later_one_that_was_passed_over_does_not_cost_the_newest_whole_one(tmp_path: Path) -> None:
    for steps in (100, 200, 300):
        path = checkpoint.save(tmp_path, state(1), steps, keep=3)
    path.write_bytes(b"not a checkpoint at all")
    checkpoint.save(tmp_path, state(2), 200, keep=1)
    assert checkpoint.newest(tmp_path)[0].env_steps == 200
    checkpoint.save(tmp_path, state(3), 400, keep=1)
    assert files(tmp_path) == ["000000000400.pt"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failure_at_any_step_leaves_the_old_one_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    checkpoint.save(tmp_path, state(1), 100, keep=3)

    def fails(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(f"millrace.learner.run_folder.atomic_write.os.{step}", fails)
    with pytest.raises(CheckpointError, match=r"000000000200\.pt not written: No space left on device; older .* untouched"):
        checkpoint.save(tmp_path, state(2), 200, keep=3)
    monkeypatch.undo()
    assert files(tmp_path) == ["000000000100.pt"]
    assert checkpoint.newest(tmp_path)[0].state["flat"][0] == 1


@contextmanager
def files_end_at_4_kb() -> Iterator[None]:
    """The kernel refuses to let any file of this process grow beyond 4 KiB, as a full disk does: pytest's own log too."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_disk_that_is_full_in_mid_file_leaves_nothing_behind(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, {"flat": torch.ones(1)}, 100, keep=3)
    with files_end_at_4_kb(), pytest.raises(CheckpointError) as caught:
        checkpoint.save(tmp_path, {"flat": torch.ones(100_000)}, 200, keep=3)
    path = tmp_path / "checkpoints" / "000000000200.pt"
    assert str(caught.value) == f"checkpoint {path} not written: File too large; older checkpoints are untouched"
    assert files(tmp_path) == ["000000000100.pt"]
    assert checkpoint.newest(tmp_path)[0].env_steps == 100


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path) -> None:
    path = checkpoint.save(tmp_path, state(1), 100, keep=3)
    (path.parent / "000000000200.pt.tmp").write_bytes(path.read_bytes()[:500])  # killed before the rename
    assert checkpoint.newest(tmp_path)[0].env_steps == 100
    checkpoint.save(tmp_path, state(3), 300, keep=3)
    assert files(tmp_path) == ["000000000100.pt", "000000000300.pt"]


def damaged(whole: bytes, how: str) -> bytes:
    match how:
        case "truncated":
            return whole[: len(whole) // 2]
        case "empty":
            return b""
        case "a flipped bit":  # among the numbers, where torch.load does not notice
            at = whole.index(torch.full((4,), 2.0).numpy().tobytes()) + 100
            return whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
        case _:
            return b"not a checkpoint at all"


@pytest.mark.parametrize("how", ["truncated", "empty", "a flipped bit", "rubbish"])
def test_a_damaged_newest_gives_way_to_the_one_before(tmp_path: Path, how: str) -> None:
    checkpoint.save(tmp_path, state(1), 100, keep=3)
    path = checkpoint.save(tmp_path, state(2), 200, keep=3)
    path.write_bytes(damaged(path.read_bytes(), how))
    found, (warning,) = checkpoint.newest(tmp_path)
    assert found.env_steps == 100
    assert found.state["flat"][0] == 1
    assert str(path) in warning
    assert "\n" not in warning
    with pytest.raises(CheckpointError, match="expected a whole file, got one that is broken"):
        checkpoint.load(path)


def test_nothing_to_go_on_with_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"expected a checkpoint in checkpoints/, got none; start afresh"):
        checkpoint.newest(tmp_path)
    path = checkpoint.save(tmp_path, state(1), 100, keep=3)
    path.write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"expected a whole checkpoint, got 1 broken; start afresh"):
        checkpoint.newest(tmp_path)


@pytest.mark.parametrize("other", [1, 3])
def test_another_format_is_said_and_not_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: int) -> None:
    checkpoint.save(tmp_path, state(1), 100, keep=3)
    with monkeypatch.context() as then:
        then.setattr(checkpoint, "FORMAT", other)
        checkpoint.save(tmp_path, state(2), 200, keep=3)
    with pytest.raises(CheckpointError, match=f"expected format 2, got {other}; use the millrace that wrote it"):
        checkpoint.newest(tmp_path)


@pytest.mark.parametrize("content", [torch.ones(3), {"weights": torch.ones(3)}, {"format": torch.ones(3)}])
def test_another_programs_file_is_said(tmp_path: Path, content: object) -> None:
    path = tmp_path / "model.pt"
    torch.save(content, path)
    with pytest.raises(CheckpointError, match="expected one of millrace, got another program's file"):
        checkpoint.load(path)


class Harmful:
    def __reduce__(self) -> tuple[Any, ...]:
        return shutil.rmtree, ("/no/such/folder/of/millrace",)


def test_reading_runs_no_code(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    torch.save({"format": 2, "env_steps": 3, "state": {"x": Harmful()}}, path)
    with pytest.raises(CheckpointError, match="broken"):
        checkpoint.load(path)
    path.write_bytes(pickle.dumps(Harmful()))
    with pytest.raises(CheckpointError, match="broken"):
        checkpoint.load(path)


class Calls:
    """Is pickled as a call of this function."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self._call


TEXT = "x" * 1000
PAIRS = [(n, n) for n in range(100)]


@pytest.mark.parametrize(
    "hostile",
    [
        Calls(bytearray, 1000),
        [Calls(codecs.encode, TEXT, "latin1") for _ in range(20)],
        Calls(codecs.encode, TEXT, "utf-32"),
        Calls(OrderedDict, PAIRS),
        Calls(torch.Tensor, 1000),
        Calls(torch.UntypedStorage, 1000),
        Calls(torch._utils._rebuild_device_tensor_from_cpu_tensor, torch.zeros(2), torch.float64, "cpu", False),
        {1, 2},
    ],
    ids=["bytearray", "one text often", "four bytes a letter", "container", "tensor", "storage", "copy", "set"],
)
def test_what_torch_would_make_of_a_few_bytes_is_refused_before_it_is_made(tmp_path: Path, hostile: object) -> None:
    """Such as a gigabyte in a file of 353 bytes. What is made here is small, so that the loader alone would take it."""
    path = tmp_path / "model.pt"
    torch.save({"format": 2, "env_steps": 3, "state": {"x": hostile}}, path)
    with pytest.raises(CheckpointError, match=r"expected tensors and plain data|more bytes objects than fit"):
        checkpoint.load(path)


def test_the_pickle_that_torch_reads_is_the_one_that_is_rehearsed(tmp_path: Path) -> None:
    """In a file that begins otherwise, it is not that of the archive; in an archive, its name may be in capital letters."""
    path = checkpoint.save(tmp_path, {"x": 1}, 100, keep=1)
    whole = path.read_bytes()
    path.write_bytes(pickle.dumps({"format": 2, "env_steps": 100, "state": {"x": 2}}, protocol=2) + whole)
    with pytest.raises(CheckpointError, match="it isn't an archive that torch"):
        checkpoint.load(path)
    torch.save({"format": 2, "env_steps": 3, "state": {"x": Calls(bytearray, 1000)}}, path)
    path.write_bytes(path.read_bytes().replace(b"/data.pkl", b"/DATA.pkl"))
    with pytest.raises(CheckpointError, match=r"got builtins\.bytearray|got __builtin__\.bytearray"):
        checkpoint.load(path)


def with_pickle(path: Path, content: bytes) -> None:
    """Write an archive with this pickle, as torch.save does."""
    writer = torch._C.PyTorchFileWriter(str(path))
    writer.write_record("data.pkl", content, len(content))
    writer.write_end_of_file()


TUPLE = b"K\x01\x85"
PAIRED = b"K\x01q\x00" + b"h\x00\x86q\x00" * 200
"""Opcodes that pair a value with itself 200 times. The hash of such a tuple takes 2^200 steps."""
STORAGE = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\n%bX\x03\x00\x00\x00cpuK\x01tQ"


@pytest.mark.parametrize(
    "opcodes",
    [
        b"}" + TUPLE + b"K\x01s",
        b"}(K\x01K\x01" + TUPLE + b"K\x01u",
        b"}G" + bytes(8) + b"K\x01s",
        b"}\x8a\x08" + (2**61 - 1).to_bytes(8, "little") + b"K\x01s",
        STORAGE % TUPLE,
        b"K\x01Q",
    ],
    ids=["key", "second key", "float", "number whose hash is 0", "storage", "storage without a tuple"],
)
def test_keys_that_take_long_to_find_are_refused(tmp_path: Path, opcodes: bytes) -> None:
    path = tmp_path / "model.pt"
    with_pickle(path, b"\x80\x02" + opcodes + b".")
    with pytest.raises(CheckpointError, match=r"expected tensors and plain data, got a (key|storage)"):
        checkpoint.load(path)


@pytest.mark.parametrize(
    ("opcodes", "why"),
    [
        (b"}X\x01\x00\x00\x00a" + PAIRED + b"s", "the same values too often"),
        (b"]q\x00" + b"](h\x00h\x00eq\x00" * 200, "the same values too often"),
        (b"}q\x00" + b"}(K\x01h\x00K\x02h\x00uq\x00" * 200, "the same values too often"),
        (b"]q\x00]q\x01(h\x00h\x00e]q\x02(h\x01h\x01eh\x00K\x01a", "a list or dict that changes after its use"),
        (b"]q\x00h\x00a", "a list or dict that changes after its use"),
        (b"}q\x00K\x01h\x00s", "a list or dict that changes after its use"),
        (b"]q\x00(K\x01h\x00e", "a list or dict that changes after its use"),
    ],
    ids=["tuples", "lists", "dicts", "filled later", "list in itself", "dict in itself", "in itself, of several"],
)
def test_values_that_are_repeated_without_end_are_refused(tmp_path: Path, opcodes: bytes, why: str) -> None:
    """Whoever visits each of them, as an optimizer does, would never end."""
    path = tmp_path / "model.pt"
    with_pickle(path, b"\x80\x02" + opcodes + b".")
    with pytest.raises(CheckpointError, match=why):
        checkpoint.load(path)


def test_values_may_be_shared(tmp_path: Path) -> None:
    shared = [(0.9, 0.999), [1, {"a": (2, 3)}], {}]
    saved = {"parts": [shared] * 20, "long": [[each] for each in shared * 1_000]}
    checkpoint.save(tmp_path, saved, 100, keep=1)
    assert checkpoint.newest(tmp_path)[0].state == saved


def entry(name: bytes, data: bytes, offset: int, extra: bytes) -> bytes:
    """An entry of an archive's directory."""
    numbers = 0, 0, 0, 0, 0, 0, zlib.crc32(data), len(data), len(data), len(name), len(extra), 0, 0, 0, 0, offset
    return ENTRY.pack(b"PK\1\2", *numbers) + name + extra


def file_in_archive(name: bytes, data: bytes) -> bytes:
    """A file as an archive contains it."""
    numbers = 0, 0, 0, 0, 0, zlib.crc32(data), len(data), len(data), len(name), 0
    return struct.pack("<4sHHHHHIIIHH", b"PK\3\4", *numbers) + name + data


def end(count: int, size: int, start: int, record_at: int, comment: bytes = b"") -> bytes:
    """The end of an archive, after its directory."""
    record = struct.pack("<4sQHHIIQQQQ", b"PK\6\6", 44, 0, 45, 0, 0, count, count, size, start)
    located = struct.pack("<4sIQI", b"PK\6\7", 0, record_at, 1)
    return record + located + struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, count, count, size, start, len(comment)) + comment


def archive(how: str) -> bytes:
    """An archive in which torch may find another pickle than Python."""
    data = pickle.dumps({"format": 2, "env_steps": 1, "state": {}}, 2)
    files = {b"a/data.pkl": data, b"a/other": data, b"a/version": b"3"}
    content, entries = b"", list[bytes]()
    for name, data in files.items():
        renamed = b"up" + struct.pack("<HBI", 5 + 7, 1, zlib.crc32(name)) + b"a/other"
        entries.append(entry(name, data, len(content), renamed if how == "renamed" and name == b"a/data.pkl" else b""))
        content += file_in_archive(name, data)
    if how == "two directories":  # one for each reader: the locator leads to the first record, the second is next to it
        first = len(content)
        content += b"".join(entries) + end(3, sum(map(len, entries)), first, 0)[:56]
        start, rest = len(content), entries[1:]
        return content + b"".join(rest) + end(2, sum(map(len, rest)), start, start - 56)
    start = len(content)
    content += b"".join(entries)
    size = len(content) - start
    content += b"?" if how == "a gap" else b""
    return content + end(3, size, start, len(content), b"PK" if how == "a comment" else b"")


@pytest.mark.parametrize("how", ["two directories", "renamed", "a gap", "a comment"])
def test_an_archive_in_which_torch_may_find_another_pickle_than_the_rehearsed_one_is_refused(
    tmp_path: Path, how: str
) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(archive("as torch writes it"))
    assert checkpoint.load(path).env_steps == 1
    path.write_bytes(archive(how))
    with pytest.raises(CheckpointError, match=r"its (directory|last bytes)"):
        checkpoint.load(path)


def with_storage(path: Path, kind: str, key: str, numel: int, records: dict[str, bytes]) -> None:
    """Write an archive with these records, and with a storage that its pickle describes thus."""
    content = b"(X\x07\x00\x00\x00storagec%s\nX%c\x00\x00\x00%sX\x03\x00\x00\x00cpuJ%stQ" % (
        kind.replace(" ", "\n").encode(), len(key.encode()), key.encode(), numel.to_bytes(4, "little", signed=True),
    )  # fmt: skip
    writer = torch._C.PyTorchFileWriter(str(path))
    for name, record in {"data.pkl": b"\x80\x02" + content + b".", **records}.items():
        writer.write_record(name, record, len(record))
    writer.write_end_of_file()


@pytest.mark.parametrize(
    ("kind", "key", "numel", "records"),
    [
        ("torch FloatStorage", "0", 5, {"data/0": bytes(16)}),
        ("torch FloatStorage", "0", 3, {"data/0": bytes(16)}),
        ("torch FloatStorage", "0", -4, {"data/0": bytes(16)}),
        ("torch DoubleStorage", "0", 4, {"data/0": bytes(16)}),
        ("torch.storage UntypedStorage", "0", 17, {"data/0": bytes(16)}),
        ("torch OtherStorage", "0", 4, {"data/0": bytes(16)}),
        ("torch FloatStorage", "1", 4, {"data/0": bytes(16)}),
        ("torch FloatStorage", "0", 4, {}),
        ("torch FloatStorage", "a", 4, {"data/a": bytes(16), "data/A": bytes(8)}),
    ],
)
def test_a_storage_has_the_size_of_its_content(
    tmp_path: Path, kind: str, key: str, numel: int, records: dict[str, bytes]
) -> None:
    """Until October 2025, torch would read the memory behind the content."""
    with_storage(tmp_path / "whole.pt", "torch FloatStorage", "A", 4, {"data/a": bytes(16)})
    with zipfile.ZipFile(tmp_path / "whole.pt") as archive:
        check_pickles(archive)
    with_storage(tmp_path / "model.pt", kind, key, numel, records)
    with zipfile.ZipFile(tmp_path / "model.pt") as archive, pytest.raises(Unfit, match="a storage"):
        check_pickles(archive)


def test_a_storage_whose_name_torch_decodes_otherwise_than_python_is_refused(tmp_path: Path) -> None:
    """Python takes the bytes of "ä" for "├ñ"; torch compares bytes, so it finds another content, which may be shorter."""
    path = tmp_path / "model.pt"
    with_storage(path, "torch FloatStorage", "├ñ", 4, {"data/ä": bytes(16), "data/├ñ": bytes(8)})
    flags = re.compile(rb"(?<=PK\x01\x02....)..", re.DOTALL)  # one of them says that a name is in UTF-8
    path.write_bytes(flags.sub(bytes(2), path.read_bytes()))
    with zipfile.ZipFile(path) as archive, pytest.raises(Unfit, match="ASCII"):
        check_pickles(archive)


def test_all_that_a_state_may_hold_passes_the_rehearsal(tmp_path: Path) -> None:
    dtypes = [torch.float64, torch.bfloat16, torch.bool, torch.int64, torch.uint16, torch.complex64, torch.float8_e4m3fn]
    saved: dict[str, Any] = {
        "tensors": [torch.zeros(3, dtype=dtype) for dtype in dtypes],
        "parameter": torch.nn.Parameter(torch.ones(2)),
        "storages": [
            torch.zeros(0),
            torch.zeros(2, 0, 3),
            *torch.split(torch.zeros(9), 5),
            torch.zeros(3).untyped_storage(),
        ],
        "plain": [(), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), 2**70, -1, 300, 70_000, 0.5, True, False, None, "ä", [], {}],
        "bytes": [b"a", b"\xff" * 300, b"a"],
        "many": list(range(2000)),
        "keys": {"ä": 0, "": 1, 0: 2, -1: 3, 2**60 - 1: 4, -(2**60) + 1: 5},
    }
    checkpoint.save(tmp_path, saved, 100, keep=1)
    found = checkpoint.newest(tmp_path)[0].state
    assert all(map(torch.equal, found.pop("tensors"), saved.pop("tensors")))
    assert torch.equal(found.pop("parameter"), saved.pop("parameter"))
    assert [each.nbytes for each in found.pop("storages")[:4]] == [each.nbytes for each in saved.pop("storages")[:4]]
    assert found == saved


def test_all_storages_that_torch_writes_have_a_known_size() -> None:
    kinds = {kind: dtype for dtype, kind in _dtype_to_storage_type_map().items() if kind[0] != "Q"}  # without quantized ones
    sizes = {f"torch {kind}": torch.empty(0, dtype=dtype).element_size() for kind, dtype in kinds.items()}
    assert sizes | {"torch.storage UntypedStorage": 1} == STORAGES


def cycle() -> list[Any]:
    within: list[Any] = [torch.ones(3).expand(10**12, 3)]
    within.append(within)
    return within


@pytest.mark.parametrize(
    "tensors",
    [
        torch.zeros(1).expand(10**12),
        torch.zeros(8)[:4].as_strided((10**6, 4), (0, 1)),
        torch.sparse_coo_tensor(torch.zeros(1, 1, dtype=torch.long), torch.ones(1), (10**12,), check_invariants=True),
        torch.empty(10**12, device="meta"),
        list(torch.ones(1, 10_000).expand(100, 10_000)),
        [[[torch.zeros(1).expand(10**12)] * 2] * 2] * 2,
        cycle(),
    ],
    ids=["expanded", "strided", "sparse", "meta", "views", "shared", "cycle"],
)
def test_a_tensor_that_is_larger_than_the_file_is_damage(tmp_path: Path, tensors: Any) -> None:
    """Whoever copies it, as an optimizer does, would fill the memory."""
    (tmp_path / "checkpoints").mkdir()
    path = tmp_path / "checkpoints" / "000000000100.pt"
    torch.save({"format": 2, "env_steps": 100, "state": {"x": {"y": [tensors]}}}, path)
    with pytest.raises(CheckpointError, match="broken"):
        checkpoint.load(path)
    checkpoint.save(tmp_path, state(2), 50, keep=1)
    assert checkpoint.newest(tmp_path)[0].env_steps == 50


def test_views_come_back(tmp_path: Path) -> None:
    flat = torch.arange(60_000.0)
    saved: dict[str, Any] = {"flat": flat, "parts": [flat[:100], flat[100:]], "transposed": flat.reshape(100, 600).T}
    checkpoint.save(tmp_path, saved, 100, keep=1)
    found = checkpoint.newest(tmp_path)[0].state
    assert all(torch.equal(found[name], saved[name]) for name in ("flat", "transposed"))


def refused(folder: Path, state: dict[str, Any]) -> str:
    """Why the state is not written. Nothing of it stays on the disk."""
    with pytest.raises(UsageError) as caught:
        checkpoint.save(folder, state, 100, keep=3)
    assert files(folder) == []
    return str(caught.value)


def test_an_expanded_tensor_is_not_written(tmp_path: Path) -> None:
    line = refused(tmp_path, {"flat": torch.zeros(1).expand(30)})
    assert line.startswith(
        "checkpoint: state['flat'] (torch.Tensor): expected tensors whose elements are all in the file, got"
    )


class OwnDict(dict[str, Any]):
    pass


class OwnTuple(NamedTuple):
    x: int = 1


def generator() -> Iterator[int]:
    yield 1


def nest() -> list[Any]:
    """Deeper than pickle can follow."""
    outermost: list[Any] = []
    for _ in range(10_000):
        outermost = [outermost]
    return outermost


class Handle:
    def __reduce__(self) -> str:
        raise RuntimeError("a handle can't be pickled")


@pytest.mark.parametrize(
    ("stray", "named"),
    [
        (b"", "builtins.bytes"),
        (torch.nn.Buffer(torch.ones(1)), "torch.Tensor"),
        (np.float64(1.0), "numpy.float64"),
        (np.zeros(3), "numpy.ndarray"),
        ({1, 2}, "builtins.set"),
        (np.random.default_rng(0), "numpy.random._generator.Generator"),
        (generator(), "builtins.generator"),
        (OwnDict(), f"{__name__}.OwnDict"),
        (OwnTuple(), f"{__name__}.OwnTuple"),
        (torch.Size([1]), "torch.Size"),
        (iter(torch.utils.data.DataLoader([1])), "torch.utils.data.dataloader._SingleProcessDataLoaderIter"),  # type: ignore[arg-type]
        (Handle(), f"{__name__}.Handle"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_could_not_be_read_back_is_not_written_and_named(tmp_path: Path, stray: object, named: str) -> None:
    line = refused(tmp_path, {"whole": [torch.ones(3)], "inner": [stray]})
    assert line.startswith(f"checkpoint: state['inner'][0] ({named}): expected tensors and plain data, got "), line
    assert line.endswith("; fix state_dict")


def test_a_nest_that_is_too_deep_is_not_written_and_named(tmp_path: Path) -> None:
    line = refused(tmp_path, {"whole": [torch.ones(3)], "inner": nest()})
    assert re.fullmatch(
        r"checkpoint: state\['inner'\](\[0\]){19} \(builtins\.list\): .*RecursionError: .*; fix state_dict", line
    )


@pytest.mark.parametrize("key", [(1, 2), 0.5, None, True, 2**60, -(2**60)])
def test_a_state_with_keys_that_could_not_be_read_back_is_not_written(tmp_path: Path, key: object) -> None:
    line = refused(tmp_path, {"inner": {key: 1}})
    assert line.startswith("checkpoint: state['inner'] (builtins.dict): expected tensors and plain data, got a key that"), (
        line
    )


def test_a_state_that_repeats_values_without_end_is_not_written(tmp_path: Path) -> None:
    paired: Any = ()
    for _ in range(40):
        paired = (paired, paired)
    assert "the same values too often" in refused(tmp_path, {"inner": [paired]})
    within: list[Any] = []
    within.append(within)
    assert "changes after its use" in refused(tmp_path, {"inner": within})


def test_a_dict_with_too_many_numbers_as_keys_is_refused(tmp_path: Path) -> None:
    """They can be chosen so that each collides with all others: 700,000 numbers, in 3.5 MB, take minutes."""
    few = {"x": dict.fromkeys(range(10_000), 1) | {str(n): n for n in range(20_000)}}
    checkpoint.save(tmp_path, few, 100, keep=1)
    assert checkpoint.newest(tmp_path)[0].state == few
    (tmp_path / "checkpoints" / "000000000100.pt").unlink()
    assert "state['x'] (builtins.dict): expected dicts with at most 10,000 numbers as keys" in refused(
        tmp_path, {"x": dict.fromkeys(range(10_001), 1)}
    )
    path = tmp_path / "model.pt"
    for first, dicts, keys in ((b"}", 1, 10_001), (b"]", 11, 10_000)):
        one = b"".join(b"M" + n.to_bytes(2, "little") + b"K\x01s" for n in range(keys))
        content = first + (one if dicts == 1 else (b"}" + one + b"a") * dicts)
        with_pickle(path, b"\x80\x02" + content + b".")
        with pytest.raises(CheckpointError, match="at most 10,000 numbers as keys"):
            checkpoint.load(path)


def test_ten_dicts_may_have_as_many_numbers_as_keys_as_one_may_have(tmp_path: Path) -> None:
    few = {"x": [dict.fromkeys(range(10_000), 1) for _ in range(10)]}
    checkpoint.save(tmp_path, few, 100, keep=1)
    assert checkpoint.newest(tmp_path)[0].state == few
    (tmp_path / "checkpoints" / "000000000100.pt").unlink()
    assert "numbers as keys, and few such dicts, got more" in refused(tmp_path, {"x": few["x"], "y": {0: 1}})


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"ccollections\nOrderedDict\n)R}K\x01Nsb", "got a number as a name"),
        (b"ccollections\nOrderedDict\n)R}X\x01\x00\x00\x00aNsK\x01Nsb", "got a number as a name"),
        (b"]q\x01", "got the opcode BINPUT"),
        (b"]q\x00]r\x02\x00\x00\x00a", "got the opcode LONG_BINPUT"),
    ],
    ids=["number as a name", "two names", "first note", "second note"],
)
def test_keys_of_the_dicts_of_attributes_and_notes_cannot_be_chosen(tmp_path: Path, content: bytes, why: str) -> None:
    """Torch copies attributes as often as the file says, and keeps the notes of a pickle in a dict."""
    with_pickle(tmp_path / "model.pt", b"\x80\x02" + content + b".")
    with pytest.raises(CheckpointError, match=why):
        checkpoint.load(tmp_path / "model.pt")


def test_the_state_of_a_module_comes_back(tmp_path: Path) -> None:
    """It is an OrderedDict with an attribute."""
    net = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3))
    saved = {"net": net.state_dict(), "again": net.state_dict()}
    checkpoint.save(tmp_path, saved, 100, keep=1)
    found = checkpoint.newest(tmp_path)[0].state
    assert all(torch.equal(found["net"][name], value) for name, value in saved["net"].items())
    assert found["net"]._metadata == saved["net"]._metadata  # type: ignore[attr-defined]
    net.load_state_dict(found["again"])


MAKE_ORDERED = b"ccollections\nOrderedDict\n)R"


@pytest.mark.parametrize(
    "opcodes",
    [
        b"ctorch\nFloatStorage\n}b",
        MAKE_ORDERED + b"](K\x01K\x02\x86eb",
        MAKE_ORDERED + MAKE_ORDERED + b"b",
        MAKE_ORDERED + b"}\x85b",
        MAKE_ORDERED + b"K\x00\x85b",
        TUPLE + b"}b",
        b"}}b",
    ],
    ids=["function", "list of pairs", "ordered", "tuple", "number in a tuple", "on a tuple", "dict"],
)
def test_attributes_are_set_only_on_an_ordered_dict_and_only_from_a_dict(tmp_path: Path, opcodes: bytes) -> None:
    path = tmp_path / "model.pt"
    with_pickle(path, b"\x80\x02" + opcodes + b".")
    with pytest.raises(CheckpointError, match="expected tensors and plain data, got the opcode BUILD"):
        checkpoint.load(path)


def test_attributes_are_values_like_others(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    with_pickle(path, b"\x80\x02" + MAKE_ORDERED + b"}" + TUPLE + b"K\x01sb.")
    with pytest.raises(CheckpointError, match="got a key that is neither"):
        checkpoint.load(path)
    with_pickle(path, b"\x80\x02" + MAKE_ORDERED + b"q\x00}X\x01\x00\x00\x00ah\x00sb.")
    with pytest.raises(CheckpointError, match="a list or dict that changes after its use"):
        checkpoint.load(path)
    with_pickle(
        path, b"\x80\x02" + MAKE_ORDERED + b"q\x00" + (MAKE_ORDERED + b"}X\x01\x00\x00\x00a(h\x00h\x00tsbq\x00") * 200 + b"."
    )
    with pytest.raises(CheckpointError, match="the same values too often"):
        checkpoint.load(path)
    ordered: Any = OrderedDict()
    ordered.more = torch.zeros(1).expand(10**12)
    torch.save({"format": 2, "env_steps": 100, "state": {"x": ordered}}, path)
    with pytest.raises(CheckpointError, match="elements are all in the file"):
        checkpoint.load(path)
