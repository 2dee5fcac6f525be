"""The MLP that a region begins with: one that has learnt a simulated place, where its shape allows.

What it knows is how features become distances, in leaves, which is alike everywhere: features find
their values in fewer steps, and where little is trained the map is better. Of where things are, it
knows nothing: that is in the features, and in the weights of the Fourier features, which start at
zero.
"""

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings

PRETRAINED = Path(__file__).with_name("pretrained_mlp.npz")
"""What :func:`write_pretrained` wrote, by `make pretrained`."""

_STEPS = 1000
"""With fewer, or more, what is learnt first is less accurate: streets after 5 million samples."""


class InitialMlp(NamedTuple):
    """What a region begins with."""

    layers: list[Tensor]  # weights [in, out] and bias [out] of each in turn
    steps: int  # it counts as having taken: what has learnt much learns more slowly


def initial_mlp(settings: FieldSettings, generator: torch.Generator) -> InitialMlp:
    """On the device of ``generator``, which draws what is not pretrained.

    Pretrained it is where features and hidden layers are as by default.
    """
    random = random_mlp(settings, generator)
    pretrained = [torch.from_numpy(part).to(generator.device) for part in _read_pretrained()]
    shape = (settings.feature_levels, settings.feature_size, settings.hidden)
    if settings.encoding == "fourier" or pretrained[0].shape != shape:
        return InitialMlp(random, steps=0)
    of_features = pretrained[0].flatten(end_dim=1)
    of_fourier = torch.zeros_like(random[0][len(of_features) :])
    leaf = settings.leaf_m / settings.logit_scale_m  # in logits
    first = torch.cat([of_features, of_fourier])
    last = [part * leaf for part in pretrained[-2:]]
    return InitialMlp([first, *pretrained[1:-2], *last], _STEPS)


def write_pretrained(mlp: Sequence[Floats], settings: FieldSettings) -> None:
    """Have regions begin from now on with the ``mlp`` of a field of these ``settings``."""
    first, *hidden = mlp
    scale = np.float32(settings.logit_scale_m / settings.leaf_m)
    levels, size = settings.feature_levels, settings.feature_size
    of_features = first[: levels * size].reshape(levels, size, -1)
    last = [part * scale for part in hidden[-2:]]
    np.savez(PRETRAINED, of_features, *hidden[:-2], *last)
    _read_pretrained.cache_clear()


def random_mlp(settings: FieldSettings, generator: torch.Generator) -> list[Tensor]:
    """Weights [in, out] and bias [out] of each layer in turn, as those of torch.nn.Linear."""
    hidden = settings.hidden
    mlp = []
    for inputs, outputs in ((settings.input_size, hidden), (hidden, hidden), (hidden, 1)):
        for size in ((inputs, outputs), (outputs,)):
            uniform = torch.rand(size, generator=generator, device=generator.device) * 2 - 1
            mlp.append(uniform * (1 / math.sqrt(inputs)))
    return mlp


@cache
def _read_pretrained() -> tuple[Floats, ...]:
    """Weights and bias of each layer in turn; distances in leaves come out of the last.

    The first weights are [levels, features, hidden], without those of Fourier features.
    """
    with np.load(PRETRAINED) as stored:
        return tuple(stored[name] for name in stored.files)
