"""Eager calls of worlds: compiled once, what they refuse, what becomes NaN under jit, one map."""

import dataclasses
import functools
import gc
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pewm_jax
from pewm_jax import worlds
from pewm_jax.config import UserError
from pewm_jax.diffusion.ddpm import DDPMConfig
from pewm_jax.geometry import cameras
from pewm_jax.planning import imagined
from pewm_jax.types import Camera, Control, WorldState
from pewm_jax.worlds import checks
from pewm_jax.worlds.persist import world as persist
from tests.compiled import counted
from tests.helpers import TINY, random_frames, tiny_model
from tests.worlds.egowm import test_world as test_egowm
from tests.worlds.persist import tiny_persist as persist_world

PEWM = tiny_model(
    clip=dataclasses.replace(TINY.clip, frames=5),
    backbone=dataclasses.replace(TINY.backbone, layers=1),
    noise=DDPMConfig(sample_steps=1),
)
MODELS = {"pewm": PEWM, "egowm": test_egowm.LATER, "persist": persist_world.MODEL}
EVERY_WORLD = pytest.mark.parametrize("kind", MODELS)
KEY = jax.random.key(0)
GOOD, BAD = [0, 1, 2, 0, 0], [0, 1, 7, 0, 0]


@functools.cache
def made(kind):
    """Return a model, weights, and the world after a few frames."""
    model = MODELS[kind]
    shapes = jax.eval_shape(functools.partial(worlds.init, model), KEY)
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        low = 1.0 if jax.tree_util.keystr(path).endswith(("['scale']", "scale_C']")) else 0.0
        return jnp.asarray(low + 0.2 * rng.normal(size=leaf.shape), jnp.float32)

    params = jax.tree_util.tree_map_with_path(draw, shapes)
    return model, params, worlds.start(model, params, seen(kind))


def seen(kind="pewm", seed=0, count=2):
    clip = MODELS[kind].clip
    return random_frames(np.random.default_rng(seed), count, clip.height, clip.width)


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def calls(kind):
    """Return the public calls on a world, each a function of a number that changes its values."""
    model, params, state = made(kind)
    begun = imagined.reset(model, params, seen(kind), KEY)
    moves = np.random.default_rng(1).integers(0, 3, (9, 3, 5))
    found = {
        "start": lambda n: worlds.start(model, params, seen(kind, n)),
        "observe": lambda n: worlds.observe(model, params, state, seen(kind, n)),
        "rollout": lambda n: pewm_jax.rollout(
            model, params, state, [0, n % 3, 1, 2, 0], jax.random.key(n)
        ),
        "imagine": lambda n: worlds.imagine(
            model, params, state, moves[n, 0], jax.random.key(n), remember=False
        ),
        "imagine_many": lambda n: worlds.imagine_many(
            model, params, state, moves[n], jax.random.split(jax.random.key(n), 3)
        ),
        "reset": lambda n: imagined.reset(model, params, seen(kind, n), jax.random.key(n)),
        "step": lambda n: imagined.step(model, params, begun, n % 3, jax.random.key(n)),
    }
    if kind == "persist":
        classes = np.random.default_rng(5).integers(0, 13, (9, 12, 12, 12))

        def start_in(n):
            frames = seen(kind, n)
            origin = frames.camera.world_from_camera[0, :3, 3] - np.float32([3, 3, 3.25])
            return persist.start_in(model, params, frames, classes[n], origin)

        found["start_in"] = start_in
    return found


@pytest.mark.slow(but="pewm")
@EVERY_WORLD
def test_a_second_eager_call_compiles_nothing(kind):
    for name, call in calls(kind).items():
        call(0)
        with counted() as compiled:
            for number in (1, 2):
                call(number)
        assert compiled.programs == 0, name


def test_many_eager_calls_keep_nothing():
    model, params, state = made("pewm")
    programs = (worlds._start, worlds._observe, worlds._imagine, worlds._imagine_many)

    def once(number):
        frames = seen(seed=number)
        worlds.observe(model, params, worlds.start(model, params, frames), frames)
        pewm_jax.rollout(model, params, state, [number % 3] * 5, jax.random.key(number))

    def left():
        gc.collect()
        sizes = [program._cache_size() for program in programs]
        return sizes, len(jax.live_arrays()), len(gc.get_objects())

    for number in range(5):
        once(number)
    before = left()
    for number in range(40):
        once(number)
    after = left()
    assert after[:2] == before[:2]
    assert after[2] - before[2] < 40


