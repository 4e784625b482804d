"""The hash names what can change a stored number, and nothing else."""

import json
from pathlib import Path

import pytest

from solar_cli.settings import Cell, Configuration, cells, load_card, resolve, restore
from solar_cli.settings.schema import Settings, hashed_values, setting

STORED = json.loads((Path(__file__).parent / "stored_cell.json").read_text())
"""A cell as the first release wrote it: its identity, configuration and hash. Never regenerated:
a setting that comes later declares what older runs had in effect (``added``)."""


def solar(*sets: str, seed: int = 0, variant: str = "default") -> Cell:
    return cells(load_card("nav"), "solar", [seed], variant, sets, label="x" if sets else None)[0]


def test_a_stored_old_configuration_keeps_its_hash() -> None:
    names = (STORED["task"], STORED["method"], STORED["variant"], STORED["seed"])
    assert restore(*names, STORED["configuration"]).hash == STORED["hash"]


def test_a_restored_cell_equals_the_stored_one() -> None:
    cell = solar(seed=7, variant="smoke")
    text = json.dumps(cell.config())
    again = restore(cell.task, cell.method, cell.variant, cell.seed, json.loads(text))
    assert again.hash == cell.hash
    assert again.config() == cell.config()


class Before(Settings):
    """A method's settings in the first release."""

    rate: float = setting(0.5, "step size")


class Later(Settings):
    """The same settings after one was added, whose old behaviour was ``momentum = 0``."""

    rate: float = setting(0.5, "step size")
    momentum: float = setting(0.9, "came later", added=0.0)


def test_an_added_setting_with_the_old_behaviour_does_not_change_the_hash() -> None:
    assert hashed_values(Later(momentum=0.0)) == hashed_values(Before())


def test_an_added_setting_with_another_behaviour_changes_the_hash() -> None:
    assert hashed_values(Later()) != hashed_values(Before())


@pytest.mark.parametrize(
    "change",
    [
        'evaluation.headline="return"',
        'evaluation.better="higher"',
        'evaluation.unit="m"',
        "evaluation.levels=[1.0]",
        "evaluation.milestones=[100, 240]",
        "methods.solar.budget.desk=7",
        "methods.solar.budget.full=70000",
    ],
)
def test_what_only_shapes_a_report_or_the_stopping_point_is_not_hashed(change: str) -> None:
    plain = cells(load_card("nav"), "solar", [0], label="x")[0]
    assert solar(change).hash == plain.hash


@pytest.mark.parametrize(
    "change",
    [
        "task.horizon=49",
        "task.parameters.goal=[1.0, 0.0]",
        "task.observation.window=2",
        "evaluation.episodes=99",
        "methods.solar.training.steps=1999",
        "methods.solar.update.linearise=false",
        "methods.solar.local_fit.widths=[2.0]",
        "methods.solar.whitening=false",
    ],
)
def test_what_can_change_a_number_is_hashed(change: str) -> None:
    plain = cells(load_card("nav"), "solar", [0], label="x")[0]
    assert solar(change).hash != plain.hash


def test_task_method_variant_and_seed_are_hashed() -> None:
    configuration = resolve(load_card("nav"), "solar").configuration
    named = [
        Cell(*names, configuration)
        for names in [
            ("nav", "solar", "default", 0),
            ("nav", "solar", "default", 1),
            ("nav", "solar", "other", 0),
            ("nav", "vae", "default", 0),
            ("nav-2", "solar", "default", 0),
        ]
    ]
    assert len({cell.hash for cell in named}) == len(named)


def test_a_hash_is_the_same_for_the_same_values_given_in_another_way() -> None:
    assert solar("task.horizon=50").hash == cells(load_card("nav"), "solar", [0], label="x")[0].hash
    assert solar("task.action.bound=1").hash == solar("task.action.bound=1.0").hash


def test_every_setting_is_hashed_or_declared_not_to_matter() -> None:
    """Walks all settings of a cell: changing any one changes the hash, unless it is declared."""
    configuration = resolve(load_card("nav"), "solar").configuration
    for part in (configuration.task, configuration.evaluation, configuration.method):
        hashed = hashed_values(part)
        for name, field in type(part).model_fields.items():
            extra = field.json_schema_extra
            assert isinstance(extra, dict)
            as_ever = "added" in extra and getattr(part, name) == extra["added"]
            assert (name in hashed) == (not extra["presentation"] and not as_ever)


def test_configurations_cannot_be_changed_after_they_are_made() -> None:
    configuration: Configuration = resolve(load_card("nav"), "solar").configuration
    with pytest.raises(ValueError, match="frozen"):
        configuration.task.horizon = 3  # type: ignore[misc]
