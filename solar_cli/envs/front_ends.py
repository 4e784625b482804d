"""Our tasks as Gymnasium environments: importing this module registers the ``Solar/`` ids.

``gymnasium.make`` gives `SingleEnv`, ``gymnasium.make_vec`` gives `BatchedEnv`; with the same seed
the second equals a `gymnasium.vector.SyncVectorEnv` of the first, bit for bit. The reward is minus
the cost; episodes are truncated at the horizon and never terminate; ``info`` holds the measures of
the state that the observation shows, after ``reset`` too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from solar_cli.envs import build_task, picture
from solar_cli.envs.spaces import action_space, observation_space
from solar_cli.envs.task import Frames
from solar_cli.settings import TaskSettings, load_card
from solar_cli.settings.card import card_folders

Array = NDArray[Any]
Info = dict[str, Any]

IDS = {
    "Solar/Navigation-v0": "nav",
    "Solar/NavigationFixed-v0": "nav-fixed",
    "Solar/Car-v0": "car",
    "Solar/CarStates-v0": "car-states",
    "Solar/Reacher-v0": "reacher",
    "Solar/Sawyer-v0": "sawyer",
}
"""Gymnasium id -> card"""
METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}


def task_settings(card: str) -> TaskSettings:
    """The task of a card, by name or path.

    The program's own cards come before those in ``./tasks``, so that an id with a version means
    the same task in every folder.
    """
    own = card_folders()[-1] / f"{card}.toml"
    return load_card(str(own) if own.is_file() else card).task


class _Core:
    """What both front ends share: a task, its spaces and the windows of its newest frames."""

    def __init__(self, card: str) -> None:
        self.settings = task_settings(card)
        self.task = build_task(self.settings)
        seen = self.settings.observation
        self.observation_space = observation_space(self.settings)
        self.action_space = action_space(self.settings)
        self._windows: Array = np.empty((0, seen.window, *seen.frame_shape))

    def reset(self, streams: Sequence[np.random.Generator]) -> None:
        """Start all episodes; before the start the first frame repeats."""
        self._windows = self._first_windows(self.task.reset(streams))

    def restart(self, which: NDArray[np.intp], streams: Sequence[np.random.Generator]) -> None:
        """Start new episodes in the rows ``which``."""
        self._windows[which] = self._first_windows(self.task.restart(which, streams))

    def step(self, actions: Array) -> Array:
        """Execute actions (N, a); the rewards (N,)."""
        frames, costs = self.task.step(np.asarray(actions, np.float64))
        self._windows = np.concatenate([self._windows[:, 1:], frames[:, None]], axis=1)
        return -costs

    def observations(self) -> Array:
        """The windows stacked along the first axis of a frame, oldest first: (N, W C, H, W)."""
        return self._windows.reshape(-1, *self.observation_space.shape).copy()

    def pictures(self) -> NDArray[np.uint8]:
        """The newest frames for people, (N, rows, columns, 3)."""
        return picture(self.settings, self._windows[:, -1])

    def _first_windows(self, frames: Frames) -> Array:
        return np.repeat(frames[:, None], self.settings.observation.window, axis=1)


class SingleEnv(gymnasium.Env[Array, Array]):
    """One episode at a time. `gymnasium.make` adds the time limit, as for any environment."""

    metadata = METADATA

    def __init__(self, card: str, render_mode: str | None = None) -> None:
        self._core = _Core(card)
        self.observation_space = self._core.observation_space
        self.action_space = self._core.action_space
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, Info]:
        """Start an episode; without a seed the generator goes on."""
        super().reset(seed=seed, options=options)
        self._core.reset([self.np_random])
        return self._core.observations()[0], self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, Info]:
        """Execute one action (a,)."""
        reward = self._core.step(np.asarray(action)[None])
        return self._core.observations()[0], float(reward[0]), False, False, self._info()

    def render(self) -> Any:
        """The state as an RGB picture (rows, columns, 3)."""
        return self._core.pictures()[0]

    def _info(self) -> Info:
        return {name: float(value[0]) for name, value in self._core.task.measures().items()}


class BatchedEnv(VectorEnv[Array, Array, Array]):
    """Many episodes at once. A row that is truncated starts anew within the same step.

    Row i draws from its own generator, seeded with ``seed + i``, which goes on over its restarts.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        card: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._core = _Core(card)
        self._limit = max_episode_steps or self._core.settings.horizon
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = self._core.observation_space
        self.single_action_space = self._core.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._streams = [seeding.np_random()[0] for _ in range(num_envs)]
        self._elapsed = np.zeros(num_envs, np.int64)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, Info]:
        """Start all episodes, or those of ``options["reset_mask"]`` (N,).

        A seed is one number, for ``seed + i``, or a list of one a row.
        """
        mask = (options or {}).get("reset_mask")
        which = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        seeds = [seed + row for row in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None:
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for {self.num_envs} rows: give one a row")
            for row in which.tolist():
                if seeds[row] is not None:
                    self._streams[row] = seeding.np_random(seeds[row])[0]
        if mask is None:
            self._core.reset(self._streams)
        else:
            self._core.restart(which, [self._streams[row] for row in which])
        self._elapsed[which] = 0
        return self._core.observations(), self._info(which)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Execute actions (N, a); ``final_obs`` and ``final_info`` are those of truncated rows."""
        rewards = self._core.step(actions)
        self._elapsed += 1
        truncated = self._elapsed >= self._limit
        info: Info = {}
        if truncated.any():
            which = np.flatnonzero(truncated)
            final, last = np.full(self.num_envs, None, dtype=object), self._core.observations()
            for row in which:
                final[row] = last[row].copy()
            info = {"final_obs": final, "_final_obs": truncated.copy()}
            info |= {"final_info": self._info(which), "_final_info": truncated.copy()}
            self._core.restart(which, [self._streams[row] for row in which])
            self._elapsed[which] = 0
        info |= self._info(np.arange(self.num_envs))
        terminated = np.zeros(self.num_envs, np.bool_)
        return self._core.observations(), rewards, terminated, truncated, info

    def render(self) -> Any:
        """The states as a tuple of RGB pictures (rows, columns, 3)."""
        return tuple(self._core.pictures())

    def _info(self, which: NDArray[np.intp]) -> Info:
        """Measures of the rows ``which``, zero in the others, each with its mask, as Gymnasium."""
        mask = np.zeros(self.num_envs, np.bool_)
        mask[which] = True
        info: Info = {}
        for name, values in self._core.task.measures().items():
            info |= {name: np.where(mask, values, 0.0), f"_{name}": mask.copy()}
        return info


def _register() -> None:
    for name, card in IDS.items():
        gymnasium.register(
            name,
            entry_point=f"{__name__}:SingleEnv",
            vector_entry_point=f"{__name__}:BatchedEnv",
            max_episode_steps=task_settings(card).horizon,
            kwargs={"card": card},
        )


_register()
