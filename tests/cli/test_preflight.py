"""What a run would fail on is refused before it starts, by a dry run as well."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from scenario import Done, Solar, Stored

RUN = ("run", "--task", "nav", "--method", "solar", "--variant", "smoke", "--seeds", "7:8")


@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ("task.parameters.gaol=[0.0, 0.0]", ["'gaol'", "did you mean 'goal'"]),
        ('evaluation.headline="final_distanc"', ["headline", "did you mean 'final_distance'"]),
    ],
)
def test_a_task_that_does_not_hold_is_refused(
    solar: Solar, stored: Stored, dry: tuple[str, ...], change: str, parts: list[str]
) -> None:
    before = stored.db.read_bytes()
    solar(*RUN, "--set", change, *dry, "--db", stored.db).refused(*parts)
    assert stored.db.read_bytes() == before


@pytest.mark.parametrize("dry", [(), ("--dry-run",)])
@pytest.mark.parametrize(
    ("change", "largest"),
    [
        ("methods.solar.representation.latent=100000", "methods.solar.representation.latent"),
        ("task.horizon=1000000", "task.horizon"),
        ("evaluation.episodes=1000000", "evaluation.episodes"),
        ("methods.solar.batches.initial=1000000", "methods.solar.batches"),
        ("methods.solar.training.segments=10000000", "methods.solar.training.segments"),
    ],
)
def test_what_cannot_fit_into_the_machine_is_refused_before_it_starts(
    solar: Solar,
    stored: Stored,
    monkeypatch: pytest.MonkeyPatch,
    dry: tuple[str, ...],
    change: str,
    largest: str,
) -> None:
    monkeypatch.setattr("solar_cli.experiment.provenance.memory_bytes", lambda field: 10 * 2**30)
    before = stored.db.read_bytes()
    done = solar(*RUN, "--set", change, *dry, "--db", stored.db)
    done.refused("nav/solar: takes at least", "this machine has 10.0 GiB", "lower", largest)
    assert stored.db.read_bytes() == before


@pytest.mark.parametrize("headline", ["return", "final_distance", "mean_distance"])
def test_every_measure_can_be_the_headline(solar: Solar, stored: Stored, headline: str) -> None:
    change = f'evaluation.headline="{headline}"'
    assert solar(*RUN, "--set", change, "--dry-run", "--db", stored.db).code == 0


def test_layers_that_do_not_fit_are_refused_before_a_cell_is_registered(
    solar: Solar, stored: Stored
) -> None:
    before = stored.db.read_bytes()
    layers = 'methods.solar.representation.encoder=[{kind="unshuffle", factor=7}]'
    solar(*RUN, "--set", layers, "--db", stored.db).refused("nav/solar", "7")
    assert stored.db.read_bytes() == before


def test_a_label_names_one_configuration(solar: Solar, stored: Stored, tmp_path: Path) -> None:
    from solar_cli.settings import cells, load_card
    from solar_cli.store.store import Store

    change, other = "task.horizon=9", "task.horizon=8"
    with Store.open(str(stored.db)) as store:
        store.add(cells(load_card("nav"), "solar", [7], "smoke", [change], "mine"))
    labelled = (*RUN, "--label", "mine", "--dry-run", "--db", stored.db)
    solar(*labelled, "--set", other).refused("--label 'mine'", "another label", "solar rm")
    assert solar(*labelled, "--set", change).code == 0
    seed = ("--seeds", "8:9")
    assert solar(*labelled, *seed, "--set", other).code == 0


REACHER = ("run", "--task", "reacher", "--method", "solar", "--variant", "smoke", "--seeds", "1")


@pytest.mark.parametrize(
    "lack",
    [
        {"MUJOCO_GL": "none-such"},
        # EGL without a driver, as where libgl1-mesa-dri is missing.
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/none/such.json"},
        {"MUJOCO_GL": "glfw", "DISPLAY": ""},
    ],
    ids=lambda lack: next(iter(lack)),
)
def test_a_machine_that_cannot_draw_is_told_what_to_install(
    stored: Stored, lack: dict[str, str]
) -> None:
    before = stored.db.read_bytes()
    program = "import sys; from solar_cli.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", program, *REACHER, "--db", str(stored.db)],
        capture_output=True,
        text=True,
        env=os.environ | lack,
    )
    shown = Done(done.returncode, done.stdout, done.stderr)
    shown.refused("MuJoCo cannot draw here", "libegl1", "libgl1-mesa-dri", "libosmesa6")
    assert stored.db.read_bytes() == before


def test_a_package_that_is_missing_is_named(
    solar: Solar, stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    solar(*REACHER, "--dry-run", "--db", stored.db).refused("pip install mujoco")
    done = solar("doctor")
    assert (done.code, "pip install mujoco" in done.out) == (0, True)
