"""Episodes that end early: models learn from live steps as if the rest had never been stored."""

import math
from collections import Counter

import numpy as np
import pytest
import torch
from bits import digest
from model_problems import made_up_segments, vector_episodes, vector_task

from solar_cli.episodes import Episodes
from solar_cli.errors import SolarError
from solar_cli.models.basis import LatentBasis
from solar_cli.models.priors import BayesianLDS, Segments, StandardNormal
from solar_cli.models.representation import Representation
from solar_cli.models.training import Dataset
from solar_cli.settings.local import Dynamics, Solar, Training
from solar_cli.streams import Streams

T, d, a = 8, 2, 1
LENGTHS = [8, 3, 1, 5, 8, 2]
every_form = pytest.mark.parametrize(
    ("factors", "rows", "window"),
    [
        (factors, rows, window)
        for factors in ("shared", "varying")
        for rows in ("newest", "all")
        for window in (1, 3)
    ],
)


def ended(lengths=LENGTHS, window=1, rubbish=0.0) -> Episodes:
    """Frames and actions (episode, time), of which the dead ones are ``rubbish``."""
    count = len(lengths)
    episode, time = np.meshgrid(np.arange(count), np.arange(T + 1), indexing="ij")
    frames = np.stack([episode, time, 0 * time], axis=-1).astype(np.float32)
    actions = np.stack([episode, time], axis=-1)[:, :-1].astype(np.float64)
    zeros = np.zeros((count, T))
    episodes = Episodes(frames, actions, actions.copy(), zeros, window, np.array(lengths))
    return spoilt(episodes, rubbish)


def spoilt(episodes: Episodes, rubbish: float) -> Episodes:
    """With ``rubbish`` in all that is dead."""
    episodes.frames[~episodes.live_frames] = rubbish
    for part in (episodes.actions, episodes.action_means, episodes.costs):
        part[~episodes.live_steps] = rubbish
    return episodes


def draws(data: Dataset, steps=1, length=3):
    settings = Training(segments=4, length=length)
    for step in range(steps):
        yield data.minibatch(settings, np.random.default_rng(step), d)


# What a step draws


def test_no_dead_frame_is_ever_in_a_segment():
    for batch in draws(Dataset([ended(rubbish=math.nan)], "cpu"), 50):
        assert bool(batch.frames.isfinite().all())
        assert bool(batch.actions.isfinite().all())


def test_every_segment_of_live_frames_is_equally_likely():
    seen: Counter[tuple[int, int]] = Counter()
    for batch in draws(Dataset([ended()], "cpu"), 1000):
        seen.update(zip(batch.frames[:, 0, 0].tolist(), batch.start.tolist(), strict=True))
    assert set(seen) == {(i, t) for i, n in enumerate(LENGTHS) for t in range(n - 1)}
    expected = 4000 / len(seen)
    assert all(abs(n - expected) < 5 * math.sqrt(expected) for n in seen.values())


def test_half_of_the_segments_of_fine_tuning_are_new():
    data = Dataset([ended(), ended([5, 1, 4])], "cpu", newest=3)
    frames = data.frames.unflatten(0, (-1, T + 1))
    frames[len(LENGTHS) :, :, 0] += 100  # the newest batch says so
    for batch in draws(data, 30):
        assert int((batch.frames[:, 0, 0] >= 100).sum()) >= 2


def test_segments_are_as_long_as_the_longest_episode_at_most():
    [batch] = draws(Dataset([ended([2, 4, 3])], "cpu"), length=50)
    assert batch.frames.shape[1] == 5


def every_segment(episodes: Segments, lengths: list[int], length: int) -> list[Segments]:
    """Each (episode, start) once."""
    return [
        Segments(
            episodes.mean[i : i + 1, s : s + length],
            episodes.variance[i : i + 1, s : s + length],
            episodes.actions[i : i + 1, s : s + length - 1],
            torch.tensor([s]),
            starts=torch.tensor([n + 2 - length]),
        )
        for i, n in enumerate(lengths)
        for s in range(n + 2 - length)
    ]


