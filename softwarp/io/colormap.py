"""A perceptually uniform colour scale: equal steps of the value look equally far apart.

The scale is a smooth curve in Oklab (Ottosson 2020), whose Euclidean distance follows perceived difference, sampled at
equal arc length. Lightness rises throughout, so it also reads in grey and for colour-blind eyes.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

# Stops as (lightness, chroma, hue in degrees): indigo, magenta, orange, light yellow.
_STOPS = ((0.28, 0.115, 280.0), (0.46, 0.17, 325.0), (0.67, 0.165, 398.0), (0.95, 0.115, 464.0))

# The same from the lowest value to the highest: blue, pale blue, nearly white, orange, red.
_DIVERGING = ((0.42, 0.15, 262.0), (0.72, 0.095, 245.0), (0.96, 0.008, 90.0), (0.76, 0.14, 62.0), (0.50, 0.19, 27.0))

_OKLAB_TO_LMS = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_LMS_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def srgb_to_linear(color: ArrayLike) -> Floats:
    """Linear-light components of sRGB-encoded ones, both in [0, 1]."""
    c = np.asarray(color, dtype=np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0.0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(color: ArrayLike) -> Floats:
    """Encoded (sRGB) components of linear-light ones, both in [0, 1]."""
    c = np.clip(np.asarray(color, dtype=np.float64), 0.0, 1.0)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1.0 / 2.4) - 0.055)


def oklab_to_linear(lab: ArrayLike) -> Floats:
    """Linear-light sRGB components of Oklab colours, shape (..., 3); may leave [0, 1] outside the gamut."""
    return np.asarray((np.asarray(lab, dtype=np.float64) @ _OKLAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T)


def colors(values: ArrayLike, low: float, high: float) -> Floats:
    """Colours (sRGB) of values on the uniform scale.

    Args:
        values: Any shape; values outside [low, high] take the end colours, a non-finite one takes mid grey.
        low: Value of the dark end.
        high: Value of the light end; the scale is all dark where it does not exceed ``low``.

    Returns:
        Colours in [0, 1], shape values.shape + (3,).
    """
    v = np.asarray(values, dtype=np.float64)
    span = high - low
    s = np.clip((v - low) / span, 0.0, 1.0) if span > 0.0 else np.zeros_like(v)
    known = np.isfinite(s)
    at = np.where(known, s, 0.0) * (_table().shape[0] - 1)
    below = np.minimum(at.astype(np.int64), _table().shape[0] - 2)
    part = (at - below)[..., None]
    out = (1.0 - part) * _table()[below] + part * _table()[below + 1]
    out[~known] = 0.5
    return np.asarray(out)


def diverging(values: ArrayLike, limit: float) -> Floats:
    """Colours (sRGB) of values of both signs: blue below zero, nearly white at zero, red above.

    Args:
        values: Any shape; a non-finite one takes mid grey.
        limit: Magnitude of the strongest colours.

    Returns:
        Colours in [0, 1], shape values.shape + (3,).
    """
    v = np.asarray(values, dtype=np.float64)
    s = np.clip(v / limit, -1.0, 1.0) if limit > 0.0 else np.zeros_like(v)
    known = np.isfinite(s)
    at = np.linspace(-1.0, 1.0, len(_DIVERGING))
    lightness, chroma, hue = np.array(_DIVERGING).T
    angle = np.radians(hue)
    stops = np.stack([lightness, chroma * np.cos(angle), chroma * np.sin(angle)])
    s = np.where(known, s, 0.0)
    out = linear_to_srgb(oklab_to_linear(np.stack([np.interp(s, at, stop) for stop in stops], axis=-1)))
    out[~known] = 0.5
    return out


def blend(part: ArrayLike, none: ArrayLike, full: ArrayLike) -> Floats:
    """Colours between two: ``none`` where ``part`` is 0 or less, ``full`` where it is 1 or more.

    Args:
        part: Any shape.
        none: sRGB colour, shape (3,).
        full: sRGB colour, shape (3,).

    Returns:
        sRGB colours, shape part.shape + (3,).
    """
    p = np.clip(np.asarray(part, dtype=np.float64), 0.0, 1.0)[..., None]
    return np.asarray((1.0 - p) * np.asarray(none) + p * np.asarray(full))


def legible_limit(values: ArrayLike) -> float:
    """A rounded upper end for a scale that shows ``values`` >= 0 well: their 99.5th percentile, two digits, upwards."""
    v = np.asarray(values, dtype=np.float64)
    v = v[np.isfinite(v)]
    top = float(np.percentile(v, 99.5)) if v.size else 0.0
    if top <= 0.0:
        return 1.0
    unit = 10.0 ** (np.floor(np.log10(top)) - 1)
    return float(np.ceil(top / unit) * unit)


@cache
def _table(size: int = 256) -> Floats:
    """The scale's sRGB colours, shape (size, 3), at equal distances along the curve through the stops."""
    lightness, chroma, hue = np.array(_STOPS).T
    knots = np.linspace(0.0, 1.0, len(_STOPS))
    s = np.linspace(0.0, 1.0, 4001)
    angle = np.radians(_monotone_cubic(knots, hue, s))
    radius = _monotone_cubic(knots, chroma, s)
    lab = np.stack([_monotone_cubic(knots, lightness, s), radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lab, axis=0), axis=-1))])
    even = np.linspace(0.0, length[-1], size)
    return linear_to_srgb(oklab_to_linear(np.stack([np.interp(even, length, lab[:, i]) for i in range(3)], axis=-1)))


def _monotone_cubic(x: Floats, y: Floats, at: Floats) -> Floats:
    """Cubic Hermite interpolation with slopes that keep monotone data monotone (Fritsch and Butland 1984)."""
    from scipy.interpolate import CubicHermiteSpline

    step = np.diff(x)
    secant = np.diff(y) / step
    slope = np.empty_like(y)
    slope[0], slope[-1] = secant[0], secant[-1]
    same_sign = secant[:-1] * secant[1:] > 0.0
    harmonic = 2.0 * secant[:-1] * secant[1:] / np.where(same_sign, secant[:-1] + secant[1:], 1.0)
    slope[1:-1] = np.where(same_sign, harmonic, 0.0)
    return np.asarray(CubicHermiteSpline(x, y, slope)(at))
