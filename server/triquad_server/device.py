"""The devices on which a server may train."""

import importlib.util

from triquad_server.errors import ServerError

DEVICES = ("cpu", "cuda")


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