@every_form
@pytest.mark.parametrize("length", [4, 6])
def test_segments_of_every_start_are_on_average_all_live_steps(factors, rows, window, length):
    """Of episodes that have a segment at all; each (episode, start) has the same chance."""
    lengths = [n for n in LENGTHS if n + 1 >= length]
    episodes = masked([n + 1 for n in lengths])
    prior = prior_of(factors, rows, window)
    parts = every_segment(episodes, lengths, length)
    found, whole = [prior.statistics(part) for part in parts], prior.statistics(episodes)
    scale = len(parts) / (T + 2 - length)  # of minibatches of one segment
    for name in ("transitions", "starts"):
        for index, expected in enumerate(getattr(whole, name)):
            mean = sum(getattr(part, name)[index] for part in found) / len(parts)
            torch.testing.assert_close(scale * mean, expected, rtol=1e-12, atol=1e-12)
    together = Segments(
        *(torch.cat([part[k] for part in parts]) for k in range(4)),
        starts=torch.cat([part.starts for part in parts]),
    )
    kl = prior.kl(prior.statistics(together))  # nats a frame that is judged, by either
    torch.testing.assert_close(kl, prior.kl(whole), rtol=1e-12, atol=1e-12)


def test_the_scale_is_that_of_all_segments_there_are():
    data = Dataset([ended(window=2)], "cpu")
    [batch] = draws(data, length=4)
    # 8 steps have 6 segments of 4 frames, 5 have 3, 3 have 1: 16, of which 4 were drawn.
    assert data.scale(batch) == pytest.approx(16 / 6 / 4)
    assert batch.starts.tolist() == [
        LENGTHS[int(row)] + 2 - 4 for row in batch.frames[:, 0, 0].tolist()
    ]


def test_where_nothing_ends_early_segments_are_those_of_the_horizon():
    [batch] = draws(Dataset([ended([T, T, T])], "cpu"))
    assert batch.starts is None
    [batch] = draws(Dataset([ended([5, 5, 5])], "cpu"))
    assert batch.starts.tolist() == [4] * 4


def test_episodes_too_short_for_a_transition_are_refused():
    with pytest.raises(SolarError, match="none of 2 episodes lasts longer than 1 step"):
        Dataset([ended([1, 1], window=2)], "cpu")


# Priors


def cut(segments: Segments, frames: list[int]) -> list[Segments]:
    """Each episode by itself, without its dead frames."""
    return [
        Segments(
            segments.mean[i : i + 1, :n],
            segments.variance[i : i + 1, :n],
            segments.actions[i : i + 1, : n - 1],
            segments.start[i : i + 1],
            starts=torch.ones(1, dtype=torch.long),
        )
        for i, n in enumerate(frames)
    ]


def masked(frames: list[int], seed=0, rubbish: float | None = None) -> Segments:
    """Episodes as one batch of segments, dead frames replaced."""
    whole = made_up_segments(seed, [0] * len(frames), T + 1, d, a)
    live = torch.arange(T + 1) < torch.tensor(frames)[:, None]
    if rubbish is not None:
        whole.mean[~live], whole.variance[~live] = rubbish, abs(rubbish)
        whole.actions[~live[:, 1:]] = rubbish
    return whole._replace(live=live)


def prior_of(factors, rows, window):
    task = vector_task(horizon=T, window=window, actions=a)
    return BayesianLDS(Dynamics(factors=factors, rows=rows), d, task, "cpu")


def kl(prior, segments):
    return prior.kl(prior.statistics(segments))


@every_form
def test_a_factor_is_that_of_episodes_cut_where_they_end(factors, rows, window):
    frames = [9, 4, 6, 9, 5]
    prior, expected = (prior_of(factors, rows, window) for _ in range(2))
    prior.conclude(masked(frames))
    transitions, initial = expected.prior, expected.initial_prior
    for episode, n in zip(cut(masked(frames), frames), frames, strict=True):
        found, share = expected.statistics(episode), 1 / (T + 2 - n)
        transitions = transitions.plus(found.transitions.scaled(share))
        initial = initial.plus(found.starts.scaled(share))
    for left, right in zip((*prior.factor, *prior.initial), (*transitions, *initial), strict=True):
        torch.testing.assert_close(left, right)
    for left, right in zip(prior.given(masked(frames)), prior.factor, strict=True):
        assert torch.equal(left, right)


@every_form
def test_kl_is_a_mean_over_live_frames(factors, rows, window):
    frames = [9, 4, 6, 9, 5]
    prior = prior_of(factors, rows, window)
    prior.conclude(masked(frames, seed=1))
    total, count = 0.0, 0
    for episode, n in zip(cut(masked(frames), frames), frames, strict=True):
        judged = n - window + 1  # the transitions, and the first frame
        total, count = total + judged * float(kl(prior, episode)), count + judged
    assert float(kl(prior, masked(frames))) == pytest.approx(total / count)


