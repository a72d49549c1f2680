"""Settings of a drive and of its page; cheap to import, so that --help is fast."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

from pewm_jax.errors import require

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine can reach."""


@dataclasses.dataclass(frozen=True)
class Start:
    """Start of the drive: a generated house unless another source is given."""

    house: int = 2
    """Seed of the generated house. The shipped model was trained on 0, 3, 6, … and not on 2, 5, 8,
    …"""
    seed: int = 0
    """Seed of the start position and of the sampler's noise."""
    scene: str = ""
    """A mesh to drive in (GLB, OBJ, PLY, …), in metres, instead of a house."""
    up: Literal["auto", "y", "z"] = "auto"
    """Which axis of the mesh points up; `auto`: y for GLB and glTF, z for the others."""
    episode: str = ""
    """A split's folder, such as data/small/revisit: start with one of its episodes."""
    number: int = 0
    """Number of the episode."""
    recording: str = ""
    """A folder of colour images, depth images and a trajectory, in the format of `pewm-jax data
    import`."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx fy cx cy in pixels of the recorded images; a recording needs them."""
    depth_scale: float = 1000.0
    """Value of a recorded depth image that means one metre."""
    recording_up: Literal["x", "y", "z", "-x", "-y", "-z"] = "-y"
    """Axis of the recording's world that points up."""
    frames: int = 24
    """Largest number of frames of an episode or a recording observed before the drive."""
    hfov: float = 90.0
    """Horizontal field of view in a house or mesh, degrees."""
    camera_height: float = 1.25
    """Height of the camera above the floor of a house or mesh, metres."""

    def __post_init__(self):
        """Validate."""
        named = [name for name in ("scene", "episode", "recording") if getattr(self, name)]
        require(
            len(named) < 2,
            f"--{' and --'.join(named)} are given: a drive starts in one place; keep only one of "
            "them.",
        )
        for name in ("house", "seed", "number"):
            value = getattr(self, name)
            require(
                isinstance(value, int) and value >= 0,
                f"--{name} is {value!r}: use an integer of 0 or more.",
            )
        require(self.frames >= 1, f"--frames is {self.frames}: use at least 1.")
        require(
            not self.recording or self.intrinsics is not None,
            "--recording needs --intrinsics fx fy cx cy, in pixels of the recorded images.",
        )
        require(1 <= self.hfov < 180, f"--hfov is {self.hfov}: use 1 up to below 180 degrees.")
        require(
            math.isfinite(self.camera_height) and self.camera_height > 0,
            f"--camera_height is {self.camera_height}: use metres above 0.",
        )


@dataclasses.dataclass(frozen=True)
class Serve:
    """How the page is served."""

    host: str = "127.0.0.1"
    """Address to serve on. With 0.0.0.0 other machines can reach the page, without a password."""
    port: int = 8080
    """Port of the page; if it is in use, the next free one."""
    names: tuple[str, ...] = ()
    """Further names of the page in the browser's address bar, such as that of a proxy. Pages of
    other sites are rejected."""
    worlds: Path | None = None
    """Folder of saved worlds and videos; by default worlds/ beside the run's reports."""
    ahead: bool = True
    """Imagine likely next steps while no key is pressed, so that they appear immediately."""
    open: bool = True
    """Open the page in the browser if there is a desktop."""

    def __post_init__(self):
        """Validate."""
        require(0 <= self.port < 65536, f"--port is {self.port}: use 0 to 65535.")
        require(bool(self.host), "--host is empty: use an address, such as 127.0.0.1.")
