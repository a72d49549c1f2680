"""Checks of the frames and controls that users give to a world.

Shapes and dtypes are always checked. Values are checked where they are known: not under ``jit``,
``vmap`` and ``grad``, which trace them. There, ``valid`` and ``nan_unless`` turn the result of an
invalid control into NaN. All functions raise ``UserError``; ``who`` is the function that was
called.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from pewm_jax.config import UserError, World
from pewm_jax.geometry import actions as action_geometry
from pewm_jax.types import Array, Camera, Control, Frames, WorldState

COLOR_TOLERANCE = 1e-3
"""Float colours may exceed [−1, 1] by this much, which is rounding."""
RIGID_TOLERANCE = 2e-3
"""Largest deviation of RᵀR from the identity in a pose that counts as rigid."""
HALF_TOLERANCE = 1e-2
"""The same for poses in half precision."""
RESIZED = (0.1, 0.02)
"""A principal point this far from the centre, as a share of the image's size, along both axes alike
to within the second number, belongs to intrinsics of another image size."""
NO_MEASUREMENT_16 = 65535
"""Value of 16-bit depth images where nothing was measured, as 0 is."""


def _refusal(who: str, got: str, give: str) -> UserError:
    return UserError(f"{who}() got {got}; give {give}.")


def check_frames(frames: Any, who: str, depth_scale: float | None = None) -> Frames:
    """Return S posed RGB-D frames as arrays, or refuse those that no camera can have taken.

    ``worlds.start`` documents what is refused. Frames whose shapes do not agree are returned as
    they are: ``require_frames`` refuses them. ``depth_scale`` is in metres per unit of depth.
    """
    if not isinstance(frames, Frames) or not isinstance(frames.camera, Camera):
        found = f"frames of type {type(frames).__name__}"
        raise _refusal(who, found, "pewm_jax.Frames with a pewm_jax.Camera")
    frames = jax.tree.map(
        lambda x: as_array(x, who, "frames"), frames, is_leaf=lambda x: isinstance(x, (list, tuple))
    )
    missing = [name for name, value in _fields(frames) if value is None]
    if missing:
        found = f"frames without {' and '.join(missing)}"
        raise _refusal(who, found, "colours, depth and cameras")
    _check_dtypes(frames, who, depth_scale)
    if _shapes_agree(frames):
        with jax.ensure_compile_time_eval():
            _check_values(frames, who)
    return frames


def require_frames(model: World, frames: Frames, who: str) -> int:
    """Return the number of frames, or refuse frames whose shapes do not fit the model."""
    count = frames.depth_THW.shape[0] if frames.depth_THW.ndim else 0
    expected = (count, model.clip.height, model.clip.width)
    if count < 1 or frames.rgb_THWC.shape != (*expected, 3) or frames.depth_THW.shape != expected:
        raise UserError(
            f"{who}() got colours {frames.rgb_THWC.shape} and depth {frames.depth_THW.shape}; this "
            f"model needs (S, {expected[1]}, {expected[2]}, 3) and (S, {expected[1]}, "
            f"{expected[2]}) with S ≥ 1: resize the frames and scale their intrinsics."
        )
    poses, intrinsics = frames.camera.world_from_camera, frames.camera.intrinsics_4
    if poses.shape != (count, 4, 4) or intrinsics.shape != (count, 4):
        found = f"{count} frames but poses {poses.shape} and intrinsics {intrinsics.shape}"
        raise _refusal(who, found, f"({count}, 4, 4) and ({count}, 4)")
    return count


def check_model(model: Any, who: str) -> None:
    """Refuse a model that is not settings."""
    if not dataclasses.is_dataclass(model) or isinstance(model, type):
        found = f"a model of type {type(model).__name__}"
        raise _refusal(who, found, "the settings that pewm_jax.load returned, or their model")


def check_params(params: Any, who: str) -> None:
    """Refuse values that are neither nested dictionaries nor another pytree of arrays.

    Which parameters a world needs is not checked.
    """
    leaves = jax.tree.leaves(params)
    arrays = bool(leaves) and all(hasattr(leaf, "dtype") for leaf in leaves)
    if not isinstance(params, Mapping) and not arrays:
        found = f"params of type {type(params).__name__}"
        raise _refusal(who, found, "the parameters that pewm_jax.load returned")


def check_state(state: Any, model: Any, who: str) -> None:
    """Refuse a value that is not a state, and a state whose frame is not of the model's size."""
    if not isinstance(state, WorldState):
        found = f"a state of type {type(state).__name__}"
        raise _refusal(who, found, "the WorldState that start() or an earlier call returned")
    clip, shape = getattr(model, "clip", None), jnp.shape(state.frame.rgb_THWC)
    if clip is not None and shape != (1, clip.height, clip.width, 3):
        found = f"a state whose frame is {shape} and not {(1, clip.height, clip.width, 3)}"
        raise _refusal(who, found, "a state that start() made of this model")


