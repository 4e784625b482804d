"""The picture of a latent space: its axes are principal components, its colours the truth."""

import numpy as np
import pytest

from solar_cli.reporting import figures
from solar_cli.reporting.latents import latent_space, principal_components

STREAM = np.random.default_rng(0)
LATENTS = STREAM.normal(size=(300, 5)) @ STREAM.normal(size=(5, 5)) + 7.0
MIXING = STREAM.normal(size=(5, 2))


def panels(figure):
    """(title, points (n, 2), colours (n,)) of each."""
    shown = [axes for axes in figure.axes if axes.get_title()]
    scatters = [axes.collections[0] for axes in shown]
    return [
        (axes.get_title(), np.asarray(dots.get_offsets()), np.asarray(dots.get_array()))
        for axes, dots in zip(shown, scatters, strict=True)
    ]


def test_components_are_those_of_the_covariance():
    points, shares = principal_components(LATENTS)
    values, vectors = np.linalg.eigh(np.cov(LATENTS.T))
    np.testing.assert_allclose(np.cov(points.T), np.diag(values[:-3:-1]), atol=1e-9)
    np.testing.assert_allclose(shares, values[:-3:-1] / values.sum())
    expected = (LATENTS - LATENTS.mean(axis=0)) @ vectors[:, :-3:-1]
    np.testing.assert_allclose(np.abs(points), np.abs(expected), atol=1e-9)


def test_the_sign_of_a_component_does_not_depend_on_chance():
    points, _ = principal_components(LATENTS)
    again, _ = principal_components(LATENTS[::-1])
    np.testing.assert_allclose(again[::-1], points, atol=1e-9)
    mirrored, _ = principal_components(-LATENTS)
    np.testing.assert_allclose(mirrored, -points, atol=1e-9)


@pytest.mark.parametrize("latents", [LATENTS[:, :1], np.zeros((300, 1)), np.zeros((300, 3))])
def test_one_latent_or_one_that_stands_still_can_be_drawn(latents):
    points, shares = principal_components(latents)
    assert points.shape == (300, 2)
    assert not points[:, 1].any()
    assert shares.tolist() == [float(latents.any()), 0.0]
    assert figures.render(latent_space(latents, LATENTS[:, :2], ["x", "y"]), "png")


def test_a_panel_is_coloured_by_its_coordinate_and_titled_with_what_a_linear_map_finds():
    linear, other = LATENTS @ MIXING[:, 0], np.cos(9.0 * LATENTS[:, 0])
    truth = np.stack([linear, np.full(300, 3.0), other], axis=1).astype(np.float32)
    found = panels(latent_space(LATENTS.astype(np.float32), truth, ["tip_x", "still", "wave"]))
    assert [title.split(",")[0] for title, *_ in found] == ["tip_x", "wave"]
    for (_, points, colours), place in zip(found, (0, 2), strict=True):
        np.testing.assert_allclose(points, principal_components(LATENTS)[0], atol=1e-4)
        np.testing.assert_array_equal(colours, truth[:, place])
    r2 = [float(title.split("R²")[1]) for title, *_ in found]
    assert r2[0] == 1.0
    assert r2[1] < 0.2


def test_a_truth_that_stands_still_has_no_picture():
    assert latent_space(LATENTS, np.ones((300, 2)), ["x", "y"]) is None


def test_the_same_latents_give_the_same_bytes():
    one, two = (
        figures.render(latent_space(LATENTS, LATENTS[:, :2], ["x", "y"]), "png") for _ in range(2)
    )
    assert one == two
