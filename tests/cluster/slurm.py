"""A Slurm cluster on this one machine: munged, slurmctld and two nodes with two cores each, all on loopback, in one folder.

Rule: an installed Slurm's files are neither read nor changed; no daemon and no job remains when the cluster is closed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType

import psutil

from tests.system.stage.processes import ROOT, Running, Stage, free_port, wait_for

DAEMONS = ("munged", "slurmctld", "slurmd")
NODES = ("n1", "n2")
DEADLINE_S = 30
CONFIGURATION = """\
ClusterName=test
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
CredType=cred/munge
# A job that is queued again starts when its old credentials have expired: by default after two minutes.
AuthInfo=socket={folder}/munge/socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=batch_sched_delay=0,sched_interval=2
SlurmdParameters=config_overrides
ReturnToService=2
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def why_not() -> str:
    """The reason why no such cluster can run here; empty if one can."""
    if os.geteuid() != 0:
        return "slurmd takes root"
    missing = [name for name in DAEMONS if shutil.which(name) is None]
    return f"{', '.join(missing)} missing: make packages" if missing else ""


class Slurm:
    """A cluster, as a context manager."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._daemons: list[Running] = []
        self._folder = Path(tempfile.mkdtemp(prefix="slurm-", dir="/tmp"))  # the path of a socket must be short
        self._variables = {**os.environ, "SLURM_CONF": str(self._folder / "slurm.conf"), "PYTHONPATH": str(ROOT)}

    def __enter__(self) -> Slurm:
        try:
            self._begin()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._ask("scancel", "--user=root", check=False)
            wait_for(lambda: not self._ask("squeue", "-h"), 60, "the end of all jobs")
        finally:
            self._end()

    def _begin(self) -> None:
        """Start the daemons, and wait until the nodes take jobs."""
        munge = self._folder / "munge"
        munge.mkdir(mode=0o700)
        (munge / "key").write_bytes(os.urandom(128))
        (munge / "key").chmod(0o400)
        nodes = [f"NodeName={name} NodeHostname=localhost NodeAddr=127.0.0.1 Port={free_port()}" for name in NODES]
        text = CONFIGURATION.format(folder=self._folder, port=free_port())
        text += "".join(f"{node} CPUs=2 RealMemory=2000\n" for node in nodes)
        (self._folder / "slurm.conf").write_text(text)
        files = {name: munge / name for name in ("socket", "pid-file", "log-file", "seed-file")}
        paths = [f"--{name}={path}" for name, path in files.items()]
        self._start("munged", "--foreground", "--force", f"--key-file={munge / 'key'}", *paths)
        wait_for((munge / "socket").exists, DEADLINE_S, "munged's socket")
        self._start("slurmctld", "-D", "-i")
        for name in NODES:
            self._start("slurmd", "-D", "-N", name)
        wait_for(lambda: self._ask("sinfo", "-h", "-o", "%T %D", check=False).strip() == f"idle {len(NODES)}", DEADLINE_S)

    def _end(self) -> None:
        """Kill all that runs, and delete the files."""
        for process in self._ours():
            process.kill()
        for daemon in self._daemons:
            daemon.process.wait(10)
        wait_for(lambda: not self._ours(), DEADLINE_S, "the end of all of Slurm's processes")
        shutil.rmtree(self._folder)

    def submit(self, script: Path) -> str:
        """Submit a script with sbatch; the job id."""
        return self._ask("sbatch", "--parsable", str(script)).strip()

    def cancel(self, job: str, *flags: str) -> None:
        """Cancel a job with scancel."""
        self._ask("scancel", *flags, job)

    def requeue(self, job: str) -> None:
        """End a job and queue it again, as an administrator would."""
        self._ask("scontrol", "requeue", job)

    def seen(self, job: str) -> dict[str, str]:
        """The fields that scontrol shows of a job: JobState, Restarts, ExitCode and more."""
        words = self._ask("scontrol", "show", "job", "-o", job).split()
        return dict(word.partition("=")[::2] for word in words)

    def _ask(self, *command: str, check: bool = True) -> str:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=DEADLINE_S, check=False, env=self._variables, cwd=self._folder
        )
        assert done.returncode == 0 or not check, f"{' '.join(command)}: {done.stderr}"
        return done.stdout

    def _start(self, *command: str) -> None:
        before = ("env", f"SLURM_CONF={self._folder / 'slurm.conf'}")
        self._daemons.append(self._stage.start([*before, *command], command[0]))

    def _ours(self) -> list[psutil.Process]:
        """Daemons, job steps and what runs in them: all have our configuration in their environment."""
        found = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("SLURM_CONF") == self._variables["SLURM_CONF"]:
                    found.append(process)
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                continue
        return [process for process in found if process.status() != psutil.STATUS_ZOMBIE]
