"""Models are tested as a worker runs them: one thread, deterministic algorithms."""

import pytest


@pytest.fixture(autouse=True)
def as_in_a_worker(worker_torch: None) -> None:
    """For every test here."""
