"""Depth images as files: PNG with 16 bits a pixel."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from triquad_tools.console.command import ToolError

_GREY_MODES = ("I;16", "I;16B", "I")  # 16 bits, as versions of Pillow name them
_END = b"IEND"
_END_BYTES = 64  # the last chunk takes 12, and some writers append to it


class ImageSize(NamedTuple):
    """The size of an image, pixels."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width} x {self.height}"


def check_depth(path: Path) -> ImageSize:
    """Return the size of a depth image; pixels are not decoded.

    Raises:
        ToolError: there is none, it is no PNG of 16 bits a pixel, or it is truncated.
    """
    from PIL import Image

    if not path.is_file():
        raise ToolError(f"{path}: no such file")
    try:
        with Image.open(path, formats=["PNG"]) as image:
            mode, size = image.mode, ImageSize(*image.size)
    except Exception as error:  # any error of the library
        raise ToolError(f"{path}: is no PNG image; depth comes as PNG of 16 bits") from error
    if mode not in _GREY_MODES:
        raise ToolError(
            f"{path}: is an image of mode {mode}: depth takes 16 bits grey; images of colour or "
            "of 8 bits hold none"
        )
    with path.open("rb") as file:
        file.seek(-min(_END_BYTES, path.stat().st_size), os.SEEK_END)
        if _END not in file.read():
            raise ToolError(f"{path}: is truncated: the end of PNG is missing; copy it again")
    return size


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Return the pixels [rows, columns] of a depth image, in its own unit.

    Raises:
        ToolError: it cannot be read.
    """
    from PIL import Image

    check_depth(path)
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return np.asarray(image).astype(np.uint16)
    except Exception as error:  # any error of the library and its codec
        raise ToolError(f"{path}: cannot be read as PNG: {error}; copy it again") from error
