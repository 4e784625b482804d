"""Our tasks as vector environments of Stable-Baselines3, many episodes in one process."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from solar_cli.envs.front_ends import BatchedEnv

Array = NDArray[Any]


class BatchedVecEnv(VecEnv):
    """A `BatchedEnv` for Stable-Baselines3: equals its ``DummyVecEnv`` of the singles, bit for bit.

    Every row is truncated at the horizon; its info then has ``terminal_observation``.
    """

    def __init__(self, card: str, num_envs: int, render_mode: str | None = "rgb_array") -> None:
        self.batched = BatchedEnv(card, num_envs, render_mode=render_mode)
        self._actions: Array = np.empty(0)
        super().__init__(
            num_envs, self.batched.single_observation_space, self.batched.single_action_space
        )

    def reset(self) -> Array:
        """Start all episodes, with the seeds that ``seed`` has set."""
        observations, info = self.batched.reset(seed=self._seeds)
        self.reset_infos = _rows(info, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: Array) -> None:
        """The actions (N, a) of the next step."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Observations, rewards, which rows are truncated, infos; truncated rows start anew."""
        observations, rewards, _, truncated, info = self.batched.step(self._actions)
        final = info.pop("final_info", {})
        finals = info.pop("final_obs", None)
        infos = _rows(info, self.num_envs)
        for row in range(self.num_envs):
            infos[row]["TimeLimit.truncated"] = bool(truncated[row])
        for row in np.flatnonzero(truncated).tolist():
            assert finals is not None
            infos[row] |= {name: float(final[name][row]) for name in final if name[0] != "_"}
            infos[row]["terminal_observation"] = finals[row]
            self.reset_infos[row] = {name: float(info[name][row]) for name in _names(info)}
        return observations, rewards.astype(np.float32), truncated, infos

    def close(self) -> None:
        """Nothing is left open."""
        self.batched.close()

    def get_images(self) -> Sequence[Array | None]:
        """The states as RGB pictures, one a row."""
        return list(self.batched.render())

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, for each row that is asked for."""
        return [getattr(self.batched, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Rows have no attributes of their own."""
        raise NotImplementedError("rows share everything: set nothing on one of them")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Rows have no methods of their own."""
        raise NotImplementedError("rows share everything: call nothing on one of them")

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """None is."""
        return [False for _ in self._get_indices(indices)]


def _names(info: dict[str, Any]) -> Iterable[str]:
    return [name for name in info if not name.startswith("_")]


def _rows(info: dict[str, Any], rows: int) -> list[dict[str, Any]]:
    """One dict a row, of Gymnasium's arrays and their masks."""
    columns = [(name, info[name].tolist()) for name in _names(info)]
    return [{name: column[row] for name, column in columns} for row in range(rows)]
