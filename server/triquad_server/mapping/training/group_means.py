"""Computes means of values in groups."""

from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Longs


class GroupMeans(NamedTuple):
    """The means of the values in each of G groups."""

    means: Doubles  # [G] 0 where there are no values
    errors: Doubles  # [G] standard errors of the means
    counts: Longs  # [G] of values

    @classmethod
    def of(cls, values: Doubles, group_of: Longs, groups: int) -> "GroupMeans":
        """Return the means of ``values`` [N], each in the group ``group_of`` [N]."""
        counts = np.bincount(group_of, minlength=groups)
        least = np.maximum(counts, 1)
        means = np.bincount(group_of, values, groups) / least
        variances = np.bincount(group_of, (values - means[group_of]) ** 2, groups) / least
        return cls(means, np.sqrt(variances / least), counts)