@pytest.mark.slow(but="pewm")
@EVERY_WORLD
def test_eager_and_jitted_calls_are_the_same_program(kind):
    model, params, state = made(kind)
    eager = worlds.imagine(model, params, state, GOOD, KEY)
    jitted = jax.jit(worlds.imagine, static_argnums=0)(model, params, state, jnp.array(GOOD), KEY)
    equal(eager, jitted)


@pytest.mark.slow
def test_they_can_be_called_under_vmap_and_grad():
    model, params, state = made("pewm")
    plans = jnp.array([GOOD, GOOD[::-1]])
    many = jax.vmap(lambda plan: worlds.imagine(model, params, state, plan, KEY)[1])(plans)
    _, alone = worlds.imagine(model, params, state, GOOD, KEY)
    np.testing.assert_allclose(many.rgb_THWC[0], alone.rgb_THWC, atol=2e-3)

    def bright(moves):
        return worlds.imagine(model, params, state, moves, KEY, remember=False)[1].rgb_THWC.sum()

    slope = jax.grad(bright)(np.full((4, 3), 0.1, np.float32))
    assert np.isfinite(slope).all()
    assert np.abs(slope).max() > 0


@pytest.mark.slow(only="persist")
@EVERY_WORLD
@pytest.mark.parametrize(
    ("control", "says"),
    [
        ([0, 7, 1], r"the discrete actions \[7\]; the 3 actions are 0 forward"),
        (np.array([-1, 0]), r"the discrete actions \[-1\]"),
        ([[0.1, np.nan, 0.0]], r"actions that are not finite \(nan\)"),
        ([[0.1, 0.0, np.inf]], r"actions that are not finite \(inf\)"),
        ("left", "actions of type str"),
        (None, "actions of type NoneType"),
        ([[0, 1], [2]], "actions of type list"),
        ([True, False], "actions of type bool"),
    ],
)
def test_unknown_actions_are_refused_where_they_are_known(kind, control, says):
    model, params, state = made(kind)
    many = control if isinstance(control, (str, type(None))) else [control, control]
    keys = jnp.stack([KEY, KEY])
    for who, act in (
        ("imagine", lambda: worlds.imagine(model, params, state, control, KEY)),
        ("imagine", lambda: pewm_jax.rollout(model, params, state, control, KEY)),
        ("imagine_many", lambda: worlds.imagine_many(model, params, state, many, keys)),
    ):
        with pytest.raises(UserError, match=says) as caught:
            act()
        assert str(caught.value).startswith(f"{who}() got ")
        assert "\n" not in str(caught.value)


def arguments(who):
    """Return a world function and arguments that it takes, by name, all but the model."""
    _, params, state = made("pewm")
    keys = jnp.stack([KEY] * 2)
    found = {
        "start": (worlds.start, {"frames": seen()}),
        "observe": (worlds.observe, {"state": state, "frames": seen()}),
        "imagine": (worlds.imagine, {"state": state, "control": GOOD, "key": KEY}),
        "imagine_many": (
            worlds.imagine_many,
            {"state": state, "controls": [GOOD, GOOD], "keys": keys},
        ),
    }
    function, given = found[who]
    return function, {"model": MODELS["pewm"], "params": params} | given


