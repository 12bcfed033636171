"""What a user of a plan should know, apart from the settings and the speed: problems that were found, and advice. Pure.

Rule: each line is about something that was measured here, and each flag that it names works with this environment. Wrappers
of gymnasium and hindsight are advised only for one agent.
"""

from __future__ import annotations

import msgspec

from millrace.planning.expected_rate import Situation, Sizes
from millrace.planning.in_words import counted, number_in_words, time_in_words
from millrace.planning.recommendation import Rate

BUSY = 0.5  # if the load average per core is above this, the machine counts as busy
RESETS_COUNT = 1.1  # resets in the background are advised if they make a run faster by at least this factor
SLOW_START_S = 10.0
OF_EPISODE = 0.05  # if no episode has ended, resets may matter if one takes more than this share of the time of all steps


def about_measurements(sizes: Sizes, situation: Situation, rate: Rate) -> list[str]:
    """The lines that follow from the measurements."""
    measured = situation.measured
    machine = situation.machine
    lines = list(measured.findings)
    if sizes.envs > measured.copies_worked:
        lines.append(
            f"this command has {sizes.envs} env copies, but the plan measured at most "
            f"{counted(measured.copies_worked, 'copy', 'copies')} at the same time: the speed of {sizes.envs} is computed, "
            "and they may not work together"
        )
    if measured.copies_failed and measured.copies_worked == 1:
        lines.append(
            f"evaluations need a second copy, but {measured.copies_failed} did not work side by side: the evaluation of "
            "this command fails unless a second copy works"
        )
    elif measured.failed_in_one_worker and measured.worked_in_one_worker == 1:
        lines.append(
            f"evaluations need a second copy in a worker, but {measured.failed_in_one_worker} in one worker did not work: "
            "the evaluation of this command fails unless 2 work. If the environment allows only one copy in each process, "
            "use OwnProcess, as in docs/how-to/named_simulators.md"
        )
    if machine.load > BUSY * machine.cores:
        lines.append(
            f"other programs use the {counted(machine.cores, 'core')} (load average {number_in_words(machine.load)}): "
            "beside them, runs are slower than expected here"
        )
    if measured.deterministic is False:
        lines.append(
            "it isn't deterministic: the same seed and actions gave other results; so if a worker is lost, new episodes "
            "begin, and two runs with the same seed differ"
        )
    if measured.wrong_masks:
        lines.append(f"its action masks aren't as a run needs them: {measured.wrong_masks}")
    if measured.episode_steps is None and measured.reset_s > OF_EPISODE * measured.alone.steps * measured.alone.own_s:
        lines.append(
            f"resets take {time_in_words(measured.reset_s)}, and the expected speed doesn't count them, because no episode "
            "has ended and there is no time limit; if your episodes are short, allow more time with --seconds"
        )
    one_agent = measured.agents == 1
    faster = rate(sizes, msgspec.structs.replace(situation, resets_ahead=True))
    twice_allowed = not machine.most_copies or 2 * sizes.envs <= machine.most_copies  # the limit counts a copy once
    if one_agent and twice_allowed and faster > RESETS_COUNT * rate(sizes, situation):
        lines.append(
            f"resets take {time_in_words(measured.reset_s)}: with --wrappers millrace:ResetAhead, which makes them in the "
            f"background, {number_in_words(faster)} env steps/s are expected; the environment must work in a second thread, "
            "and each copy then needs the memory and the licences of two"
        )
    if one_agent and measured.goals:
        lines.append(
            "its observations have goals: an algorithm with a replay buffer can learn in hindsight (--hindsight 0.8)"
        )
    if measured.start_s > SLOW_START_S:
        lines.append(
            f"a worker with a copy takes {time_in_words(measured.start_s)} to start: after this time a lost one is replaced"
        )
    return lines