def check_key(key: Any, who: str, candidates: int | None = None) -> None:
    """Refuse values that are not a PRNG key, or not as many keys as there are candidates.

    Typed keys and the old ones of uint32 are keys.
    """
    one = candidates is None
    shape = found = getattr(key, "shape", None)
    dtype = getattr(key, "dtype", None)
    if dtype is not None and dtype == np.uint32 and found:
        shape = found[:-1]  # the words of an old key
    elif dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
        shape = None
    if shape is None:
        what, example = ("a key", "jax.random.key(0)") if one else ("keys", "")
        example = example or f"jax.random.split(jax.random.key(0), {candidates})"
        raise _refusal(who, f"{what} of type {type(key).__name__}", example)
    if shape != (() if one else (candidates,)):
        wanted = "one key" if one else f"{candidates} keys, one for each candidate"
        raise _refusal(who, f"keys of shape {shape}", wanted)


def candidates_of(controls: Any, who: str) -> int:
    """Return K, the length of the leading axis of controls, or refuse controls without one."""
    camera = controls.camera if isinstance(controls, Control) else controls
    if isinstance(camera, Camera):
        poses, intrinsics = (jnp.shape(x) for x in (camera.world_from_camera, camera.intrinsics_4))
        fits = len(poses) == 4 and len(intrinsics) == 3 and poses[0] == intrinsics[0]
        found, wanted = f"cameras with poses {poses}", "(K, n, 4, 4) and intrinsics (K, n, 4)"
        shape = poses
    else:
        shape = jnp.shape(controls)  # type: ignore[arg-type]
        fits = len(shape) in (2, 3)
        found, wanted = f"actions of shape {shape}", "(K, n) integers or (K, n, 3) floats"
    if not fits or shape[0] == 0:
        raise _refusal(who, found, f"{wanted}, with a leading axis K ≥ 1 of candidates")
    return shape[0]


def in_metres(frames: Frames, depth_scale: Array | float | None) -> Frames:
    """Return frames whose floats are float32 and whose depth is in metres.

    ``depth_scale`` is in metres per unit of depth, None for 1. Depth of 65535 in uint16 is no
    measurement, and becomes 0.
    """

    def single(x: Array) -> Array:
        floating = jnp.issubdtype(x.dtype, jnp.floating)
        return x.astype(jnp.float32) if floating and x.dtype != jnp.float32 else x

    depth = frames.depth_THW
    if depth_scale is not None:
        units = jnp.asarray(depth, jnp.float32)
        if depth.dtype == jnp.uint16:
            units = jnp.where(depth == NO_MEASUREMENT_16, 0, units)
        depth = units * jnp.asarray(depth_scale, jnp.float32)
    return jax.tree.map(single, dataclasses.replace(frames, depth_THW=depth))


def check_control(control: Any, who: str) -> Any:
    """Return a control with arrays in the place of lists, or refuse values that steer nothing.

    Any leading axes. Refused are values without a form of ``worlds.imagine``, unknown discrete
    actions, actions that are not finite, and cameras that are not rigid.
    """
    if isinstance(control, Control):
        arrays = [
            None if value is None else _finite(as_array(value, who, name), who, name)
            for name, value in (("actions", control.actions_TA), ("state", control.state_A))
        ]
        return Control(_check_cameras(control.camera, who), *arrays)
    if isinstance(control, Camera):
        return _check_cameras(control, who)
    actions = as_array(control, who, "actions")
    if not jnp.issubdtype(actions.dtype, jnp.integer):
        return _finite(actions, who, "actions")
    _check_discrete(actions, who)
    return actions


def as_array(value: Any, who: str, what: str) -> Array:
    """Return an array of numbers; lists become arrays on the host, arrays stay where they are."""
    if isinstance(value, (jax.Array, np.ndarray, Tracer)):
        found = value
    else:
        traced = any(isinstance(leaf, (Tracer, jax.Array)) for leaf in jax.tree.leaves(value))
        try:
            found = jnp.asarray(value) if traced else np.asarray(value)
        except (TypeError, ValueError):
            found = None
    if found is None or not _is_number(found.dtype):
        kind = f"an array of {found.dtype}" if isinstance(found, np.ndarray) else "no array"
        got = f"{what} of type {type(value).__name__}, {kind}"
        raise _refusal(who, got, "numbers as an array, or a list of equally long lists")
    return found


