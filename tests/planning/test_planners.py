"""Planners: do they find what is there, from nothing but costs?"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pewm_jax.config import ConfigError, UserError
from pewm_jax.planning import planners
from pewm_jax.planning.plan import plan, search
from pewm_jax.planning.settings import CEM, MPPI, Box, Discrete, PlanConfig, RandomShooting
from tests.planning.grid import Grid

KEY = jax.random.key(0)
GRID, HORIZON, TASKS = Grid(), 8, 120
DEFAULT = PlanConfig(horizon=HORIZON, rounds=20)


@functools.cache
def successes(planner, seen=True):
    """Whether the plan of each task ends on its goal; unseen, costs are random numbers."""
    starts, goals, distances = GRID.tasks(TASKS, HORIZON)

    def one(start, goal, distance, key):
        def cost(actions, key):
            row, column, heading = GRID.ends(start, actions).T
            random = jax.random.uniform(key, (len(actions),))
            return distance[row, column, heading] if seen else random

        actions = search(planner, DEFAULT, cost, key).actions
        return (GRID.ends(start, actions[None])[0, :2] == goal).all()

    keys = jax.random.split(KEY, TASKS)
    return np.asarray(jax.jit(jax.vmap(one))(starts, goals, distances, keys))


@pytest.mark.slow
def test_cem_reaches_the_goals_within_its_horizon():
    assert successes(CEM()).mean() >= 0.95


@pytest.mark.slow
def test_with_random_costs_it_does_no_better_than_random_actions():
    starts, goals, _ = GRID.tasks(TASKS, HORIZON)
    random = jax.random.randint(KEY, (TASKS, 500, HORIZON), 0, 3)
    ends = jax.jit(jax.vmap(GRID.ends))(starts, random)
    by_chance = np.asarray((ends[..., :2] == goals[:, None]).all(-1)).mean(1)
    spread = np.sqrt((by_chance * (1 - by_chance)).sum()) / TASKS
    blind = successes(CEM(), seen=False).mean()
    assert abs(blind - by_chance.mean()) < 4 * spread
    assert successes(CEM()).mean() > by_chance.mean() + 0.5


TARGET = np.random.default_rng(0).uniform(-0.8, 0.8, (6, 2)).astype(np.float32)
ORDER = np.random.default_rng(1).integers(0, 5, 12)
BOX = Box((-1, -1), (1, 1))


def smooth(actions, key):
    """A bowl of continuous actions, or how far discrete ones are from an order."""
    del key
    if actions.ndim == 3:
        return jnp.square(actions - TARGET).sum((1, 2))
    return jnp.square(actions - ORDER).sum(1).astype(jnp.float32)


@pytest.mark.parametrize("kind", [CEM, MPPI])
@pytest.mark.parametrize("space", [BOX, Discrete(5)])
def test_every_planner_beats_random_shooting_at_equal_budget(kind, space):
    config = PlanConfig(horizon=6 if space == BOX else 12)

    def found(planner):
        return jax.jit(jax.vmap(lambda key: search(planner, config, smooth, key)))(
            jax.random.split(KEY, 8)
        )

    shot, ours = found(RandomShooting(space)), found(kind(space))
    assert (ours.cost < 0.5 * shot.cost).all()
    np.testing.assert_allclose(ours.cost, ours.rounds.best_R[:, -1])
    assert (np.diff(ours.rounds.best_R, axis=1) <= 0).all()
    assert (np.diff(shot.rounds.best_R, axis=1) <= 0).all()
    assert (ours.rounds.spread_R[:, -1] < ours.rounds.spread_R[:, 0]).all()
    again = jax.jit(jax.vmap(lambda actions: smooth(actions[None], KEY)[0]))(ours.actions)
    np.testing.assert_allclose(again, ours.cost, rtol=1e-5)


def test_smoothing_and_momentum_by_hand():
    planner = CEM(Discrete(2), momentum=0.25, smoothing=0.2, keep=0)
    config = PlanConfig(horizon=2, receding_horizon=1, candidates=4, elites=2, rounds=1)
    begun = planners.init(planner, config)
    np.testing.assert_allclose(begun.belief, 0.5)
    choices = jnp.array([[0, 1], [1, 1], [0, 0], [1, 0]])
    after = planners.update(planner, config, begun, choices, jnp.array([1.0, 4.0, 2.0, jnp.nan]))
    # The elites 0 and 2 chose 0, 0 first and 1, 0 then. 0.8 · (1, 0) + 0.1 = (0.9, 0.1), and
    # 0.25 · 0.5 + 0.75 · 0.9 = 0.8.
    np.testing.assert_allclose(after.belief, [[0.8, 0.2], [0.5, 0.5]], atol=1e-6)
    np.testing.assert_array_equal(after.best, [0, 1])
    assert float(after.cost) == 1
    worse = planners.update(planner, config, after, choices[1:2], jnp.array([3.0]))
    assert float(worse.cost) == 1
    np.testing.assert_array_equal(worse.best, [0, 1])


def test_means_deviations_and_their_floor_by_hand():
    planner = CEM(Box((0, 0), (2, 4)), momentum=0.5, initial_std=1.0, min_std=0.25, keep=0)
    config = PlanConfig(horizon=1, receding_horizon=1, candidates=3, elites=2, rounds=1)
    begun = planners.init(planner, config)
    np.testing.assert_allclose(begun.belief.mean_HA, [[1, 2]])
    np.testing.assert_allclose(begun.belief.std_HA, [[1, 2]])
    choices = jnp.array([[[0.0, 4.0]], [[1.0, 4.0]], [[2.0, 0.0]]])
    after = planners.update(planner, config, begun, choices, jnp.array([1.0, 2.0, 3.0])).belief
    np.testing.assert_allclose(after.mean_HA, [[0.75, 3.0]])  # half of (1, 2) and (0.5, 4)
    np.testing.assert_allclose(after.std_HA, [[0.75, 1.0]])  # half of (1, 2) and (0.5, 0)
    again = planners.update(
        planner, config, begun, jnp.repeat(choices[:1], 3, 0), jnp.array([1.0, 2.0, 3.0])
    )
    again = planners.update(planner, config, again, jnp.repeat(choices[:1], 3, 0), jnp.ones(3))
    np.testing.assert_allclose(again.belief.std_HA, [[0.25, 0.5]])  # the floor, of half widths


def test_the_best_different_candidates_stay_and_the_same_count_once():
    planner = CEM(Discrete(2), momentum=0, smoothing=0, keep=1.0)
    config = PlanConfig(horizon=1, receding_horizon=1, candidates=3, elites=2, rounds=1)
    choices = jnp.array([[1], [1], [0]])
    begun = planners.init(planner, config)
    after = planners.update(planner, config, begun, choices, jnp.array([1.0, 1.0, 3.0]))
    np.testing.assert_allclose(after.belief, [[0.5, 0.5]])  # 1 and 0, not 1 and 1
    np.testing.assert_array_equal(after.kept_EH, [[1], [0]])
    np.testing.assert_array_equal(after.kept_costs_E, [1, 3])
    worse = planners.update(planner, config, after, choices[2:].repeat(3, 0), jnp.full(3, 3.0))
    np.testing.assert_allclose(worse.belief, [[0.5, 0.5]])  # the kept 1 still counts
    forgets = CEM(Discrete(2), momentum=0, smoothing=0, keep=0)
    begun = planners.init(forgets, config)
    after = planners.update(forgets, config, begun, choices[2:].repeat(3, 0), jnp.full(3, 3.0))
    np.testing.assert_allclose(after.belief, [[1, 0]])


def test_path_integrals_weigh_by_hand():
    planner = MPPI(Discrete(2), momentum=0, smoothing=0, temperature=2.0)
    config = PlanConfig(horizon=1, receding_horizon=1, candidates=3, elites=1, rounds=1)
    weights = planners.importance(planner, config, jnp.array([0.0, 2.0, jnp.inf]))
    expected = np.exp([0, -2 / 2.0])  # the deviation of 0 and 2 is 1
    np.testing.assert_allclose(weights, [*expected / expected.sum(), 0], rtol=1e-6)
    same = planners.importance(planner, config, jnp.array([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(same, 1 / 3, rtol=1e-6)


def test_where_nothing_is_possible_nothing_is_learned():
    for planner in (CEM(), MPPI(), CEM(Box()), MPPI(Box())):
        begun = planners.init(planner, DEFAULT)
        choices = planners.propose(planner, DEFAULT, begun, KEY)
        after = planners.update(planner, DEFAULT, begun, choices, jnp.full(60, jnp.inf))
        for name in ("belief", "best", "cost"):
            a, b = getattr(after, name), getattr(begun, name)
            jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("planner", [CEM(), RandomShooting(), CEM(Box()), MPPI(Box())])
def test_proposals_keep_to_the_space_and_begin_with_what_is_believed(planner):
    begun = planners.init(planner, DEFAULT)
    drawn = np.asarray(planners.propose(planner, DEFAULT, begun, KEY))
    np.testing.assert_array_equal(drawn[0], planners.mode(begun.belief))
    if isinstance(planner.space, Discrete):
        assert drawn.shape == (60, 8)
        assert set(np.unique(drawn)) == {0, 1, 2}
    else:
        assert drawn.shape == (60, 8, 3)
        assert (drawn >= np.float32(planner.space.low)).all()
        assert (drawn <= np.float32(planner.space.high)).all()
        assert (drawn[..., 1] == 0).all(), "bounds that are equal fix it"


@pytest.mark.parametrize("planner", [CEM(Discrete(3)), RandomShooting(), CEM(Box())])
def test_what_is_left_of_a_plan_is_tried_first_in_the_next(planner):
    config = PlanConfig(horizon=4, receding_horizon=1, action_block=2, candidates=6, elites=2)
    discrete = isinstance(planner.space, Discrete)
    old = jnp.array([0, 2, 1, 2]) if discrete else jnp.full((4, 3), 0.1) * jnp.array([1, 0, 1])
    rest = planners.shifted(config, old)
    assert len(rest) == 3
    begun = planners.init(planner, config, rest)
    choices = planners.propose(planner, config, begun, KEY)
    np.testing.assert_allclose(choices[0, :3], rest)
    actions = planners.actions_of(config, choices)
    assert actions.shape[1] == config.actions == 8
    np.testing.assert_array_equal(actions[:, ::2], actions[:, 1::2])
    with pytest.raises(UserError, match="give at most 4 blocks"):
        planners.init(planner, config, jnp.zeros((5,)))


def test_on_the_host_a_plan_is_the_same_and_nothing_is_compiled_twice():
    from pewm_jax.planning import plan as module

    config = PlanConfig(horizon=6, candidates=20, elites=5, rounds=5, receding_horizon=2)
    traced = []

    @jax.jit
    def cost(actions, key):
        traced.append(actions.shape)
        return smooth(actions, key)

    before = module._proposed._cache_size(), module._learned._cache_size()
    found = plan(CEM(BOX), config, cost, KEY, progress=False)
    plan(CEM(BOX), config, cost, jax.random.key(1), progress=False)
    assert traced == [(20, 6, 2)]
    assert module._proposed._cache_size() == before[0] + 1
    assert module._learned._cache_size() == before[1] + 1
    whole = jax.jit(lambda key: search(CEM(BOX), config, cost, key))(KEY)
    np.testing.assert_allclose(found.actions, whole.actions, atol=1e-5)
    np.testing.assert_allclose(found.rounds.least_R, whole.rounds.least_R, rtol=1e-4)


SMALL = PlanConfig(horizon=12, candidates=10, elites=3, rounds=6)


class Interrupted:
    """A cost that is interrupted once, in a round."""

    def __init__(self, number):
        self.number, self.rounds = number, 0

    def __call__(self, actions, key):
        self.rounds += 1
        if self.rounds == self.number:
            raise KeyboardInterrupt
        return np.asarray(smooth(actions, key))


def test_an_interrupted_search_goes_on_to_the_same_plan(tmp_path):
    planner, file = CEM(Discrete(5)), tmp_path / "plan.npz"
    expected = plan(planner, SMALL, smooth, KEY, progress=False)
    cost = Interrupted(4)
    with pytest.raises(KeyboardInterrupt):
        plan(planner, SMALL, cost, KEY, checkpoint=file, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["plan.npz"]
    found = plan(planner, SMALL, cost, KEY, checkpoint=file, progress=False)
    assert cost.rounds == 3 + 1 + 3, "three rounds were done and are not done again"
    again = plan(planner, SMALL, Interrupted(1), KEY, checkpoint=file, progress=False)  # not asked
    anew = plan(planner, SMALL, smooth, KEY, progress=False)
    for other in (found, again, anew):
        jax.tree.map(np.testing.assert_array_equal, other, expected)


def test_a_checkpoint_of_another_search_and_a_damaged_one_are_refused(tmp_path):
    planner, file = CEM(Discrete(5)), tmp_path / "plan.npz"
    ours = functools.partial(plan, config=SMALL, cost_of_actions=smooth, progress=False)
    ours(planner, key=KEY, checkpoint=file)
    for other in (
        lambda: ours(planner, key=jax.random.key(1), checkpoint=file),
        lambda: ours(CEM(Discrete(5), momentum=0.2), key=KEY, checkpoint=file),
        lambda: ours(planner, key=KEY, checkpoint=file, start=jnp.array([1])),
        lambda: ours(planner, key=KEY, checkpoint=file, about="another goal"),
    ):
        with pytest.raises(UserError, match="belongs to a search with other inputs"):
            other()
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(UserError, match=r"damaged .*: delete it"):
        ours(planner, key=KEY, checkpoint=file)


@pytest.mark.parametrize("wrong", [np.nan, -np.inf])
def test_costs_that_are_no_numbers_end_in_a_sentence(wrong):
    def cost(actions, key):
        costs = np.array(smooth(actions, key))
        cost.round += 1
        if cost.round == 3:
            costs[[1, 4]] = wrong
        return costs

    cost.round = 0
    with pytest.raises(UserError, match=r"in round 2 the cost of 2 of 10 candidates \(1, 4\)"):
        plan(CEM(Discrete(5)), SMALL, cost, KEY, progress=False)


def test_other_costs_that_cannot_be_planned_by_are_refused():
    planner = CEM(Discrete(5))
    with pytest.raises(UserError, match="no candidate of 6 rounds has a finite cost"):
        plan(planner, SMALL, lambda *_: np.full(10, np.inf), KEY, progress=False)
    with pytest.raises(UserError, match="return one number per candidate"):
        plan(planner, SMALL, lambda *_: np.zeros((10, 1)), KEY, progress=False)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: PlanConfig(horizon=0), "plan.horizon is 0"),
        (lambda: PlanConfig(horizon=2, receding_horizon=3), "execute at most as many"),
        (lambda: PlanConfig(candidates=5, elites=6), "keep fewer or draw more"),
        (lambda: Box((0.0,), (1.0, 2.0)), "give both for"),
        (lambda: Box((1.0,), (0.0,)), "the low one first"),
        (lambda: CEM(momentum=1.0), "planner.momentum is 1.0"),
        (lambda: CEM(smoothing=-0.1), "planner.smoothing"),
        (lambda: CEM(min_std=1.0), "min_std ≤ initial_std"),
        (lambda: MPPI(temperature=0), "planner.temperature is 0"),
        (lambda: Discrete(0), "space.count is 0"),
    ],
)
def test_settings_that_cannot_work_are_refused(make, says):
    with pytest.raises(ConfigError, match=says):
        make()
