"""Episodes are collected once, kept as they were, and counted; judging them changes nothing."""

import copy
import warnings
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from collected_episodes import collected_in

from solar_cli.envs import build_task
from solar_cli.episodes import Batch, Episodes, Evaluation, evaluate, roll_out, window_indices
from solar_cli.errors import SolarError
from solar_cli.experience import HELD, Environment, Experience
from solar_cli.pulse import Diverged
from solar_cli.settings import TaskSettings, load_card
from solar_cli.streams import Streams

T, BOUND = 5, 0.5


class Sums:
    """The state is the sum of the actions so far; a frame is the state, and which step it is."""

    horizon, action_size, action_bound, truth_names = T, 1, BOUND, ("x",)
    at_once: int | None = None

    def reset(self, streams):
        self.x = np.array([stream.uniform() for stream in streams])
        self.step_number = 0
        return self.frames()

    def frames(self):
        steps = np.full_like(self.x, self.step_number)
        return np.stack([self.x, steps], axis=1).astype(np.float32)

    def step(self, actions):
        costs = self.x + 10 * actions[:, 0]
        self.x = self.x + actions[:, 0]
        self.step_number += 1
        return self.frames(), costs

    def ended(self):
        return np.zeros(len(self.x), np.bool_)

    def measures(self):
        return {"place": self.x.copy(), "square": self.x**2}

    def truth(self):
        return self.x[:, None].copy()


class Ending(Sums):
    """Episodes end where the sum leaves [0, 1]; it stays there, and a step then costs 7."""

    def reset(self, streams):
        frames = super().reset(streams)
        self.over = np.zeros(len(self.x), np.bool_)
        self.last = frames
        return frames

    def step(self, actions):
        over = self.over.copy()
        frames, costs = super().step(np.where(over[:, None], 0.0, actions))
        self.over |= (self.x < 0.0) | (self.x > 1.0)
        self.last = np.where(over[:, None], self.last, frames)
        return self.last.copy(), np.where(over, 7.0, costs)

    def ended(self):
        return self.over.copy()


class Failing(Sums):
    """A judge that fails, from some step on."""

    def __init__(self, which: str, first: int) -> None:
        self.which, self.first = which, first

    def measures(self):
        return self.judged("measures", super().measures)

    def truth(self):
        return self.judged("truth", super().truth)

    def judged(self, which: str, result: Callable[[], Any]) -> Any:
        if which == self.which and self.step_number >= self.first:
            raise RuntimeError("no ground truth today")
        return result()


class Pull:
    """Pulls towards zero, with white noise; notes what it was shown."""

    def __init__(self, gain: float = 0.3, std: float = 0.2) -> None:
        self.gain, self.std = gain, std
        self.shown: list[np.ndarray] = []

    def start(self, episodes, stream):
        return None if stream is None else self.std * stream.standard_normal((episodes, T, 1))

    def act(self, observations, t, state):
        self.shown.append(observations.copy())
        means = -self.gain * observations[:, -1, :1].astype(np.float64)
        return means if state is None else means + state[:, t], means, state


@pytest.fixture
def settings() -> TaskSettings:
    return TaskSettings.model_validate(
        {
            "simulator": "sums",
            "horizon": T,
            "observation": {"kind": "state", "width": 2, "window": 3},
            "action": {"size": 1, "bound": BOUND},
            "exploration": {"std": 0.2},
        }
    )


@pytest.fixture
def environment(settings: TaskSettings, tmp_path: Path) -> Environment:
    return Environment(Sums(), settings, Streams(1), tmp_path / "episodes")


def again(environment: Environment, iteration: int) -> Environment:
    """What another process makes of a checkpoint, at the start of an iteration."""
    fresh = Environment(Sums(), environment.settings, Streams(1), environment._folder)
    fresh.load_state_dict(copy.deepcopy(environment.state_dict()))
    fresh.begin(iteration)
    return fresh


def files(environment: Environment) -> list[Path]:
    return sorted(environment._folder.iterdir())


def assert_equal_bits(a: Episodes, b: Episodes) -> None:
    for name in ("frames", "actions", "action_means", "costs", "lengths"):
        left, right = getattr(a, name), getattr(b, name)
        assert left.dtype == right.dtype, name
        assert left.shape == right.shape, name
        assert left.tobytes() == right.tobytes(), name
    assert a.window == b.window


# What an episode is


