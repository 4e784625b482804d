"""Rules of evidence 1: a policy comes from collected costs and frames, and from nothing else."""

import pytest
from bits import digest
from method_runs import Run

from solar_cli.envs import build_task
from solar_cli.episodes import evaluate
from solar_cli.settings.registry import BUILT_IN
from solar_cli.streams import Streams


class Blind:
    """A task without a judge."""

    def __init__(self, task):
        self._task = task

    def __getattr__(self, name):
        return getattr(self._task, name)

    def measures(self):
        raise RuntimeError("not for learners")

    def truth(self):
        raise RuntimeError("not for learners")


FINE_TUNED = "training.fine_tune_steps=4"
SMOOTHER = 'dynamics={ posterior = "smoother", hidden = 2 }'


@pytest.mark.parametrize(
    ("name", "sets"),
    [
        ("solar", [FINE_TUNED]),
        ("solar", [SMOOTHER]),
        ("vae", [FINE_TUNED]),
        ("rce", [FINE_TUNED]),
        ("lqr-flm", []),
        ("global-mpc", [FINE_TUNED]),
        ("global-mpc", [SMOOTHER]),
        ("mpc-nn", []),
        ("pixel-mpc", []),
    ],
)
def test_evaluating_never_once_or_ten_times_gives_the_same_policies(tmp_path, name, sets):
    found = set()
    for times in (0, 1, 10):
        run = Run(tmp_path / str(times), name, *sets)
        task = run.configuration.task
        for iteration in (1, 2):
            run.iterate(iteration, iteration)
            for number in range(times):
                streams = Streams(0).under("evaluation", iteration, number)
                evaluation = evaluate(build_task(task), task, run.learner.policy, 3, streams)
                run.learner.diagnose(evaluation)
                run.learner.encode(evaluation.episodes)
                run.learner.reconstruct(evaluation.episodes)
        found.add((run.bits(), repr(run.metrics)))
    assert len(found) == 1


@pytest.mark.filterwarnings("ignore:ground truth is missing")
@pytest.mark.parametrize("name", [entry.name for entry in BUILT_IN])
def test_measures_are_out_of_a_learners_reach(tmp_path, name):
    seeing = Run(tmp_path / "seeing", name).iterate(1, 2)
    blind = Run(tmp_path / "blind", name, wrap=Blind).iterate(1, 2)
    assert repr(blind.metrics) == repr(seeing.metrics)
    assert digest(blind.state()["learner"]) == digest(seeing.state()["learner"])
