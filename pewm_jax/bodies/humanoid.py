"""A humanoid on wheels with 25 degrees of freedom: its joints.

The degrees of freedom are those of the 1X humanoid data set, in its order: three of the hip, the
knee, two of the ankle, seven of each arm, the neck, the closure of each hand, and the linear and
angular velocity. Joints and sizes are our own: the data set has no model of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pewm_jax.bodies.kinematics import FORWARD, TURN, Body, Freedom, Joint

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_BACK, _OUT = (0.0, -1.0, 0.0), {"left": X, "right": (-1.0, 0.0, 0.0)}
"""Axes about which an arm rises to the front, and to its own side."""
ARM_LINKS = ("upper_arm", "forearm", "hand", "fingers", "thumb")
"""The visible links of an arm; their names begin with the side."""
BONES = (
    (("upper_arm", "forearm"), ("forearm", "hand")),
    (("hand", "fingers"), ("fingers", "tip"), ("hand", "thumb")),
)
"""Bones of an arm, and of a hand."""


def _freedoms() -> tuple[Freedom, ...]:
    def arm(side: str) -> tuple[Freedom, ...]:
        return (
            Freedom(f"{side}_shoulder_pitch", -0.6, 2.4, 0.3),
            Freedom(f"{side}_shoulder_roll", -0.3, 1.5, 0.15),
            Freedom(f"{side}_shoulder_yaw", -1.2, 1.2),
            Freedom(f"{side}_elbow_pitch", 0.0, 2.3, 1.2),
            Freedom(f"{side}_elbow_yaw", -1.5, 1.5),
            Freedom(f"{side}_wrist_pitch", -0.8, 0.8),
            Freedom(f"{side}_wrist_roll", -0.5, 0.5),
        )

    return (
        Freedom("hip_yaw", -0.8, 0.8, fastest=0.15),
        Freedom("hip_roll", -0.25, 0.25, fastest=0.1),
        Freedom("hip_pitch", -0.3, 1.0, fastest=0.15),
        Freedom("knee_pitch", 0.0, 1.4, fastest=0.2),
        Freedom("ankle_roll", -0.2, 0.2, fastest=0.1),
        Freedom("ankle_pitch", -0.3, 0.8, fastest=0.15),
        *arm("left"),
        *arm("right"),
        Freedom("neck_pitch", -0.5, 1.1, 0.35, fastest=0.2),
        Freedom("left_hand_closure", 0.0, 1.0, 0.2),
        Freedom("right_hand_closure", 0.0, 1.0, 0.2),
        Freedom(FORWARD, -0.3, 0.3, fastest=0.12),
        Freedom(TURN, -0.6, 0.6, fastest=0.18),
    )


def _arm(side: str) -> tuple[Joint, ...]:
    left = 1.0 if side == "left" else -1.0

    def joint(name: str, parent: str, *rest: object) -> Joint:
        return Joint(f"{side}_{name}", parent, *rest)  # type: ignore[arg-type]

    def own(name: str) -> str:
        return f"{side}_{name}"

    shoulder = joint("shoulder", "torso", (0.0, 0.21 * left, 0.42), _BACK, own("shoulder_pitch"))
    return (
        shoulder,
        joint("roll", own("shoulder"), (0.0, 0.0, 0.0), _OUT[side], own("shoulder_roll")),
        joint("upper_arm", own("roll"), (0.0, 0.0, 0.0), (0.0, 0.0, left), own("shoulder_yaw")),
        joint("elbow", own("upper_arm"), (0.0, 0.0, -0.27), _BACK, own("elbow_pitch")),
        joint("forearm", own("elbow"), (0.0, 0.0, 0.0), (0.0, 0.0, left), own("elbow_yaw")),
        joint("wrist", own("forearm"), (0.0, 0.0, -0.25), _BACK, own("wrist_pitch")),
        joint("hand", own("wrist"), (0.0, 0.0, 0.0), _OUT[side], own("wrist_roll")),
        joint(
            "fingers",
            own("hand"),
            (0.0, 0.0, -0.1),
            (-left, 0.0, 0.0),
            own("hand_closure"),
            1.6,
        ),
        joint("tip", own("fingers"), (0.0, 0.0, -0.09)),
        joint(
            "thumb",
            own("hand"),
            (0.05, 0.0, -0.03),
            (0.0, 0.0, -left),
            own("hand_closure"),
            1.0,
        ),
    )


def _body() -> Body:
    still = (0.0, 0.0, 0.0)
    return Body(
        "humanoid",
        _freedoms(),
        (
            Joint("base", "", still),
            Joint("ankle", "base", (0.0, 0.0, 0.1), X, "ankle_roll"),
            Joint("shank", "ankle", still, Y, "ankle_pitch"),
            Joint("thigh", "shank", (0.0, 0.0, 0.38), _BACK, "knee_pitch"),
            Joint("hip", "thigh", (0.0, 0.0, 0.38), Y, "hip_pitch"),
            Joint("waist", "hip", still, X, "hip_roll"),
            Joint("torso", "waist", still, Z, "hip_yaw"),
            *_arm("left"),
            *_arm("right"),
            Joint("head", "torso", (0.02, 0.0, 0.5), Y, "neck_pitch"),
            Joint("eyes", "head", (0.03, 0.0, 0.1)),
        ),
        eyes="eyes",
        arms=tuple(f"{side}_{link}" for side in ("left", "right") for link in ARM_LINKS),
        bones=tuple(
            tuple(
                (f"{side}_{one}", f"{side}_{other}")
                for side in ("left", "right")
                for one, other in group
            )
            for group in BONES
        ),
    )


HUMANOID = _body()
"""The body of ``data collect --body humanoid``."""


BODIES = {"humanoid": HUMANOID}
"""The bodies by name."""


def arm_ids(info: Mapping[str, Any]) -> list[int]:
    """Return the instance ids of an episode's arms and hands; none if it has no body."""
    about = info.get("body") or {}
    body = BODIES.get(about.get("name", ""))
    return [] if body is None else [about["ids"][link] for link in body.arms]
