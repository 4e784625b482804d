"""States without learning: what was observed, and principal components against NumPy's."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from bits import through_a_file
from model_problems import vector_episodes, vector_task

from solar_cli.episodes import Batch, Episodes, window_indices
from solar_cli.models import projection
from solar_cli.models.projection import Projection, principal_components
from solar_cli.settings import TaskSettings
from solar_cli.settings.local import LqrFlm

TASK = vector_task(horizon=7, width=3, window=2)
FIRST = vector_episodes(TASK, 14)
SIDE = 4


class Collected:
    """A learner's experience: the iteration, and one batch for each up to it."""

    def __init__(self, *batches: Episodes) -> None:
        self.batches = batches
        self.iteration = len(batches)

    def recent(self, count: int) -> list[Episodes]:
        return list(self.batches[-count:])


def make(task: TaskSettings = TASK, **changes) -> Projection:
    asked = {"batches": {"initial": 14, "noisy": 6}, "budget": {"desk": 1, "full": 1}, **changes}
    return Projection(LqrFlm.model_validate(asked), task, "cpu")


def image_task(window: int = 1) -> TaskSettings:
    seen = {"kind": "image", "height": SIDE, "width": SIDE, "channels": 2, "window": window}
    return TASK.model_copy(
        update={"observation": type(TASK.observation).model_validate(seen), "horizon": 7}
    )


def image_episodes(count: int, seed: int = 0, rank: int = 32, window: int = 1) -> Episodes:
    """Random images in a space of that many dimensions, but for being rounded."""
    rng, fixed = np.random.default_rng(seed), np.random.default_rng(77)
    patterns = fixed.normal(size=(rank, 2 * SIDE**2)) * 2.0 ** -np.arange(rank)[:, None]
    flat = 128 + 20 * rng.normal(size=(count, 8, rank)) @ patterns
    frames = flat.round().clip(0, 255).astype(np.uint8).reshape(count, 8, 2, SIDE, SIDE)
    vectors = vector_episodes(TASK, count, seed)
    return replace(vectors, frames=frames, window=window)


def flat(episodes: Episodes) -> np.ndarray:
    return episodes.frames[episodes.live_frames].reshape(-1, 2 * SIDE**2) / 255.0


# Observed states


