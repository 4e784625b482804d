"""What an environment has collected."""

from solar_cli.episodes import Episodes
from solar_cli.experience import Environment


def collected_in(iteration: int, environment: Environment) -> Episodes:
    """All episodes of one iteration, in order."""
    names = [name for name in environment.batches() if name.iteration == iteration]
    return Episodes.joined([environment.batch(name) for name in names])
