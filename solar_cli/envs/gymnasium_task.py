"""Any Gymnasium environment as a task: a card says which one, what is seen of it, what it costs.

Actions are scaled from [-bound, bound] onto the environment's box, entry by entry. A state is the
flattened observation; an image is what the environment renders, at the card's size. An episode that
terminates ends early; one that is truncated before the card's horizon does, too.
"""

from __future__ import annotations

import atexit
import os
import weakref
from difflib import get_close_matches
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solar_cli.envs import offscreen
from solar_cli.envs.gymnasium_card import Entries, Gauge, Parameters, SquaredCost
from solar_cli.envs.rasteriser import enlarge, shrink
from solar_cli.envs.task import Floats, Frames, LoopTask, StateCost
from solar_cli.errors import SolarError, UsageError, nearest
from solar_cli.settings import Observation, TaskSettings
from solar_cli.settings.card import validated

LUMA = (0.299, 0.587, 0.114)
"""grey of red, green and blue (ITU-R BT.601)"""


class Camera:
    """What environments render, at the card's size.

    MuJoCo's environments share one renderer: each has 90 MB of its own otherwise. It looks at where
    the bodies were when it was made, so the first to render is always the same one.
    """

    def __init__(self, seen: Observation) -> None:
        self.rendered = (0, 0)
        """rows and columns that an environment rendered last"""
        self._seen = seen
        self._renderer: Any = None

    def frame(self, env: Any) -> Frames:
        """What ``env`` shows now, (C, H, W) uint8."""
        drawn = self._lent(env) if hasattr(env.unwrapped, "mujoco_renderer") else env.render()
        if not isinstance(drawn, np.ndarray) or drawn.shape[2:] != (3,):
            raise TypeError(f"it renders {type(drawn).__name__}, not an array (rows, columns, 3)")
        self.rendered = drawn.shape[:2]
        planes = np.moveaxis(drawn.astype(np.float64), -1, 0)
        if self._seen.channels == 1:
            planes = np.tensordot(LUMA, planes, axes=1)[None]
        return np.rint(shrink(planes, self._seen.height, self._seen.width)).astype(np.uint8)

    def _lent(self, env: Any) -> Any:
        """What ``env`` renders with the renderer that all share."""
        for name, value in offscreen.DEFAULTS.items():
            os.environ.setdefault(name, value)
        base = env.unwrapped
        renderer = self._renderer = self._renderer or base.mujoco_renderer
        base.mujoco_renderer = renderer
        renderer.model, renderer.data = base.model, base.data
        if viewer := renderer.viewer:
            viewer.model, viewer.data = base.model, base.data
            viewer.make_context_current()  # another task may have drawn meanwhile
        try:
            drawn = env.render()
        except Exception as error:  # a graphics library that is not there shows in many ways
            raise offscreen.cannot_draw(error) from error
        if not viewer:
            end = weakref.finalize(self, _free, renderer.viewer)
            end.atexit = (
                False  # that would be after MuJoCo has ended EGL; handlers run last in first
            )
            atexit.register(end)
        return drawn


def _free(viewer: Any) -> None:
    """Free what a viewer holds within its own context; anywhere else that of another would go."""
    viewer.make_context_current()
    viewer.con.free()
    viewer.free()


