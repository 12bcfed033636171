"""The sizes of a probe's sessions: they fit into the time, even if all that copies do computes."""

from __future__ import annotations

import pytest

from millrace.planning.probe_sizes import SPARE, Needed, SessionSize


@pytest.mark.parametrize(
    ("before", "after", "times"),
    [
        (SessionSize(1, 1), SessionSize(1, 8), 8),  # the copies of a worker take turns
        (SessionSize(1, 1), SessionSize(2, 1), 1),  # each worker has a core
        (SessionSize(2, 1), SessionSize(8, 1), 4),  # four workers for each core
        (SessionSize(8, 1), SessionSize(16, 1), 2),
        (SessionSize(1, 2), SessionSize(8, 4), 8),
    ],
)
def test_a_session_fits_if_there_is_time_for_its_copies_one_after_another_and_its_workers_on_the_cores(
    before: SessionSize, after: SessionSize, times: int
) -> None:
    needed = Needed(before, 3.0)
    least_s = SPARE * times * 3.0
    assert needed.fits(after, cores=2, left_s=1.001 * least_s)
    assert not needed.fits(after, cores=2, left_s=0.999 * least_s)


@pytest.mark.parametrize("left_s", [0.5, 4.0, 9.0, 40.0])
def test_the_most_copies_in_a_worker_are_as_many_as_fit_into_the_time(left_s: float) -> None:
    needed = Needed(SessionSize(), 2.0)
    most = needed.most_each(left_s)
    assert not needed.fits(SessionSize(1, most + 1), 2, left_s)
    assert most == 0 or needed.fits(SessionSize(1, most), 2, left_s)
