"""Motions of a humanoid while it walks, stands and turns: postures of the legs and the arms.

An arm goes from one posture to the next along a smooth path, holds it for a while, and goes on.
Postures reach forward, carry, hang at the side, and rise. Legs, hips and neck drift slowly; hips
sway while the body walks. No physics: arms may pass through furniture.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pewm_jax.bodies.kinematics import Body, walking

MOVE_FRAMES, HOLD_FRAMES = (5, 14), (0, 7)
"""Fewest and most frames of a motion between two postures, and of a pause after it."""
SLOW = 8
"""Frames over which slow motions are correlated."""
FASTEST = 0.3
"""Largest change of an angle of an arm, or of a hand's closure, from frame to frame."""
BOTH = 0.3
"""Probability that an arm does the same as the other one."""
PAUSES = 0.35
"""Share of the frames of an episode in which the body stands still."""
PAUSE_FRAMES = (8, 20)
"""Fewest and most frames of a pause of walking."""


@dataclasses.dataclass(frozen=True)
class Posture:
    """Ranges of the joints of an arm, radians, and how often they are chosen.

    Attributes:
        weight: relative frequency.
        pitch: of the shoulder; the arm rises to the front.
        roll: of the shoulder; the arm rises to its side.
        yaw: of the shoulder.
        elbow: bend of the elbow.
    """

    weight: float
    pitch: tuple[float, float]
    roll: tuple[float, float]
    yaw: tuple[float, float]
    elbow: tuple[float, float]


POSTURES = {
    "reach": Posture(0.5, (0.5, 1.3), (-0.1, 0.4), (-0.4, 0.4), (0.2, 1.2)),
    "carry": Posture(0.25, (0.0, 0.5), (0.0, 0.3), (-0.1, 0.6), (1.2, 1.9)),
    "raise": Posture(0.15, (1.2, 2.0), (0.1, 0.6), (-0.3, 0.3), (0.8, 1.8)),
    "hang": Posture(0.1, (-0.2, 0.3), (0.05, 0.25), (-0.2, 0.2), (0.1, 0.6)),
}
"""Name → posture of an arm."""
_WRIST = {"elbow_yaw": 0.9, "wrist_pitch": 0.5, "wrist_roll": 0.3}


def motion(body: Body, planar_T3: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (T, A) float64 states of a humanoid along a walk (T, 3) that never steps aside.

    Args:
        body: a body with the degrees of freedom of ``humanoid``.
        planar_T3: x, y, yaw at each frame.
        rng: source of all randomness.

    Returns:
        States inside the limits of the body, whose last two numbers are those of the walk.
    """
    walked_T2 = walking(planar_T3)
    frames = len(walked_T2)
    state = np.tile(body.rest, (frames, 1))

    def put(name: str, values: np.ndarray) -> None:
        state[:, body.index(name)] = values

    slow = {name: _slow(rng, frames) for name in ("crouch", "lean", "roll", "turn", "neck")}
    crouch = np.clip(0.12 + 0.14 * slow["crouch"], 0.0, 0.5)
    put("ankle_pitch", crouch)
    put("knee_pitch", 2 * crouch)
    put("hip_pitch", crouch + 0.06 * slow["lean"])
    steps = np.cumsum(np.abs(walked_T2[:, 0]) > 0)
    gait = np.sin(np.pi * steps / 2 + rng.uniform(0, np.pi)) * (np.abs(walked_T2[:, 0]) > 0)
    put("ankle_roll", 0.02 * slow["roll"])
    put("hip_roll", 0.03 * slow["roll"] + 0.02 * gait)
    put("hip_yaw", 0.1 * slow["turn"] + 0.05 * gait)
    put("neck_pitch", 0.42 + 0.18 * slow["neck"])
    names = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow_pitch", *_WRIST)
    left = _arm(rng, frames)
    right = left if rng.random() < BOTH else _arm(rng, frames)
    for side, arm in (("left", left), ("right", right)):
        for k, name in enumerate(names):
            put(f"{side}_{name}", arm[:, k])
        put(f"{side}_hand_closure", arm[:, -1])
    state = np.clip(state, body.low, body.high)
    state[:, -2:] = walked_T2
    return state


def with_pauses(
    planar_T3: np.ndarray, frames: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return a walk of ``frames`` frames with pauses in it, and the (frames,) frames of the walk.

    The walk has ``walked(frames)`` frames or more.
    """
    rest = frames - walked(frames)
    repeats = np.ones(frames - rest, int)
    while rest > 0:
        pause = min(rest, int(rng.integers(*PAUSE_FRAMES, endpoint=True)))
        repeats[rng.integers(len(repeats))] += pause
        rest -= pause
    source = np.repeat(np.arange(len(repeats)), repeats)
    return np.asarray(planar_T3)[source], source


def walked(frames: int) -> int:
    """Return how many of the frames of an episode belong to its walk, not to pauses."""
    return max(2, frames - round(PAUSES * frames))


def _arm(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Return (frames, 8) angles of an arm, and the closure of its hand last."""
    now = _posture(rng)
    rows = [now[None]]
    count = 1
    while count < frames:
        then = _posture(rng)
        # The fastest moment of such a path is 1.875 times as fast as its mean.
        least = int(np.ceil(1.875 * np.abs(then - now).max() / FASTEST))
        moving = max(least, int(rng.integers(*MOVE_FRAMES, endpoint=True)))
        share = np.linspace(0, 1, moving + 1)[1:, None]
        rows.append(now + (then - now) * share**3 * (10 - 15 * share + 6 * share**2))
        held = int(rng.integers(*HOLD_FRAMES, endpoint=True))
        rows.append(np.repeat(then[None], held, 0))
        now, count = then, count + moving + held
    return np.concatenate(rows)[:frames]


def _posture(rng: np.random.Generator) -> np.ndarray:
    """Draw a posture of an arm: seven angles and the closure of the hand."""
    weights = np.array([each.weight for each in POSTURES.values()])
    chosen = list(POSTURES.values())[rng.choice(len(weights), p=weights / weights.sum())]
    shoulder = [rng.uniform(*span) for span in (chosen.pitch, chosen.roll, chosen.yaw)]
    wrist = [rng.uniform(-most, most) for most in _WRIST.values()]
    return np.array([*shoulder, rng.uniform(*chosen.elbow), *wrist, rng.uniform(0, 1)])


def _slow(rng: np.random.Generator, frames: int) -> np.ndarray:
    """Return (frames,) slowly changing numbers of deviation 1."""
    window = np.exp(-0.5 * (np.arange(-3 * SLOW, 3 * SLOW + 1) / SLOW) ** 2)
    noise = rng.normal(size=frames + len(window) - 1)
    return np.convolve(noise, window / np.linalg.norm(window), "valid")