class EnvironmentFails(SolarError):
    """The environment's own code raised an error, or gave what is no observation."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: an error of the environment's own code, which the log shows")
        self.what = what
        """which environment, where, and why"""


class GymnasiumEpisode:
    """A `Simulation`: one environment, used again for one episode after another."""

    def __init__(self, parameters: Parameters, settings: TaskSettings, camera: Camera) -> None:
        self.truth_names = parameters.names
        self._parameters = parameters
        self._horizon = settings.horizon
        self._camera = camera if settings.observation.kind == "image" else None
        self._env = _make(parameters, settings)
        self._scale_by(self._env.action_space, settings)
        entries = self._entries(self._env.observation_space, settings)
        self._gauges = {
            name: Gauge(name, measure, entries) for name, measure in parameters.measures.items()
        }
        self._cost: SquaredCost | None = None
        if parameters.cost and entries:
            self._cost = SquaredCost(parameters.cost, entries, settings.action_cost)
        self._steps, self._ended, self._after = 0, False, 0.0
        self._info: dict[str, Any] = {}
        self._observed: Floats = np.empty(0)
        self._frame: Frames = np.empty(0)

    def reset(self, stream: np.random.Generator) -> Frames:
        """As `Simulation.reset`."""
        seed, options = int(stream.integers(2**31)), self._parameters.reset or None
        self._steps, self._ended = 0, False
        try:
            self._see(*self._env.reset(seed=seed, options=options))
        except Exception as error:
            raise self._failure("at a reset", error) from error
        return self._frame

    def step(self, action: Floats) -> tuple[Frames, float]:
        """As `Simulation.step`."""
        if self._ended:
            return self._frame, self._after
        before, scaled = self._observed, (self._centre + self._factor * action).astype(self._dtype)
        self._steps += 1
        try:
            observation, reward, terminated, truncated, info = self._env.step(
                np.clip(scaled, self._low, self._high).reshape(self._shape)
            )
            self._see(observation, info)
        except Exception as error:
            raise self._failure(f"in step {self._steps} of an episode", error) from error
        self._ended = bool(terminated or (truncated and self._steps < self._horizon))
        if self._cost is None:
            self._after, cost = 0.0, -float(reward)
        else:
            self._after = float(self._cost(self._observed, 0 * action))
            cost = float(self._cost(before, action))
        if self._parameters.ended_cost is not None:
            self._after = self._parameters.ended_cost
        return self._frame, cost

    def ended(self) -> bool:
        """As `Simulation.ended`."""
        return self._ended

    def measures(self) -> dict[str, float]:
        """Those of the card, and ``alive``: 1, or 0 from an early end on."""
        given = {name: gauge(self._observed, self._info) for name, gauge in self._gauges.items()}
        return {**given, "alive": float(not self._ended)}

    def truth(self) -> Floats:
        """The observation's entries, where the card names them."""
        return self._observed[: len(self.truth_names)].copy()

    def check_info(self) -> None:
        """Raise `UsageError` where a step does not tell what the card measures."""
        for name, gauge in self._gauges.items():
            if gauge.info is not None and gauge.info not in self._info:
                raise UsageError(
                    f"task.parameters.measures.{name}: a step of {self._parameters.id} tells no "
                    f"{gauge.info!r}: {nearest(gauge.info, self._info)}"
                )

    def _see(self, observation: Any, info: dict[str, Any]) -> None:
        self._info = info
        if self._camera is None or self._parameters.reads_entries:
            observed = np.array(observation, np.float64).ravel()
            if len(self._observed) not in (0, len(observed)):
                raise ValueError(f"{len(observed)} numbers observed, {len(self._observed)} before")
            self._observed = observed
        if self._camera is None:
            self._frame = self._observed.astype(np.float32)
        else:
            self._frame = self._camera.frame(self._env)

    def _failure(self, where: str, error: Exception) -> SolarError:
        if isinstance(error, SolarError):
            return error
        return EnvironmentFails(f"{self._parameters.id} fails {where} ({cause(error)})")

    def _scale_by(self, space: Any, settings: TaskSettings) -> None:
        """Take over the box of actions. Raises `UsageError` for what is none."""
        from gymnasium import spaces

        name = self._parameters.id
        if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
            raise UsageError(
                f"task.parameters.id: the actions of {name} are {space}: only a Box of real "
                "numbers can be controlled; choose another"
            )
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise UsageError(
                f"task.parameters.id: the actions of {name} are {space}, without bounds to scale "
                "to; choose another"
            )
        if settings.action.size != space.low.size:
            raise UsageError(
                f"task.action: the actions of {name} are {space}: set size = {space.low.size}"
            )
        self._shape, self._dtype = space.shape, space.dtype
        self._low, self._high = space.low.ravel(), space.high.ravel()
        low, high = self._low.astype(np.float64), self._high.astype(np.float64)
        self._centre, self._factor = (low + high) / 2, (high - low) / 2 / settings.action.bound

    def _entries(self, space: Any, settings: TaskSettings) -> Entries | None:
        """How the card refers to observations; None where it need not."""
        from gymnasium import spaces

        if self._camera is not None and not self._parameters.reads_entries:
            return None
        if not isinstance(space, spaces.Box):
            raise UsageError(
                f"task.parameters.id: an observation of {self._parameters.id} is {space}: only a "
                "Box can be read; choose another, or learn from images and from its reward alone"
            )
        size = int(np.prod(space.shape))
        if self._camera is None and settings.observation.width != size:
            raise UsageError(
                f"task.observation: an observation of {self._parameters.id} is {space}: set "
                f"width = {size}"
            )
        return Entries(self._parameters, size)


