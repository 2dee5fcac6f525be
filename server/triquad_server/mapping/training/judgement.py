"""Judges a region's field, place by place, with the rays that it is not trained on.

The field should be zero where such a ray ends. Its error there includes the sensor's noise, which
stays the same: where the error rises, the field has forgotten the place, or the surface moved.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.field_fit import PlaceFits, Places

_LEAST_RAYS = 24  # rays of a place that is judged

_SURE = 5.0
"""A place fits worse if its mean square error rose by this many standard errors of the mean."""

_LEAST_SHARE = 0.5
"""It must also rise by this share: rays from elsewhere have other noise."""

_LEAST_RISE = 0.02
"""And as if by this much, in leaves: 4 mm at the default leaf."""

_ROUNDS = 3
"""How often in a row places are learnt again before new rays have come. Else two places that make
each other forget would do so for ever."""

_NEW_SHARE = 0.5
"""The share of the rays that has to be new for that."""


class Repairs(NamedTuple):
    """The results for places that fitted worse than before, so far."""

    done: int = 0  # places that were learnt again
    given_up: int = 0  # places that training did not repair


class _Errors(NamedTuple):
    """The mean square errors at the rays in each of P places."""

    means: Doubles  # [P] square metres; 0 where there are no rays
    sigmas: Doubles  # [P] standard errors of the means
    counts: Longs  # [P] of rays

    @classmethod
    def of(cls, squares: Doubles, place_of: NDArray[np.intp], places: int) -> "_Errors":
        """Return those of ``squares`` [N], each in the place ``place_of`` [N]."""
        counts = np.bincount(place_of, minlength=places)
        least = np.maximum(counts, 1)
        means = np.bincount(place_of, squares, places) / least
        variances = np.bincount(place_of, (squares - means[place_of]) ** 2, places) / least
        return cls(means, np.sqrt(variances / least), counts)


class Judgement:
    """Compares a region's field with what it was at best, where rays end that are held out."""

    def __init__(self, settings: FieldSettings, repairs: Repairs) -> None:
        """Begin with nothing judged; ``repairs`` are those of before a restart."""
        self._settings = settings
        self.fit: PlaceFits | None = None  # as it was judged last
        self.repairs = repairs
        self._best: dict[int, float] = {}  # mean square error of each place, square metres
        self._rounds = 0  # in which places were learnt again
        self._repaired: set[int] = set()  # places that are being learnt again

    @property
    def repairing(self) -> int:
        """Return how many places are being learnt again."""
        return len(self._repaired)

    def judge(self, ends: Floats, sdf: NDArray[np.floating], are_new: Bools) -> Longs:
        """Return the places to learn again, as of :func:`triquad_map.field_fit.place_keys`.

        A place that training does not repair is accepted as it is.

        Args:
            ends: [N, 3] of the rays that are held out, metres from the region's centre.
            sdf: [N] the field's values there, metres.
            are_new: [N] which were held out since the last time: they show what is there now.
        """
        places = Places.of(ends, self._settings)
        self.fit = PlaceFits.of(places, sdf)
        keys, squares = places.keys.tolist(), sdf.astype(np.float64) ** 2
        now = _Errors.of(squares, places.place_of, len(keys))
        newest = _Errors.of(squares[are_new], places.place_of[are_new], len(keys))
        best = np.array([self._best.get(place, np.inf) for place in keys])
        is_worse = self._are_worse(now, best) | self._are_worse(newest, best)
        if are_new.mean() >= _NEW_SHARE:
            self._rounds = 0
        may_repair = self._rounds < _ROUNDS
        self._rounds += bool(is_worse.any())
        again = is_worse & may_repair
        accepted = np.where(is_worse, now.means, np.minimum(best, now.means))
        self._best = dict(zip(keys, np.where(again, best, accepted).tolist(), strict=True))
        worse = set(places.keys[is_worse].tolist())
        self.repairs = Repairs(
            self.repairs.done + len(self._repaired - worse),
            self.repairs.given_up + len(worse) * (not may_repair),
        )
        self._repaired = worse if may_repair else set()
        return places.keys[again]

    def _are_worse(self, now: _Errors, best: Doubles) -> Bools:
        """Return which places [P] certainly fit worse than with mean square errors ``best`` [P]."""
        least = np.maximum((_LEAST_RISE * self._settings.leaf_m) ** 2, _LEAST_SHARE * best)
        worse: Bools = now.means - best > np.maximum(_SURE * now.sigmas, least)
        return worse & (now.counts >= _LEAST_RAYS)
