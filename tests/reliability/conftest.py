"""Matrices to disturb, and what they have to end with."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from disturbed import PATIENCE, Matrix, Undisturbed

from solar_cli.store.store import Store


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Many processes, each of which imports torch: minutes alone, more beside other work."""
    here = Path(__file__).parent
    for item in items:
        if item.path.parent == here:
            item.add_marker(pytest.mark.timeout(4 * PATIENCE))


@pytest.fixture
def matrix(tmp_path: Path) -> Iterator[Callable[..., Matrix]]:
    made: list[Matrix] = []

    def make(seeds: int, task: str = "nav", method: str = "solar") -> Matrix:
        made.append(Matrix(tmp_path / str(len(made)), seeds, task, method))
        made[-1].folder.mkdir()
        return made[-1]

    yield make
    for scheduler in [s for one in made for s in one.schedulers]:
        scheduler.kill()
        scheduler.wait()


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    quiet = Matrix(tmp_path_factory.mktemp("undisturbed"), seeds=2)
    assert all(result["finished"] for result in quiet.finish())
    with Store.open(quiet.db) as store:
        seconds = max(record.seconds for record in store.cells())
    return Undisturbed(quiet.fingerprints(), seconds)