def test_windows_repeat_the_first_frame_before_the_start():
    assert window_indices(3, 3).tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3]]
    assert window_indices(2, 1).tolist() == [[0], [1], [2]]
    assert window_indices(1, 4).tolist() == [[0, 0, 0, 0], [0, 0, 0, 1]]


def test_a_policy_sees_windows_that_end_at_the_present_frame(settings: TaskSettings):
    policy = Pull()
    roll_out(Sums(), settings, policy, [np.random.default_rng(0)], None)
    numbers = [shown[0, :, 1].tolist() for shown in policy.shown]
    assert numbers == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]]


@pytest.mark.parametrize("at_once", [1, 3, 7, 20])
def test_episodes_do_not_depend_on_how_many_run_side_by_side(settings: TaskSettings, at_once):
    def run(task):
        resets = [Streams(2).generator("reset", i) for i in range(7)]
        return roll_out(task, settings, Pull(), resets, Streams(2).generator("noise"))

    grouped = Sums()
    grouped.at_once = at_once
    found, whole = run(grouped), run(Sums())
    for name in ("frames", "actions", "action_means", "costs"):
        left, right = getattr(found.episodes, name), getattr(whole.episodes, name)
        np.testing.assert_array_equal(left, right)
    np.testing.assert_array_equal(found.truth, whole.truth)
    assert found.summary().keys() == whole.summary().keys()
    np.testing.assert_array_equal(found.measures["place"], whole.measures["place"])


