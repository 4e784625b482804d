"""One episode of a task before anything is learned."""

from __future__ import annotations

from solar_cli.control.exploration import Exploration
from solar_cli.envs import build_task
from solar_cli.episodes import Episodes, roll_out
from solar_cli.settings import TaskSettings
from solar_cli.streams import Streams


def first_episode(settings: TaskSettings) -> Episodes:
    """One episode of the card's exploration noise, the same each time."""
    streams = Streams(0).under("preview")
    resets, noise = [streams.generator("reset")], streams.generator("noise")
    task, policy = build_task(settings), Exploration(settings)
    return roll_out(task, settings, policy, resets, noise).episodes
