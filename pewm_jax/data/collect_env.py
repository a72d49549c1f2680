"""Collect episodes from a user's environment: ``pewm-jax data collect OUT --env MODULE:NAME``.

The environment follows Gymnasium's API and provides, in its observation (a dictionary) or ``info``,

    rgb         (H, W, 3) uint8
    depth       (H, W) float, metres along the camera's z axis, 0 = no measurement
    pose        (4, 4) world_from_camera, OpenCV axes, metres, the world's z up
    intrinsics  (4,) fx, fy, cx, cy in pixels, centres at +0.5; or the attribute ``intrinsics_4``
                of the environment

Every episode begins with a ``reset`` whose seed follows from the settings and the episode's number,
so an interrupted collection can be resumed. Planar actions are computed from the poses: they are
the agent's actual motion, not its intended one. Each episode is validated before it is written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from pewm_jax import registry as kinds
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data import resume
from pewm_jax.data.checks import check_episode
from pewm_jax.data.episodes import EpisodeArrays, read_episode, write_episode
from pewm_jax.data.importer import planar_actions
from pewm_jax.data.make_episode import require_at_least
from pewm_jax.io.progress import Meter

SPLITS = ("train", "validation", "test")
"""Names of the splits' folders."""
TRIES = 20
"""Largest number of consecutive episodes that may be too short."""
FORM = (
    "rgb (H, W, 3) uint8, depth (H, W) in metres along z, pose (4, 4) world_from_camera (OpenCV "
    "axes, z up), and intrinsics (4,) fx, fy, cx, cy, which may also be the environment's "
    "attribute intrinsics_4"
)
"""The arrays that an environment has to provide, for error messages."""
FIX = "; fix it."


@dataclasses.dataclass(frozen=True)
class CollectEnvConfig:
    """Let an agent walk through your own environment and write its frames as episodes."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to write; gets train/, validation/ and test/."""
    env: str
    """MODULE:NAME of a function or class that returns a gymnasium.Env, or of a registered
    environment after the module that registers it: pewm_jax.planning:pewm_jax/House-v0."""
    env_args: str = "{}"
    """Arguments of the function, as a JSON object: '{"task": "image"}'."""
    policy: str = ""
    """MODULE:FUNCTION that maps an observation to an action; empty: random, repeated actions."""
    persistence: float = 0.7
    """Without a policy: probability of repeating the last action, if it moved the agent."""
    train: int = 320
    """Episodes to train on."""
    validation: int = 8
    """Episodes to watch training with."""
    test: int = 24
    """Episodes to evaluate on."""
    frames: int = 96
    """Frames of an episode."""
    min_frames: int = 9
    """Episodes that the environment ends before --frames are kept if they have this many frames;
    shorter ones are made again with another seed."""
    seed: int = 0
    """Seed of the environment and of random actions."""
    shard_episodes: int = 8
    """Episodes per file."""
    overwrite: bool = False
    """Replace a dataset that was made with other settings."""

    def __post_init__(self):
        """Validate."""
        require_at_least(self, 0, "train", "validation", "test", "seed")
        if self.train + self.validation + self.test == 0:
            raise ConfigError("--train, --validation and --test are all 0: nothing to collect.")
        require_at_least(self, 1, "shard_episodes")
        if not 2 <= self.min_frames <= self.frames:
            raise ConfigError(
                f"--min-frames is {self.min_frames} and --frames {self.frames}: use 2 or more, and "
                "no more than --frames."
            )
        if not 0 <= self.persistence <= 1:
            raise ConfigError(f"--persistence is {self.persistence}: use a probability, 0 to 1.")
        for flag, value in (("--env", self.env), ("--policy", self.policy or "a:b")):
            module, colon, name = value.partition(":")
            if not (colon and name and all(part.isidentifier() for part in module.split("."))):
                raise ConfigError(
                    f"{flag} is {value!r}: give MODULE:NAME, such as my_robot:make for make() in "
                    "my_robot.py."
                )
        try:
            table = json.loads(self.env_args)
        except ValueError:
            table = None
        if not isinstance(table, dict):
            raise ConfigError(f"--env-args is {self.env_args!r}: give a JSON object.")

    def episodes(self, split: str) -> int:
        """Episodes of a split."""
        return getattr(self, split)

    def settings(self, split: str) -> dict[str, Any]:
        """Return the settings that determine the bytes of a split."""
        settings = dataclasses.asdict(self)
        for name in ("out", "overwrite", *SPLITS):
            del settings[name]
        return {"made_by": "collect --env", "episodes": self.episodes(split), **settings}


