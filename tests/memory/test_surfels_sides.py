"""From behind a surfel hides and is not shown; what was imagined gives way to what was observed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.memory import rendering
from pewm_jax.memory import rendering as views
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.types import Camera, Frames, MemoryReadout, View
from tests.helpers import random_camera, tiny_model

SIZE = (16, 24)
FINE = SurfelConfig(cell_m=(0.05,) * 3, cells=(512,) * 3, capacity=4096, tokens=8, footprint=5)
render = jax.jit(lambda model, *args: model.memory.render(model, *args), static_argnums=(0, 3, 4))
look = jax.jit(
    lambda model, memory, frames, observed: model.memory.insert(
        model, {}, memory, frames, observed=observed
    ),
    static_argnums=(0, 3),
)


def camera_at(x, yaw):
    """A camera at (x, 0, 0) that looks along +x turned by yaw."""
    one = random_camera(np.random.default_rng(0), 1, upright=True)
    pose = pose_from_yaw((x, 0.0, 0.0), yaw, 0.0)[None]
    return jax.tree.map(jnp.asarray, Camera(one.intrinsics_4, pose))


def wall(depth, colour, camera):
    """What a camera sees that has a wall of one colour before it."""
    rgb = np.full((1, *SIZE, 3), colour, np.float32)
    return Frames(rgb, np.full((1, *SIZE), depth, np.float32), camera)


def remember(config, *seen):
    """A memory of frames, each ``(frames, observed)``."""
    model = tiny_model(memory=config)
    memory = model.memory.empty(model, jnp.zeros(3))
    for frames, observed in seen:
        memory = look(model, memory, frames, observed)
    return model, memory


@pytest.mark.parametrize("keep", ["mean", "newest"])
def test_a_wall_seen_from_one_side_is_hidden_and_hides_from_the_other(keep):
    config = FINE if keep == "mean" else SurfelConfig(**{**vars(FINE), "keep": keep})
    here, there, beyond = camera_at(0.0, 0.0), camera_at(4.0, np.pi), camera_at(-2.0, np.pi)
    seen = (wall(2.0, 0.5, here), True), (wall(3.0, -0.5, beyond), True)
    model, memory = remember(config, *seen)
    front = render(model, memory, here, *SIZE)
    assert np.asarray(front.seen_THW).all()
    np.testing.assert_allclose(front.features_THWF[..., :3], 0.5, atol=1e-5)
    back = render(model, memory, there, *SIZE)
    middle = np.s_[:, 4:12, 6:18]
    assert not np.asarray(back.seen_THW)[middle].any()
    assert not np.asarray(back.features_THWF)[middle].any()
    np.testing.assert_allclose(np.asarray(back.depth_THW)[middle], 2.0, atol=0.1)
    both, same = remember(SurfelConfig(**{**vars(config), "sides": False}), *seen)
    shown = render(both, same, there, *SIZE)
    assert np.asarray(shown.seen_THW)[middle].all()
    np.testing.assert_allclose(np.asarray(shown.features_THWF)[middle], 0.5, atol=1e-5)


def test_a_cell_seen_from_both_sides_is_shown_to_both():
    here, there = camera_at(0.0, 0.0), camera_at(4.0, np.pi)
    model, memory = remember(FINE, (wall(2.0, 0.5, here), True), (wall(2.0, 0.1, there), True))
    for camera in (here, there):
        assert np.asarray(render(model, memory, camera, *SIZE).seen_THW)[:, 4:12, 6:18].all()


def test_what_was_imagined_is_shown_where_nothing_observed_is():
    here, turned = camera_at(0.0, 0.0), camera_at(0.0, np.pi)
    observed = wall(3.0, 0.5, here), True
    false, new = (wall(1.5, -0.5, here), False), (wall(2.0, -0.5, turned), False)
    model, memory = remember(FINE, observed, false, new)
    view = render(model, memory, here, *SIZE)
    np.testing.assert_allclose(view.features_THWF, 0.5, atol=1e-5)
    np.testing.assert_allclose(view.depth_THW, 3.0, atol=0.05)
    behind = render(model, memory, turned, *SIZE)
    assert np.asarray(behind.seen_THW).all()
    np.testing.assert_allclose(behind.features_THWF, -0.5, atol=1e-5)
    mixed, same = remember(SurfelConfig(**{**vars(FINE), "observed_first": False}), observed, false)
    np.testing.assert_allclose(render(mixed, same, here, *SIZE).features_THWF, -0.5, atol=1e-5)


def test_with_nothing_imagined_the_order_changes_no_bit():
    here = camera_at(0.0, 0.3)
    pictures = []
    for first in (True, False):
        config = SurfelConfig(**{**vars(FINE), "observed_first": first})
        model, memory = remember(config, (wall(2.0, 0.5, camera_at(0.0, 0.0)), True))
        pictures.append(render(model, memory, here, *SIZE))
    for a, b in zip(*map(jax.tree.leaves, pictures), strict=True):
        np.testing.assert_array_equal(a, b)


def test_one_view_over_another_shows_the_first_where_it_shows_anything():
    rng = np.random.default_rng(0)

    def view():
        seen = rng.random((2, 3, 4)) < 0.5
        hides = rng.random((2, 3, 4)) < 0.5
        depth = rng.uniform(1, 5, (2, 3, 4)) * (seen | hides)
        return rendering.View(rng.normal(size=(2, 3, 4, 3)) * seen[..., None], depth, seen)

    front, back = view(), view()
    made = jax.device_get(views.over(front, back))
    for place in np.ndindex(2, 3, 4):
        shows = front if front.seen_THW[place] or not back.seen_THW[place] else back
        np.testing.assert_array_equal(
            made.features_THWF[place], np.float32(shows.features_THWF[place])
        )
        assert made.seen_THW[place] == (front.seen_THW[place] or back.seen_THW[place])
        depth = shows.depth_THW[place] or back.depth_THW[place]
        assert made.depth_THW[place] == np.float32(depth)


def test_what_the_memory_showed_is_not_remembered_again_as_imagined():
    frames = wall(2.0, 0.5, camera_at(0.0, 0.0))
    two = jax.tree.map(lambda x: jnp.concatenate([x, x]), frames)
    seen = np.zeros((1, 3, *SIZE), bool)
    seen[0, 2, :, :5] = True
    shown = MemoryReadout(view=View(np.zeros((1, 3, *SIZE, 3)), np.ones(seen.shape), seen))
    model = tiny_model(memory=FINE)
    new = np.asarray(model.new_surfaces(two, shown).depth_THW)
    np.testing.assert_array_equal(new, np.where(seen[0, 1:], 0, 2).astype(np.float32))
    again = tiny_model(memory=SurfelConfig(**{**vars(FINE), "imagined_again": True}))
    for whole, readout in (
        (model, None),
        (model, MemoryReadout()),
        (again, shown),
        (tiny_model(), shown),
    ):
        assert whole.new_surfaces(two, readout) is two
