"""Seen-before masks on scenes whose answer is known in closed form."""

from __future__ import annotations

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.eval.metrics import images as masks
from pewm_jax.geometry.cameras import intrinsics_from_fov, pixel_grid, pose_from_yaw
from pewm_jax.types import Camera, Frames
from tests.properties import examples

SIZE = 64
seen_masks = jax.jit(masks.seen_masks)
INTRINSICS = intrinsics_from_fov(SIZE, SIZE, 90.0)


def rays(pose):
    """World directions with unit z-depth for every pixel."""
    grid = pixel_grid(SIZE, SIZE)
    local = np.concatenate(
        [(grid - INTRINSICS[2:]) / INTRINSICS[:2], np.ones((SIZE, SIZE, 1), np.float32)], -1
    )
    return local @ pose[:3, :3].T


def room_depth(pose, wall_x=4.0, pillar=None):
    """Z-depth in a room of walls x = ±wall_x, y = ±3, floor z = 0, ceiling z = 2.6."""
    d, o = rays(pose), pose[:3, 3]
    with np.errstate(divide="ignore"):
        t = np.minimum.reduce(
            [
                np.max([(wall_x - o[0]) / d[..., 0], (-wall_x - o[0]) / d[..., 0]], 0),
                np.max([(3 - o[1]) / d[..., 1], (-3 - o[1]) / d[..., 1]], 0),
                np.max([(2.6 - o[2]) / d[..., 2], (0 - o[2]) / d[..., 2]], 0),
            ]
        )
        if pillar is not None:  # an upright board at x = pillar, |y| < 0.5
            hit = (pillar - o[0]) / d[..., 0]
            y = o[1] + hit * d[..., 1]
            t = np.where((hit > 0) & (hit < t) & (np.abs(y) < 0.5), hit, t)
    return t.astype(np.float32)


def view(poses, **kwargs):
    pose = np.stack(poses)
    depth = np.stack([room_depth(p, **kwargs) for p in poses])
    camera = Camera(np.tile(INTRINSICS, (len(poses), 1)), pose)
    return Frames(np.zeros((*depth.shape, 3), np.float32), depth, camera)


def at(x, y, yaw_deg):
    return pose_from_yaw(np.array([x, y, 1.25]), np.radians(yaw_deg))


@examples(20)
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0, 360))
def test_a_frame_has_seen_itself(x, y, yaw):
    frame = view([at(x, y, yaw)])
    seen, unseen = seen_masks(frame, frame)
    assert seen.all()
    assert not unseen.any()


def test_turning_shares_exactly_the_overlap():
    # Turning left by 45° with 90° of view: the right half was seen, the left half was not.
    before, after = view([at(0, 0, 0)]), view([at(0, 0, 45)])
    seen, unseen = seen_masks(after, before)
    mid_row = np.asarray(seen[0, SIZE // 2])
    assert mid_row[SIZE // 2 :].all()
    assert not mid_row[: SIZE // 2].any()
    assert (np.asarray(unseen) == ~np.asarray(seen)).all()


def test_turning_away_has_seen_nothing():
    seen, unseen = seen_masks(view([at(0, 0, 180)]), view([at(0, 0, 0)]))
    assert not seen.any()
    assert unseen.all()


def test_a_turn_around_has_seen_the_floor_at_grazing_angles():
    # After looking all around, a step forward shows nothing new in an empty convex room, except
    # what lies under the camera, below every earlier view.
    around = view([at(-1, 0.2, 30 * k) for k in range(12)])
    seen, _ = seen_masks(view([at(-0.75, 0.2, 10)]), around)
    assert np.asarray(seen)[0, : SIZE - 8].mean() > 0.995


def test_what_a_board_hid_is_unseen():
    # From afar the board hides the wall behind it; from a step to the side that wall appears.
    front = view([at(-3, 0, 0)], pillar=0.0)
    side = view([at(-3, 2, -20)], pillar=0.0)
    seen, unseen = (np.asarray(m)[0] for m in seen_masks(side, front))
    pose = side.camera.world_from_camera[0]
    points = pose[:3, 3] + rays(pose) * side.depth_THW[0][..., None]
    on_wall = np.abs(points[..., 0] - 4) < 1e-3
    # The board's shadow on the wall x = 4 cast from (−3, 0): |y| < 0.5 · 7 / 3.
    shadow = on_wall & (np.abs(points[..., 1]) < 0.5 * 7 / 3 - 0.25)
    lit = on_wall & (np.abs(points[..., 1]) > 0.5 * 7 / 3 + 0.25) & (np.abs(points[..., 1]) < 2.8)
    lit &= np.abs(points[..., 2] - 1.3) < 1.2
    assert shadow.sum() > 50
    assert lit.sum() > 50
    assert unseen[shadow].all()
    assert seen[lit].all()


def test_a_moved_wall_is_unseen():
    here = at(0, 0, 0)
    before, after = view([here]), view([here], wall_x=3.7)
    seen, _ = seen_masks(after, before)
    assert not np.asarray(seen)[0, SIZE // 2, SIZE // 2]


def test_pixels_without_depth_are_neither():
    before = view([at(0, 0, 0)])
    depth = before.depth_THW.copy()
    depth[0, :8] = 0
    holes = Frames(before.rgb_THWC, depth, before.camera)
    seen, unseen = seen_masks(holes, before)
    assert not np.asarray(seen | unseen)[0, :8].any()
    assert np.asarray(seen)[0, 8:].all()
    # And a hole in an earlier frame is no evidence of having seen.
    seen, _ = seen_masks(before, holes)
    assert not np.asarray(seen)[0, :7].any()
