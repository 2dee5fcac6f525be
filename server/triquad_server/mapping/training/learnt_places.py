"""The learnt places of a region: training on more of their rays makes them no better.

A robot at rest sends the same surfaces again and again. They are taken in, since they show what is
still there, but once the error of a place falls no more, its rays need no training: so the map
settles while scans come. When anything changes in view, all is learnt again as if it were new.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.clusters import rows_of
from triquad_map.field_fit import place_keys

from triquad_server.mapping.training.group_means import GroupMeans

AtEnds = Callable[[Floats], NDArray[np.floating]]

VISITS = 5
"""The samples per ray, on average, between two comparisons: enough to make a difference where one
is possible."""

_COMPARISONS = 2  # comparisons in a row in which a learnt place's error did not fall

_LEAST_FALL = 0.2
"""The least fall that counts, as a share of the mean square error, including the rays' noise."""

_SURE = 5.0
"""A settled place fits worse if it does so by this many standard errors of the mean."""

_LEAST_RISE = 0.5
"""The error must also rise by this share of its mean square error."""

_LEAST_RAYS = 24
"""The least rays of a place by itself: places that have fewer are compared as one."""

_FEW_NEEDING = 0.01
"""If a smaller share of a scan's rays end in places that are not learnt, these need no training
either: in a place of few rays, chance alone makes the error fall now and then."""

_NOISE = 0.1  # of rays, in leaves: below such errors, few rays show whether they fall

_TURNS = 4
"""One in this many of a scan's rays is taken into account, and another the next time."""

_FEW_REMOVED = 2
"""If surface is removed from more voxels of a place at once, all is learnt again: for single ones,
the rays' noise may be the cause."""

_FOLLOWED = np.dtype(
    [
        ("key", np.int64),
        ("error", np.float64),  # mean square error, as a multiple of the first that was compared
        ("least", np.float64),  # the last of these that had fallen
        ("comparisons", np.int64),  # comparisons since
        ("settled", np.float64),  # mean square error once it was learnt and had settled, or NaN
    ]
)


