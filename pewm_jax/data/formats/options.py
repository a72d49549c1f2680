"""The settings of ``pewm-jax data import``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pewm_jax import registry
from pewm_jax.config import ConfigError
from pewm_jax.data.episodes import DEPTH_LIMIT_M

AXES = ("x", "y", "z", "-x", "-y", "-z")
OF_FORMATS = (
    *("depth_scale", "trajectory", "camera", "pose", "metres_per_step", "min_confidence"),
    *("episodes", "fov", "camera_height", "frames", "step", "turn_deg", "dataset", "actions"),
)
"""Options that only some formats use; a format names those that it uses."""


@dataclasses.dataclass(frozen=True)
class ImportConfig:
    """Import recordings of a format, or find out the format: auto.

    FORMAT SRC OUT: the format is the first argument, or --format. The formats are open3d, tum,
    lerobot, nomad, 7scenes, replica, scannet, arkitscenes, stray, habitat, scenezoo, and those of
    plugins. An import that was interrupted is resumed by the same command.
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """The recording, or a folder of several."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Dataset folder; the episodes are added to its split."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx fy cx cy in pixels of the recorded colour images; for formats whose files do not have
    them."""
    format: str = "open3d"
    """Format of the recording; `auto` finds it."""
    pixel_centres: Literal["integer", "half"] | None = None
    """Coordinate of the centre of the first pixel in cx and cy: `integer` is 0 (OpenCV), `half` is
    0.5; by default the format's."""
    depth_scale: float | None = None
    """Value of a depth image that means one metre, such as 1000 for millimetres; by default the
    format's. The largest 16-bit value, 65535, means no measurement, regardless of the scale."""
    max_depth: float = DEPTH_LIMIT_M
    """Depths beyond this become "no measurement", metres. By default all depths that the format can
    store are kept; give the range of the sensor, such as 10, to drop unreliable depths."""
    stride: int = 1
    """Keep every n-th frame."""
    size: tuple[int, int] | None = None
    """Width and height of the images in the dataset, pixels; by default they keep their size."""
    fit: Literal["crop", "letterbox"] = "crop"
    """How images get another aspect ratio: `crop` cuts equal borders off, `letterbox` adds black
    ones without depth. Intrinsics move along; nothing is squeezed."""
    rotate: Literal["auto", "0", "90", "180", "270"] = "auto"
    """Degrees clockwise by which images are turned; `auto` turns sideways scans of phones
    upright."""
    trajectory: Path | None = None
    """Trajectory file of open3d and tum; by default groundtruth.txt or the only .log file."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the recording's world that points up, written --up=-y; by default the format's: -y
    where the world is the first, level camera, z with motion capture."""
    invert_poses: bool = False
    """The poses of the files are world-to-camera, against the convention of the format."""
    camera_axes: Literal["opencv", "opengl"] = "opencv"
    """Axes of the camera in the poses of the files: `opengl` is x right, y up, z backward."""
    names: Path | None = None
    """Text file with the name of a sequence per line: only these are imported, such as
    traj_names.txt of NoMaD."""
    camera: str | None = None
    """LeRobot: feature of the colour images; by default the first camera. SceneZoo: source of
    frames, such as iphone; by default the first with a pinhole camera."""
    pose: str | None = None
    """LeRobot: feature of the camera's pose in the world: 16, 12 or 7 numbers (xyz, quaternion
    xyzw), or 3 (x, y, yaw)."""
    actions: Literal["recorded", "state"] = "recorded"
    """LeRobot: `recorded` takes the feature `action`, if there is one; `state` takes the feature
    `observation.state` of the next frame that is kept, for data whose states are joint angles."""
    metres_per_step: float | None = None
    """NoMaD: length of one step of the robot; by default that of the data set that the folder's
    name tells (recon, scand, tartan, sacson)."""
    min_confidence: int = 1
    """Phones: depth of less confidence becomes "no measurement": 0 keeps all, 2 only the best."""
    episodes: Path | None = None
    """Habitat: the episodes, a .json.gz file or a folder of them; by default those below SRC."""
    fov: float = 90.0
    """Habitat: horizontal field of view, degrees."""
    camera_height: float = 1.25
    """Habitat: height of the camera above the agent's position, metres."""
    frames: int = 500
    """Habitat: largest number of frames of an episode."""
    step: float = 0.25
    """Habitat: length of a step, metres."""
    turn_deg: float = 30.0
    """Habitat: angle of a turn, degrees."""
    dataset: str | None = None
    """SceneZoo: name of the data set, such as scannetv2, scannetppv2, multiscan or 3rscan."""
    episode_frames: int = 500
    """A longer sequence is cut into episodes of at most this many frames."""
    skip_bad: int = 0
    """Leave out up to this many frames that are missing or damaged; more are refused."""
    check: bool = False
    """Draw the reprojection between distant frames as OUT/NAME-check.png, and print its error."""
    split: str = "train"
    """Split to add to."""
    name: str | None = None
    """Name of the recording; by default the name of the folder."""
    overwrite: bool = False
    """Replace a recording of the same name."""

    def __post_init__(self):
        """Validate."""
        if self.format not in ("auto", *registry.names("format")):
            registry.named("format", self.format)  # of an installed package, or refused
        for flag, least in (("stride", 1), ("episode_frames", 1), ("frames", 1), ("skip_bad", 0)):
            if getattr(self, flag) < least:
                name = flag.replace("_", "-")
                raise ConfigError(f"--{name} is {getattr(self, flag)}: use {least} or more.")
        for flag in ("metres_per_step", "fov", "step", "turn_deg"):
            value = getattr(self, flag)
            if value is not None and not 0 < value < 180:
                name = flag.replace("_", "-")
                raise ConfigError(f"--{name} is {value}: use a number above 0 and below 180.")
        for what, value in (("split", self.split), ("name", self.name or "episode")):
            if not value or any(c in value for c in "/\\") or value.startswith("."):
                raise ConfigError(f"--{what} is {value!r}: use a plain name without slashes.")
        self._check_images()

    def _check_images(self) -> None:
        """Validate the settings of images and depth."""
        if self.depth_scale is not None and not self.depth_scale > 0:
            raise ConfigError(f"--depth-scale is {self.depth_scale}: use 1000 for millimetres.")
        if not 0 < self.max_depth <= DEPTH_LIMIT_M:
            raise ConfigError(
                f"--max-depth is {self.max_depth}: use metres above 0, up to the {DEPTH_LIMIT_M} "
                "that the format can store."
            )
        if self.size is not None and min(self.size) < 1:
            raise ConfigError(f"--size is {self.size}: use a width and height in pixels.")
        if self.intrinsics is not None and not min(self.intrinsics[:2]) > 0:
            raise ConfigError(f"--intrinsics {self.intrinsics}: fx and fy must be above 0.")

    @property
    def called(self) -> str:
        """Name of the recording."""
        return self.name or self.src.resolve().name or "recording"

    def require_used(self, used: tuple[str, ...], name_of_format: str) -> None:
        """Refuse an option that the format does not use; ``used`` are those that it uses."""
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        for name in OF_FORMATS:
            if name not in used and getattr(self, name) != defaults[name]:
                flag = name.replace("_", "-")
                raise ConfigError(
                    f"--{flag} is not used by the format {name_of_format}; leave it out."
                )