@pytest.mark.slow(only="persist")
@pytest.mark.parametrize("who", ["start", "observe", "imagine", "imagine_many"])
@pytest.mark.parametrize(
    ("argument", "value", "says"),
    [
        ("model", None, "a model of type NoneType; give .* pewm_jax.load"),
        ("model", "small", "a model of type str"),
        ("params", None, "params of type NoneType; give .* pewm_jax.load"),
        ("params", [1, 2], "params of type list"),
        ("state", None, "a state of type NoneType"),
        ("state", "persist", r"a state whose frame is \(1, 16, 16, 3\).*16, 24, 3.* of this model"),
        ("key", 0, r"a key of type int; give jax.random.key\(0\)"),
        ("key", None, "a key of type NoneType"),
        ("key", np.zeros(2), "a key of type ndarray"),
        ("key", "two", r"keys of shape \(2,\); give one key"),
        ("keys", 0, r"keys of type int; give jax.random.split\(jax.random.key\(0\), 2\)"),
        ("keys", KEY, r"keys of shape \(\); give 2 keys, one for each candidate"),
        ("keys", "three", r"keys of shape \(3,\); give 2 keys"),
        ("controls", GOOD, r"actions of shape \(5,\); give .* leading axis K"),
        ("controls", np.zeros((2, 3, 3, 3)), r"actions of shape \(2, 3, 3, 3\)"),
        ("controls", 0, r"actions of shape \(\)"),
        ("controls", np.zeros((0, 3), int), r"actions of shape \(0, 3\)"),
        ("controls", "cameras", r"cameras with poses \(2, 4, 4\); give .* leading axis K"),
    ],
)
def test_what_is_no_model_weights_state_or_key_is_refused_in_a_sentence(who, argument, value, says):
    function, given = arguments(who)
    if argument not in given:
        pytest.skip(f"{who} has no such argument")
    made_of = {
        "persist": lambda: made("persist")[2],
        "two": lambda: jnp.stack([KEY] * 2),
        "three": lambda: jnp.stack([KEY] * 3),
        "cameras": lambda: seen().camera,
    }
    wrong = made_of[value]() if isinstance(value, str) and value in made_of else value
    with pytest.raises(UserError, match=says) as caught:
        function(**given | {argument: wrong})
    assert str(caught.value).startswith(f"{who}() got ")
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_keys_of_the_old_kind_are_taken():
    model, params, state = made("pewm")
    old, new = jax.random.PRNGKey(0), KEY
    equal(*(worlds.imagine(model, params, state, GOOD, key) for key in (old, new)))
    many = (worlds.imagine_many(model, params, state, [GOOD], key[None]) for key in (old, new))
    equal(*many)


def test_cameras_to_imagine_are_rigid_and_finite():
    model, params, state = made("pewm")
    camera = seen(count=3).camera
    for change, says in (
        (lambda x: x * np.float32(1.5), "pose that is not rigid in frame 0"),
        (lambda x: np.where(np.arange(3)[:, None, None] == 2, np.nan, x), "finite in frame 2"),
    ):
        wrong = Camera(camera.intrinsics_4, change(camera.world_from_camera))
        for control in (wrong, Control(wrong, np.zeros((3, 3), np.float32))):
            with pytest.raises(UserError, match=says):
                worlds.imagine(model, params, state, control, KEY)


def all_nan(frames):
    pose = frames.camera.world_from_camera
    return all(np.isnan(x).all() for x in (frames.rgb_THWC, frames.depth_THW, pose))


def stays_nan(kind, imagine, control):
    """Imagine an invalid control, then go on from there."""
    model, params, state = made(kind)
    after, frames = imagine(model, params, state, jnp.asarray(control), KEY)
    assert all_nan(frames)
    assert all_nan(after.frame)
    equal(after.map, state.map)
    again, frames = worlds.imagine(model, params, after, GOOD, KEY)
    assert all_nan(frames)
    assert all_nan(again.frame)
    equal(again.map, state.map)
    looked = worlds.observe(model, params, again, seen(kind, 3))
    assert all_nan(looked.frame)
    equal(looked.map, state.map)


@pytest.mark.slow(but="control0")
@pytest.mark.parametrize(
    "control", [BAD, [0, 0, 0, 0, -1], np.float32([[0.1, 0, 0], [0, np.nan, 0]])]
)
def test_under_jit_an_unknown_action_gives_nan_and_leaves_the_memory(control):
    stays_nan("pewm", jax.jit(worlds.imagine, static_argnums=0), control)


@pytest.fixture
def unchecked(monkeypatch):
    """Values are not checked, as under jit; the programs are those of eager calls."""
    monkeypatch.setattr(checks, "check_control", lambda control, who: jnp.asarray(control))


@pytest.mark.slow(only="persist")
@EVERY_WORLD
@pytest.mark.usefixtures("unchecked")
def test_in_every_world_an_unknown_action_gives_nan_and_leaves_the_memory(kind):
    stays_nan(kind, worlds.imagine, BAD)


@pytest.mark.slow(only="persist")
@EVERY_WORLD
@pytest.mark.usefixtures("unchecked")
def test_an_unknown_action_spoils_its_own_candidate_alone(kind):
    model, params, state = made(kind)
    keys = jnp.stack([KEY] * 3)
    clean, expected = worlds.imagine_many(model, params, state, [GOOD] * 3, keys)
    after, frames = worlds.imagine_many(model, params, state, [GOOD, BAD, GOOD], keys)
    for here, wanted in ((frames, expected), (after.frame, clean.frame)):
        first, second, third = (jax.tree.map(lambda x, k=k: x[k], here) for k in range(3))
        assert all_nan(second)
        equal(first, jax.tree.map(lambda x: x[0], wanted))
        equal(third, jax.tree.map(lambda x: x[2], wanted))


