"""``solar tasks NAME --preview FILE.gif``: one episode, drawn before anything is learned."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image
from scenario import Solar

CARD = """
summary = "A state without a picture, or one that ends early."

[task]
simulator = "gymnasium"
horizon = 9
parameters = { id = "Preview/NAME-v0" }
observation = { kind = "state", width = 1 }
action = { size = 1, bound = 1.0 }
exploration = { std = 0.3 }

[methods.solar]
batches = { initial = 10, noisy = 10 }
budget = { desk = 20, full = 20 }
training = { length = 4 }

[methods.solar.representation]
latent = 1
head = "none"
encoder = [{ kind = "linear", width = 1, activation = "none" }]
decoder = []
"""


class Short(gymnasium.Env[Any, Any]):
    """Ends with its fourth step."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = spaces.Box(-1.0, 1.0, (1,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return np.zeros(1, np.float32), 0.0, self.steps == 4, False, {}

    def render(self) -> Any:
        return np.full((10, 20, 3), 50 * self.steps, np.uint8)


class Blind(Short):
    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012


@pytest.fixture
def cards(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """``short.toml`` and ``blind.toml`` in the present folder, and what they name."""
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    monkeypatch.setattr(gymnasium, "registry", gymnasium.envs.registration.registry)
    for kind in (Short, Blind):
        gymnasium.register(f"Preview/{kind.__name__}-v0", entry_point=kind)
        card = CARD.replace("NAME", kind.__name__)
        (tmp_path / f"{kind.__name__.lower()}.toml").write_text(card)


def test_a_preview_is_one_episode_as_a_gif(solar: Solar, tmp_path: Path) -> None:
    done = solar("tasks", "nav", "--variant", "smoke", "--preview", "nav.gif")
    assert done.code == 0, done
    assert done.out == (
        "nav: 10 steps of exploration noise; "
        "left: the 2 channels that a learner sees; right: for people\n"
    )
    with Image.open(tmp_path / "nav.gif") as gif:
        assert (gif.format, gif.n_frames) == ("GIF", 11)  # type: ignore[attr-defined]


def test_the_same_card_gives_the_same_preview_and_more_noise_another(
    solar: Solar, tmp_path: Path
) -> None:
    asked = ("tasks", "nav", "--variant", "smoke", "--preview")
    more = ("--set", "task.exploration.std=0.9")
    for name, given in (("one.gif", ()), ("two.gif", ()), ("far.gif", more)):
        assert solar(*asked, name, *given).code == 0
    one, two, far = ((tmp_path / f"{name}.gif").read_bytes() for name in ("one", "two", "far"))
    assert one == two
    assert one != far


def test_a_state_is_drawn_where_its_simulator_can(solar: Solar, tmp_path: Path) -> None:
    done = solar("tasks", "car-states", "--variant", "smoke", "--preview", "car.gif", "--json")
    told = json.loads(done.out)
    assert told == {
        "task": "car-states",
        "preview": "car.gif",
        "steps": 10,
        "caption": "for people: a learner sees 9 numbers",
    }
    assert (tmp_path / "car.gif").exists()


@pytest.mark.usefixtures("cards")
def test_a_card_by_path_is_drawn_up_to_where_its_episode_ends(solar: Solar, tmp_path: Path) -> None:
    done = solar("tasks", "./short.toml", "--preview", "short.gif")
    assert "./short.toml: 4 steps of exploration noise, which ended it before 9" in done.out
    with Image.open(tmp_path / "short.gif") as gif:
        assert (gif.n_frames, gif.size) == (5, (480, 240))  # type: ignore[attr-defined]


@pytest.mark.filterwarnings("ignore:.*render_mode")
@pytest.mark.usefixtures("cards")
def test_a_state_without_a_picture_is_refused_in_one_line(solar: Solar, tmp_path: Path) -> None:
    done = solar("tasks", "blind.toml", "--preview", "blind.gif")
    done.refused(
        "--preview", "nothing to draw of blind.toml", "can be learned", "renders no images"
    )
    assert not (tmp_path / "blind.gif").exists()
    wide = ("--set", "task.observation.width=3")
    done = solar("tasks", "blind.toml", "--preview", "blind.gif", *wide)
    done.refused("set width = 1")
    assert "nothing to draw" not in done.err


REFUSED = {
    "no GIF": (("nav", "--preview", "nav.png"), ["nav.png", "FILE.gif"]),
    "no folder": (("nav", "--preview", "no/nav.gif"), ["no/nav.gif", "folder no"]),
    "no task": (("--preview", "nav.gif"), ["nav.gif", "solar tasks NAME"]),
    "a file that is there": (("nav", "--preview", "there.gif"), ["there.gif", "--force"]),
    "unknown task": (("nva", "--preview", "nav.gif"), ["'nva'", "did you mean 'nav'"]),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_preview_refuses_bad_input(solar: Solar, tmp_path: Path, fault: str) -> None:
    (tmp_path / "there.gif").write_bytes(b"kept")
    arguments, parts = REFUSED[fault]
    solar("tasks", *arguments).refused(*parts)
    assert [path.name for path in tmp_path.iterdir()] == ["there.gif"]
    assert (tmp_path / "there.gif").read_bytes() == b"kept"


def test_a_preview_overwrites_when_it_is_told_to(solar: Solar, tmp_path: Path) -> None:
    (tmp_path / "there.gif").write_bytes(b"kept")
    asked = ("tasks", "nav", "--variant", "smoke", "--preview", "there.gif", "--force")
    assert solar(*asked).code == 0
    assert (tmp_path / "there.gif").read_bytes().startswith(b"GIF89a")
