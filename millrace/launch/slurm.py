"""`millrace launch slurm`: a learner and workers as one Slurm job, its script. Pure; no scheduler logic.

Two job steps: the learner on the job's first node, the workers wherever Slurm puts them. They meet through a folder that all
nodes share: it holds the address, the keys, and the runs, so that a job that is queued again goes on.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from millrace.cli.flags import SlurmFlags
from millrace.launch.cluster_flags import learner_flags
from protocol.errors import UsageError


def script(flags: SlurmFlags, rest: Sequence[str]) -> str:
    """For sbatch. `rest` are the learner's own flags. Raises `UsageError`."""
    folder = flags.folder.expanduser().absolute()
    for text in (str(folder), flags.time, flags.partition):
        if any(character.isspace() or character in "%\"'\\" for character in text):
            raise UsageError(f"{text!r}: sbatch takes no spaces, quotes or % in its options; choose another name")
    for name in ("cpus", "save_s"):
        if getattr(flags, name) < 1:
            raise UsageError(f"{name} expected int >= 1, got {getattr(flags, name)}")
    options = {
        "job-name": flags.name,
        "ntasks": str(1 + flags.workers),
        "cpus-per-task": str(flags.cpus),
        "time": flags.time,
        "signal": f"B:USR1@{flags.save_s}",
        "output": f"{folder}/%x-%j.log",
        "open-mode": "append",
        **({"partition": flags.partition} if flags.partition else {}),
    }
    directives = "".join(f"#SBATCH --{name}={value}\n" for name, value in options.items())
    env, *own = map(shlex.quote, learner_flags(flags.env, rest, bind="BIND", runs="RUNS"))
    return f"""\
#!/bin/bash
# A learner and {flags.workers} workers as one Slurm job: sbatch THIS_FILE. docs/slurm.md tells more.
{directives}#SBATCH --requeue

set -u
folder={shlex.quote(str(folder))}
millrace=({shlex.quote(str(flags.python))} -m millrace)
token=$folder/keys/default.token
[ -e "$token" ] || "${{millrace[@]}}" keys new default --keys "$folder/keys" || exit
port=$((20000 + SLURM_JOB_ID % 20000))  # a port for each job: other jobs may have this node too
address=$folder/$SLURM_JOB_NAME-$SLURM_JOB_ID.address
rm -f "$address"
step=(srun --exact --cpus-per-task={flags.cpus} --mem=0)  # 0: a step leaves the job's memory to the other one, too

# The learner. Its step writes the address when it has its cores, so that the workers' step cannot take them first.
"${{step[@]}}" --nodes=1 --ntasks=1 --nodelist="$SLURMD_NODENAME" \\
    bash -c 'echo "tcp://$SLURM_LAUNCH_NODE_IPADDR:$2" > "$1"; exec "${{@:3}}"' learner "$address" "$port" \\
    "${{millrace[@]}}" learner {env} --keys "$folder/keys" \\
    {" ".join(own).replace("BIND", '"tcp://0.0.0.0:$port"', 1).replace("RUNS", '"$folder/runs"', 1)} &
learner=$!
until [ -s "$address" ] || ! kill -0 "$learner" 2>/dev/null; do sleep 0.2; done

# A task is a worker, started again unless it was told to leave (0) or refused (2).
"${{step[@]}}" --ntasks={flags.workers} --wait=0 --kill-on-bad-exit=0 \\
    bash -c 'stay=1; trap stay=0 TERM; while [ $stay = 1 ]; do "$@"; case $? in 0|2) break;; esac; sleep 1; done' worker \\
    "${{millrace[@]}}" worker "$(cat "$address")" --token "$token" --join-timeout-s 600 &
workers=$!

# SIGTERM to the learner's step: a checkpoint, and the workers are sent home. srun itself would kill.
again=0
trap 'again=1; scancel --signal=TERM "$SLURM_JOB_ID.0"' USR1  # {flags.save_s} s before the time limit
trap : TERM  # scancel: Slurm tells both steps itself
while kill -0 "$learner" 2>/dev/null; do wait "$learner"; done
wait "$learner"
code=$?
scancel --signal=TERM "$SLURM_JOB_ID.1" 2>/dev/null  # who has not heard the learner
while kill -0 "$workers" 2>/dev/null; do wait "$workers"; done
rm -f "$address"
[ "$again" -eq 0 ] || scontrol requeue "$SLURM_JOB_ID"
exit "$code"
"""
