"""Settings of the reference policies: there is nothing to learn."""

from __future__ import annotations

from solar_cli.settings.local import Budget
from solar_cli.settings.schema import Settings, setting


class Reference(Settings):
    """A policy that never changes."""

    episodes: int = setting(20, "episodes an iteration collects", ge=1)
    budget: Budget = setting(Budget(desk=20, full=20), "where to stop", presentation=True)
