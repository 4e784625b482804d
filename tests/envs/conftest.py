import pytest


@pytest.fixture(params=["pybullet", "mujoco"])
def engine(request):
    """Name of a physics engine of the task ``sawyer``."""
    return request.param
