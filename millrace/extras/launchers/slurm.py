"""`millrace launch slurm`: makes the script of one Slurm job that runs a learner and workers. Pure; no scheduler logic.

The job has two steps: the learner on the job's first node, and the workers on nodes that Slurm chooses. All nodes share a
folder, which contains the learner's address, the keys and the run folders, so a requeued job resumes its run.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence

from millrace.extras.launchers.command_line import learner_flags
from millrace.extras.launchers.flags import SlurmFlags
from millrace.protocol.errors import UsageError
from millrace.protocol.home_folder import expanded


def script(flags: SlurmFlags, rest: Sequence[str]) -> str:
    """The script for sbatch. `rest`: the user's flags for the learner. Raises `UsageError` for text sbatch can't take."""
    folder = expanded(flags.folder, "folder").absolute()
    for text in (str(folder), flags.time, flags.partition):
        if any(character.isspace() or character in "%\"'\\" for character in text):
            raise UsageError(f"{text!r}: sbatch takes no spaces, quotes or % in its options; choose another name")
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
    env, *own = map(shlex.quote, learner_flags(flags.env, rest, flags.workers, bind="BIND", runs="RUNS"))
    return f"""\
#!/bin/bash
# A learner and {flags.workers} workers as one Slurm job: sbatch THIS_FILE. See docs/how-to/clusters.md.
{directives}#SBATCH --requeue

set -u
folder={shlex.quote(str(folder))}
millrace=({shlex.quote(str(flags.python if flags.python.name else sys.executable))} -m millrace)
token=$folder/keys/default.token
[ -e "$token" ] || "${{millrace[@]}}" keys new default --keys "$folder/keys" || exit
port=$((20000 + SLURM_JOB_ID % 20000))  # a port for each job: other jobs may have this node too
address=$folder/$SLURM_JOB_NAME-$SLURM_JOB_ID.address
rm -f "$address"
step=(srun --exact --cpus-per-task={flags.cpus} --mem=0)  # 0: both steps share the job's memory

# The learner. Its step writes the address once it has its cores, so that the step of the workers cannot take them first.
"${{step[@]}}" --nodes=1 --ntasks=1 --nodelist="$SLURMD_NODENAME" \\
    bash -c 'echo "tcp://$SLURM_LAUNCH_NODE_IPADDR:$2" > "$1"; exec "${{@:3}}"' learner "$address" "$port" \\
    "${{millrace[@]}}" learner {env} --keys "$folder/keys" \\
    {" ".join(own).replace("BIND", '"tcp://0.0.0.0:$port"', 1).replace("RUNS", '"$folder/runs"', 1)} &
learner=$!
until [ -s "$address" ] || ! kill -0 "$learner" 2>/dev/null; do sleep 0.2; done

# Each task is a worker. It is started again unless the learner told it to leave (exit code 0) or refused it (2).
"${{step[@]}}" --ntasks={flags.workers} --wait=0 --kill-on-bad-exit=0 \\
    bash -c 'stay=1; trap stay=0 TERM; while [ $stay = 1 ]; do "$@"; case $? in 0|2) break;; esac; sleep 1; done' worker \\
    "${{millrace[@]}}" worker "$(cat "$address")" --token "$token" --join-timeout-s 600 &
workers=$!

# Before the time limit: send SIGTERM to the learner's job step, not to srun, which would kill its tasks. The learner then
# writes a checkpoint and tells the workers to leave.
again=0
trap 'again=1; scancel --signal=TERM "$SLURM_JOB_ID.0"' USR1  # {flags.save_s} s before the time limit
trap : TERM  # scancel: Slurm signals both steps itself
while kill -0 "$learner" 2>/dev/null; do wait "$learner"; done
wait "$learner"
code=$?
scancel --signal=TERM "$SLURM_JOB_ID.1" 2>/dev/null  # workers that the learner's message did not reach
while kill -0 "$workers" 2>/dev/null; do wait "$workers"; done
rm -f "$address"
[ "$again" -eq 0 ] || scontrol requeue "$SLURM_JOB_ID"
exit "$code"
"""