@pytest.mark.slow
def test_an_unknown_action_spoils_the_last_frame_of_its_candidate():
    model, params, state = made("pewm")
    many = jax.jit(functools.partial(worlds.imagine_many, last=True), static_argnums=0)
    _, frames = many(model, params, state, jnp.array([GOOD, BAD]), jnp.stack([KEY] * 2))
    first, second = (jax.tree.map(lambda x, k=k: x[k], frames) for k in range(2))
    assert np.isfinite(first.rgb_THWC).all()
    assert all_nan(second)


@pytest.mark.slow(only="persist")
@EVERY_WORLD
def test_a_step_by_an_unknown_action_is_refused_or_shows_no_depth(kind, monkeypatch):
    model, params, _ = made(kind)
    begun = imagined.reset(model, params, seen(kind), KEY)
    with pytest.raises(UserError, match=r"discrete actions \[3\]"):
        imagined.step(model, params, begun, 3, KEY)
    monkeypatch.setattr(checks, "check_control", lambda control, who: jnp.asarray(control))
    after, shown = imagined.step(model, params, begun, 3, KEY)
    assert np.isnan(shown["depth"]).all()
    assert np.isnan(shown["pose"]).all()
    assert all_nan(after.world.frame)
    equal(after.world.map, begun.world.map)


def posed(frames, pose):
    return dataclasses.replace(
        frames, camera=dataclasses.replace(frames.camera, world_from_camera=pose)
    )


def at_last(x, value):
    """Return an array whose last frame has one other value, in its corner."""
    out = np.array(x)
    out[(-1, *(0,) * (out.ndim - 1))] = value
    return out


def with_pose(change):
    def changed(frames):
        pose = np.array(frames.camera.world_from_camera)
        pose[-1] = change(pose[-1])
        return posed(frames, pose)

    return changed


def with_intrinsics(*numbers):
    def changed(frames):
        intrinsics = np.array(frames.camera.intrinsics_4)
        intrinsics[-1] = numbers
        return dataclasses.replace(
            frames, camera=Camera(intrinsics, frames.camera.world_from_camera)
        )

    return changed


def replaced(**changes):
    return lambda frames: dataclasses.replace(
        frames, **{name: change(getattr(frames, name)) for name, change in changes.items()}
    )


