"""The tone mapping of the browser, and how to undo it beforehand.

What is not an image goes through ACES Filmic as three.js has it (R3F's default, which viser keeps):
a fit by Stephen Hill of the ACES reference and output transforms. Colours would not be those of
their legends.
"""

import numpy as np
from triquad_format.records.arrays import Doubles

_EXPOSURE = 1.0 / 0.6
_IN = np.array(
    [
        [0.59719, 0.35458, 0.04823],
        [0.07600, 0.90834, 0.01566],
        [0.02840, 0.13383, 0.83777],
    ]
)
_OUT = np.array(
    [
        [1.60475, -0.53108, -0.07367],
        [-0.10208, 1.10813, -0.00605],
        [-0.00327, -0.07276, 1.07602],
    ]
)
_FIT = (0.0245786, -0.000090537, 0.983729, 0.4329510, 0.238081)
_BRIGHTEST = 0.98  # of what it lets through: white itself would have to be infinitely bright


def toned(light: Doubles) -> Doubles:
    """What linear colours [N, 3] become on the screen, linear in [0, 1]."""
    a, b, c, d, e = _FIT
    bright = _EXPOSURE * light @ _IN.T
    shown = (bright * (bright + a) + b) / (bright * (c * bright + d) + e) @ _OUT.T
    return np.asarray(np.clip(shown, 0.0, 1.0), np.float64)


def untoned(shown: Doubles) -> Doubles:
    """The linear colours [N, 3] that become ``shown`` [N, 3]: also above 1, or below 0."""
    a, b, c, d, e = _FIT
    wanted = np.clip(shown @ np.linalg.inv(_OUT).T, 0.0, _BRIGHTEST)
    # (1 - c y) x^2 + (a - d y) x + (b - e y) = 0
    square, linear, constant = 1.0 - c * wanted, a - d * wanted, b - e * wanted
    bright = (-linear + np.sqrt(linear**2 - 4.0 * square * constant)) / (2.0 * square)
    return np.asarray(bright @ np.linalg.inv(_IN).T / _EXPOSURE, np.float64)