def test_latents_of_observed_states_are_those_states():
    model = make()
    assert torch.equal(model.latents(FIRST).float(), torch.tensor(FIRST.frames))
    latest, _ = model.follow(FIRST.frames[:, 2], 2, None, None)
    assert torch.equal(latest.float(), torch.tensor(FIRST.frames[:, 2]))
    model.update(Collected(FIRST))
    np.testing.assert_array_equal(model.reconstruct(FIRST), FIRST.frames)
    # Nothing is lost on the way to states either.
    z, (A, b) = model.embed(FIRST).numpy(), (part.numpy() for part in model.basis)
    windows = np.linalg.solve(A, (z - b)[..., None])[..., 0].reshape(14, 8, 2, 3)
    for t, (before, now) in enumerate(window_indices(7, 2)):
        np.testing.assert_allclose(windows[:, t, 0], FIRST.frames[:, now], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(windows[:, t, 1], FIRST.frames[:, before], rtol=1e-9, atol=1e-9)


def test_states_are_white_on_the_first_batch_and_differences_have_unit_std():
    model = make()
    model.update(Collected(FIRST))
    z = model.embed(FIRST).flatten(0, 1).numpy()
    np.testing.assert_allclose(z[:, :3].mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cov(z[:, :3].T), np.eye(3), atol=1e-9)
    np.testing.assert_allclose(z[:, 3:].std(axis=0, ddof=1), 1.0, rtol=1e-9)


def test_units_of_an_entry_do_not_matter():
    """A thousandth of a unit is no noise: powers of two, so that nothing is rounded."""
    scale = np.array([1.0, 2.0**-12, 2.0**9], np.float32)
    other = replace(FIRST, frames=FIRST.frames * scale)
    one, two = make(), make()
    one.update(Collected(FIRST))
    two.update(Collected(other))
    # A root of a matrix is unique but for signs, and for rounding.
    torch.testing.assert_close(one.embed(FIRST).abs(), two.embed(other).abs(), rtol=1e-6, atol=1e-6)


def test_an_entry_that_never_changes_breaks_nothing():
    frames = FIRST.frames.copy()
    frames[..., 1] = 0.1
    still = replace(FIRST, frames=frames)
    model = make()
    model.update(Collected(still))
    assert float(model.embed(still).abs().max()) < 10  # of what else varies, in its std


def test_without_whitening_states_are_windows_as_they_are():
    model = make(whitening=False)
    model.update(Collected(FIRST))
    z = model.embed(FIRST).numpy()
    for t, (before, now) in enumerate(window_indices(7, 2)):
        expected = np.concatenate([FIRST.frames[:, now], FIRST.frames[:, before]], axis=-1)
        np.testing.assert_array_equal(z[:, t], expected.astype(np.float64))


# Images


@pytest.mark.parametrize("frames", [20, 50])
def test_principal_components_are_the_best_linear_description(frames):
    """Fewer frames than the 32 pixels, and more: singular vectors either way."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(frames, 32)) * np.linspace(1, 3, 32) + 5.0
    mean, components = principal_components(torch.as_tensor(x).float(), 6)
    _, _, right = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)
    np.testing.assert_allclose(mean, x.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(components.T @ components, np.eye(6), atol=1e-4)
    overlap = np.abs(right[:6] @ components.numpy())
    np.testing.assert_allclose(overlap, np.eye(6), atol=2e-3)  # float32, gaps of a few per cent


def test_directions_that_frames_do_not_vary_in_are_zero():
    x = torch.zeros(9, 32)
    x[:, 3] = torch.arange(9.0)
    _, components = principal_components(x, 4)
    assert float(components[:, 0].abs().max()) == pytest.approx(1.0, abs=1e-6)
    assert not components[:, 1:].any()
    two = torch.as_tensor(np.random.default_rng(0).random((2, 32))).float()
    _, few = principal_components(two, 4)
    assert few.shape == (32, 4)
    assert not few[:, 1:].any()


def test_images_are_reconstructed_with_the_least_error_that_so_many_numbers_allow():
    task, episodes = image_task(), image_episodes(14)
    model = make(task, components=3)
    metrics = model.update(Collected(episodes))
    x = flat(episodes)
    singular = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    least = np.square(singular[3:]).sum() / x.size
    found = model.reconstruct(episodes)
    assert (found.shape, found.dtype) == (episodes.frames.shape, np.uint8)
    error = np.square(flat(replace(episodes, frames=found)) - x).mean()
    rounding = 1 / 12 / 255**2
    assert error == pytest.approx(least + rounding, rel=0.1)
    expected = flat(replace(episodes, frames=found)).reshape(-1, 2, SIDE**2)
    spread = np.square(x - x.mean(axis=0)).reshape(-1, 2, SIDE**2).mean(axis=(0, 2))
    residual = np.square(expected - x.reshape(-1, 2, SIDE**2)).mean(axis=(0, 2))
    assert metrics["least_explained_variance"] == pytest.approx(
        (1 - residual / spread).min(), abs=0.02
    )


@pytest.mark.parametrize("window", [1, 3])
def test_a_state_of_images_has_their_components_for_each_frame_of_the_window(window):
    task, episodes = image_task(window), image_episodes(14, window=window)
    model = make(task, components=3)
    model.update(Collected(episodes))
    assert model.state_size == 3 * window
    assert model.embed(episodes).shape == (14, 8, 3 * window)
    assert model.latents(episodes).shape == (14, 8, 3)


def test_an_image_has_no_more_components_than_pixels():
    assert make(image_task(), components=50).latent == 2 * SIDE**2


# The first batch


@pytest.mark.parametrize("task", [TASK, image_task()], ids=["states", "images"])
def test_what_states_mean_is_fixed_by_the_first_batch(task):
    make_one = (
        image_episodes
        if task.observation.kind == "image"
        else (lambda n, seed: vector_episodes(TASK, n, seed))
    )
    first, second = (replace(make_one(14, seed=seed), batch=Batch(seed, 0)) for seed in (1, 2))
    model = make(task, components=3)
    assert not model.trained
    model.update(Collected(first))
    before = model.embed(second)
    model.update(Collected(first, second))
    assert torch.equal(model.embed(second), before)
    assert (model.trained, model.moved_in) == (True, 1)


def test_what_a_task_shows_after_the_end_does_not_count(monkeypatch):
    rubbish = image_episodes(14)
    lengths = np.arange(14) % 6 + 2
    frames = rubbish.frames.copy()
    frames[np.arange(8) > lengths[:, None]] = 0
    one, two = (
        replace(rubbish, frames=shown, lengths=lengths) for shown in (rubbish.frames, frames)
    )
    models = [make(image_task(), components=3) for _ in "ab"]
    for model, episodes in zip(models, (one, two), strict=True):
        model.update(Collected(episodes))
    assert torch.equal(*(model.embed(one) for model in models))


def test_components_are_found_in_a_bounded_number_of_frames(monkeypatch):
    monkeypatch.setattr(projection, "MOST_FRAMES", 20)
    sizes, found = [], projection.principal_components
    monkeypatch.setattr(
        projection, "principal_components", lambda x, k: sizes.append(len(x)) or found(x, k)
    )
    make(image_task(), components=3).update(Collected(image_episodes(14)))
    assert 10 <= sizes[0] <= 20


def test_a_saved_projection_gives_the_same_states():
    for task, episodes in ((TASK, FIRST), (image_task(), image_episodes(14))):
        model, again = make(task, components=3), make(task, components=3)
        again.load_state_dict(through_a_file(model.state_dict()))
        assert not again.trained
        model.update(Collected(episodes))
        again.load_state_dict(through_a_file(model.state_dict()))
        assert torch.equal(again.embed(episodes), model.embed(episodes))
        assert again.moved_in == 1


def test_nothing_is_known_of_dynamics():
    model = make()
    model.update(Collected(FIRST))
    prior = model.dynamics_prior([], as_it_stands=True)
    assert (prior.factor, prior.latent) == (None, 3)
