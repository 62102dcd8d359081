"""Log of what a laser DAC puts out, in its own clock: mirror codes and level from a time on."""

import numpy as np

COLUMNS = ("from_s", "until_s", "sample", "x", "y", "level")


class SampleLog:
    """Samples in order. Between two of them the outputs keep what the first one states.

    Codes have 12 bits, levels are shares of full scale. Samples are numbered as they are played.
    """

    def __init__(self, x=2048, y=2048):
        self._blocks, self.count = [], 0
        self.state(0.0, x, y)

    def put(self, from_s, period_s, x, y, level):
        """Append samples [n] that begin at from_s and follow each other after period_s."""
        steps = np.arange(len(x))
        self._blocks.append(np.column_stack([from_s + period_s * steps, self.count + steps, x, y, level]))
        self.count += len(x)

    def state(self, from_s, x=None, y=None):
        """Append dark outputs that no sample causes, without codes where the mirrors stay."""
        last = self._blocks[-1][-1] if self._blocks else [0.0, 0, x, y, 0.0]
        x, y = (last[2] if x is None else x), (last[3] if y is None else y)
        self._blocks.append(np.array([[from_s, self.count, x, y, 0.0]]))

    def table(self, until_s):
        """Return the changes until a time, [n, 6] as COLUMNS: begin and end in s, sample, codes x and y, level."""
        samples = np.concatenate(self._blocks)
        samples = samples[np.append(True, (np.diff(samples[:, 2:], axis=0) != 0).any(axis=1))]
        ends_s = np.append(samples[1:, 0], max(until_s, samples[-1, 0]))
        return np.column_stack([samples[:, 0], ends_s, samples[:, 1:]])


def dark_from_s(table):
    """Return the end of the last light in a table, 0 without any."""
    light = table[table[:, 5] > 0]
    return light[-1, 1] if len(light) else 0.0
