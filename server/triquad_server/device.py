"""Chooses the device on which a server computes."""

import ctypes
import importlib.util
import sys

from triquad_server.errors import ServerError

_DRIVERS = {"linux": "libcuda.so.1", "win32": "nvcuda.dll"}


def choose_device(wanted: str) -> str:
    """Return the device to compute on: ``wanted``, or for "auto" a GPU where there is one.

    Raises:
        ServerError: there is no GPU or no torch, but one is wanted; or it is no device.
    """
    if wanted not in ("auto", "cpu", "cuda"):
        raise ServerError(f"device {wanted!r}: use auto, cpu or cuda")
    if wanted == "cpu":
        return "cpu"
    has_torch = importlib.util.find_spec("torch") is not None
    if wanted == "cuda" and not has_torch:
        raise ServerError('device cuda: torch is missing: pip install "triquad[gpu]"')
    if has_torch and _has_driver() and _cuda_is_usable():
        return "cuda"
    if wanted == "cuda":
        raise ServerError("device cuda: no CUDA device is usable here; use cpu or auto")
    return "cpu"


def _has_driver() -> bool:
    """Return whether there may be a GPU, without torch, whose import takes 200 MB and a second."""
    driver = _DRIVERS.get(sys.platform)
    if driver is None:
        return False
    try:
        ctypes.CDLL(driver)
    except OSError:
        return False
    return True


def _cuda_is_usable() -> bool:
    import torch

    return torch.cuda.is_available()
