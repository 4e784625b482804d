import math

import numpy as np
import pytest

from solar_cli.envs.rasteriser import Box, Disc, draw_blobs, draw_figure, enlarge, shrink


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


FIGURE = (
    Box((-4.0, 0.5), (2.0, 4.5), 90.0),
    Box((0.0, 0.0), (7.3, 3.1), 255.0),
    Disc((2.5, -0.5), 2.2, 30.0),
    Box((3.0, 1.0), (0.3, 1.4), 180.0),  # thinner than a pixel
)


def painted(centres, headings, figure=FIGURE, shape=(40, 48), ground=20):
    images = np.full((len(centres), *shape), ground, np.uint8)
    draw_figure(images, np.asarray(centres, float), np.asarray(headings, float), figure)
    return images


def poses(count, shape=(40, 48), beyond=8):
    draws = np.random.default_rng(4)
    centres = draws.uniform(-beyond, np.array(shape) + beyond, (count, 2))
    return centres, draws.uniform(-7, 7, count)


def supersampled(centre, heading, figure=FIGURE, shape=(40, 48), ground=20):
    """From 16 x 16 points a pixel, which a part covers or does not."""
    rows, columns = (np.arange(side * 16) / 16 - 15 / 32 for side in shape)
    right, up = np.meshgrid(columns - centre[1], centre[0] - rows)
    turned = (right + 1j * up) * np.exp(-1j * heading)
    image = np.full(turned.shape, float(ground))
    for part in figure:
        x, y = turned.real - part.centre[0], turned.imag - part.centre[1]
        if isinstance(part, Disc):
            inside = np.hypot(x, y) <= part.radius
        else:
            inside = (np.abs(x) <= part.half[0]) & (np.abs(y) <= part.half[1])
        image[inside] = part.grey
    return image.reshape(shape[0], 16, shape[1], 16).mean(axis=(1, 3))


def test_a_figure_is_as_one_drawn_from_many_points():
    centres, headings = poses(30)
    images = painted(centres, headings).astype(float)
    expected = np.stack([supersampled(*pose) for pose in zip(centres, headings, strict=True)])
    errors = np.abs(images - expected)
    assert errors.mean(axis=(1, 2)).max() < 0.5  # of 255
    # Worst where several edges share a pixel, which one number cannot say.
    assert errors.max() < 60


def test_a_box_along_the_pixels_covers_its_exact_share():
    def shared(pixel, low, high):
        return max(0.0, min(pixel + 0.5, high) - max(pixel - 0.5, low))

    for half in [(3.7, 1.2), (0.2, 2.0), (0.5, 0.5)]:
        [image] = painted([[5.3, 6.7]], [0.0], [Box((0.4, -0.6), half, 255.0)], (12, 14), 0)
        # Ahead is to the right, left is up.
        columns = [shared(c, 7.1 - half[0], 7.1 + half[0]) for c in range(14)]
        rows = [shared(r, 5.9 - half[1], 5.9 + half[1]) for r in range(12)]
        assert np.abs(image - 255 * np.outer(rows, columns)).max() <= 0.5 + 1e-9


@pytest.mark.parametrize(("heading", "nose"), [(0, (20, 30)), (np.pi / 2, (10, 20))])
def test_a_heading_turns_from_right_to_up(heading, nose):
    [image] = painted([[20.0, 20.0]], [heading], [Disc((10.0, 0.0), 1.0, 255.0)])
    assert np.unravel_index(image.argmax(), image.shape) == nose


@pytest.mark.parametrize("figure", [FIGURE, (Disc((0.0, 0.0), 2.8, 255.0),)])
def test_a_patch_has_the_bits_of_a_whole_frame(figure):
    centres, headings = poses(60)
    centres[::2] = centres[::2].round()
    # A part far outside every image shows nowhere, but what is within reach is then all of it.
    everywhere = (*figure, Disc((500.0, 0.0), 0.0, 255.0))
    patches, whole = (painted(centres, headings, parts) for parts in (figure, everywhere))
    assert np.array_equal(patches, whole)


def test_a_figure_does_not_depend_on_those_beside_it():
    centres, headings = poses(150)
    together = painted(centres, headings)
    for i in range(0, 150, 7):
        assert np.array_equal(painted(centres[i : i + 1], headings[i : i + 1])[0], together[i])
    assert np.array_equal(painted(centres[::3], headings[::3]), together[::3])


def test_a_figure_outside_its_image_leaves_it_as_it_was():
    assert (painted([[-60.0, 300.0], [20.0, -30.0]], [0.3, 0.4]) == 20).all()


def test_a_part_covers_those_before_it():
    small, large = Disc((0.0, 0.0), 2.0, 100.0), Disc((0.0, 0.0), 5.0, 200.0)
    one, other = (
        painted([[20.0, 20.0]], [0.0], parts) for parts in ((small, large), (large, small))
    )
    assert (one[0, 20, 20], other[0, 20, 20]) == (200, 100)
    assert one[0, 20, 16] == other[0, 20, 16] == 200


@pytest.mark.parametrize(("rows", "columns"), [(6, 4), (3, 2), (4, 3), (7, 9), (1, 1)])
def test_a_shrunk_image_keeps_the_light_of_every_area(rows, columns):
    """Enlarged by repetition to a common size, old and new pixels that cover it alike agree."""
    image = np.random.default_rng(0).uniform(size=(2, 6, 4))
    fine = image.repeat(rows, axis=1).repeat(columns, axis=2)
    expected = fine.reshape(2, rows, 6, columns, 4).mean(axis=(2, 4))
    np.testing.assert_allclose(shrink(image, rows, columns), expected, atol=1e-12)
