"""NoMaD proposes: a hidden goal changes nothing, noise is the key's, waypoints become actions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import ActionConfig, ConfigError, UserError
from pewm_jax.geometry.actions import discrete_table, integrate
from pewm_jax.io import tree
from pewm_jax.models.nomad import model as nomad
from pewm_jax.models.nomad.config import NomadConfig
from pewm_jax.planning import nomad_policy

TINY = NomadConfig(
    height=12,
    width=16,
    context=1,
    trunk_width=0.25,
    trunk_depth=0.5,
    trunk_stages=1,
    dim=16,
    layers=1,
    heads=2,
    waypoints=4,
    channels=(8, 16),
    time_dim=8,
)
STEPS = ActionConfig(step_m=0.25, turn_deg=30.0)


@pytest.fixture(scope="module")
def params():
    rng = np.random.default_rng(0)
    drawn = {
        path: rng.normal(0.5 * path.endswith("scale"), 0.2, shape).astype(np.float32)
        for path, shape in nomad.shapes(TINY).items()
    }
    return tree.unflatten(drawn)


@pytest.fixture(scope="module")
def propose():
    return nomad_policy.propose


def pictures(seed, count=2):
    return np.random.default_rng(seed).integers(0, 256, (count, 16, 20, 3), dtype=np.uint8)


def test_a_hidden_goal_changes_nothing_and_a_shown_one_does(params):
    seen = jax.random.normal(jax.random.key(0), (2, 2, 12, 16, 3))
    goal = jax.random.normal(jax.random.key(1), (2, 12, 16, 3))
    hidden = jnp.array([True, False])

    @jax.jit
    def slope(goal):
        def total(goal):
            made = nomad.encode(TINY, params, seen, goal, hidden)
            return jnp.sum(made * jnp.arange(1.0, 17)), made

        return jax.value_and_grad(total, has_aux=True)(goal)

    (_, made), moved = slope(goal)
    (_, other), _ = slope(jnp.zeros_like(goal))
    assert not np.any(np.asarray(moved[0]))
    assert np.any(np.asarray(moved[1]))
    assert np.array_equal(made[0], other[0])
    assert not np.allclose(made[1], other[1])


def test_proposals_have_their_shape_and_depend_on_the_key_alone(params, propose):
    seen, goal = pictures(0), pictures(1, 1)[0]
    one = propose(TINY, params, seen, goal, jax.random.key(0), 3)
    again = propose(TINY, params, seen, goal, jax.random.key(0), 3)
    other = propose(TINY, params, seen, goal, jax.random.key(1), 3)
    assert one.shape == (3, 4, 2)
    assert np.array_equal(one, again)
    assert not np.allclose(one, other)
    assert not np.allclose(one[0], one[1])
    steps = np.diff(np.asarray(one), axis=1, prepend=0) / TINY.spacing_m
    assert (steps > np.array(TINY.lowest) - 1e-4).all()
    assert (steps < np.array(TINY.highest) + 1e-4).all()


def test_steps_and_waypoints_turn_into_each_other():
    points = np.random.default_rng(0).normal(size=(3, 4, 2)).astype(np.float32)
    there = nomad.normalise(TINY, points)
    assert np.allclose(nomad.waypoints(TINY, there), points, atol=1e-5)
    longest = np.cumsum(np.tile(np.array(TINY.highest) * TINY.spacing_m, (4, 1)), 0)
    assert np.allclose(nomad.normalise(TINY, longest), 1, atol=1e-5)


def places(actions_N3):
    """Where the agent is after each action, seen from where it began."""
    start = jnp.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], jnp.float32)
    return np.asarray(integrate(start, actions_N3))[1:, :2, 3]


def test_continuous_actions_lead_through_the_waypoints():
    rng = np.random.default_rng(0)
    points = np.cumsum(rng.normal(0.1, 0.2, (5, 6, 2)), 1)
    points[0, 3] = points[0, 2]  # it stays
    actions = nomad_policy.continuous(points)
    for each, point in zip(actions, points, strict=True):
        assert np.allclose(places(each), point, atol=1e-5)
    assert np.allclose(actions[1, 1:, 1], 0, atol=1e-6)  # after the first move it looks ahead
    assert actions[0, 2, 2] == 0


@pytest.mark.parametrize("walk", [[0, 0, 0, 0, 0], [1, 0, 0, 2, 0], [2, 2, 2, 0, 0, 1, 0], [0] * 9])
def test_discrete_actions_are_those_that_made_the_waypoints(walk):
    made = places(discrete_table(STEPS)[walk])
    assert nomad_policy.discrete(STEPS, made).tolist() == walk
    nudged = made + np.random.default_rng(0).normal(0, 0.01, made.shape)
    found = nomad_policy.discrete(STEPS, np.stack([made, nudged]))
    assert found.shape == (2, len(walk))
    assert np.abs(places(discrete_table(STEPS)[found[1]]) - made).max() < 1e-5


def test_a_policy_acts_by_its_proposals_and_forgets(params, propose):
    policy = nomad_policy.Policy(TINY, params, STEPS, steps=2, seed=3)
    seen = [{"rgb": picture, "goal": np.zeros(2)} for picture in pictures(0, 3)]
    walked = [policy(each) for each in seen]
    assert set(walked) <= {0, 1, 2}
    key = jax.random.fold_in(jax.random.key(3), 0)
    first = np.stack([seen[0]["rgb"]] * 2)
    way = propose(TINY, params, first, None, key, 1)
    assert walked[:2] == nomad_policy.discrete(STEPS, way)[0, :2].tolist()
    policy.reset()
    assert len(policy.seen) == 0
    with pytest.raises(UserError, match="take 1 to 4 actions"):
        nomad_policy.Policy(TINY, params, STEPS, steps=5)


def test_the_history_begins_with_its_first_picture_repeated():
    seen = pictures(0, 5)
    assert np.array_equal(nomad_policy.history(TINY, seen), seen[-2:])
    assert np.array_equal(nomad_policy.history(TINY, seen[:1]), seen[[0, 0]])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"waypoints": 5}, "policy.channels"),
        ({"dim": 18}, "policy.dim is 18"),
        ({"kernel": 4}, "odd number"),
        ({"trunk_stages": 8}, "7 stages"),
        ({"lowest": (6.0, -1.0)}, "must be below"),
        ({"trunk_width": 0.0}, "more than 0"),
    ],
)
def test_sizes_that_cannot_work_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        dataclasses.replace(TINY, **changes)


def test_another_number_of_pictures_is_refused(params):
    with pytest.raises(UserError, match="encode\\(\\) got 3 pictures"):
        nomad_policy.propose(TINY, params, pictures(0, 3), None, jax.random.key(0), 1)