def test_kl_to_a_standard_normal_is_a_mean_over_live_frames():
    frames, prior = [9, 4, 6, 1, 5], StandardNormal()
    episodes = zip(cut(masked(frames), frames), frames, strict=True)
    parts = [n * float(kl(prior, episode)) for episode, n in episodes]
    assert float(kl(prior, masked(frames))) == pytest.approx(sum(parts) / sum(frames))


@every_form
def test_what_stands_in_dead_frames_does_not_matter_to_a_prior(factors, rows, window):
    frames = [9, 4, 6, 9, 5]

    def learned(rubbish):
        prior, segments = prior_of(factors, rows, window), masked(frames, rubbish=rubbish)
        prior.conclude(segments)
        return digest([prior.state_dict(), kl(prior, segments), kl(StandardNormal(), segments)])

    assert learned(3.0) == learned(-50.0)


# Representations


TASK = vector_task(horizon=T, window=2)


class Collected:
    """A learner's experience: the iteration, and one batch for each up to it."""

    def __init__(self, *batches: Episodes) -> None:
        self.batches, self.iteration = batches, len(batches)

    def recent(self, count: int) -> list[Episodes]:
        return list(self.batches[-count:])


def batch(seed: int, rubbish: float) -> Episodes:
    whole = vector_episodes(TASK, 12, seed)
    lengths = np.random.default_rng(seed).integers(3, T + 1, size=12)
    parts = (whole.frames, whole.actions, whole.action_means, whole.costs, whole.window)
    return spoilt(Episodes(*parts, lengths), rubbish)


def updated(rubbish: float, fine_tune_steps: int) -> tuple[Representation, list[dict]]:
    """A representation after two iterations, and their metrics."""
    layers = ({"kind": "linear", "width": 6},)
    settings = Solar.model_validate(
        {
            "batches": {"initial": 12, "noisy": 12},
            "budget": {"desk": 1, "full": 1},
            "representation": {"latent": 2, "encoder": layers, "decoder": layers},
            "training": {
                "steps": 6,
                "segments": 3,
                "length": 4,
                "attempts": 1,
                "fine_tune_steps": fine_tune_steps,
            },
        }
    )
    made = Representation(
        settings,
        TASK,
        lambda: BayesianLDS(settings.dynamics, 2, TASK, "cpu"),
        lambda *_: 1.0,
        Streams(0),
        "cpu",
        lambda *_: None,
    )
    batches, metrics = [batch(seed, rubbish) for seed in (0, 1)], []
    for count in (1, 2):
        told = made.update(Collected(*batches[:count]))  # type: ignore[arg-type]
        metrics.append({k: v for k, v in told.items() if not k.startswith("seconds")})
    return made, metrics


@pytest.mark.filterwarnings("ignore:no representation of")
@pytest.mark.parametrize("fine_tune_steps", [0, 4])
def test_what_stands_in_dead_frames_does_not_matter_to_a_representation(fine_tune_steps):
    (one, told), (two, other) = (updated(rubbish, fine_tune_steps) for rubbish in (3.0, -50.0))
    assert told == other
    assert digest(one._parameters()) == digest(two._parameters())


@pytest.mark.filterwarnings("ignore:no representation of")
def test_scaling_and_whitening_are_those_of_live_frames():
    made, _ = updated(1e3, 0)
    learned = batch(0, 1e3)[:-2]  # 15 % of 12 are held out
    pairs = list(zip(learned.frames, learned.lengths, strict=True))
    frames = np.concatenate([shown[: n + 1] for shown, n in pairs])
    networks = made._model.networks
    torch.testing.assert_close(networks.frame_mean, torch.as_tensor(frames.mean(axis=0)))
    torch.testing.assert_close(networks.frame_scale, torch.as_tensor(frames.std(axis=0)))
    windows = []
    for shown, n in pairs:
        y, _ = made.follow(shown[: n + 1], 0, None, None)
        windows += [torch.stack([y[t], y[max(t - 1, 0)]]) for t in range(n + 1)]
    for left, right in zip(made.basis, LatentBasis.whitening(torch.stack(windows)), strict=True):
        torch.testing.assert_close(left, right)