class LearntPlaces:
    """Tracks the error of a region's places at the ends of rays that are held out."""

    def __init__(self, settings: FieldSettings) -> None:
        """Begin with no place learnt."""
        self._settings = settings
        self._turn = 0
        self._visits = 0.0  # samples per ray on average since errors were compared
        self._ends = np.zeros((0, 3), np.float32)  # ends of the rays for the next comparison
        self._squares = np.zeros(0)  # the field's values there
        self.learn_all_again()

    def __len__(self) -> int:
        return len(self._learnt)

    def learn_all_again(self) -> None:
        """From now on, treat no place as learnt."""
        self._followed = np.zeros(0, _FOLLOWED)  # increasing keys
        self._learnt = np.zeros(0, np.int64)  # keys of the learnt ones
        self._seen = np.zeros(0, np.int64)  # keys of places in which rays ended since the last time

    def see(self, ends: Doubles) -> None:
        """Record that rays end at ``ends`` [N, 3], metres from the region's centre."""
        self._turn = (self._turn + 1) % _TURNS
        keys = place_keys(ends[self._turn :: _TURNS], self._settings)
        new = rows_of(self._seen, keys) < 0
        if new.any():
            self._seen = np.union1d(self._seen, keys[new])

    def need_training(self, ends: Doubles | Floats) -> Bools:
        """Return which rays [N] of a scan, ending at ``ends`` [N, 3], need training."""
        if len(self._learnt) == 0:
            return np.ones(len(ends), np.bool_)
        needing = rows_of(self._learnt, place_keys(ends, self._settings)) < 0
        if needing.sum() < _FEW_NEEDING * len(needing):
            needing[:] = False
        return needing

    def surface_removed(self, points: Doubles) -> None:
        """Record that surface was removed from ``points`` [N, 3], one in each voxel."""
        _, counts = np.unique(place_keys(points, self._settings), return_counts=True)
        if (counts > _FEW_REMOVED).any():
            self.learn_all_again()

    def trained(self, visits: float) -> None:
        """Record that ``visits`` samples per ray, on average, were drawn and trained on."""
        self._visits += visits

    def judge(
        self, ends: Floats, sdf: NDArray[np.floating], field: AtEnds, *, settled: bool
    ) -> bool:
        """Find where the error no longer falls; return whether it rose, so all is learnt again.

        Args:
            ends: [N, 3] of the rays that are held out now, metres from the region's centre.
            sdf: [N] the field's values there, metres.
            field: gives the field's values elsewhere.
            settled: nothing is trained any more. Before, errors rise and fall by chance.
        """
        squares = sdf.astype(np.float64) ** 2
        rose = settled and self._rose(ends, squares)
        if rose:
            self.learn_all_again()
        if self._visits >= VISITS:
            self._compare(field)
            self._ends, self._squares = ends.copy(), squares
            self._visits = 0.0
            self._seen = self._seen[:0]
        return rose

    def _compare(self, field: AtEnds) -> None:
        """Compare the errors at the rays of the last time, in places that were seen since."""
        keys = self._seen
        rows = rows_of(keys, place_keys(self._ends, self._settings))
        is_seen = rows >= 0
        now = field(np.ascontiguousarray(self._ends[is_seen])).astype(np.float64) ** 2
        before = GroupMeans.of(self._squares[is_seen], rows[is_seen], len(keys))
        after = GroupMeans.of(now, rows[is_seen], len(keys))
        times = np.divide(after.means, before.means, out=np.ones(len(keys)), where=before.means > 0)
        told = (after.counts >= _LEAST_RAYS) & (before.means > 0)
        few = after.counts < _LEAST_RAYS
        if after.counts[few].sum() >= _LEAST_RAYS:
            times[few] = self._times_of_few(before.means[few], after.means[few], after.counts[few])
            told |= few
        self._follow(keys[told], times[told])

    def _times_of_few(self, before: Doubles, after: Doubles, rays: Longs) -> float:
        """Return the ratio of mean square errors after and before, in places of few ``rays`` [P].

        The logarithms are averaged: one place in which nothing can be learnt does not decide for
        all.
        """
        noise = (_NOISE * self._settings.leaf_m) ** 2
        logs = np.log((after + noise) / (before + noise))
        return float(np.exp((logs * rays).sum() / rays.sum()))

    def _follow(self, keys: Longs, times: Doubles) -> None:
        """Record that the errors of places are ``times`` what they were."""
        self._begin_to_follow(keys)
        rows = rows_of(self._followed["key"], keys)
        places = self._followed[rows]
        was_learnt = places["comparisons"] >= _COMPARISONS
        places["error"] *= times
        falls = places["error"] < (1 - _LEAST_FALL) * places["least"]
        falls |= np.isnan(places["least"])  # the first time
        places["least"] = np.where(falls, places["error"], places["least"])
        places["comparisons"] = np.where(falls & ~was_learnt, 0, places["comparisons"] + 1)
        self._followed[rows] = places
        self._learnt = self._followed["key"][self._followed["comparisons"] >= _COMPARISONS]

    def _begin_to_follow(self, keys: Longs) -> None:
        new = np.zeros(len(keys), _FOLLOWED)
        new["key"], new["error"] = keys, 1.0
        new["least"] = new["settled"] = np.nan
        new = new[~np.isin(keys, self._followed["key"])]
        self._followed = np.sort(np.concatenate([self._followed, new]), order="key")

    def _rose(self, ends: Floats, squares: Doubles) -> bool:
        """Return whether the field fits the present rays anywhere worse than when it had settled.

        A place that has settled now is compared from now on.
        """
        if len(self._learnt) == 0:
            return False
        places = self._followed
        rows = rows_of(places["key"], place_keys(ends, self._settings))
        now = GroupMeans.of(squares[rows >= 0], rows[rows >= 0], len(places))
        enough = (now.counts >= _LEAST_RAYS) & (places["comparisons"] >= _COMPARISONS)
        is_first = enough & np.isnan(places["settled"])
        places["settled"] = np.where(is_first, now.means, places["settled"])
        least = np.maximum(_SURE * now.errors, _LEAST_RISE * places["settled"])
        return bool((enough & (now.means - places["settled"] > least)).any())
