import math

import numpy as np
import pytest

from solar_cli.envs.rasteriser import draw_blobs, enlarge, shrink


def drawn(centres, deviation=1.0, shape=(32, 32)):
    images = np.zeros((len(centres), *shape), np.uint8)
    draw_blobs(images, np.asarray(centres, float), deviation)
    return images


def analytic(centre, deviation, shape):
    """One pixel at a time, with Python's own arithmetic."""
    return np.array(
        [
            [
                255 * math.exp(-((r - centre[0]) ** 2 + (c - centre[1]) ** 2) / 2 / deviation**2)
                for c in range(shape[1])
            ]
            for r in range(shape[0])
        ]
    )


@pytest.mark.parametrize(
    ("deviation", "shape"), [(1.0, (32, 32)), (0.6, (20, 32)), (2.3, (64, 48)), (3.0, (9, 30))]
)
def test_every_pixel_is_the_rounded_gaussian_at_its_centre(deviation, shape):
    # Whole, half and general positions; some lie partly or wholly outside the image.
    inside = np.random.default_rng(0).uniform(-6, np.array(shape) + 6, (40, 2))
    centres = np.vstack([[[5.0, 7.0], [5.5, 7.5], [0.0, 0.0], [-80.0, 300.0]], inside])
    for image, centre in zip(drawn(centres, deviation, shape), centres, strict=True):
        # Half a grey level of rounding, and the last bits of two ways to compute the exponential.
        assert np.abs(image - analytic(centre, deviation, shape)).max() <= 0.5 + 1e-9


def test_a_blob_outside_its_image_leaves_it_black():
    assert not drawn([[-80.0, 300.0], [16.0, -4.0]]).any()


def test_the_position_can_be_read_to_a_fiftieth_of_a_pixel():
    centres = np.random.default_rng(1).uniform(6, 25, (200, 2))
    images = drawn(centres).astype(float)
    mass = images.sum(axis=(1, 2))
    rows = images.sum(axis=2) @ np.arange(32) / mass
    columns = images.sum(axis=1) @ np.arange(32) / mass
    assert np.abs(np.stack([rows, columns], axis=1) - centres).max() < 0.02


def test_a_coarse_image_samples_a_fine_one():
    centres = np.random.default_rng(2).uniform(0, 31, (20, 2))
    fine = drawn(3.0 * centres + 1.0, deviation=3.0, shape=(96, 96))
    # A value within 1e-9 of a half may round either way.
    assert np.abs(fine[:, 1::3, 1::3].astype(int) - drawn(centres)).max() <= 1


def test_other_pixels_are_left_alone():
    images = np.full((1, 32, 32), 7, np.uint8)
    draw_blobs(images, np.array([[16.0, 16.0]]), 1.0)
    assert (images[0, :8] == 7).all()
    assert (images[0, :, 24:] == 7).all()


def test_enlarging_keeps_constants_and_ramps():
    assert enlarge(np.full((2, 5, 6), 0.3), 8) == pytest.approx(0.3)
    ramp = enlarge(np.tile(np.arange(10.0), (10, 1)), 4)
    assert ramp.shape == (40, 40)
    # Away from the border, where the ramp stops.
    places = (np.arange(40) + 0.5) / 4 - 0.5
    assert ramp[20, 8:-8] == pytest.approx(places[8:-8])


def test_enlarging_keeps_the_pixels_at_their_centres():
    image = np.random.default_rng(3).uniform(size=(7, 9))
    assert enlarge(image, 3)[1::3, 1::3] == pytest.approx(image)


@pytest.mark.parametrize(("rows", "columns"), [(6, 4), (3, 2), (4, 3), (7, 9), (1, 1)])
def test_a_shrunk_image_keeps_the_light_of_every_area(rows, columns):
    """Enlarged by repetition to a common size, old and new pixels that cover it alike agree."""
    image = np.random.default_rng(0).uniform(size=(2, 6, 4))
    fine = image.repeat(rows, axis=1).repeat(columns, axis=2)
    expected = fine.reshape(2, rows, 6, columns, 4).mean(axis=(2, 4))
    np.testing.assert_allclose(shrink(image, rows, columns), expected, atol=1e-12)
