"""What the README tells a reader to type works as it stands."""

import json
import re
from pathlib import Path

import pytest
from scenario import Solar, Stored

from solar_cli.settings.registry import BUILT_IN

TEXT = (Path(__file__).parent.parent.parent / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


CARDS = dict(
    zip(
        re.findall(r"here\s`tasks/(.+?)\.toml`", TEXT),
        [block for block in blocks("toml") if "[task]" in block],
        strict=True,
    )
)


@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [("nav-left", "goal", [-1.0, 0.0]), ("pole", "id", "InvertedPendulum-v5")],
)
def test_a_card_is_a_card(
    solar: Solar, tmp_path: Path, name: str, parameter: str, value: object
) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / f"{name}.toml").write_text(CARDS[name])
    lines = {line["path"]: line for line in json.loads(solar("tasks", name, "--json").out)}
    assert lines["task.parameters"]["value"][parameter] == value
    done = solar("run", "--task", name, "--method", "solar", "--dry-run", "--json")
    [cell] = json.loads(done.out)
    assert (cell["task"], cell["action"], cell["target"]) == (name, "run", 240)


def test_every_method_is_told_with_a_command(solar: Solar) -> None:
    section = TEXT.split("## Methods")[1].split("\n## ")[0]
    for entry in BUILT_IN:
        assert f"`{entry.name}`" in section
    commands = re.findall(r"`solar (run .+?)`", section)
    named = {word for command in commands for word in command.split()}
    assert {entry.name for entry in BUILT_IN} <= named
    for command in commands:
        cells = json.loads(solar(*command.split(), "--dry-run", "--json").out)
        assert {cell["action"] for cell in cells} == {"run"}


def test_every_parameter_of_a_gymnasium_task_is_told() -> None:
    from solar_cli.envs.gymnasium_card import Parameters

    section = TEXT.split("## Bring a Gymnasium task")[1].split("\n## ")[0]
    for name, field in Parameters.model_fields.items():
        assert f"`{field.alias or name}`" in section


def test_the_data_frame_has_the_columns_that_are_used(
    stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [snippet] = [block for block in blocks("python") if "solar_cli.load" in block]
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "solar.db").write_bytes(stored.db.read_bytes())
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(snippet, names)
    curve = names["curve"]
    assert curve.loc[("nav", "solar", "smoke", 0), "mean"] == pytest.approx(1.0)  # type: ignore[attr-defined]


def test_everything_it_points_at_is_there() -> None:
    root = Path(__file__).parent.parent.parent
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", TEXT)
    assert not {link for link in links if not (root / link).exists()}