def make(
    env: Any,
    policy: Callable[[Any], Any] | None,
    config: CollectEnvConfig,
    split: str,
    index: int,
) -> bytes:
    """Run one episode, number ``index`` of a split, and return its record.

    Raises:
        UserError: the environment does not provide the arrays needed or ends its episodes too soon,
            or the episode fails validation.
    """
    longest = 0
    for attempt in range(TRIES):
        draw = np.random.default_rng([config.seed, SPLITS.index(split), index, attempt])
        act = policy or _Persistent(env.action_space, config.persistence, draw)
        seen, intrinsics, scene = _walk(env, act, config, int(draw.integers(2**31)))
        longest = max(longest, len(seen))
        if len(seen) >= config.min_frames:
            return _record(seen, intrinsics, config, f"{split}-{index:06d}", scene)
    raise UserError(
        f"--env {config.env} ended {TRIES} episodes in a row after at most {longest} frames: let "
        f"its episodes last longer, or lower --min-frames ({config.min_frames})."
    )


def _walk(
    env: Any, act: Callable[[Any], Any], config: CollectEnvConfig, seed: int
) -> tuple[list[dict[str, np.ndarray]], np.ndarray, str]:
    """Return the frames of an episode, the intrinsics, and the scene's name."""
    observation, info = _call_user(config, ": reset failed", FIX, env.reset, seed=seed)
    first, intrinsics = _read_frame(env, observation, info, config)
    seen = [first]
    while len(seen) < config.frames:
        action = _call_user(config, ": the policy failed", FIX, act, observation)
        after = _call_user(config, ": step failed", FIX, env.step, action)
        observation, _, terminated, truncated, info = after
        frame, same = _read_frame(env, observation, info, config)
        if not np.array_equal(same, intrinsics) or frame["rgb"].shape != first["rgb"].shape:
            raise UserError(
                f"--env {config.env} changed its intrinsics or image size within an episode: an "
                "episode has one camera."
            )
        if isinstance(act, _Persistent) and np.array_equal(frame["pose"], seen[-1]["pose"]):
            act.forget()  # the action had no effect: the agent faces a wall
        seen.append(frame)
        if terminated or truncated:
            break
    shown = info.get("scene") if isinstance(info, Mapping) else None
    return seen, intrinsics, str(shown or config.env.partition(":")[2])


def _call_user(
    config: CollectEnvConfig, failure: str, fix: str, function: Callable, *args, **kwargs
):
    """Call a user's function; raise any exception as a ``UserError``."""
    try:
        return function(*args, **kwargs)
    except UserError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise UserError(f"--env {config.env}{failure} ({reason}){fix}") from error


