import numpy as np

from softwarp.io import colormap

# Ottosson (2020), A perceptual color space for image processing: linear sRGB to cone responses, their roots to Oklab
RGB_TO_LMS = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
LMS_TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def oklab(color: np.ndarray) -> np.ndarray:
    """Oklab colours of linear-light sRGB components, shape (..., 3)."""
    return np.cbrt(np.asarray(color) @ RGB_TO_LMS.T) @ LMS_TO_OKLAB.T


def test_scale_is_perceptually_uniform():
    """Equal steps of the value are equal distances in Oklab, and lightness rises all the way."""
    shades = colormap.colors(np.linspace(0.0, 1.0, 256), 0.0, 1.0)
    lab = oklab(colormap.srgb_to_linear(shades))
    step = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    np.testing.assert_allclose(step, step.mean(), rtol=1e-3)
    assert np.all(np.diff(lab[:, 0]) > 0.0)
    assert lab[-1, 0] - lab[0, 0] > 0.6


def test_ends_and_unknown_values():
    """Beyond the ends the end colours; grey for NaN; all dark on an empty range."""
    dark, light, over, under, unknown = colormap.colors([0.0, 10.0, 99.0, -5.0, np.nan], 0.0, 10.0)
    np.testing.assert_array_equal(over, light)
    np.testing.assert_array_equal(under, dark)
    np.testing.assert_array_equal(unknown, 0.5)
    np.testing.assert_array_equal(colormap.colors([3.0], 1.0, 1.0)[0], dark)


def test_encodings_are_inverse():
    """Linear light to sRGB and back, and to Oklab and back; Oklab's white is (1, 0, 0) by definition."""
    c = np.linspace(0.0, 1.0, 33)
    np.testing.assert_allclose(colormap.linear_to_srgb(colormap.srgb_to_linear(c)), c, atol=1e-6)
    np.testing.assert_allclose(colormap.oklab_to_linear([1.0, 0.0, 0.0]), [1.0, 1.0, 1.0], atol=1e-6)
    shades = np.stack([c, c[::-1], c**2], axis=1)
    np.testing.assert_allclose(colormap.oklab_to_linear(oklab(shades)), shades, atol=1e-6)


def test_legible_limit_rounds_up_to_two_digits():
    assert colormap.legible_limit(np.full(100, 12340.0)) == 13000.0
    assert colormap.legible_limit([0.0, np.nan]) == 1.0
    assert colormap.legible_limit([]) == 1.0


def test_blend_is_clamped():
    shades = colormap.blend([-1.0, 0.5, 2.0], (0.0, 0.0, 0.0), (1.0, 0.5, 0.0))
    np.testing.assert_allclose(shades, [[0, 0, 0], [0.5, 0.25, 0], [1, 0.5, 0]])
