"""What is drawn: surfaces of the right radius and colour, maps with their angles, colours of errors."""

import matplotlib
import numpy as np
import pytest

from shisd import models, plotting
from tests.truth import scipy_basis

matplotlib.use("Agg")
C = np.array([0.3, -1.0, 0.5, 0.8], np.float32)  # most of it along one axis, and more on one side


@pytest.fixture
def pyplot():
    from matplotlib import pyplot

    yield pyplot
    pyplot.close("all")


@pytest.mark.parametrize("argument", ["coefficients", "function"])
def test_a_function_is_a_surface_of_its_size_in_the_colour_of_its_sign(argument, pyplot):
    axes, drawn = pyplot.figure().add_subplot(projection="3d"), {}
    axes.plot_surface = lambda *xyz, facecolors, **style: drawn.update(points=np.stack(xyz, -1), colours=facecolors)
    function = C if argument == "coefficients" else lambda w: scipy_basis(np.asarray(w, float), 1) @ C
    assert plotting.plot_sphere_function(function, axes=axes, resolution=8) is axes
    points, colours = (drawn[name].reshape(-1, 3) for name in ("points", "colours"))
    assert drawn["points"].shape == (9, 17, 3)
    radius = np.linalg.norm(points, axis=1)
    values = scipy_basis(points / radius[:, None], 1) @ C
    np.testing.assert_allclose(radius, np.abs(values) / np.max(np.abs(values)), atol=1e-6)
    largest = np.sqrt(3 / (4 * np.pi)) * np.linalg.norm(C[1:]) + C[0] / np.sqrt(4 * np.pi)
    assert 0.98 * largest < np.max(np.abs(values)) <= largest
    for sign, name in ((1, plotting.POSITIVE), (-1, plotting.NEGATIVE)):
        shares = colours[sign * values > 0] / np.array(matplotlib.colors.to_rgb(name))
        np.testing.assert_allclose(shares, np.broadcast_to(shares[:, :1], shares.shape), rtol=1e-6)  # only shaded
        assert 0.4 < shares.min() and shares.max() < 1.01
    assert [text.get_text() for text in axes.texts] == ["x", "y", "z"]


def test_every_basis_function_has_its_place_and_name(pyplot):
    figure = plotting.plot_basis(1)
    figure.canvas.draw()
    names = {axes.texts[-1].get_text(): axes.get_subplotspec() for axes in figure.axes}
    places = {name: (spec.rowspan.start, spec.colspan.start) for name, spec in names.items()}
    assert places == {"$y_{0}^{0}$": (0, 1), "$y_{1}^{-1}$": (1, 0), "$y_{1}^{0}$": (1, 1), "$y_{1}^{1}$": (1, 2)}


def test_maps_are_shown_as_stored_with_their_angles(pyplot):
    texels = np.linspace(0, 2, 4 * 8 * 3, dtype=np.float32).reshape(4, 8, 3)
    axes = plotting.show_map(models.Environment(texels), exposure=0.75)
    axes.figure.canvas.draw()
    (image,) = axes.images
    np.testing.assert_allclose(image.get_array(), np.minimum(0.75 * texels, 1) ** (1 / 2.2), rtol=1e-6)
    assert image.get_extent() == [0, 360, 180, 0] and image.origin == "upper"  # row 0, the zenith, on top
    assert "0 = +x, 90 = +y" in axes.get_xlabel() and "0 = +z" in axes.get_ylabel()


def test_colours_of_errors_run_along_the_logarithm_between_the_limits():
    errors = np.array([[0.0, 1e-4, 1e-2], [-1e-1, 1.0, 50.0], [np.inf, np.nan, 1e-3]])
    got = plotting.false_colour(errors, limits=(1e-4, 1.0), colormap="gray")
    np.testing.assert_allclose(got[..., 0], [[0, 0, 0.5], [0.75, 1, 1], [1, 0.5, 0.25]], atol=0.01)  # 256 grey levels
    np.testing.assert_array_equal(got[..., :1], got[..., 1:2])
    for limits in ((0.0, 1.0), (1.0, 1.0), (2.0, 1.0)):
        with pytest.raises(ValueError, match="`limits` must be two increasing positive numbers; got"):
            plotting.false_colour(errors, limits=limits)