def _read_frame(
    env: Any, observation: Any, info: Any, config: CollectEnvConfig
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the frame that an environment provides, and the intrinsics; check their form."""
    places = [place for place in (observation, info) if isinstance(place, Mapping)]
    found: dict[str, Any] = {
        name: next((place[name] for place in places if name in place), None)
        for name in ("rgb", "depth", "pose", "intrinsics")
    }
    if found["intrinsics"] is None:
        found["intrinsics"] = getattr(getattr(env, "unwrapped", env), "intrinsics_4", None)
    absent = [name for name, value in found.items() if value is None]
    if absent:
        raise UserError(
            f"--env {config.env} provides no {', '.join(absent)}: provide {FORM}, in the "
            "observation (a dictionary) or in info."
        )
    frame = {name: np.asarray(value) for name, value in found.items()}
    rgb, depth, size = frame["rgb"], frame["depth"], frame["depth"].shape
    fits = {
        "rgb": len(size) == 2 and rgb.shape == (*size, 3) and rgb.dtype == np.uint8,
        "depth": len(size) == 2 and depth.dtype.kind == "f",
        "pose": frame["pose"].shape == (4, 4),
        "intrinsics": frame["intrinsics"].shape == (4,),
    }
    wrong = [name for name, fit in fits.items() if not fit]
    if wrong:
        what = ", ".join(f"{name} {frame[name].shape} {frame[name].dtype}" for name in wrong)
        raise UserError(f"--env {config.env} provides {what}: provide {FORM}.")
    # Copied, because an environment may reuse its buffers.
    return {name: frame[name].copy() for name in ("rgb", "depth", "pose")}, frame["intrinsics"]


def _record(
    seen: list[dict[str, np.ndarray]],
    intrinsics: np.ndarray,
    config: CollectEnvConfig,
    name: str,
    scene: str,
) -> bytes:
    """Encode an episode and check it as ``data validate`` does."""
    rgb, depth, pose = (np.stack([frame[key] for frame in seen]) for key in seen[0])
    arrays = EpisodeArrays(rgb, depth, intrinsics, pose, planar_actions(pose))
    record = write_episode(arrays, name, scene, {"policy": config.policy or "random-persistent"})
    problems = check_episode(read_episode(record), f"--env {config.env}, episode {name}")
    if problems:
        raise UserError(str(problems[0]))
    return record


class _Persistent:
    """A policy that draws random actions from a space and repeats each with a probability."""

    def __init__(self, space: Any, persistence: float, rng: np.random.Generator):
        self._space, self._persistence, self._rng = space, persistence, rng
        self._last: Any = None
        space.seed(int(rng.integers(2**31)))

    def __call__(self, observation: Any) -> Any:
        """Return an action; the observation is ignored."""
        del observation
        if self._last is None or self._rng.random() >= self._persistence:
            self._last = self._space.sample()
        return self._last

    def forget(self) -> None:
        """Draw a new action at the next call."""
        self._last = None


def open_env(config: CollectEnvConfig) -> Any:
    """Return the environment that ``--env`` names.

    Raises:
        UserError: no environment has this name, it cannot be created, or it is not an environment.
    """
    made, name = _named(config.env, "--env")
    made = _registered(config, name) if made is None else made
    fix = ": fix it, or its --env-args."
    env = _call_user(config, " cannot be created", fix, made, **json.loads(config.env_args))
    for wanted in ("reset", "step", "close", "action_space"):
        if not hasattr(env, wanted):
            raise UserError(
                f"--env {config.env} returns a {type(env).__name__} without {wanted}: give a "
                "function or class that returns a gymnasium.Env."
            )
    return env


def _registered(config: CollectEnvConfig, name: str) -> Callable[..., Any]:
    """Return a function that creates a registered environment of Gymnasium."""
    try:
        import gymnasium  # noqa: PLC0415 - optional: other environments do not need it
    except ImportError:
        gymnasium = None
    if gymnasium is None or name not in gymnasium.registry:
        raise UserError(
            f"--env {config.env}: the module has no {name!r}, and Gymnasium (pip install "
            "'pewm-jax[planning]') has no such environment registered after importing it."
        )
    return lambda **arguments: gymnasium.make(name, **arguments)


def open_policy(config: CollectEnvConfig) -> Callable[[Any], Any] | None:
    """Return the policy that ``--policy`` names, or None; UserError if it does not exist."""
    if not config.policy:
        return None
    found, name = _named(config.policy, "--policy")
    if not callable(found):
        raise UserError(
            f"--policy {config.policy}: the module has no function {name}; give MODULE:FUNCTION "
            "that maps an observation to an action."
        )
    return found


def _named(text: str, flag: str) -> tuple[Any, str]:
    """Return what MODULE:NAME names, or None, and NAME; the module may be in the current folder."""
    module, _, name = text.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    return getattr(kinds.imported(module, flag), name, None), name


def collect_env(config: CollectEnvConfig, log: Callable[[str], None] = print) -> None:
    """Create a dataset from an environment, or its missing shards; ``log`` prints lines.

    Raises:
        UserError: as ``open_env``, ``open_policy`` and ``make``, or the output folder contains a
            dataset with other settings.
    """
    splits = resume.unfinished_splits(
        config.out,
        {split: config.episodes(split) for split in SPLITS},
        config.settings,
        config.shard_episodes,
        overwrite=config.overwrite,
    )
    if not splits:
        log(f"{config.out} is complete with these settings: nothing to do.")
        return
    env, policy = open_env(config), open_policy(config)

    def records(split: str, indices: range, meter: Meter) -> Iterator[bytes]:
        for index in indices:
            yield make(env, policy, config, split, index)
            meter.advance(1)

    with contextlib.closing(env):
        # Make one episode before writing anything, so that an unsuitable environment fails here.
        make(env, policy, config, splits[0].folder.name, 0)
        total = sum(config.episodes(split.folder.name) for split in splits)
        with Meter(f"collecting {config.out}", total, "episodes") as meter:
            for split in splits:
                split.prepare()
                missing = split.missing()
                meter.advance(
                    sum(map(len, split.wanted.values())) - sum(map(len, missing.values()))
                )
                for path, indices in missing.items():
                    split.write(path, records(split.folder.name, indices, meter))
                split.publish()
        log(meter.summary())