def valid(control: Any, present: Camera, leading: int = 0) -> Array:
    """Return whether all of a control is known and finite, and so is the present frame's pose.

    Args:
        control: from ``check_control``.
        present: the camera of the present frame, shared by all controls.
        leading: leading axes of the control to keep: 0 gives (), 1 gives (K,) bool.
    """

    def fine(x: Array) -> Array:
        whole = (
            jnp.isfinite(x) if jnp.issubdtype(x.dtype, jnp.floating) else jnp.ones(x.shape, bool)
        )
        if not isinstance(control, (Camera, Control)) and jnp.issubdtype(x.dtype, jnp.integer):
            whole = (x >= 0) & (x < len(action_geometry.NAMES))
        return whole.all(tuple(range(leading, whole.ndim)))

    found = jnp.isfinite(present.world_from_camera).all()
    for leaf in jax.tree.leaves(control):
        found = found & fine(jnp.asarray(leaf))
    return found


def nan_unless(ok: Array, frames: Frames) -> Frames:
    """Return frames with NaN colours, depth and poses where ``ok``, () or (K,), is False."""

    def mark(x: Array) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return jnp.where(ok.reshape(*ok.shape, *(1,) * (x.ndim - ok.ndim)), x, jnp.nan)

    pose = mark(frames.camera.world_from_camera)
    camera = dataclasses.replace(frames.camera, world_from_camera=pose)
    return Frames(mark(frames.rgb_THWC), mark(frames.depth_THW), camera)


def memory_if(ok: Array, new: Any, old: Any) -> Any:
    """Return the new memory, or the old one where ``ok`` is False."""
    if jax.tree.structure(new) != jax.tree.structure(old):
        return new
    return jax.tree.map(lambda a, b: jnp.where(ok, a, b) if a.shape == b.shape else a, new, old)


def returned_state(model: Any, name: str, found: Any, size: tuple[int, ...]) -> WorldState:
    """Return the state that the method ``name`` of a world returned, or refuse it by that name.

    The present frame must have the size (1, H, W), or (K, 1, H, W), and float values.
    """
    who = f"{type(model).__name__}.{name}()"
    if not isinstance(found, WorldState):
        raise UserError(f"{who} must return a WorldState; it returned a {type(found).__name__}.")
    _check_returned(found.frame, f"{who} returned a state whose frame", size)
    return found


def returned_frames(
    model: Any, name: str, found: Any, present: tuple[int, ...], count: int
) -> tuple[WorldState, Frames]:
    """Return the state and the ``count`` frames that a method returned; see ``returned_state``."""
    who = f"{type(model).__name__}.{name}()"
    if not isinstance(found, tuple) or len(found) != 2:
        raise UserError(
            f"{who} must return (WorldState, Frames); it returned a {type(found).__name__}."
        )
    state = returned_state(model, name, found[0], present)
    _check_returned(found[1], f"{who} returned frames that", (*present[:-3], count, *present[-2:]))
    return state, found[1]


def steps_of(control: Any, leading: int = 0) -> int:
    """Return the number of frames that a control, from ``check_control``, asks for."""
    camera = control.camera if isinstance(control, Control) else control
    steps = camera.intrinsics_4 if isinstance(camera, Camera) else camera
    return jnp.shape(steps)[leading]


def _check_returned(frames: Any, what: str, size: tuple[int, ...]) -> None:
    """Refuse frames of another shape, or of integers, that a world's method returned."""
    if not isinstance(frames, Frames):
        raise UserError(f"{what} must be Frames, not a {type(frames).__name__}.")
    *leading, _, _ = size
    wanted = ((*size, 3), size, (*leading, 4, 4), (*leading, 4))
    for (name, value), shape in zip(_fields(frames), wanted, strict=True):
        if jnp.shape(value) != shape:
            raise UserError(f"{what} must have {name} {shape}: they are {jnp.shape(value)}.")
        if not jnp.issubdtype(jnp.result_type(value), jnp.floating):
            raise UserError(
                f"{what} must have {name} of type float32: they are {value.dtype} "
                "(codecs.signals.as_signal converts colours)."
            )


def _fields(frames: Frames) -> tuple[tuple[str, Any], ...]:
    return (
        ("colours", frames.rgb_THWC),
        ("depth", frames.depth_THW),
        ("poses", frames.camera.world_from_camera),
        ("intrinsics", frames.camera.intrinsics_4),
    )