def test_ground_truth_that_a_group_lacks_is_missing_in_all(settings: TaskSettings):
    task = Failing("truth", T)
    task.at_once, starts = 2, iter([99, 1])
    reset = task.reset
    task.reset = lambda streams: (setattr(task, "first", next(starts)), reset(streams))[1]
    resets = [Streams(2).generator("reset", i) for i in range(4)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = roll_out(task, settings, Pull(), resets, None)
    assert found.truth.shape == (4, T + 1, 0)
    assert found.truth_names == ()
    assert found.measures == {}  # both come from one look


def test_executed_actions_are_clipped_and_costs_are_theirs(settings: TaskSettings):
    policy = Pull(gain=2.0)
    episodes = roll_out(
        Sums(), settings, policy, [np.random.default_rng(i) for i in range(4)], None
    ).episodes
    x = episodes.frames[..., 0].astype(np.float64)
    wanted = -2.0 * x[:, :-1]
    np.testing.assert_array_equal(episodes.action_means[..., 0], wanted)
    np.testing.assert_array_equal(episodes.actions[..., 0], np.clip(wanted, -BOUND, BOUND))
    assert (np.abs(wanted) > BOUND).any()
    # Frames are float32, so states read off them are exact to 1e-7 only.
    np.testing.assert_allclose(episodes.costs, x[:, :-1] + 10 * episodes.actions[..., 0], atol=1e-5)
    np.testing.assert_allclose(np.diff(x), episodes.actions[..., 0], atol=1e-6)


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize("step", [0, 3, T])
def test_a_state_that_is_not_finite_meets_no_policy(settings: TaskSettings, value, step):
    class Spoilt(Sums):
        def frames(self):
            frames = super().frames()
            frames[-1, 1] = value if self.step_number == step else frames[-1, 1]
            return frames

    policy = Pull()
    with pytest.raises(Diverged, match=f"entry 1 of the observed state is {value} at step {step} "):
        roll_out(Spoilt(), settings, policy, [np.random.default_rng(i) for i in (0, 1)], None)
    assert len(policy.shown) == step


def test_a_summary_has_one_number_an_episode():
    zeros = np.zeros((2, 2, 1))
    evaluation = Evaluation(
        Episodes(np.zeros((2, 3, 1), np.float32), zeros, zeros, np.array([[1.0, 2.0], [3.0, 5.0]])),
        {"distance": np.array([[3.0, 2.0, 1.0], [9.0, 3.0, 0.0]])},
        np.zeros((2, 3, 1)),
    )
    summary = {name: values.tolist() for name, values in evaluation.summary().items()}
    assert summary == {
        "return": [-3.0, -8.0],
        "final_distance": [1.0, 0.0],
        "mean_distance": [2.0, 4.0],
    }


def test_joined_batches_keep_the_order_of_their_episodes(environment: Environment):
    environment.begin(1)
    parts = [environment.collect(Pull(), count) for count in (2, 3)]
    joined = Episodes.joined(parts)
    assert len(joined) == 5
    assert joined.horizon == T
    assert_equal_bits(joined[:2], parts[0])
    assert_equal_bits(joined[2:], parts[1])


# What ends early


@pytest.fixture
def ending(settings: TaskSettings, tmp_path: Path) -> Environment:
    return Environment(Ending(), settings, Streams(1), tmp_path / "ending")


def test_an_episode_is_as_long_as_its_task_says(ending: Environment):
    ending.begin(1)
    found = ending.collect(Pull(gain=0.0, std=0.4), 40)
    x = found.frames[..., 0]
    outside = (x < 0.0) | (x > 1.0)
    expected = np.where(outside.any(axis=1), outside.argmax(axis=1), T)
    np.testing.assert_array_equal(found.lengths, expected)
    assert {1, T} < set(expected.tolist())
    for episode, length in enumerate(found.lengths.tolist()):
        assert found.live_steps[episode].tolist() == [t < length for t in range(T)]
        assert found.live_frames[episode].tolist() == [t <= length for t in range(T + 1)]
        np.testing.assert_array_equal(
            found.frames[episode, length:],
            np.broadcast_to(found.frames[episode, length], (T + 1 - length, 2)),
        )
    assert (found.costs[~found.live_steps] == 7.0).all()
    assert not found.actions[~found.live_steps].any()
    assert not found.action_means[~found.live_steps].any()
    assert found.actions[found.live_steps].all()


def test_live_steps_are_those_of_a_task_that_goes_on(ending: Environment, environment: Environment):
    batches = []
    for one in (ending, environment):
        one.begin(1)
        batches.append(one.collect(Pull(gain=0.0, std=0.4), 40))
    for name in ("actions", "action_means", "costs"):
        left, right = (getattr(batch, name)[batches[0].live_steps] for batch in batches)
        np.testing.assert_array_equal(left, right)


def test_lengths_survive_their_file_and_go_where_episodes_go(ending: Environment):
    ending.begin(1)
    parts = [ending.collect(Pull(gain=0.0, std=0.4), count) for count in (20, 10)]
    fresh = again(ending, 1)
    fresh._task = Ending()
    assert_equal_bits(collected_in(1, fresh), Episodes.joined(parts))
    rows = np.array([25, 3])
    joined = Episodes.joined(parts)
    np.testing.assert_array_equal(joined[rows].lengths, [parts[1].lengths[5], parts[0].lengths[3]])


def test_only_executed_actions_are_counted(ending: Environment):
    ending.begin(1)
    found = ending.collect(Pull(gain=0.0, std=0.4), 40)
    assert ending.steps == found.lengths.sum() < 40 * T
    clipped = np.abs(found.actions[found.live_steps]) == BOUND
    assert ending.summary(1)["clipped"] == pytest.approx(clipped.mean(), rel=1e-12)
    assert ending.summary(1)["return"] == pytest.approx(-found.costs.sum(axis=1).mean(), rel=1e-12)


def test_a_file_of_whole_episodes_holds_what_it_always_held(environment: Environment):
    environment.begin(1)
    environment.collect(Pull(), 2)
    with np.load(files(environment)[0]) as arrays:
        assert set(arrays) == {"frames", "actions", "action_means", "costs"}


def test_a_ledger_without_steps_is_of_whole_episodes(environment: Environment):
    environment.begin(1)
    environment.collect(Pull(), 3)
    state = environment.state_dict()
    for entry in state["ledger"]:
        del entry["steps"]
    environment.load_state_dict(state)
    assert environment.steps == 3 * T


# What counts


def test_collected_episodes_count_once(environment: Environment):
    environment.begin(1)
    environment.collect(Pull(), 4)
    environment.collect(Pull(), 2, noisy=False)
    environment.begin(2)
    environment.collect(Pull(), 3)
    assert (environment.episodes, environment.steps) == (9, 9 * T)
    environment.begin(2)  # the iteration is repeated
    environment.collect(Pull(), 3)
    assert (environment.episodes, environment.steps) == (9, 9 * T)
    assert [len(collected_in(iteration, environment)) for iteration in (1, 2)] == [6, 3]


def test_a_repeated_iteration_finds_what_it_collected(environment: Environment):
    environment.begin(1)
    collected = environment.collect(Pull(), 4)
    environment.begin(1)
    # Another policy would collect other episodes: these were not collected again.
    assert_equal_bits(environment.collect(Pull(gain=0.9), 4), collected)


def test_episodes_that_are_not_kept_count_and_are_nowhere(environment: Environment):
    environment.begin(1)
    kept = environment.collect(Pull(), 2)
    environment.collect(Pull(), 4, kept=False)
    assert (environment.episodes, environment.steps) == (6, 6 * T)
    assert [path.name for path in files(environment)] == ["0001-0.npz"]
    assert environment.batches() == [Batch(1, 0)]
    [recent] = environment.recent(1)
    assert_equal_bits(recent, kept)
    with pytest.raises(StopIteration):
        environment.batch(Batch(1, 1))


def test_episodes_that_are_not_kept_are_in_the_summary(environment: Environment):
    parts = []
    for kept in (True, False):
        environment.begin(1 + len(parts))
        collected = [environment.collect(Pull(), count, kept=kept) for count in (2, 4)]
        parts.append((environment.summary(environment.iteration), collected))
    for summary, collected in parts:
        costs = np.concatenate([batch.costs for batch in collected])
        assert summary["return"] == pytest.approx(-costs.sum(axis=1).mean())


def test_episodes_that_are_not_kept_are_collected_again_and_count_once(environment: Environment):
    environment.begin(1)
    collected = [environment.collect(Pull(), 4, kept=False) for _ in range(3)]
    resumed = again(environment, 1)
    resumed.resume_at(1)
    for before in (*collected[1:], None):
        found = resumed.collect(Pull(), 4, kept=False)
        if before is not None:
            assert_equal_bits(found, before)
            assert resumed.episodes == 12
    assert resumed.episodes == 16


def test_recent_batches_are_those_of_the_last_iterations_oldest_first(environment: Environment):
    batches: dict[int, list[Episodes]] = {}
    for iteration in (1, 2, 3, 4):
        environment.begin(iteration)
        batches[iteration] = [environment.collect(Pull(), iteration)]
        batches[iteration].append(environment.collect(Pull(), 1, noisy=False))
    expected = [*batches[3], *batches[4]]
    for found, batch in zip(environment.recent(2), expected, strict=True):
        assert_equal_bits(found, batch)
    assert_equal_bits(collected_in(2, environment), Episodes.joined(batches[2]))
    assert [len(batch) for batch in environment.recent(1)] == [4, 1]
    assert [len(batch) for batch in environment.recent(10)] == [1, 1, 2, 1, 3, 1, 4, 1]
    environment.begin(2)  # what was collected later is not there yet
    assert [len(batch) for batch in environment.recent(2)] == [1, 1, 2, 1]


def test_a_learner_meets_its_experience_and_no_judge(environment: Environment):
    environment.begin(3)
    experience = Experience(environment)
    collected = experience.collect(Pull(), 4)
    assert experience.iteration == 3
    assert_equal_bits(experience.batch(Batch(3, 0)), collected)
    public = {name for name in dir(experience) if not name.startswith("_")}
    assert public == {"collect", "resume_at", "batches", "batch", "recent", "iteration"}


@pytest.mark.parametrize(("count", "noisy"), [(3, False), (2, True)])
def test_another_call_does_not_get_what_was_collected(environment: Environment, count, noisy):
    """A version of another order of calls left a ledger."""
    environment.begin(1)
    environment.collect(Pull(), 3)
    environment.begin(1)
    with pytest.raises(SolarError, match=r"iteration 1 .*3 episodes.*--redo"):
        environment.collect(Pull(), count, noisy=noisy)


def test_batches_are_found_by_their_names(environment: Environment):
    calls: dict[Batch, Episodes] = {}
    for iteration in (1, 2):
        environment.begin(iteration)
        for call, noisy in enumerate((False, True)):
            name = Batch(iteration, call, noisy)
            calls[name] = environment.collect(Pull(), 1 + call, noisy=noisy)
    assert environment.batches() == list(calls)
    for name, collected in calls.items():
        found = environment.batch(name)
        assert_equal_bits(found, collected)
        assert found.batch == collected.batch == name
        assert found[:1].batch is None
        assert Episodes.joined([found, found]).batch is None


def test_an_iteration_is_summed_up_over_its_noisy_episodes(environment: Environment):
    environment.begin(1)
    noisy = [environment.collect(Pull(), 1), environment.collect(Pull(), 3)]
    environment.collect(Pull(gain=-5.0), 7, noisy=False)
    summary = environment.summary(1)
    costs = np.concatenate([batch.costs for batch in noisy])
    actions = np.concatenate([batch.actions for batch in noisy])
    x = np.concatenate([batch.frames for batch in noisy])[..., 0].astype(np.float64)
    assert summary["return"] == pytest.approx(-costs.sum(axis=1).mean(), rel=1e-12)
    assert summary["clipped"] == pytest.approx((np.abs(actions) == BOUND).mean(), rel=1e-12)
    assert summary["final_place"] == pytest.approx(x[:, -1].mean(), rel=1e-6)  # float32 frames
    assert summary["mean_square"] == pytest.approx((x**2).mean(), rel=1e-6)
    assert environment.summary(2) == {}


def test_noise_belongs_to_the_iteration_and_the_call(environment: Environment):
    batches = []
    for iteration in (1, 2):
        environment.begin(iteration)
        batches += [environment.collect(Pull(), 2) for _ in range(2)]
    noise = [batch.actions - batch.action_means for batch in batches]
    starts = [batch.frames[:, 0, 0] for batch in batches]
    for i in range(4):
        for j in range(i):
            assert not np.isclose(noise[i], noise[j]).any()
            assert not np.isclose(starts[i], starts[j]).any()
    quiet = environment.collect(Pull(), 2, noisy=False)
    np.testing.assert_array_equal(quiet.actions, quiet.action_means)


# What is kept


def test_a_file_gives_back_what_was_collected(environment: Environment):
    environment.begin(1)
    collected = [environment.collect(Pull(), 3), environment.collect(Pull(), 2, noisy=False)]
    fresh = again(environment, 1)
    assert_equal_bits(collected_in(1, fresh), Episodes.joined(collected))
    assert fresh.summary(1) == environment.summary(1)


def test_images_survive_their_file(tmp_path: Path):
    task = load_card("nav").task.model_copy(update={"horizon": T})

    class Still(Pull):
        def act(self, observations, t, state):
            means = np.zeros((len(observations), 2))
            return means + state[:, t], means, state

    def make() -> Environment:
        return Environment(build_task(task), task, Streams(2), tmp_path)

    environment = make()
    environment.begin(1)
    collected = environment.collect(Still(), 3)
    fresh = make()
    fresh.load_state_dict(environment.state_dict())
    fresh.begin(1)
    assert collected.frames.dtype == np.uint8
    assert_equal_bits(fresh.recent(1)[0], collected)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-9]),
    "one bit flipped": lambda path: path.write_bytes(
        path.read_bytes()[:99] + bytes([path.read_bytes()[99] ^ 1]) + path.read_bytes()[100:]
    ),
}
damaged = pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)


