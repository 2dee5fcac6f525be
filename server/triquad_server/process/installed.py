"""Checks for what the server needs in addition to the base installation: libraries, a GPU."""

import importlib.util

from triquad_server.errors import ServerError

_NEEDED = ("numba", "pydantic")
DEVICES = ("cpu", "cuda")


def require_libraries() -> None:
    """Report what to install, before anything is imported that needs it.

    Raises:
        ServerError: a library is missing.
    """
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise ServerError(f"{' and '.join(missing)} {verb} missing: install triquad[server]")


def check_device(device: str) -> None:
    """Check that a device can be used here; on the CPU nothing is imported for that.

    Raises:
        ServerError: there is no GPU or no torch, but one is wanted; or it is no device.
    """
    if device not in DEVICES:
        raise ServerError(f"device {device!r}: use {' or '.join(DEVICES)}")
    if device == "cpu":
        return
    if importlib.util.find_spec("torch") is None:
        raise ServerError('device cuda: torch is missing: pip install "triquad[gpu]"')
    import torch  # which takes 200 MB and a second

    if not torch.cuda.is_available():
        raise ServerError("device cuda: no CUDA device is usable here; use cpu")
