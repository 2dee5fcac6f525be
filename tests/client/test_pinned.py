"""Queries that are answered from one epoch, however the map goes on meanwhile."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from support import servers
from triquad_client import Client, InvalidInputError, RefusedError
from triquad_server.settings import ServiceSettings

POINTS = servers.sphere(300).astype(np.float64)
SETTINGS = servers.SMALL.model_copy(
    update={"service": ServiceSettings(epochs_kept=1, epochs_pinned=2)}
)


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    """Of a service that keeps the newest epoch, and two that are asked for."""
    with servers.service_and_client(SETTINGS) as client:
        learn_more(client)
        yield client


def learn_more(client: Client) -> None:
    """Have the map change, and settle."""
    servers.learn_all(client, 1, servers.sphere() * np.float32(1.1))


def test_a_pinned_map_stays_as_it_was(client: Client) -> None:
    view = client.pinned()
    before = view.query_sdf(POINTS, gradient=True)
    assert before.epoch == view.epoch == client.status().epoch
    for _ in range(3):
        learn_more(client)
        after = view.query_sdf(POINTS, gradient=True)
        assert after.epoch == view.epoch
        np.testing.assert_array_equal(after.sdf, before.sdf)
        np.testing.assert_array_equal(after.gradient, before.gradient)
    newest = client.query_sdf(POINTS)
    assert newest.epoch > view.epoch
    assert (newest.sdf != before.sdf).any()
    assert client.pinned().epoch == newest.epoch


def test_all_parts_of_a_big_query_come_from_the_epoch_that_is_asked_for(client: Client) -> None:
    view = client.pinned()
    learn_more(client)
    big = client.query_sdf(np.tile(POINTS, (1000, 1)), at_epoch=view.epoch)
    assert big.epoch == view.epoch
    expected = view.query_sdf(POINTS).sdf
    np.testing.assert_allclose(big.sdf, np.tile(expected, 1000), atol=1e-5)


def test_an_epoch_that_is_gone_is_refused_and_no_other_answers(client: Client) -> None:
    view = client.pinned()
    for _ in range(2):  # two others are asked for since
        learn_more(client)
        client.pinned()
    learn_more(client)
    for points in (POINTS, np.tile(POINTS, (1000, 1))):
        with pytest.raises(RefusedError, match=f"epoch {view.epoch} is not kept") as caught:
            view.query_sdf(points)
        assert caught.value.code == "epoch_gone"
    assert client.query_sdf(POINTS).epoch > view.epoch


@pytest.mark.parametrize("epoch", [0, -1, 2**63, 1.5, "newest"])
def test_what_is_no_epoch_is_refused_here(client: Client, epoch: Any) -> None:
    with pytest.raises(InvalidInputError, match="at_epoch"):
        client.query_sdf(POINTS, at_epoch=epoch)


def test_an_epoch_may_be_any_integer(client: Client) -> None:
    epoch = client.query_sdf(POINTS).epoch
    assert client.query_sdf(POINTS, at_epoch=np.int64(epoch)).epoch == epoch
