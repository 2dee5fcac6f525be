"""Damage of map files. It must be found: the file reads back as it was, or is refused."""

import numpy as np
from fuzz.choices import Draw, Mutation, flipped, number, place, shuffle
from hypothesis import strategies as st
from support.files.mapfile_edit import parts_of, rewritten, with_fitting_crcs


def flip_bits(draw: Draw, data: bytes) -> bytes:
    """Some bits are flipped anywhere."""
    return flipped(draw, data, 8)


def cut(draw: Draw, data: bytes) -> bytes:
    """Bytes are missing, doubled, moved, zeroed or replaced by noise."""
    a, b = sorted(draw(st.integers(0, len(data))) for _ in range(2))
    first, middle, last = data[:a], data[a:b], data[b:]
    noise = np.random.default_rng(a).bytes(b - a)
    cuts = [first, first + last + middle]
    cuts += [first + other + last for other in (b"", middle * 2, bytes(b - a), noise)]
    return cuts[place(draw, cuts)]


def change_numbers(draw: Draw, data: bytes) -> bytes:
    """A number at any place is another, most of them at the end; MCAP's checksums fit."""
    near_end = st.integers(max(0, len(data) - 2000), len(data) - 8)
    at = draw(near_end | st.integers(0, len(data) - 8))
    size = draw(st.sampled_from([1, 2, 4, 8]))
    new = number(draw).to_bytes(8, "little")[:size]
    return with_fitting_crcs(data[:at] + new + data[at + size :])


def change_parts(draw: Draw, data: bytes) -> bytes:
    """Parts are others, doubled or swapped; MCAP's checksums fit, digests do not."""
    payloads = [part.payload for part in parts_of(data)[:-1]]
    at = place(draw, payloads)
    if payloads[at] and draw(st.booleans()):
        payloads[at] = flipped(draw, payloads[at], 3)
    else:
        others = list(payloads)
        shuffle(draw, others)
        payloads = (others + payloads[-1:])[: len(payloads)]
    return rewritten(data, payloads=dict(enumerate(payloads)), fitting=False)


DAMAGE: tuple[Mutation, ...] = (
    flip_bits,
    cut,
    change_numbers,
    change_parts,
)
