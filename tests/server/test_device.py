"""A server names what is missing for the device that it was asked to compute on."""

import sys

import pytest
from triquad_server.errors import ServerError
from triquad_server.process.installed import check_device


def test_without_torch_a_gpu_is_refused_with_the_extra_that_has_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)  # as where it is not installed
    with pytest.raises(ServerError, match=r'pip install "triquad\[gpu\]"'):
        check_device("cuda")
    check_device("cpu")
