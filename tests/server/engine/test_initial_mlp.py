"""What regions begin with: an MLP that knows how features become distances."""

from dataclasses import replace

import numpy as np
import pytest
from triquad_format.records.field_settings import FieldSettings
from triquad_server.engine.initial_mlp import random_mlp
from triquad_server.engine.live_field import Batch, LiveField, initial_field
from triquad_server.engine.memory import Memory
from triquad_server.engine.tensor_trainer import TensorTrainer

ARRAYS = Memory()
DEFAULT = FieldSettings(depth=8)
RATE = 0.01
RADIUS = 9.0  # of the ball that is learnt, leaves


@pytest.mark.parametrize(
    "leaf_m", [*(pytest.param(leaf_m, marks=pytest.mark.long) for leaf_m in (0.01, 0.05)), 0.2]
)
def test_a_new_region_learns_quicker_than_one_that_begins_at_random(leaf_m: float) -> None:
    settings = replace(DEFAULT, leaf_m=leaf_m)
    pretrained = [error_leaves(initial_field(settings, ARRAYS, seed)) for seed in range(6)]
    at_random = [error_leaves(begun_at_random(settings, seed)) for seed in range(6)]
    assert np.mean(pretrained) < 0.95 * np.mean(at_random)


def begun_at_random(settings: FieldSettings, seed: int) -> LiveField:
    generator = np.random.default_rng(seed)
    frequencies = initial_field(settings, ARRAYS, seed).arrays.frequencies
    return LiveField(settings, frequencies, random_mlp(settings, generator), 0, generator, ARRAYS)


def grown(field: LiveField) -> LiveField:
    """With room for the surface of the ball."""
    side = np.arange(-12, 12)
    leaves = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    off = np.linalg.norm(leaves + 0.5, axis=1) - RADIUS
    field.grow(leaves[np.abs(off) < 1.5] + (1 << field.settings.depth - 1))
    return field


def near_the_ball(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points [count, 3] in leaves from the middle of the ball, within some leaves of it."""
    ways = rng.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return ways * (RADIUS + rng.normal(0, 0.5, (count, 1)))


def error_leaves(field: LiveField) -> float:
    """The mean error near the surface of a ball that was learnt in a few steps."""
    trainer, leaf_m = TensorTrainer(grown(field)), field.settings.leaf_m
    rng = np.random.default_rng(2)
    for _ in range(30):
        points = near_the_ball(rng, 1024)
        labels = np.linalg.norm(points, axis=1) - RADIUS
        samples = (np.column_stack([points, labels]) * leaf_m).astype(np.float32)
        trainer.train(Batch(samples[:, :3], samples[:, 3]), RATE)
    points = near_the_ball(rng, 4096)
    return float(np.abs(leaves_at(field, points) - np.linalg.norm(points, axis=1) + RADIUS).mean())


def leaves_at(field: LiveField, points: np.ndarray) -> np.ndarray:
    """Signed distances [N] at points [N, 3], all in leaves."""
    leaf_m = field.settings.leaf_m
    values = field.freeze().evaluate((points * leaf_m).astype(np.float32), gradient=False)
    return values.sdf / leaf_m
