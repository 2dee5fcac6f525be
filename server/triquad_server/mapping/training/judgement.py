"""Judges a region's field, place by place, with the rays that it is not trained on.

The field should be zero where such a ray ends. Its error there includes the sensor's noise as well
as the field's own error, but the noise of a ray does not change: where the same rays fit worse than
they did, the field has forgotten.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.clusters import rows_of
from triquad_map.field_fit import PlaceFits, Places

from triquad_server.mapping.replay.held_out import ray_keys
from triquad_server.mapping.replay.ray_table import END
from triquad_server.mapping.training.group_means import GroupMeans

_LEAST_RAYS = 24  # rays of a place that is judged
_SURE = 5.0
"""A place has forgotten if it fits worse by this many standard errors of the mean."""

_LEAST_RISE = 0.02
"""The error must also rise as if by this much, in leaves: 4 mm at the default leaf."""

_LEAST_SHARE = 0.15
"""It must also rise by this share of its mean square error, most of which is the sensor's noise:
where leaves are small and a camera is noisy, far more than the rise above."""

_NEW_SHARE = 0.1
"""If this share of the rays is new, the place is being learnt."""

_REPAIRS = 3  # repairs of a place in a row; then it is accepted as it is


@dataclass(frozen=True)
class JudgedPlaces(PlaceFits):
    """The fit of a field to its places, and where it was better before."""

    forgotten: Bools  # [P] where the same rays fit worse than they did
    forgotten_keys: Longs  # of these, as of :func:`triquad_map.field_fit.place_keys`
    repaired: int  # places that had forgotten before, and no longer have
    given_up: int  # places that had, and that training did not repair

    @classmethod
    def of_places(
        cls,
        places: Places,
        sdf: NDArray[np.floating],
        forgotten: Bools,
        repaired: int = 0,
        given_up: int = 0,
    ) -> "JudgedPlaces":
        """Return the fit of a field with values ``sdf`` [N], metres, at the ends of ``places``."""
        fits = vars(PlaceFits.of(places, sdf))
        return cls(
            **fits,
            forgotten=forgotten,
            forgotten_keys=places.keys[forgotten],
            repaired=repaired,
            given_up=given_up,
        )


class Repairs(NamedTuple):
    """The results for places that had forgotten, so far."""

    done: int = 0  # places that were learnt again
    given_up: int = 0  # places that training did not repair


class Judgement:
    """Compares a region's field with what it was, at the ends of the rays that are held out."""

    def __init__(self, settings: FieldSettings) -> None:
        """Begin with nothing judged."""
        self._settings = settings
        self.fit: JudgedPlaces | None = None  # as it was judged last
        self.repairs = Repairs()
        # By ray, in the order of the keys: the field's value when it was best in that place.
        self._keys = np.zeros(0, np.int64)
        self._best = np.zeros(0)
        self._tries: dict[int, int] = {}  # repairs in a row, of places that have forgotten

    @classmethod
    def restored(
        cls, settings: FieldSettings, repairs: Repairs, rows: Floats, sdf: NDArray[np.floating]
    ) -> "Judgement":
        """Make the field's present values the reference; arguments as for :meth:`judge`."""
        judgement = cls(settings)
        judgement.repairs = repairs
        if len(rows):
            judgement._remember(ray_keys(rows, settings), sdf.astype(np.float64))
            places = Places.of(rows[:, END : END + 3], settings)
            none = np.zeros(len(places.keys), np.bool_)
            judgement.fit = JudgedPlaces.of_places(places, sdf, forgotten=none)
        return judgement

    def judge(
        self, rows: Floats, sdf: NDArray[np.floating], *, may_repair: bool = True
    ) -> JudgedPlaces:
        """Judge the field by held-out rays.

        Args:
            rows: [N, COLUMNS] of the rays' table, one at least.
            sdf: [N] the field's value where they end, metres.
            may_repair: what was forgotten may be learnt again; else it is accepted as it is.
        """
        keys = ray_keys(rows, self._settings)
        best = self._best_of(keys)
        places = Places.of(rows[:, END : END + 3], self._settings)
        # The rise of the squares at the same rays' ends.
        rises = _means(sdf.astype(np.float64) ** 2 - best**2, places)
        is_new = rises.counts < (1 - _NEW_SHARE) * places.rays
        worse = self._are_sure(rises, _means(best**2, places).means) & ~is_new
        still_worse = set(places.keys[worse].tolist())
        repaired = sum(place not in still_worse for place in self._tries)
        forgotten = worse & may_repair
        forgotten &= self._may_be_repaired(places.keys, forgotten)
        is_best = ((rises.means < 0) | is_new | worse) & ~forgotten
        now_best = is_best[places.place_of] | np.isnan(best)
        self._remember(keys, np.where(now_best, sdf, best))
        given_up = int((worse & ~forgotten).sum())
        self.repairs = Repairs(self.repairs.done + repaired, self.repairs.given_up + given_up)
        self.fit = JudgedPlaces.of_places(places, sdf, forgotten, repaired, given_up)
        return self.fit

    def _are_sure(self, rises: GroupMeans, before: Doubles) -> Bools:
        """Return where the field is certainly worse than its mean square errors ``before`` [P]."""
        least = np.maximum((_LEAST_RISE * self._settings.leaf_m) ** 2, _LEAST_SHARE * before)
        sure = rises.means > np.maximum(_SURE * rises.errors, least)
        return sure & (rises.counts >= _LEAST_RAYS)

    def _best_of(self, keys: Longs) -> Doubles:
        """Return the remembered values of rays; NaN where there is none."""
        best = np.full(len(keys), np.nan)
        rows = rows_of(self._keys, keys)
        best[rows >= 0] = self._best[rows[rows >= 0]]
        return best

    def _remember(self, keys: Longs, best: Doubles) -> None:
        order = np.argsort(keys)
        self._keys, self._best = keys[order], best[order]

    def _may_be_repaired(self, places: Longs, worse: Bools) -> Bools:
        """Return which places were not yet repaired in vain too often, and count the repairs."""
        tried = [self._tries.get(place, 0) for place in places.tolist()]
        fine = np.array(tried, np.int64) < _REPAIRS
        again = zip(places.tolist(), tried, (worse & fine).tolist(), strict=True)
        self._tries = {place: count + 1 for place, count, repaired in again if repaired}
        return fine


def _means(values: Doubles, places: Places) -> GroupMeans:
    """Return the means of the rays' ``values`` [N] in each place, without those that are NaN."""
    is_known = ~np.isnan(values)
    return GroupMeans.of(values[is_known], places.place_of[is_known], len(places.keys))