def signal(rgb):
    return rgb / np.float32(127.5) - 1


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0]).astype(np.float32)
REFUSED = {
    "bytes as floats": (
        replaced(rgb_THWC=lambda x: x.astype(np.float32)),
        "float32 colours from .* in frame 0; give uint8 in",
    ),
    "one bright pixel": (
        replaced(rgb_THWC=lambda x: at_last(signal(x), 1.5)),
        "to 1.5 in frame 1; give uint8 in",
    ),
    "NaN colours": (replaced(rgb_THWC=lambda x: at_last(signal(x), np.nan)), "nan in frame 1"),
    "wide integers": (
        replaced(rgb_THWC=lambda x: x.astype(np.uint16) * 257),
        "uint16 colours from .* in frame 0",
    ),
    "bool colours": (replaced(rgb_THWC=lambda x: x > 9), "colours of type bool"),
    "millimetres": (
        replaced(depth_THW=lambda x: (x * 1000).astype(np.uint16)),
        "depth as uint16 integers.* depth_scale=0.001",
    ),
    "signed millimetres": (
        replaced(depth_THW=lambda x: (x * 1000).astype(np.int32)),
        "depth as int32 integers",
    ),
    "bool depth": (replaced(depth_THW=lambda x: x > 1), "depth of type bool"),
    "NaN depth": (replaced(depth_THW=lambda x: at_last(x, np.nan)), "nan in frame 1; give finite"),
    "infinite depth": (replaced(depth_THW=lambda x: at_last(x, np.inf)), "to inf in frame 1"),
    "negative depth": (replaced(depth_THW=lambda x: at_last(x, -1)), "from -1 to .* in frame 1"),
    "NaN pose": (with_pose(lambda p: p * np.nan), "pose that is not finite in frame 1"),
    "scaled pose": (
        with_pose(lambda p: p * np.float32([[1.01, 1.01, 1.01, 1]])),
        "not rigid in frame 1",
    ),
    "mirrored pose": (with_pose(lambda p: p @ MIRROR), "not rigid in frame 1.*determinant is -1"),
    "transposed pose": (with_pose(lambda p: p.T), "not rigid in frame 1.*last row is"),
    "zero pose": (with_pose(np.zeros_like), "not rigid in frame 1"),
    "no focal length": (with_intrinsics(0, 9, 12, 8), r"\(0, 9, 12, 8\) in frame 1; focal"),
    "NaN intrinsics": (with_intrinsics(np.nan, 9, 12, 8), "in frame 1; focal"),
    "larger images": (with_intrinsics(525, 525, 319.5, 239.5), "not of the 24 × 16 images given"),
    "images twice as large": (with_intrinsics(24, 24, 24, 16), "not of the 24 × 16 images"),
    "images half as large": (with_intrinsics(6, 6, 6, 4), "not of the 24 × 16 images"),
    "shares of the image": (with_intrinsics(0.5, 0.5, 0.5, 0.5), "not of the 24 × 16 images"),
    "no frames": (lambda frames: None, "frames of type NoneType"),
    "no camera": (replaced(camera=lambda x: None), "frames of type Frames with|pewm_jax.Camera"),
    "no depth": (replaced(depth_THW=lambda x: None), "frames without depth"),
    "words": (replaced(depth_THW=lambda x: [["far"]]), "frames of type list"),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("on_device", [False, True])
def test_frames_of_no_camera_are_refused_in_a_sentence(name, on_device):
    change, says = REFUSED[name]
    model, params, state = made("pewm")
    wrong = change(seen())
    if on_device:
        wrong = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, wrong)
    for who, act in (
        ("start", lambda: worlds.start(model, params, wrong)),
        ("observe", lambda: worlds.observe(model, params, state, wrong)),
        ("start", lambda: imagined.reset(model, params, wrong, KEY)),
    ):
        with pytest.raises(UserError, match=says) as caught:
            act()
        told = str(caught.value)
        assert told.startswith(f"{who}() got ")
        assert told.endswith(".")
        assert "\n" not in told


@pytest.mark.slow(only="persist")
@pytest.mark.parametrize("kind", ["egowm", "persist"])
@pytest.mark.parametrize("name", ["bytes as floats", "millimetres", "NaN pose", "NaN depth"])
def test_every_world_refuses_them(kind, name):
    change, says = REFUSED[name]
    model, params, state = made(kind)
    wrong = change(seen(kind))
    for act in (
        lambda: worlds.start(model, params, wrong),
        lambda: worlds.observe(model, params, state, wrong),
    ):
        with pytest.raises(UserError, match=says):
            act()
    if kind == "persist":
        with pytest.raises(UserError, match=says):
            persist.start_in(model, params, wrong, np.zeros((12, 12, 12), int), np.zeros(3))


def rounded(frames):
    """Poses as they are read from text, and colours a little off."""
    pose = np.round(frames.camera.world_from_camera, 4)
    return posed(replaced(rgb_THWC=lambda x: signal(x) * np.float32(1 + 1e-6))(frames), pose)


def turned_far(frames):
    """Poses after a thousand rotations in float32."""
    turn = cameras.pose_from_yaw(np.zeros(3), 0.1)
    small = np.array(turn @ np.linalg.inv(cameras.pose_from_yaw(np.zeros(3), 0.0)), np.float32)
    pose = np.array(frames.camera.world_from_camera, np.float32)
    for _ in range(1000):
        pose = small @ pose
    return posed(frames, pose)


@pytest.mark.parametrize(
    "change",
    [
        lambda frames: frames,
        rounded,
        turned_far,
        replaced(rgb_THWC=lambda x: x.astype(np.int64)),
        replaced(rgb_THWC=lambda x: signal(x).astype(np.float64)),
        replaced(rgb_THWC=lambda x: signal(x).astype(np.float16)),
        replaced(rgb_THWC=lambda x: signal(x).astype(jnp.bfloat16)),
        replaced(depth_THW=lambda x: x.astype(np.float16)),
        replaced(depth_THW=np.zeros_like),
        with_pose(lambda p: p.astype(np.float16)),
        with_intrinsics(12, 12, 3, 9),  # cropped at the left
        with_intrinsics(60, 11, 11.5, 7.5),
    ],
)
def test_frames_of_a_camera_are_taken(change):
    model, params, _ = made("pewm")
    frames = change(seen())
    state = worlds.start(model, params, frames)
    assert state.frame.rgb_THWC.dtype == state.frame.depth_THW.dtype == jnp.float32
    assert np.isfinite(state.frame.rgb_THWC).all()
    worlds.observe(model, params, state, jax.tree.map(jnp.asarray, frames))