@damaged
def test_a_damaged_file_of_this_iteration_is_collected_again(environment: Environment, damage):
    environment.begin(1)
    environment.collect(Pull(), 4)
    environment.begin(2)
    collected = [environment.collect(Pull(), 3), environment.collect(Pull(), 2, noisy=False)]
    for file in files(environment)[1:]:
        damage(file)
    fresh = again(environment, 2)
    for expected, noisy in zip(collected, (True, False), strict=True):
        assert_equal_bits(fresh.collect(Pull(), len(expected), noisy=noisy), expected)
    assert fresh.episodes == environment.episodes == 9
    assert fresh.state_dict() == environment.state_dict()


@damaged
def test_what_was_collected_again_is_there_for_later_processes(environment: Environment, damage):
    environment.begin(1)
    collected = environment.collect(Pull(), 4)
    damage(files(environment)[0])
    fresh = again(environment, 1)
    fresh.collect(Pull(), 4)
    assert_equal_bits(again(fresh, 2).recent(2)[0], collected)


@damaged
def test_collecting_again_with_another_policy_is_refused_and_changes_no_file(
    environment: Environment, damage
):
    environment.begin(1)
    environment.collect(Pull(), 4)
    damage(files(environment)[0])
    before = {file.name: file.read_bytes() for file in files(environment)}
    fresh = again(environment, 1)
    with pytest.raises(SolarError, match=r"0001-0\.npz.*restore the file"):
        fresh.collect(Pull(gain=0.9), 4)
    assert {file.name: file.read_bytes() for file in files(environment)} == before
    assert fresh.state_dict() == environment.state_dict()


