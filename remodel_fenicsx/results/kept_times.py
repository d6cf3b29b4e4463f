"""Which of the recorded times are shown where all would be too many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from remodel_fenicsx.results.recording import HistoryColumns

Numbers = NDArray[np.float64]


def kept_times(history: HistoryColumns, times: Numbers, most: int) -> Numbers:
    """So many of the recorded times, the first and the last among them: spaced evenly, half in time, half in change.

    Parameters
    ----------
    history
        What changes: each column over its range.
    times
        That are recorded, (n,).
    most
        How many are kept, at least 2; all where there are no more.
    """
    if len(times) <= most:
        return times
    rows = np.stack([np.interp(times, history["time"], column) for column in history.values()])
    rows = np.where(np.isfinite(rows), rows, 0.0)
    change = np.abs(np.diff(rows, axis=1)) / np.maximum(np.ptp(rows, axis=1), np.finfo(float).tiny)[:, None]
    share = [np.concatenate([[0.0], np.cumsum(part)]) for part in (np.diff(times), change.sum(axis=0))]
    place = np.sum([part / (part[-1] or 1.0) for part in share], axis=0)
    wanted = np.linspace(0.0, float(place[-1]), most)
    chosen, number = np.abs(place[:, None] - wanted).argmin(axis=0), np.arange(most)
    later = np.maximum.accumulate(chosen - number) + number  # none twice
    return times[np.minimum(later, len(times) - most + number)]