def build(settings: TaskSettings) -> LoopTask:
    """The task of a card with ``simulator = "gymnasium"``.

    Its parameters are those of `Parameters`. Raises `UsageError` naming the key that does not fit,
    or what is missing here.
    """
    where = f"simulator {settings.simulator!r}"
    parameters = validated(Parameters, settings.parameters, where, "task.parameters")
    seen, camera = settings.observation, Camera(settings.observation)
    if seen.kind == "image" and seen.channels not in (1, 3):
        raise UsageError(
            f"task.observation.channels = {seen.channels}: what an environment renders has 3, or, "
            "turned grey, 1"
        )
    if seen.window > settings.horizon:
        raise UsageError(
            f"task.observation.window = {seen.window}: longer than an episode of task.horizon = "
            f"{settings.horizon} steps; change one"
        )
    _require_a_start(GymnasiumEpisode(parameters, settings, camera), settings)
    return LoopTask(lambda: GymnasiumEpisode(parameters, settings, camera), settings)


def state_cost(settings: TaskSettings) -> StateCost:
    """As `StateCost`, of the card's squares. Raises `UsageError` where the reward is it."""
    where = f"simulator {settings.simulator!r}"
    parameters = validated(Parameters, settings.parameters, where, "task.parameters")
    if parameters.cost is None:
        raise UsageError(
            "task.parameters.cost: a reward is known of collected steps only; give squares of "
            "entries, cost = { ENTRY = { weight = 1.0 } }"
        )
    entries = Entries(parameters, settings.observation.width)
    return SquaredCost(parameters.cost, entries, settings.action_cost)


def drawable(settings: TaskSettings, rows: int) -> TaskSettings:
    """The same task seen as the environment renders it, ``rows`` high and in its proportions.

    Raises `UsageError` for an environment that renders nothing here.
    """
    where = f"simulator {settings.simulator!r}"
    parameters = validated(Parameters, settings.parameters, where, "task.parameters")
    seen = Observation(kind="image", height=rows, width=rows, channels=3)
    shown, camera = settings.model_copy(update={"observation": seen}), Camera(seen)
    _require_a_start(GymnasiumEpisode(parameters, shown, camera), shown)
    high, wide = camera.rendered
    seen = seen.model_copy(update={"width": round(rows * wide / high)})
    return settings.model_copy(update={"observation": seen})


def _require_a_start(episode: GymnasiumEpisode, settings: TaskSettings) -> None:
    """Raise `UsageError` where an environment fails from the start, as for want of a package."""
    try:
        episode.reset(np.random.default_rng(0))
        episode.step(np.zeros(settings.action.size))
    except EnvironmentFails as error:
        raise UsageError(
            f"task.parameters: {error.what}: install what is missing, or correct 'make' or 'reset'"
        ) from error
    episode.check_info()


def _make(parameters: Parameters, settings: TaskSettings) -> Any:
    import gymnasium

    if parameters.package is not None:
        try:
            import_module(parameters.package)
        except Exception as error:
            raise UsageError(
                f"task.parameters.import: the package {parameters.package!r} cannot be imported "
                f"here ({cause(error)}): install it"
            ) from error
    name, image = parameters.id, settings.observation.kind == "image"
    if name not in gymnasium.registry:
        close = get_close_matches(name, gymnasium.registry, n=1)
        hint = (
            f"did you mean {close[0]!r}?" if close else "which package has it? import = 'PACKAGE'"
        )
        raise UsageError(f"task.parameters.id: Gymnasium knows no {name!r}: {hint}")
    if "mujoco" in str(gymnasium.registry[name].entry_point):
        # Before the environment does, and to draw where possible: other tasks, or this one later.
        offscreen.load_mujoco(to_draw=image)
    try:
        env = gymnasium.make(
            name,
            max_episode_steps=settings.horizon,
            disable_env_checker=True,
            **({"render_mode": "rgb_array"} if image else {}),
            **parameters.make,
        )
    except Exception as error:
        raise UsageError(
            f"task.parameters: Gymnasium cannot make {name!r} here ({cause(error)}): install what "
            "is missing, or correct 'make'"
        ) from error
    if image and "rgb_array" not in (modes := env.metadata.get("render_modes", [])):
        raise UsageError(
            f"task.observation.kind: {name} renders no images, its render modes are {modes}: only "
            "its state can be seen, kind = 'state'"
        )
    return env


def cause(error: Exception) -> str:
    """An error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def picture(frames: Frames, factor: int) -> Floats:
    """Frames (..., C, H, W) for people, (..., H factor, W factor, 3), in their own colours."""
    planes = np.clip(enlarge(frames / 255.0, factor), 0.0, 1.0)
    shape = (*planes.shape[:-3], 3, *planes.shape[-2:])
    colours: NDArray[np.float64] = np.moveaxis(np.broadcast_to(planes, shape), -3, -1)
    return colours