@damaged
def test_a_damaged_file_of_an_older_iteration_is_refused(environment: Environment, damage):
    environment.begin(1)
    environment.collect(Pull(), 4)
    environment.begin(2)
    environment.collect(Pull(), 3)
    damage(files(environment)[0])
    fresh = again(environment, 2)
    assert len(fresh.collect(Pull(), 3)) == 3
    assert [len(batch) for batch in fresh.recent(1)] == [3]
    for ask in (lambda: fresh.recent(2), lambda: collected_in(1, fresh)):
        with pytest.raises((SolarError, OSError), match=r"0001-0\.npz.*damaged.*--redo"):
            ask()


def test_frames_of_long_ago_leave_memory_and_are_read_again(environment: Environment):
    held: list[weakref.ref[Episodes]] = []
    starts = []
    for iteration in range(1, HELD + 6):
        environment.begin(iteration)
        collected = environment.collect(Pull(), 2)
        collected_in(1, environment)  # asked for every time
        held.append(weakref.ref(collected))
        starts.append(collected.frames[:, 0].copy())
    del collected
    alive = [iteration for iteration, batch in enumerate(held, 1) if batch() is not None]
    assert alive == [1, *range(len(held) - HELD + 2, len(held) + 1)]
    for found, start in zip(environment.recent(len(held)), starts, strict=True):
        np.testing.assert_array_equal(found.frames[:, 0], start)


