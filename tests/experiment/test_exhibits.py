"""What is kept of a last evaluation to be drawn."""

from collections.abc import Callable

import numpy as np
import pytest

from solar_cli.episodes import Episodes, Evaluation
from solar_cli.experiment.exhibits import POINTS, RECONSTRUCTED, exhibit
from solar_cli.settings import Cell
from solar_cli.store.owner import Owner
from solar_cli.store.store import Store

NAMES = ("x", "y")
LENGTHS = np.array([3, 70, 40])


class Seeing:
    """Its two latents of a frame are the frame's number and the square of that."""

    def encode(self, episodes: Episodes) -> np.ndarray | None:
        assert isinstance(episodes, Episodes)  # and so without the truth
        number = episodes.frames[..., 0].astype(float)
        return np.stack([number, number**2], axis=-1)

    def reconstruct(self, episodes: Episodes) -> None:
        return None


class Unseeing(Seeing):
    def encode(self, episodes: Episodes) -> None:
        return None


def judged(count: int = 3, names: tuple[str, ...] = NAMES) -> Evaluation:
    """Episodes of 70 steps that end after `LENGTHS`; the truth is twice and thrice the number."""
    numbers = np.arange(count * 71, dtype=np.float32).reshape(count, 71, 1)
    actions = np.zeros((count, 70, 1))
    lengths = LENGTHS[np.arange(count) % 3]
    episodes = Episodes(numbers, actions, actions, actions[..., 0], 1, lengths)
    truth = np.concatenate([2.0 * numbers, 3.0 * numbers], axis=-1)
    return Evaluation(episodes, {}, truth[..., : len(names)], names)


@pytest.fixture
def kept(
    store: Store, make_cells: Callable[..., list[Cell]]
) -> Callable[..., dict[str, dict[str, np.ndarray]]]:
    """Exhibit, and read back what is stored, by kind."""
    [cell] = make_cells()
    store.add([cell])
    attempt = store.claim(cell.hash, Owner.current(), 4, {})
    store.folder(cell.hash).mkdir(parents=True, exist_ok=True)

    def read(evaluation: Evaluation, learner: object) -> dict[str, dict[str, np.ndarray]]:
        exhibit(store, cell.hash, attempt, 3, "state", evaluation, learner)  # type: ignore[arg-type]
        found = {}
        for artifact in store.artifacts(cell.hash):
            with np.load(artifact.path, allow_pickle=False) as arrays:
                found[artifact.kind] = dict(arrays)
        return found

    return read


def test_latents_of_every_live_frame_stand_beside_their_truth(kept) -> None:
    found = kept(judged(), Seeing())["latents"]
    numbers = found["latents"][:, 0]
    expected = [71 * episode + t for episode in range(3) for t in range(LENGTHS[episode] + 1)]
    assert numbers.tolist() == expected
    np.testing.assert_array_equal(found["latents"][:, 1], numbers**2)
    np.testing.assert_array_equal(found["truth"], np.stack([2 * numbers, 3 * numbers], axis=1))
    assert found["names"].tolist() == ["x", "y"]


def test_of_many_latents_some_are_kept_from_the_first_to_the_last(kept) -> None:
    numbers = kept(judged(90), Seeing())["latents"]["latents"][:, 0]
    assert len(numbers) == POINTS
    assert (np.diff(numbers) > 0).all()
    assert (numbers[0], numbers[-1]) == (0, 89 * 71 + LENGTHS[2])


@pytest.mark.parametrize(
    ("evaluation", "learner"), [(judged(), Unseeing()), (judged(names=()), Seeing())]
)
def test_without_latents_or_truth_there_are_none(kept, evaluation, learner) -> None:
    assert set(kept(evaluation, learner)) == {"animation"}


class Foretelling(Unseeing):
    """Foresees numbers that are one too large, 20 steps ahead."""

    def foresee(self, episodes: Episodes) -> np.ndarray:
        return episodes.frames[:, 1:21] + 1


def test_predictions_stand_beside_what_came_of_the_first_episode(kept) -> None:
    found = kept(judged(), Foretelling())["prediction"]
    steps = found["original"][:, 0]
    assert len(steps) == RECONSTRUCTED
    assert (steps[0], steps[-1]) == (1, 20)
    assert (np.diff(steps) > 0).all()
    np.testing.assert_array_equal(found["prediction"][:, 0], steps + 1)


def test_before_there_is_a_model_nothing_is_foreseen(kept) -> None:
    class Silent(Foretelling):
        def foresee(self, episodes: Episodes) -> None:
            return None

    assert set(kept(judged(), Silent())) == {"animation"}
