"""What tests of several folders need."""

from collections.abc import Iterator

import pytest


@pytest.fixture
def worker_torch() -> Iterator[None]:
    """Torch as a worker has it: one thread, deterministic algorithms."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(threads)