def test_no_half_written_file_is_left(environment: Environment):
    for iteration in (1, 2):
        environment.begin(iteration)
        environment.collect(Pull(), 2)
    assert [file.name for file in files(environment)] == ["0001-0.npz", "0002-0.npz"]


# What judging must not change


def test_evaluating_changes_neither_the_count_nor_what_is_collected(
    environment: Environment, settings: TaskSettings, tmp_path: Path
):
    quiet = Environment(Sums(), settings, Streams(1), tmp_path / "quiet")
    judge, streams = Sums(), Streams(1).under("evaluation")
    for iteration in (1, 2):
        environment.begin(iteration)
        quiet.begin(iteration)
        before = copy.deepcopy(environment.state_dict())
        for _ in range(3):
            evaluate(judge, settings, Pull(), 4, streams.under(iteration))
        assert environment.state_dict() == before
        assert_equal_bits(environment.collect(Pull(), 3), quiet.collect(Pull(), 3))
    assert environment.state_dict() == quiet.state_dict()


def test_evaluations_are_noise_free_and_repeat_themselves(settings: TaskSettings):
    first, second = (evaluate(Sums(), settings, Pull(), 6, Streams(1)) for _ in range(2))
    other = evaluate(Sums(), settings, Pull(), 6, Streams(2))
    assert_equal_bits(first.episodes, second.episodes)
    np.testing.assert_array_equal(first.episodes.actions, first.episodes.action_means)
    assert len(np.unique(first.episodes.frames[:, 0, 0])) == 6
    assert not (first.episodes.frames[:, 0] == other.episodes.frames[:, 0])[:, 0].any()


@pytest.mark.parametrize("which", ["measures", "truth"])
@pytest.mark.parametrize("first", [0, 2, T])
def test_a_failing_judge_is_out_of_a_learners_reach(
    environment: Environment, settings: TaskSettings, tmp_path: Path, which: str, first: int
):
    blind = Environment(Failing(which, first), settings, Streams(1), tmp_path / "blind")
    for iteration in (1, 2):
        environment.begin(iteration)
        blind.begin(iteration)
        expected = environment.collect(Pull(), 3)
        with pytest.warns(UserWarning, match="no ground truth today"):
            found = blind.collect(Pull(), 3)
        assert_equal_bits(found, expected)
        assert blind.episodes == environment.episodes
        learned = {"return", "clipped"}
        kept, all_of_it = blind.summary(iteration), environment.summary(iteration)
        assert {name: kept[name] for name in learned} == {name: all_of_it[name] for name in learned}


def test_measures_of_some_episodes_only_are_no_mean(settings: TaskSettings, tmp_path: Path):
    task = Failing("measures", T + 1)
    environment = Environment(task, settings, Streams(1), tmp_path)
    environment.begin(1)
    environment.collect(Pull(), 2)
    task.first = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        environment.collect(Pull(), 2)
    assert set(environment.summary(1)) == {"return", "clipped"}