def _is_number(dtype: Any) -> bool:
    real = (jnp.integer, jnp.floating, jnp.bool_)
    return any(jnp.issubdtype(dtype, kind) for kind in real)


def _check_dtypes(frames: Frames, who: str, depth_scale: float | None) -> None:
    """Refuse dtypes without a meaning, also of traced frames."""
    for name, value in _fields(frames):
        if jnp.issubdtype(value.dtype, jnp.bool_):
            wanted = "colours as uint8 or floats in [−1, 1], and depth, poses and intrinsics as"
            raise _refusal(who, f"{name} of type bool", f"{wanted} float32")
    depth = frames.depth_THW
    if depth_scale is None and jnp.issubdtype(depth.dtype, jnp.integer):
        raise UserError(
            f"{who}() got depth as {depth.dtype} integers, whose unit is unknown; give the metres "
            "per unit, such as depth_scale=0.001 for millimetres, or give float metres."
        )
    if depth_scale is None or isinstance(depth_scale, Tracer):
        return
    try:
        scale = float(depth_scale)
    except (TypeError, ValueError):
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        wanted = "the metres per unit of depth, a number above 0, such as 0.001 for millimetres"
        raise _refusal(who, f"depth_scale {depth_scale!r}", wanted)


def _shapes_agree(frames: Frames) -> bool:
    """Tell whether these are S ≥ 1 frames of one size with a camera each."""
    rgb, depth, poses, intrinsics = (value.shape for _, value in _fields(frames))
    if len(depth) != 3 or 0 in depth:
        return False
    count = depth[0]
    return rgb == (*depth, 3) and poses == (count, 4, 4) and intrinsics == (count, 4)


def _check_values(frames: Frames, who: str) -> None:
    """Refuse colours, depth, poses and intrinsics whose values cannot be used."""
    rgb, depth = frames.rgb_THWC, frames.depth_THW
    named = {
        "rgb": _ranges(rgb),
        "depth": _ranges(depth),
        "poses": frames.camera.world_from_camera,
        "intrinsics": frames.camera.intrinsics_4,
    }
    known: dict[str, Any] = jax.device_get({k: v for k, v in named.items() if _is_known(v)})
    least, most = -1.0 - COLOR_TOLERANCE, 1.0 + COLOR_TOLERANCE
    if jnp.issubdtype(rgb.dtype, jnp.integer):
        least, most = 0.0, 255.0
    colours = "uint8 in [0, 255], or floats in [−1, 1] (bytes / 127.5 − 1)"
    metres = "finite metres along z, and 0 where nothing was measured"
    for name, what, low, high, wanted in (
        ("rgb", f"{rgb.dtype} colours", least, most, colours),
        ("depth", "depth", 0.0, np.finfo(np.float64).max, metres),
    ):
        if name in known:
            lowest, highest = (x.astype(np.float64) for x in known[name])
            frame = _first(~((lowest >= low) & (highest <= high)))
            if frame is not None:
                found = f"{what} from {lowest[frame]:g} to {highest[frame]:g} in frame {frame}"
                raise _refusal(who, found, wanted)
    if "poses" in known:
        _check_poses(known["poses"], who)
    if "intrinsics" in known:
        _check_intrinsics(known["intrinsics"], depth.shape[1:], who)


def _is_known(value: Any) -> bool:
    """Tell whether values can be read here: not traced, and not on other processes' devices."""
    leaves = jax.tree.leaves(value)
    return bool(leaves) and not any(
        isinstance(x, Tracer) or (isinstance(x, jax.Array) and not x.is_fully_addressable)
        for x in leaves
    )


def _ranges(x: Array) -> tuple[Array, Array] | None:
    """Return the lowest and highest value of each frame, NaN if there is any; None if unknown."""
    if not _is_known(x):
        return None
    # They are computed where the array is, so that no images are copied from an accelerator.
    if isinstance(x, jax.Array) and any(device.platform != "cpu" for device in x.devices()):
        return _device_ranges(x)
    values = np.asarray(x).reshape(len(x), -1)
    with np.errstate(invalid="ignore"):
        return values.min(1), values.max(1)


@jax.jit
def _device_ranges(x: Array) -> tuple[Array, Array]:
    values = x.reshape(len(x), -1)
    return values.min(1), values.max(1)


def _first(wrong: Any) -> int | None:
    """Return the number of the first frame that is wrong."""
    return int(np.argmax(wrong)) if wrong.any() else None


