"""What control groups leave a process: the least of its own group and all above it, in both versions of the files."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from millrace.protocol.machine.available_memory import available_bytes
from millrace.protocol.machine.control_groups import cpu_quota, free_bytes
from millrace.protocol.machine.cpu_cores import usable_cores

V2 = "31 23 0:28 / /sys/fs/cgroup rw,relatime shared:9 - cgroup2 cgroup2 rw,nsdelegate"
V1_MEMORY = "35 31 0:32 / /sys/fs/cgroup/memory rw,relatime shared:9 - cgroup cgroup rw,memory"
V1_CPU = "36 31 0:33 / /sys/fs/cgroup/cpu,cpuacct rw,relatime shared:8 - cgroup cgroup rw,cpu,cpuacct"
NO_LIMIT_V1 = str(2**63 - 4096)


def system(tmp_path: Path, mounts: list[str], groups: list[str]) -> Path:
    """A folder that stands for `/`, with these lines in /proc/self/mountinfo and /proc/self/cgroup."""
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/mountinfo").write_text("\n".join(["22 1 8:1 / / rw - ext4 /dev/root rw", *mounts]) + "\n")
    (tmp_path / "proc/self/cgroup").write_text("\n".join(groups) + "\n")
    return tmp_path


def write(root: Path, group: str, **values: object) -> None:
    """Write files of one group, at its path below /sys/fs/cgroup. In their names, `__` stands for a dot."""
    folder = root / "sys/fs/cgroup" / group
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in values.items():
        (folder / name.replace("__", ".")).write_text(f"{value}\n")


# -------------------------------------------------------------------------------------------- memory


def test_in_version_2_the_least_of_all_groups_above_counts_and_inactive_cache_is_free(
    tmp_path: Path,
) -> None:
    """As in a job of Slurm: the limit is at the job, and its process is in a group of a step below it."""
    root = system(tmp_path, [V2], ["0::/system.slice/job_7/step_0"])
    assert free_bytes(root) is None
    write(root, "system.slice/job_7/step_0", memory__max="max", memory__current=900, memory__stat="anon 1")
    assert free_bytes(root) is None
    write(root, "system.slice/job_7", memory__max=3000, memory__current=1000, memory__stat="anon 1\ninactive_file 500\n")
    assert free_bytes(root) == 2500
    write(root, "system.slice/job_7/step_0", memory__max=2000)
    assert free_bytes(root) == 1100
    write(root, "system.slice", memory__max="max", memory__high=5000, memory__current=4600)
    assert free_bytes(root) == 400, "above memory.high, the kernel all but stops the processes"
    write(root, "system.slice", memory__current=7000)
    assert free_bytes(root) == 0
    write(root, "other", memory__max=1, memory__current=1)
    assert free_bytes(root) == 0


def test_in_version_1_too(tmp_path: Path) -> None:
    root = system(tmp_path, [V1_MEMORY, V1_CPU], ["5:cpu,cpuacct:/", "4:memory:/slurm/job_7/step_0", "0::/elsewhere"])
    usage = {"memory__usage_in_bytes": 1000}
    write(root, "memory", memory__limit_in_bytes=NO_LIMIT_V1, **usage)
    assert free_bytes(root) == 2**63 - 4096 - 1000
    write(root, "memory/slurm/job_7/step_0", memory__limit_in_bytes=NO_LIMIT_V1, **usage)
    write(root, "memory/slurm/job_7", memory__limit_in_bytes=3000, **usage, memory__stat="cache 7\ntotal_inactive_file 500")
    assert free_bytes(root) == 2500


def test_in_a_hybrid_each_tree_has_a_path_of_its_own(tmp_path: Path) -> None:
    unified = V2.replace("/sys/fs/cgroup", "/sys/fs/cgroup/unified")
    root = system(tmp_path, [V1_MEMORY, unified], ["9:name=systemd:/user", "4:memory:/job_7", "0::/user"])
    write(root, "unified/user", cgroup__procs=1)
    write(root, "memory/job_7", memory__limit_in_bytes=3000, memory__usage_in_bytes=1000)
    write(root, "memory/user", memory__limit_in_bytes=1, memory__usage_in_bytes=1)
    assert free_bytes(root) == 2000


@pytest.mark.parametrize(
    ("mount", "group"),
    [
        (V2, "0::/"),  # a namespace of its own
        (V2.replace("0:28 / ", "0:28 /docker/1a "), "0::/docker/1a"),  # the host's paths, and only the own part is mounted
        (V2, "0::/../../job_7"),  # moved out of its namespace
        (V2, "0::/docker/1a"),  # the own part is mounted, and mountinfo does not say so
        (V2.replace("0:28 / ", "0:28 /docker/1a "), "0::/"),
    ],
)
def test_a_container_sees_the_limit_at_its_mount_point(tmp_path: Path, mount: str, group: str) -> None:
    root = system(tmp_path, [mount], [group])
    write(root, "", memory__max=3000, memory__current=1000)
    assert free_bytes(root) == 2000


def test_a_tree_that_is_mounted_elsewhere_is_found(tmp_path: Path) -> None:
    root = system(
        tmp_path, [V1_MEMORY.replace("/sys/fs/cgroup/memory", r"/sys/fs/cgroup/of\040this\040host")], ["4:memory:/a b"]
    )
    write(root, "of this host/a b", memory__limit_in_bytes=3000, memory__usage_in_bytes=1000)
    assert free_bytes(root) == 2000


def test_memory_is_the_machines_or_what_a_job_leaves(tmp_path: Path) -> None:
    assert available_bytes(tmp_path) is None
    root = system(tmp_path, [V2], ["0::/job_7"])
    assert available_bytes(root) is None
    (root / "proc/meminfo").write_text("MemTotal:  9000 kB\nMemAvailable:  4000 kB\nHugePages_Total:  0\n")
    assert available_bytes(root) == 4000 * 1024
    write(root, "job_7", memory__max=3000, memory__current=1000)
    assert available_bytes(root) == 2000


@pytest.mark.parametrize("content", [b"", b"\xff\xfe:\xff\n::\n:::", b"0::\n4:memory\n- - -\n1 - cgroup"])
def test_files_of_another_form_say_nothing(tmp_path: Path, content: bytes) -> None:
    root = system(tmp_path, [], [])
    for name in ("cgroup", "mountinfo"):
        (root / "proc/self" / name).write_bytes(content)
    assert free_bytes(root) is None
    assert cpu_quota(root) == math.inf


# -------------------------------------------------------------------------------------------- cores


@pytest.mark.parametrize(
    ("told", "cores"),
    [
        ("max 100000", math.inf),
        ("400000 100000", 4.0),
        ("150000 100000", 1.5),
        ("5000 0", math.inf),
        ("", math.inf),
        ("5000", math.inf),
    ],
)
def test_the_cpu_quota_of_version_2(tmp_path: Path, told: str, cores: float) -> None:
    root = system(tmp_path, [V2], ["0::/job_7/step_0"])
    write(root, "job_7/step_0", cpu__max="9900000 100000")
    write(root, "job_7", cpu__max=told)
    assert cpu_quota(root) == min(99.0, cores)


def test_the_cpu_quota_of_version_1(tmp_path: Path) -> None:
    root = system(tmp_path, [V1_MEMORY, V1_CPU], ["5:cpu,cpuacct:/job_7/step_0", "4:memory:/"])
    write(root, "cpu,cpuacct/job_7/step_0", cpu__cfs_quota_us=-1, cpu__cfs_period_us=100000)
    assert cpu_quota(root) == math.inf
    write(root, "cpu,cpuacct/job_7", cpu__cfs_quota_us=250000, cpu__cfs_period_us=100000)
    assert cpu_quota(root) == 2.5


@pytest.mark.parametrize(("quota", "count"), [("max", 8), (400000, 4), (150000, 1), (5000, 1), (9900000, 8)])
def test_a_process_may_use_its_share_of_the_cores(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, quota: object, count: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    assert usable_cores(tmp_path) == 8  # not Linux
    root = system(tmp_path, [V2], ["0::/job_7/step_0"])
    write(root, "job_7", cpu__max=f"{quota} 100000")
    assert usable_cores(root) == count
