"""Scores of navigation: evo's ATE and RPE, and what can be worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.config import UserError
from pewm_jax.geometry.cameras import pose_from_yaw
from pewm_jax.planning import scores
from tests.helpers import rigid
from tests.properties import examples


def walk(rng, frames):
    """Cameras anywhere, with any rotation, as float64 rigid transforms."""
    poses = np.stack([rigid(rng).astype(np.float64) for _ in range(frames)])
    u, _, v = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = u @ v
    return poses


def by_evo(reference, estimate, kind):
    from evo.core import metrics, trajectory

    metric = {"ape": metrics.APE, "rpe": metrics.RPE}[kind](metrics.PoseRelation.translation_part)
    metric.process_data(
        tuple(trajectory.PosePath3D(poses_se3=list(p)) for p in (reference, estimate))
    )
    return metric.get_statistic(metrics.StatisticsType.rmse)


@pytest.mark.parametrize("seed", range(3))
def test_ate_and_rpe_are_those_of_evo(seed):
    rng = np.random.default_rng(seed)
    reference, estimate = walk(rng, 7), walk(rng, 7)
    np.testing.assert_allclose(
        scores.ate(reference, estimate), by_evo(reference, estimate, "ape"), rtol=1e-9
    )
    np.testing.assert_allclose(
        scores.rpe(reference, estimate), by_evo(reference, estimate, "rpe"), rtol=1e-9
    )


planar = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-7, 7))


@given(st.lists(st.tuples(planar, planar), min_size=2, max_size=5))
@examples(30)
def test_planar_poses_and_cameras_score_alike(pairs):
    reference, estimate = (np.array(side) for side in zip(*pairs, strict=True))
    cameras = [
        np.stack([pose_from_yaw(np.array([x, y, 1.2]), yaw) for x, y, yaw in side])
        for side in (reference, estimate)
    ]
    for score in (scores.ate, scores.rpe):
        np.testing.assert_allclose(score(reference, estimate), score(*cameras), atol=1e-4)
        assert score(reference, reference) < 1e-9
    for score in (scores.position_error, scores.yaw_error):
        flat = score(reference[0], estimate[0])
        np.testing.assert_allclose(flat, score(cameras[0][0], cameras[1][0]), atol=1e-4)


def test_relative_errors_do_not_see_where_a_walk_begins():
    rng = np.random.default_rng(0)
    reference = walk(rng, 5)
    elsewhere = rigid(rng).astype(np.float64) @ reference
    assert scores.rpe(reference, elsewhere) < 1e-5
    assert scores.ate(reference, elsewhere) > 0.1


def test_errors_are_what_one_works_out_by_hand():
    here, there = (0.0, 0.0, 3.0), (3.0, 4.0, -3.0)
    assert scores.position_error(here, there) == 5
    np.testing.assert_allclose(scores.yaw_error(here, there), 2 * np.pi - 6)
    assert scores.ate([here, here], [there, there]) == 5
    assert scores.path_length([here, there, here]) == 10
    assert scores.success(here, (0.5, 0.0, 3.0), 0.5)
    assert not scores.success(here, (0.51, 0.0, 3.0), 0.5)
    assert not scores.success(here, there, 5.0, 10.0)
    assert scores.success(here, there, 5.0, 20.0)


def test_similarity_is_in_relation_to_the_task():
    start, goal = (0.0, 0.0, 0.0), (4.0, 0.0, 0.0)
    assert scores.sim(start, goal, goal) == 100
    assert scores.sim(start, start, goal) == 50
    assert scores.sim(start, (2.0, 0.0, 0.0), goal) == 75
    assert scores.sim(start, (-9.0, 0.0, 0.0), goal) == 50
    np.testing.assert_allclose(scores.sim(start, (4.0, 0.0, np.pi), goal), 50)
    np.testing.assert_allclose(scores.sim(start, (0.0, 0.0, np.pi), goal), 0)
    turn = (0.0, 0.0, np.pi / 2)
    np.testing.assert_allclose(scores.sim(start, start, turn), 75)
    assert scores.sim(start, turn, turn) == 100


def test_success_is_weighted_by_the_path():
    assert scores.spl(True, 4.0, 8.0) == 0.5
    assert scores.spl(True, 4.0, 3.6) == 1
    assert scores.spl([True, False, True], [4, 4, 2], [8, 4, 2]) == 0.5


@pytest.mark.parametrize(
    "call",
    [
        lambda: scores.ate(np.zeros((2, 3)), np.zeros((3, 3))),
        lambda: scores.ate(np.zeros((0, 3)), np.zeros((0, 3))),
        lambda: scores.ate(np.zeros((2, 4)), np.zeros((2, 4))),
        lambda: scores.ate([[np.nan, 0, 0]], [[0, 0, 0]]),
        lambda: scores.rpe(np.zeros((1, 3)), np.zeros((1, 3))),
        lambda: scores.position_error(np.zeros(2), np.zeros(3)),
        lambda: scores.yaw_error([0, 0, np.inf], np.zeros(3)),
        lambda: scores.spl([], [], []),
        lambda: scores.spl([True], [1, 2], [1, 2]),
        lambda: scores.spl(True, 0.0, 1.0),
        lambda: scores.spl(True, 1.0, np.nan),
    ],
)
def test_what_cannot_be_scored_is_refused_in_a_sentence(call):
    with pytest.raises(UserError) as caught:
        call()
    assert str(caught.value).endswith(".")
    assert "() got " in str(caught.value)
