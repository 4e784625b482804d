"""The fake method, registered as any other package's would be; cells and attempts of it."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from solar_cli.settings import Cell, cells, load_card, registry
from solar_cli.store.store import Store

HERE = Path(__file__).parent


@pytest.fixture(scope="module", autouse=True)
def fake_package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Installs the fake method, for workers too."""
    torch.set_num_threads(1)  # as in a worker
    site = tmp_path_factory.mktemp("site")
    metadata = site / "fake_method-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: fake-method\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text("[solar.methods]\nfake = fake_method:ENTRY\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        patch.syspath_prepend(str(site))
        patch.setenv("PYTHONPATH", f"{site}:{HERE}", prepend=":")
        registry._known.cache_clear()
        yield
    registry._known.cache_clear()


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """Ctrl-C is heard, though a shell that starts the tests in the background has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(str(tmp_path / "solar.db")) as store:
        yield store


MakeCells = Callable[..., list[Cell]]


@pytest.fixture
def make_cells() -> MakeCells:
    """Cells of nav's smoke variant; keywords are settings of the fake method."""

    def make(seeds: int = 1, method: str = "fake", **settings: Any) -> list[Cell]:
        sets = [
            f"methods.{method}.{name}={f'{value!r}' if isinstance(value, str) else value}"
            for name, value in settings.items()
        ]
        return cells(load_card("nav"), method, range(seeds), "smoke", sets)

    return make
