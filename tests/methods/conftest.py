"""Methods are tested as a worker runs them, with pulses that fit into a test."""

from pathlib import Path

import pytest

from solar_cli.models import neural_fit, training


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A dozen steps of training bring nothing to life."""
    here = Path(__file__).parent
    for item in items:
        if item.path.parent == here:
            item.add_marker(pytest.mark.filterwarnings("ignore:no representation of"))


@pytest.fixture(autouse=True)
def as_in_a_worker(worker_torch: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """For every test here, with short steps."""
    monkeypatch.setattr(training, "PULSE_STEPS", 4)
    monkeypatch.setattr(neural_fit, "JUDGED_STEPS", 4)
