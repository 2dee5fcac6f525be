"""The MLP that a region begins with: pretrained on simulated streets, where its shape allows.

It maps features to distances, in leaves, a relation that is much alike everywhere: at leaves
of up to 0.2 m features find their values in fewer steps, and where little is trained the map is
better. It holds no positions of surfaces: those are in the features, and in the weights of the
Fourier features, which start at zero.
"""

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings

PRETRAINED = Path(__file__).with_name("pretrained_mlp.npz")
"""The file with the arrays that :func:`initial_mlp` reads; `make pretrained` writes it."""

_STEPS = 1600
"""The steps that a pretrained MLP counts as having taken; a young one moves more."""


class InitialMlp(NamedTuple):
    """The MLP that a region begins with."""

    parts: list[Floats]  # weights [in, out] and bias [out] of each layer in turn
    steps: int  # steps that it counts as having taken


def initial_mlp(settings: FieldSettings, generator: np.random.Generator) -> InitialMlp:
    """Return the MLP; what is not pretrained is drawn by ``generator``.

    It is pretrained where features, their deviation and the hidden layers are as by default.
    """
    random = random_mlp(settings, generator)
    if settings.encoding == "fourier":
        return InitialMlp(random, steps=0)
    stored = _read_pretrained()
    shape = (settings.feature_levels, settings.feature_size, settings.hidden)
    if stored["weights1"].shape != shape or stored["feature_std"] != settings.feature_std:
        return InitialMlp(random, steps=0)
    names = ("weights1", "bias1", "weights2", "bias2", "weights3", "bias3")
    parts = [stored[name] for name in names]
    of_features = parts[0].reshape(-1, settings.hidden)
    of_fourier = np.zeros_like(random[0][len(of_features) :])
    logits_per_leaf = np.float32(settings.leaf_m / settings.logit_scale_m)
    last = [part * logits_per_leaf for part in parts[-2:]]
    return InitialMlp([np.concatenate([of_features, of_fourier]), *parts[1:-2], *last], _STEPS)


def random_mlp(settings: FieldSettings, generator: np.random.Generator) -> list[Floats]:
    """Return weights [in, out] and bias [out] of each layer in turn, as in torch.nn.Linear."""
    hidden = settings.hidden
    mlp = []
    for inputs, outputs in ((settings.input_size, hidden), (hidden, hidden), (hidden, 1)):
        for size in ((inputs, outputs), (outputs,)):
            uniform = generator.random(size, np.float32) * 2 - 1
            mlp.append(uniform * np.float32(1 / math.sqrt(inputs)))
    return mlp


@cache
def _read_pretrained() -> dict[str, Floats]:
    """Return the weights and bias of each layer: the first [levels, features, hidden], without
    those of the Fourier features; the last one's output is distances in leaves.
    """
    with np.load(PRETRAINED) as stored:
        return dict(stored)
