"""Planning with imagination and with the true renderer: candidates, costs, control, ranking."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from pewm_jax import presets, worlds
from pewm_jax.codecs.learned import LearnedCodecConfig
from pewm_jax.config import ConfigError, UserError
from pewm_jax.data.navigation import is_free, navigable, sample_free
from pewm_jax.data.render import render
from pewm_jax.data.scenes import house
from pewm_jax.encoders.simple import PatchColoursConfig
from pewm_jax.geometry.actions import discrete_table, rotation_z
from pewm_jax.geometry.cameras import intrinsics_from_fov, pose_from_yaw
from pewm_jax.memory.surfels import SurfelConfig
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.planning import candidates, costs
from pewm_jax.planning.candidates import CandidateCost, ImaginedRollout, rank, rank_by
from pewm_jax.planning.mpc import mpc, simulator_predictor, world_predictor
from pewm_jax.planning.plan import plan
from pewm_jax.planning.settings import CEM, PlanConfig, RandomShooting
from pewm_jax.readers.render import RenderConfig
from pewm_jax.types import Camera, Frames
from pewm_jax.worlds.pewm import candidates as pewm_views
from tests.compiled import counted
from tests.helpers import random_frames, random_world

CONFIG = presets.load("tiny")
KEY = jax.random.key(0)
PLANS = np.random.default_rng(1).integers(0, 3, (5, 6))
"""Of 6 actions; a clip imagines 4."""
SHORT_PLANS = PLANS[:, :3]
BATCH = 2


def gated():
    """A tiny model of the kind that ships: surfels, rendered, and a gate at the pixels."""
    model = CONFIG.model
    codec = LearnedCodecConfig(4, 8, 8, 1, 1, gate=8)
    memory = SurfelConfig(
        capacity=4096, encoder=PatchColoursConfig(), reader=RenderConfig(picture_width=16)
    )
    backbone = dataclasses.replace(model.backbone, layers=1)
    return dataclasses.replace(model, backbone=backbone, codec=codec, memory=memory)


@functools.cache
def world(kind):
    memory = dataclasses.replace(CONFIG.model.memory, capacity=2048)
    model = dataclasses.replace(CONFIG.model, memory=memory) if kind == "tiny" else gated()
    params = random_world(model, scale=0.1)
    frames = random_frames(np.random.default_rng(0), 3, 16, 16)
    return model, params, jax.jit(worlds.start, static_argnums=0)(model, params, frames)


@functools.cache
def imagined():
    """The last frames of ``SHORT_PLANS``, in batches, and how often that was compiled."""
    model, params, state = world("tiny")
    before = candidates._imagined._cache_size()
    whole = ImaginedRollout(model, params, state, KEY, batch=BATCH)(SHORT_PLANS)
    return whole, candidates._imagined._cache_size() - before


def equal(a, b, atol=0.0):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


@pytest.mark.slow
def test_batches_are_the_loop_after_several_clips_of_a_rendered_memory():
    model, params, state = world("surfels")
    rollout = ImaginedRollout(model, params, state, KEY, batch=3)
    last = rollout(PLANS)
    imagine = jax.jit(functools.partial(worlds.imagine, model, remember=False))
    for number, actions in enumerate(PLANS):
        one = jax.tree.map(lambda x: x[-1:], imagine(params, state, actions, KEY)[1])
        equal(jax.tree.map(lambda x, k=number: x[k], last), one, atol=2e-4)
    assert np.abs(last.rgb_THWC[0] - last.rgb_THWC[1]).max() > 0.01, "candidates differ"
    kept, all_ = rollout.state.map, state.map
    assert len(kept.cell_V) < len(all_.cell_V), "free slots are left out"
    np.testing.assert_array_equal(kept.cell_V, all_.cell_V[: len(kept.cell_V)])
    assert int(kept.occupied) == int(all_.occupied) > 0


@pytest.mark.slow
def test_a_camera_is_rendered_once_whatever_came_before(monkeypatch):
    model, params, state = world("surfels")
    turns = np.array([[1, 2, 0], [2, 1, 0], [0, 0, 0], [0, 1, 2]])
    one, other = (ImaginedRollout(model, params, state, KEY, batch=4) for _ in range(2))
    first = one(turns)
    assert (
        one._views.rendered == 7
    )  # here, left, right; one, two, three steps ahead; and left there
    again = one(turns[::-1])
    assert one._views.rendered == 7
    equal(jax.tree.map(lambda x: x[::-1], again), first)
    monkeypatch.setattr(pewm_views, "MOST", 1)  # no room: all are forgotten between batches
    other(turns[2:])
    equal(other(turns), first)
    keys = jax.numpy.stack([KEY] * 4)
    many = jax.jit(functools.partial(worlds.imagine_many, last=True), static_argnums=0)
    equal(many(model, params, one.state, turns, keys)[1], first, atol=2e-4)


@pytest.mark.slow
def test_the_size_of_a_batch_changes_nothing_and_compiles_once():
    model, params, state = world("tiny")
    (whole, compiled), rollout = imagined(), ImaginedRollout(model, params, state, KEY, batch=BATCH)
    assert compiled == 1
    before = candidates._imagined._cache_size()
    for part in (SHORT_PLANS[:1], SHORT_PLANS[:4]):
        some, expected = rollout(part), whole.rgb_THWC[: len(part)]
        np.testing.assert_allclose(some.rgb_THWC, expected, atol=1e-6)
    assert candidates._imagined._cache_size() == before
    with pytest.raises(UserError, match="candidates of shape"):
        rollout(PLANS[0])
    with pytest.raises(ConfigError, match="batch is 0"):
        ImaginedRollout(model, params, state, KEY, batch=0)


def test_a_planner_holds_one_map_however_many_its_candidates():
    model, params, state = world("tiny")
    features, held = state.map.features_VF, []

    def bytes_of_maps():
        """Count every copy that is alive, those of candidates with a leading axis included."""
        shapes = (x.shape for x in jax.live_arrays() if x.shape[-2:] == features.shape)
        return sum(int(np.prod(shape)) for shape in shapes)

    def cost(frames, goal):
        held.append(bytes_of_maps())
        assert frames.depth_THW.shape[0] == 6
        return np.arange(6.0)

    before = bytes_of_maps()
    rollout = ImaginedRollout(model, params, state, KEY, batch=BATCH)
    assert rollout.state.map.features_VF is features
    rank(model, params, state, np.resize(SHORT_PLANS, (6, 3)), cost, None, KEY, batch=BATCH)
    config = PlanConfig(horizon=3, candidates=6, elites=2, rounds=2)
    plan(CEM(), config, lambda actions, _: cost(rollout(actions), None), KEY, progress=False)
    assert held == [before] * 3


def test_planning_again_compiles_nothing():
    """Neither a plan nor a ranking, of other candidates from another key."""
    model, params, state = world("surfels")
    goal = jax.tree.map(lambda x: x[:1], random_frames(np.random.default_rng(1), 1, 16, 16))
    config = PlanConfig(horizon=3, candidates=5, elites=2, rounds=2)
    rng = np.random.default_rng(0)

    def once(number):
        key = jax.random.key(number)
        rank(model, params, state, rng.integers(0, 3, (5, 3)), costs.Pixels(), goal, key)
        judged = CandidateCost(ImaginedRollout(model, params, state, key), costs.Pixels(), goal)
        return plan(CEM(), config, judged, key, progress=False)

    once(0)
    with counted() as compiled:
        once(1)
        once(2)
    assert compiled.programs == 0


@pytest.mark.parametrize("wrong", [7, -1])
def test_unknown_actions_are_not_ranked(wrong):
    model, params, state = world("tiny")
    proposals = np.array([[0, 1, 2], [0, wrong, 0]])
    with pytest.raises(UserError, match=rf"discrete actions \[{wrong}\]; the 3 actions are"):
        rank(model, params, state, proposals, costs.Pixels(), None, KEY)
    with pytest.raises(UserError, match="not finite"):
        rank(model, params, state, np.full((2, 3, 3), np.nan), costs.Pixels(), None, KEY)


def test_what_was_judged_is_not_imagined_again():
    seen = []

    def rollout(actions):
        seen.append(len(actions))
        return of_colour(np.asarray(actions)[:, -1] / 2)

    judged = CandidateCost(rollout, costs.Pixels(), of_colour([0.0], goal=True))
    actions = np.array([[0, 1], [1, 0], [0, 1]])
    first = judged(actions)
    np.testing.assert_allclose(first, [0.0625, 0, 0.0625])
    np.testing.assert_array_equal(judged(np.array([[2, 2], [1, 0], [0, 1]])), [0.25, 0, first[0]])
    assert (seen, judged.asked, judged.rolled_out) == ([2, 1], 6, 3)


def of_colour(values, goal=False, side=40, depth=2.0):
    """Frames (K, 1) of one colour each, or a goal (1,)."""
    values = np.asarray(values, np.float32)
    shape = (len(values),) if goal else (len(values), 1)
    rgb = np.broadcast_to(values.reshape(*shape, 1, 1, 1), (*shape, side, side, 3))
    poses = np.broadcast_to(np.eye(4, dtype=np.float32), (*shape, 4, 4))
    camera = Camera(np.ones((*shape, 4), np.float32), poses)
    return Frames(rgb, np.full((*shape, side, side), depth, np.float32), camera)


def test_costs_by_hand():
    goal, frames = of_colour([0.0], goal=True), of_colour([1.0, 0.0])
    np.testing.assert_allclose(costs.Pixels()(frames, goal), [0.25, 0])
    deep = dataclasses.replace(frames, depth_THW=frames.depth_THW * np.e)
    both = costs.with_depth(costs.Pixels(), 0.5)
    np.testing.assert_allclose(both(deep, goal), [0.75, 0.5], rtol=1e-6)
    holes = np.array(deep.depth_THW)
    holes[0, 0, :20], holes[1] = 0, 0
    deep = dataclasses.replace(deep, depth_THW=holes)
    np.testing.assert_allclose(costs.Depth()(deep, goal), [1, np.nan], rtol=1e-6)
    two = jax.tree.map(lambda *x: np.concatenate(x, 1), frames, of_colour([0.0, 1.0]))
    weighted = costs.Pixels(weights=(3.0, 1.0))(two, goal)
    np.testing.assert_allclose(weighted, [0.1875, 0.0625])
    features = costs.Features(PatchColoursConfig(), {})(frames, goal)
    np.testing.assert_allclose(features, [1, 0], atol=1e-6)
    model, params, _ = world("tiny")
    np.testing.assert_allclose(costs.Features(model, params)(frames, goal), features, atol=1e-6)
    moved = of_colour([0.0])
    pose = np.array(moved.camera.world_from_camera)
    pose[..., :3, 3] = 3, 4, 0
    moved = dataclasses.replace(moved, camera=Camera(moved.camera.intrinsics_4, pose))
    np.testing.assert_allclose(costs.Distance(costs.straight)(moved, goal), [5])


def test_lpips_is_a_cost_and_absent_weights_are_refused(monkeypatch, tmp_path):
    params = lpips.init("alex", KEY)
    cost = costs.Perceptual("alex", params)
    frames, goal = of_colour([0.1, 0.5]), of_colour([0.1], goal=True)
    same, other = np.asarray(cost(frames, goal))
    assert same < 1e-6
    assert other > 1e-3
    with pytest.raises(UserError, match="too small for LPIPS"):
        cost(of_colour([0.0], side=16), of_colour([0.0], goal=True, side=16))
    with pytest.raises(UserError, match=r"absent\.pth"):
        costs.perceptual(tmp_path / "absent.pth")
    monkeypatch.setattr(lpips_weights, "installed", lambda net: None)
    with pytest.raises(UserError, match="needs weights, and none are installed"):
        costs.perceptual()


def test_goals_and_weights_that_do_not_fit_are_refused():
    frames, goal = of_colour([0.0]), of_colour([0.0], goal=True)
    with pytest.raises(UserError, match="of one size"):
        costs.Pixels()(frames, of_colour([0.0], goal=True, side=8))
    with pytest.raises(UserError, match="2 weights and there are 1 frames"):
        costs.Pixels(weights=(1.0, 1.0))(frames, goal)
    with pytest.raises(ConfigError, match="not all 0"):
        costs.Pixels(weights=(0.0,))


def test_a_model_that_imagines_nan_is_refused_in_a_sentence():
    model, params, state = world("tiny")
    broken = jax.tree.map(lambda x: x * np.nan, params)
    goal = state.frame
    judged = CandidateCost(
        ImaginedRollout(model, broken, state, KEY, batch=BATCH), costs.Pixels(), goal
    )
    config = PlanConfig(horizon=3, candidates=4, elites=2, rounds=2)
    with pytest.raises(UserError, match="in round 0 the cost of 4 of 4 candidates"):
        plan(CEM(), config, judged, KEY, progress=False)
    with pytest.raises(UserError, match="the cost of 5 of 5 candidates"):
        rank(model, broken, state, SHORT_PLANS, costs.Pixels(), goal, KEY, batch=BATCH)


def test_proposals_are_ranked_by_what_is_imagined():
    model, params, state = world("tiny")
    goal = jax.tree.map(lambda x: x[2], imagined()[0])
    found = rank(model, params, state, SHORT_PLANS, costs.Pixels(), goal, KEY, batch=BATCH)
    assert found.order_K[0] == 2
    assert found.costs_K[2] < 1e-6
    assert (np.diff(found.costs_K[found.order_K]) >= 0).all()
    by_hand = rank_by(lambda _: imagined()[0], SHORT_PLANS, costs.Pixels(), goal)
    np.testing.assert_array_equal(by_hand.order_K, found.order_K)
    np.testing.assert_allclose(by_hand.costs_K, found.costs_K, atol=1e-4)


SHORT = PlanConfig(horizon=3, receding_horizon=2, candidates=5, elites=2, rounds=2)


def walk(limit=None):
    """Surroundings of random pictures: each step shows the next, or interrupts."""
    taken = []

    def step(action):
        taken.append(action)
        if limit is not None and len(taken) > limit:
            raise KeyboardInterrupt
        return random_frames(np.random.default_rng(len(taken)), 1, 16, 16), len(taken) == 5

    return step, taken


def test_an_agent_remembers_what_it_really_sees_and_can_be_interrupted(tmp_path):
    model, params, state = world("tiny")
    mind, seen = (
        world_predictor(model, params, batch=BATCH),
        random_frames(np.random.default_rng(0), 3, 16, 16),
    )
    goal = jax.tree.map(lambda x: x[2], imagined()[0])

    def act(step, **options):
        return mpc(
            mind, step, seen, goal, costs.Pixels(), CEM(), SHORT, KEY, progress=False, **options
        )

    step, taken = walk()
    done = act(step, budget=9)
    np.testing.assert_array_equal(done.actions, taken)
    assert done.reached
    assert len(taken) == 5, "it stops at the goal, in the middle of its third plan"
    assert len(done.plans) == len(done.costs) == 3
    assert done.frames.rgb_THWC.shape == (5, 16, 16, 3)
    assert int(done.state.map.occupied) > int(state.map.occupied), "real frames are remembered"
    np.testing.assert_allclose(
        done.state.frame.rgb_THWC[0] * 127.5 + 127.5, done.frames.rgb_THWC[-1], atol=1e-3
    )
    step, _ = walk(limit=3)
    with pytest.raises(KeyboardInterrupt):
        act(step, budget=9, folder=tmp_path, about="truth, straight")
    step, _ = walk()
    with pytest.raises(UserError, match="belongs to a search with other inputs"):
        act(step, budget=9, folder=tmp_path, about="truth, something else")
    with pytest.raises(UserError, match="pass about="):
        act(step, budget=9, folder=tmp_path)
    resumed = act(step, budget=9, folder=tmp_path, about="truth, straight")
    equal(resumed.actions, done.actions)
    equal(resumed.costs, done.costs)
    assert len(act(walk()[0], budget=3).actions) == 3
    with pytest.raises(UserError, match="budget is 0"):
        act(step, budget=0)


SIDE, HEIGHT = 12, 1.2
TABLE = discrete_table(CONFIG.model.actions)


@functools.cache
def home():
    scene = house(3)
    return scene, navigable(scene)


def truly(pose_44, actions_KN):
    """Poses (K, 4, 4) after actions, forward steps into what is not free left out."""
    _, grid = home()
    pose = np.asarray(pose_44)
    begin = np.arctan2(pose[1, 2], pose[0, 2])
    xy, turn = np.repeat(pose[None, :2, 3], len(actions_KN), 0), np.zeros(len(actions_KN))
    for dx, _, dyaw in TABLE[np.asarray(actions_KN)].transpose(1, 2, 0):
        yaw = begin + turn
        after = xy + dx[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
        between = xy + np.linspace(0, 1, 6)[1:, None, None] * (after - xy)
        xy = np.where(is_free(grid, between).all(0)[:, None], after, xy)
        turn = turn + dyaw
    ends = np.repeat(pose[None], len(actions_KN), 0)
    ends[:, :3, :3] = np.asarray(rotation_z(turn)) @ pose[:3, :3]
    ends[:, :2, 3] = xy
    return ends


def seen_from(poses_K44):
    """The true frames, (K, 1)."""
    intrinsics = np.tile(intrinsics_from_fov(SIDE, SIDE, 90.0), (len(poses_K44), 1))
    camera = Camera(intrinsics, poses_K44)
    made = render(home()[0], camera, SIDE, SIDE)
    frames = Frames(made.rgb_THWC, made.depth_THW, camera)
    return jax.tree.map(lambda x: x[:, None], frames)


def simulator(present):
    """A rollout by the true renderer from the present frame."""
    return lambda actions: seen_from(truly(present.camera.world_from_camera[-1], actions))


@pytest.mark.slow
@pytest.mark.parametrize("cost", [costs.Distance(costs.straight), costs.Pixels()])
def test_with_the_true_renderer_goals_within_the_horizon_are_reached(cost):
    rng, config = np.random.default_rng(0), PlanConfig(horizon=6, rounds=8)
    _, grid = home()
    reached, by_chance = [], []
    for number in range(20):
        start = pose_from_yaw((*sample_free(grid, rng, 1)[0], HEIGHT), rng.uniform(-3, 3))
        goal = truly(start, rng.integers(0, 3, (1, 6)))
        present, wanted = (jax.tree.map(lambda x: x[0], seen_from(x)) for x in (start[None], goal))
        judged = CandidateCost(simulator(present), cost, wanted)
        found = plan(CEM(), config, judged, jax.random.key(number), progress=False)
        shot = rng.integers(0, 3, (1, 6))
        for actions, count in ((np.asarray(found.actions)[None], reached), (shot, by_chance)):
            end = truly(start, actions)
            count.append(float(costs.straight(end, goal[0])[0]) < 0.1)
    assert np.mean(reached) >= 0.95
    assert np.mean(by_chance) < 0.5


@pytest.mark.slow
def test_an_agent_that_knows_the_truth_walks_to_its_goal():
    rng = np.random.default_rng(1)
    start = pose_from_yaw((*sample_free(home()[1], rng, 1)[0], HEIGHT), 0.3)
    goal = truly(start, np.array([[1, 0, 0, 2, 0, 0]]))
    present, wanted = (jax.tree.map(lambda x: x[0], seen_from(x)) for x in (start[None], goal))
    here = [start[None]]

    def step(action):
        here.append(truly(here[-1][0], np.array([[action]])))
        done = float(costs.straight(here[-1], goal[0])[0]) < 0.1
        return jax.tree.map(lambda x: x[0], seen_from(here[-1])), done

    config = PlanConfig(horizon=4, receding_horizon=2, candidates=30, elites=8, rounds=5)
    oracle = costs.Distance(costs.straight)
    done = mpc(
        simulator_predictor(simulator), step, present, wanted, oracle, CEM(), config, KEY, budget=16
    )
    assert done.reached
    assert len(done.plans) > 1
    blind = mpc(
        simulator_predictor(simulator),
        step,
        present,
        wanted,
        lambda f, g: np.zeros(len(f.depth_THW)),
        RandomShooting(),
        config,
        KEY,
        budget=2,
        progress=False,
    )
    assert len(blind.actions) == 2
