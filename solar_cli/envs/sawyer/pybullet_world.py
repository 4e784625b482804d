"""The scene in PyBullet, which draws in software: no graphics library is needed."""

from __future__ import annotations

import tempfile
import weakref
from functools import cache
from typing import Any

import numpy as np
import pybullet
from numpy.typing import NDArray

from solar_cli.envs.sawyer import facts, urdf
from solar_cli.envs.sawyer.control import PERIOD, Floats, Pose

STEP = 0.005
"""seconds of a step of the physics"""
SUBSTEPS = round(PERIOD / STEP)
ITERATIONS = 80
"""of the contact solver; with half of them a brick sinks half a millimetre into the other"""
GAIN = STEP / facts.LAG
"""share of its error that a servo aims to remove in a step"""
WEIGHT = (0.0, 0.0, -9.81 * facts.LOWER_MASS)
FINER = 2
"""pixels drawn for one, along each side: the engine does not smooth edges"""
NEAR, FAR = 0.1, 3.0
"""m from the camera between which things are drawn"""
LIGHT: dict[str, Any] = {
    "lightDirection": (0.6, -0.8, 2.0),
    "lightAmbientCoeff": 0.65,
    "lightDiffuseCoeff": 0.35,
    "lightSpecularCoeff": 0.0,
    "shadow": False,
}
LINKS = {link.name: number - 1 for number, link in enumerate(facts.LINKS)}
"""PyBullet's numbers of the arm's links; the base is -1"""
JOINTS = [LINKS[link.name] for link in facts.LINKS if link.joint is not None]
CAPS = [link.joint.torque for link in facts.LINKS if link.joint is not None]


@cache
def _models() -> dict[str, str]:
    return {"arm": urdf.arm(), "brick": urdf.lower_brick(), "table": urdf.table()}


class PybulletWorld:
    """A `World` with a client of its own, in which every episode builds the scene anew.

    Putting a scene back in place leaves traces in the engine, and so does saving and restoring it.
    Parameters that reach beyond a client, such as contactBreakingThreshold, are never set. A client
    takes 30 to 40 MB.
    """

    def __init__(self, height: int, width: int) -> None:
        self._client = {"physicsClientId": pybullet.connect(pybullet.DIRECT)}
        weakref.finalize(self, pybullet.disconnect, **self._client)
        self._size = height, width
        self._camera = (
            pybullet.computeViewMatrix(facts.EYE, facts.LOOK, (0.0, 0.0, 1.0)),
            pybullet.computeProjectionMatrixFOV(facts.FIELD_OF_VIEW, width / height, NEAR, FAR),
        )

    def reset(self, joints: Floats, lower: Floats) -> None:
        """As `World.reset`."""
        pybullet.resetSimulation(**self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=STEP, numSolverIterations=ITERATIONS, **self._client
        )
        x, y, yaw = lower.tolist()
        self._load("table", useFixedBase=True)
        self._arm = self._load("arm", useFixedBase=True)
        self._brick = self._load(
            "brick",
            basePosition=(x, y, facts.HEIGHT / 2),
            baseOrientation=pybullet.getQuaternionFromEuler((0.0, 0.0, yaw)),
        )
        for joint, angle in zip(JOINTS, joints.tolist(), strict=True):
            pybullet.resetJointState(self._arm, joint, angle, **self._client)

    def _load(self, model: str, **placed: Any) -> int:
        """PyBullet's number of a new body that has its model's masses, and no drag."""
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE
        # The engine reads files only. One that outlived the call would outlive a killed process.
        with tempfile.NamedTemporaryFile("w", prefix="solar-", suffix=".urdf") as file:
            file.write(_models()[model])
            file.flush()
            body: int = pybullet.loadURDF(file.name, flags=flags, **placed, **self._client)
        for link in range(-1, pybullet.getNumJoints(body, **self._client)):
            pybullet.changeDynamics(
                body,
                link,
                lateralFriction=facts.FRICTION**0.5,  # two bodies' are multiplied
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                **self._client,
            )
        return body

    def joints(self) -> Floats:
        """As `World.joints`."""
        states = pybullet.getJointStates(self._arm, JOINTS, **self._client)
        return np.array([angle for angle, *_ in states])

    def advance(self, targets: Floats) -> None:
        """As `World.advance`."""
        pybullet.setJointMotorControlArray(
            self._arm,
            JOINTS,
            pybullet.POSITION_CONTROL,
            targetPositions=targets.tolist(),
            forces=CAPS,
            positionGains=[GAIN] * len(JOINTS),
            velocityGains=[1.0] * len(JOINTS),
            **self._client,
        )
        for _ in range(SUBSTEPS):
            # There is no gravity, as the arm carries itself: the free brick alone has a weight.
            place, _ = pybullet.getBasePositionAndOrientation(self._brick, **self._client)
            pybullet.applyExternalForce(
                self._brick, -1, WEIGHT, place, pybullet.WORLD_FRAME, **self._client
            )
            pybullet.stepSimulation(**self._client)

    def held(self) -> Pose:
        """As `World.held`."""
        number = LINKS[facts.HELD]
        state = pybullet.getLinkState(
            self._arm, number, computeForwardKinematics=True, **self._client
        )
        return _pose(*state[4:6])

    def lower(self) -> Pose:
        """As `World.lower`."""
        return _pose(*pybullet.getBasePositionAndOrientation(self._brick, **self._client))

    def image(self) -> NDArray[Any]:
        """As `World.image`."""
        height, width = self._size
        shown = pybullet.getCameraImage(
            FINER * width,
            FINER * height,
            *self._camera,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            renderer=pybullet.ER_TINY_RENDERER,
            **LIGHT,
            **self._client,
        )
        fine = np.asarray(shown[2], np.uint8).reshape(height, FINER, width, FINER, 4)[..., :3]
        total = fine.sum(axis=(1, 3), dtype=np.uint16)
        frame: NDArray[Any] = ((total + FINER**2 // 2) // FINER**2).astype(np.uint8)
        return frame


def _pose(position: Any, quaternion: Any) -> Pose:
    axes = pybullet.getMatrixFromQuaternion(quaternion)
    return Pose(np.array(position), np.array(axes).reshape(3, 3))