def _check_poses(poses: np.ndarray, who: str) -> None:
    """Refuse poses (…, 4, 4) that are not rigid; frames are counted along the leading axes."""
    half = np.asarray(poses).dtype.itemsize < 4
    tolerance = HALF_TOLERANCE if half else RIGID_TOLERANCE
    flat = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    frame = _first(~np.isfinite(flat).all((1, 2)))
    if frame is not None:
        raise UserError(
            f"{who}() got a camera pose that is not finite in frame {frame}; leave the frame out, "
            "or give its world_from_camera, 4 × 4, in metres."
        )
    rotation = flat[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.abs(np.einsum("nji,njk->nik", rotation, rotation) - np.eye(3)).max((1, 2))
        turned = np.linalg.det(rotation)
    last = np.abs(flat[:, 3] - np.array([0, 0, 0, 1.0])).max(1)
    frame = _first(~((apart <= tolerance) & (turned > 0) & (last <= tolerance)))
    if frame is not None:
        row = ", ".join(f"{x:g}" for x in flat[frame, 3])
        raise UserError(
            f"{who}() got a camera pose that is not rigid in frame {frame} (RᵀR is up to "
            f"{apart[frame]:.2g} off the identity, the determinant is {turned[frame]:.3g}, the "
            f"last row is [{row}]); give world_from_camera with a rotation R, a translation in "
            "metres and the last row [0, 0, 0, 1]."
        )


def _check_intrinsics(intrinsics: np.ndarray, size: tuple[int, ...] | None, who: str) -> None:
    """Refuse intrinsics (…, 4) of no camera, or of images of another size than (H, W)."""
    flat = np.asarray(intrinsics, np.float64).reshape(-1, 4)
    wrong = ~(np.isfinite(flat).all(1) & (flat[:, :2] > 0).all(1))
    why = "focal lengths are positive and finite"
    if size is not None and not wrong.any():
        height, width = size
        share = flat[:, 2:] / np.array([width, height])
        outside = ~((share > 0) & (share < 1)).all(1)
        away, apart = np.abs(share - 0.5).min(1), np.abs(share[:, 0] - share[:, 1])
        wrong = outside | ((away > RESIZED[0]) & (apart < RESIZED[1]))
        why = f"these are not of the {width} × {height} images given"
    frame = _first(wrong)
    if frame is not None:
        numbers = ", ".join(f"{x:g}" for x in flat[frame])
        raise UserError(
            f"{who}() got the intrinsics ({numbers}) in frame {frame}; {why}: give fx, fy, cx, cy "
            "in pixels, scaled together with the images."
        )


def _check_cameras(camera: Any, who: str) -> Camera:
    """Return cameras as arrays; values are checked where they are known and the shapes fit."""
    if not isinstance(camera, Camera):
        raise _refusal(who, f"cameras of type {type(camera).__name__}", "a pewm_jax.Camera")
    poses = as_array(camera.world_from_camera, who, "poses")
    intrinsics = as_array(camera.intrinsics_4, who, "intrinsics")
    if poses.shape[-2:] == (4, 4) and poses.size and _is_known(poses):
        _check_poses(np.asarray(poses), who)
    if intrinsics.shape[-1:] == (4,) and intrinsics.size and _is_known(intrinsics):
        _check_intrinsics(np.asarray(intrinsics), None, who)
    return Camera(intrinsics, poses)


def _finite(values: Array, who: str, what: str) -> Array:
    """Return values, or refuse booleans and values that are known and not finite."""
    if jnp.issubdtype(values.dtype, jnp.bool_):
        raise _refusal(who, f"{what} of type bool", "integers or floats")
    if jnp.issubdtype(values.dtype, jnp.floating) and _is_known(values):
        found = np.asarray(values)
        wrong = found[~np.isfinite(found)]
        if wrong.size:
            found = f"{what} that are not finite ({wrong.ravel()[0]})"
            raise _refusal(who, found, "metres and radians")
    return values


def _check_discrete(actions: Array, who: str) -> None:
    """Refuse unknown discrete actions, which a table lookup would clamp."""
    if not _is_known(actions):
        return
    found = np.asarray(actions).ravel()
    names = action_geometry.NAMES
    wrong = sorted({int(a) for a in found[(found < 0) | (found >= len(names))]})
    if wrong:
        known = ", ".join(f"{number} {name}" for number, name in enumerate(names))
        raise UserError(
            f"{who}() got the discrete actions {wrong}; the {len(names)} actions are {known} "
            "(continuous actions are floats of shape (n, 3))."
        )