@pytest.mark.parametrize("jitted", [False, True])
def test_integer_depth_is_taken_with_its_scale(jitted):
    model, params, state = made("pewm")
    start, observe = worlds.start, worlds.observe
    if jitted:
        start, observe = (jax.jit(act, static_argnums=0) for act in (start, observe))
    frames = seen()
    millimetres = np.round(frames.depth_THW * 1000).astype(np.uint16)
    millimetres[0, 0, :2] = 0, 65535
    metres = np.where(millimetres == 65535, 0, millimetres) * np.float32(0.001)
    given, expected = (
        dataclasses.replace(frames, depth_THW=depth) for depth in (millimetres, metres)
    )
    equal(start(model, params, given, depth_scale=0.001), start(model, params, expected))
    equal(
        observe(model, params, state, given, depth_scale=0.001),
        observe(model, params, state, expected),
    )
    with pytest.raises(UserError, match="depth as uint16 integers"):
        start(model, params, given)
    for wrong in (0, -1.0, np.nan, "mm"):
        with pytest.raises(UserError, match="got depth_scale"):
            worlds.start(model, params, given, depth_scale=wrong)


@pytest.mark.slow(but=("pewm", "egowm"))
@EVERY_WORLD
def test_candidates_and_what_is_not_remembered_share_the_map_of_the_state(kind):
    model, params, state = made(kind)
    many, _ = worlds.imagine_many(model, params, state, [GOOD] * 3, jnp.stack([KEY] * 3))
    one, _ = worlds.imagine(model, params, state, GOOD, KEY, remember=False)
    for after in (many, one):
        assert after.map is state.map


def shapes_within(jaxpr):
    """Yield the shapes of everything that a program computes."""
    for equation in jaxpr.eqns:
        yield from (getattr(out.aval, "shape", ()) for out in equation.outvars)
        for value in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from shapes_within(inner)


@pytest.mark.slow
def test_sixty_four_candidates_hold_one_map():
    """Neither by ``imagine_many`` nor by ``jax.vmap`` with the state's axis None is it copied."""
    model, params, state = made("pewm")
    actions, keys = jnp.zeros((64, 4), jnp.int32), jnp.stack([KEY] * 64)
    features = state.map.features_VF.shape

    def candidates(params, state, actions, keys):
        return worlds.imagine_many(model, params, state, actions, keys)

    one = functools.partial(worlds.imagine, model, remember=False)
    shared = jax.vmap(one, (None, None, 0, 0), (WorldState(0, None), 0))
    for act in (candidates, shared):
        made_of = jax.make_jaxpr(act)(params, state, actions, keys)
        assert (64, *features) not in set(shapes_within(made_of.jaxpr))
        after, frames = jax.eval_shape(act, params, state, actions, keys)
        assert after.map.features_VF.shape == features
        assert frames.depth_THW.shape[:2] == (64, 4)
    copies = jax.vmap(functools.partial(worlds.imagine, model), (None, None, 0, 0))
    after, _ = jax.eval_shape(copies, params, state, actions, keys)
    assert after.map.features_VF.shape == (64, *features), "each remembers what it imagined"


@pytest.mark.slow
def test_the_tutorial_compares_many_futures(capsys):
    """Its two blocks run, and give the same; neither copies the map."""
    page = (Path(__file__).parents[2] / "docs" / "tutorial.md").read_text()
    section = page.split("## Imagine many candidates\n")[1]
    first, second = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    names = dict(zip(("config", "params", "state"), made("pewm"), strict=True))
    names |= {"jax": jax, "pewm_jax": pewm_jax}
    exec(first, names)
    assert capsys.readouterr().out == "(3, 3, 16, 24, 3)\n"
    expected = names["clips"].rgb_THWC
    exec(second, names)
    np.testing.assert_allclose(names["clips"].rgb_THWC, expected, atol=2e-3)
    assert names["after"].map.features_VF.shape == names["state"].map.features_VF.shape
