"""What the README tells a reader to type works as it stands."""

import json
import re
from pathlib import Path

import pytest
from scenario import Solar, Stored

TEXT = (Path(__file__).parent.parent.parent / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def test_the_card_is_a_card(solar: Solar, tmp_path: Path) -> None:
    [card] = [block for block in blocks("toml") if "[task]" in block]
    [name] = re.findall(r"here `tasks/(.+?)\.toml`", TEXT)
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / f"{name}.toml").write_text(card)
    lines = {line["path"]: line for line in json.loads(solar("tasks", name, "--json").out)}
    assert lines["task.parameters"]["value"] == {"goal": [-1.0, 0.0]}
    done = solar("run", "--task", name, "--method", "solar", "--dry-run", "--json")
    [cell] = json.loads(done.out)
    assert (cell["task"], cell["action"], cell["target"]) == (name, "run", 240)


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
