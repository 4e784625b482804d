"""An iteration that was interrupted where it may be ends with the bits of one that was not."""

from itertools import count

import pytest
from method_runs import Run

from solar_cli.errors import SolarError

FINE_TUNING = ("training.fine_tune_steps=8", "training.fine_tune_rate=0.003")
FLOORS = ("update.early_updates=1", "update.std_floor=[0.95, 0.3]", "update.kl_step=5.0")
"""The number of updates so far shows in the policy's std."""
SMOOTHER = ('dynamics.posterior="smoother"', "dynamics.hidden=2")


@pytest.mark.parametrize(
    ("name", "sets", "pulses"),
    [
        ("solar", FINE_TUNING, 3 + 2 + 2),
        ("solar", ("training.attempts=2", *FLOORS), 2 * 3),
        ("solar", ('dynamics.factors="varying"', 'dynamics.rows="all"'), 3),
        ("solar", (*FINE_TUNING, *SMOOTHER), 3 + 2 + 2),
        ("solar", (*SMOOTHER, 'dynamics.factors="varying"'), 3),
        ("vae", FINE_TUNING, 3 + 2 + 2),
        ("rce", FINE_TUNING, 3 + 2 + 2),
        ("rce", ("training.attempts=2",), 2 * 3),
        ("global-mpc", (), 3 + 3 * 3),
        ("global-mpc", FINE_TUNING, 3 + 2 * 2 + 3 * 3),
        ("mpc-nn", (), 3 * 3),
    ],
    ids=[
        "solar fine-tuned",
        "solar frozen, two attempts",
        "solar as in Eq. 5",
        "smoother fine-tuned",
        "smoother, varying",
        "vae fine-tuned",
        "rce fine-tuned",
        "rce frozen, two attempts",
        "global-mpc",
        "global-mpc fine-tuned",
        "mpc-nn",
    ],
)
def test_a_run_interrupted_at_any_pulse_ends_with_the_same_bits(tmp_path, name, sets, pulses):
    saved = []
    whole = Run(
        tmp_path,
        name,
        *sets,
        pulse=lambda *_: saved.append((whole.environment.iteration, whole.state())),
    )
    whole.iterate(1, 3)
    assert len(saved) == pulses
    for iteration, state in saved:
        goes_on(Run(tmp_path, name, *sets).restore(state), iteration, whole)


def goes_on(resumed, iteration, whole):
    """Resumed in an iteration, it ends as the run that was not interrupted."""
    resumed.iterate(iteration, len(whole.metrics))
    assert repr(resumed.metrics) == repr(whole.metrics[iteration - 1 :])
    assert resumed.bits() == whole.bits()


@pytest.mark.parametrize(
    ("name", "sets"),
    [("solar", FINE_TUNING), ("vae", FINE_TUNING), ("rce", FINE_TUNING), ("lqr-flm", ())],
)
@pytest.mark.parametrize("noise_free", [0, 2])
def test_a_run_interrupted_while_it_collects_ends_with_the_same_bits(
    tmp_path, name, sets, noise_free
):
    """With episodes that judge, the third iteration is rejected: the best collects again."""
    sets = (*sets, f"batches.noise_free={noise_free}")
    saved, more = [], {2: -1.0, 3: 1e3} if noise_free else {}

    steps = count(1)

    def costing(iteration, costs):
        return costs + more.get(iteration, 0.0)

    def halfway(iteration, costs):
        if next(steps) % 6 == 3:  # of the six steps of an episode
            saved.append((iteration, whole.state()))
        return costing(iteration, costs)

    whole = Run(tmp_path, name, *sets, costs=halfway)
    whole.iterate(1, 3)
    assert [iteration for iteration, _ in saved] == sorted([1, 2, 3] * (1 + bool(noise_free)))
    assert [metrics["rejected"] for metrics in whole.metrics] == [0.0, 0.0, float(noise_free > 0)]
    for iteration, state in saved:
        goes_on(Run(tmp_path, name, *sets, costs=costing).restore(state), iteration, whole)


@pytest.mark.parametrize("name", ["global-mpc", "mpc-nn", "random", "zero"])
def test_a_run_without_local_control_can_be_interrupted_while_it_collects(tmp_path, name):
    saved, steps = [], count(1)

    def halfway(iteration, costs):
        if next(steps) % 6 == 3:  # of the six steps of an episode
            saved.append((iteration, whole.state()))
        return costs

    whole = Run(tmp_path, name, costs=halfway)
    whole.iterate(1, 3)
    assert [iteration for iteration, _ in saved] == [1, 2, 3]
    for iteration, state in saved:
        goes_on(Run(tmp_path, name).restore(state), iteration, whole)


@pytest.mark.parametrize("name", ["solar", "vae", "rce", "lqr-flm"])
def test_a_run_interrupted_between_iterations_ends_with_the_same_bits(tmp_path, name):
    whole = Run(tmp_path / "whole", name, *FLOORS)
    parts = Run(tmp_path / "parts", name, *FLOORS).iterate(1, 1)
    whole.iterate(1, 3)
    for iteration in (2, 3):
        state = parts.state()
        parts = Run(tmp_path / "parts", name, *FLOORS).restore(state).iterate(iteration, iteration)
        assert repr(parts.metrics[0]) == repr(whole.metrics[iteration - 1])
    assert parts.bits() == whole.bits()


def test_an_iteration_that_is_repeated_gives_the_same_bits(tmp_path):
    """A checkpoint before the iteration is taken up, though its episodes are on disk already."""
    once = Run(tmp_path, "solar", *FINE_TUNING).iterate(1, 1)
    state = once.state()
    once.iterate(2, 2)
    again = Run(tmp_path, "solar", *FINE_TUNING).restore(state).iterate(2, 2)
    assert again.bits() == once.bits()


@pytest.mark.parametrize("name", ["solar", "vae", "rce", "lqr-flm"])
def test_a_cell_has_its_bits(tmp_path, name):
    runs = [Run(tmp_path / str(i), name, seed=i // 2).iterate(1, 2) for i in range(3)]
    assert runs[0].bits() == runs[1].bits()
    assert repr(runs[0].metrics) == repr(runs[1].metrics)
    assert runs[2].bits() != runs[0].bits()


@pytest.mark.parametrize("iteration", [1, 2])
def test_episodes_lost_inside_an_iteration_come_back_or_are_missed(tmp_path, iteration):
    """What a half-trained encoder would collect is not what its iteration has collected."""
    saved = []
    whole = Run(
        tmp_path,
        "solar",
        *FINE_TUNING,
        pulse=lambda *_: saved.append((whole.environment.iteration, whole.state())),
    )
    whole.iterate(1, 2)
    state = next(state for number, state in saved if number == iteration)
    (tmp_path / f"{iteration:04d}-0.npz").unlink()
    resumed = Run(tmp_path, "solar", *FINE_TUNING).restore(state)
    try:
        found = resumed.iterate(iteration, 2).bits()
    except (SolarError, OSError) as error:
        found = str(error)
    assert found == whole.bits() or f"{iteration:04d}-0.npz" in found
