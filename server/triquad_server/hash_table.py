"""An open-addressing hash table of tensors, on any device."""

import torch
from torch import Tensor

EMPTY = -1
MULTIPLIER = 0x9E3779B97F4A7C15 - (1 << 64)  # 2**64 / golden ratio, as a signed number
_MIN_CAPACITY = 1024
_MAX_LOAD = 0.25  # keeps probe sequences short: every look-up walks the longest one


class HashTable:
    """Maps non-negative int64 keys to positive int64 rows; an absent key maps to row 0."""

    def __init__(self, device: torch.device) -> None:
        self._count = 0
        self._longest_probe = 0
        self._keys = torch.full((_MIN_CAPACITY,), EMPTY, dtype=torch.int64, device=device)
        self._rows = torch.zeros(_MIN_CAPACITY, dtype=torch.int64, device=device)

    def __len__(self) -> int:
        return self._count

    @property
    def keys(self) -> Tensor:
        """The table's keys by slot, :data:`EMPTY` where there is none."""
        return self._keys

    @property
    def rows(self) -> Tensor:
        """The table's rows by slot."""
        return self._rows

    @property
    def shift(self) -> int:
        """A key's first slot is ``key * MULTIPLIER >> shift``, modulo the number of slots."""
        return 65 - len(self._keys).bit_length()

    def lookup(self, keys: Tensor) -> Tensor:
        """Rows of ``keys`` (any shape); 0 where a key is absent."""
        slots = self._home(keys)
        rows = torch.zeros_like(keys)
        for _ in range(self._longest_probe):
            rows = torch.where(self._keys[slots] == keys, self._rows[slots], rows)
            slots = (slots + 1) & (len(self._keys) - 1)
        return rows

    def insert(self, keys: Tensor, rows: Tensor) -> None:
        """Add ``keys`` [N], unique and so far absent, with their ``rows`` [N]."""
        self._reserve(self._count + len(keys))
        self._place(keys, rows)
        self._count += len(keys)

    def items(self) -> tuple[Tensor, Tensor]:
        """All keys in increasing order, and their rows."""
        used = self._keys != EMPTY
        keys, order = torch.sort(self._keys[used])
        return keys, self._rows[used][order]

    def copy(self) -> "HashTable":
        """An independent copy."""
        twin = HashTable.__new__(HashTable)
        twin._count, twin._longest_probe = self._count, self._longest_probe
        twin._keys, twin._rows = self._keys.clone(), self._rows.clone()
        return twin

    def _home(self, keys: Tensor) -> Tensor:
        return ((keys * MULTIPLIER) >> self.shift) & (len(self._keys) - 1)

    def _reserve(self, count: int) -> None:
        capacity = len(self._keys)
        if count <= capacity * _MAX_LOAD:
            return
        keys, rows = self.items()
        while count > capacity * _MAX_LOAD:
            capacity *= 2
        self._keys = self._keys.new_full((capacity,), EMPTY)
        self._rows = self._rows.new_zeros(capacity)
        self._longest_probe = 0
        self._place(keys, rows)

    def _place(self, keys: Tensor, rows: Tensor) -> None:
        slots = self._home(keys)
        probes = 0
        while len(keys):
            probes += 1
            empty = self._keys[slots] == EMPTY
            self._keys[slots[empty]] = keys[empty]  # of keys that meet in a slot, one stays
            placed = self._keys[slots] == keys
            self._rows[slots[placed]] = rows[placed]
            keys, rows = keys[~placed], rows[~placed]
            slots = (slots[~placed] + 1) & (len(self._keys) - 1)
        self._longest_probe = max(self._longest_probe, probes)
