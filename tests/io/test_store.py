"""Stored results are reused, half-written ones are not, and other inputs are refused."""

import json

import numpy as np
import pytest

from pewm_jax.config import UserError
from pewm_jax.io import store
from pewm_jax.io.store import ARRAYS, COMPRESSED, TABLE, ResultCache, Workers, map_resumable

VALUES = {
    ARRAYS: {"a": np.arange(3.0), "b": np.array([True])},
    COMPRESSED: {"a": np.zeros((4, 5), np.float32)},
    TABLE: {"a": [1, 2.5], "b": None},
}


def squares(done, stop=None):
    """Return a function that squares numbers, notes them in ``done`` and fails at ``stop``."""

    def work(missing):
        for number in missing:
            if number == stop:
                raise KeyboardInterrupt
            done.append(number)
            yield number, {"square": np.array(number**2)}

    return work


def run(cache, keys=range(5), stop=None, **more):
    done = []
    results = map_resumable(
        keys, lambda number: f"n{number}", squares(done, stop), cache=cache, **more
    )
    return done, {key: int(value["square"]) for key, value in results.items()}


@pytest.mark.parametrize("kind", [ARRAYS, COMPRESSED, TABLE])
def test_a_result_is_read_as_it_was_written(tmp_path, kind):
    cache = ResultCache(tmp_path / "new", kind)
    assert cache.get("house/x") is None
    cache.put("house/x", VALUES[kind])
    found = cache.get("house/x")
    assert found is not None
    assert found.keys() == VALUES[kind].keys()
    for name, value in VALUES[kind].items():
        np.testing.assert_array_equal(found[name], value)
    assert cache.path("house/x").name == f"x{kind.suffix}"


@pytest.mark.parametrize("kind", [ARRAYS, COMPRESSED, TABLE])
def test_a_file_that_is_cut_short_anywhere_counts_as_absent(tmp_path, kind):
    cache = ResultCache(tmp_path, kind)
    cache.put("x", VALUES[kind])
    whole = cache.path("x").read_bytes()
    for length in range(0, len(whole) - 1, max(1, len(whole) // 40)):
        cache.path("x").write_bytes(whole[:length])
        assert cache.get("x") is None, length
    cache.path("x").write_bytes(b"\xff" + whole[1:])
    assert cache.get("x") is None


def test_a_flipped_bit_is_no_crash(tmp_path):
    cache = ResultCache(tmp_path)
    cache.put("x", VALUES[ARRAYS])
    whole = bytearray(cache.path("x").read_bytes())
    for at in range(len(whole)):
        damaged = bytearray(whole)
        damaged[at] ^= 0x55
        cache.path("x").write_bytes(damaged)
        cache.get("x")  # a result, or None


def test_an_array_without_a_name_and_a_list_count_as_absent(tmp_path):
    with (tmp_path / "x.npz").open("wb") as file:
        np.save(file, np.zeros(3))
    (tmp_path / "x.json").write_text("[1]")
    assert ResultCache(tmp_path).get("x") is None
    assert ResultCache(tmp_path, TABLE).get("x") is None


def test_an_interrupted_loop_resumes_with_what_is_missing(tmp_path):
    cache, lines = ResultCache(tmp_path), []
    with pytest.raises(KeyboardInterrupt):
        run(cache, stop=3)
    done, results = run(cache, log=lines.append, what="numbers")
    assert done == [3, 4]
    assert results == {0: 0, 1: 1, 2: 4, 3: 9, 4: 16}
    assert lines == ["3 of 5 numbers are reused from an earlier run"]
    assert list(results) == list(range(5))
    assert run(cache)[0] == []


def test_half_a_file_is_computed_again(tmp_path):
    cache = ResultCache(tmp_path)
    run(cache)
    path = cache.path("n2")
    path.write_bytes(path.read_bytes()[:50])
    assert run(cache) == ([2], {0: 0, 1: 1, 2: 4, 3: 9, 4: 16})


def test_a_result_that_is_not_enough_is_computed_again(tmp_path):
    cache = ResultCache(tmp_path)
    run(cache)
    assert run(cache, is_usable=lambda key, _: key != 1)[0] == [1]


def test_results_of_other_inputs_are_not_reused(tmp_path):
    one = ResultCache.for_weights(tmp_path, "w" * 64, "p" * 64)
    run(one)
    assert run(ResultCache.for_weights(tmp_path, "w" * 64, "q" * 64))[0] == list(range(5))
    assert (
        run(ResultCache.for_weights(tmp_path, "w" * 64, "p" * 64))[0] == []
    )  # both protocols stay
    assert run(ResultCache.for_weights(tmp_path, "v" * 64, "p" * 64))[0] == list(range(5))
    assert run(ResultCache.for_weights(tmp_path, "w" * 64, "p" * 64))[0] == list(range(5))


def test_compute_calls_the_work_once(tmp_path):
    cache, calls = ResultCache(tmp_path, TABLE), []
    for _ in range(2):
        assert cache.compute("a", lambda: calls.append(1) or {"x": 1}) == {"x": 1}
    assert calls == [1]


def test_several_processes_share_the_work_and_get_all_of_it(tmp_path):
    """Process 1 finishes at the barrier of process 0, as if both had run at once."""
    cache, done = ResultCache(tmp_path), {}

    def barrier(_name):
        done[1] = run(cache, workers=Workers(2, 1), is_light=lambda n: n > 2)[0]

    done[0], results = run(cache, workers=Workers(2, 0, barrier), is_light=lambda n: n > 2)
    assert done == {0: [0, 2, 3], 1: [1, 4]}
    assert results == {0: 0, 1: 1, 2: 4, 3: 9, 4: 16}


def test_a_group_is_computed_by_one_process():
    keys = [(clip, measure) for clip in range(4) for measure in "ab"]
    for index in range(2):
        seen = []

        class Silent(ResultCache):
            def get(self, name):
                return None

            def put(self, name, result):
                return result

            def wait_for(self, name, patience_s=0.0):
                return None

        def work(missing, seen=seen):
            seen += missing
            return [(key, 1) for key in missing]

        map_resumable(
            keys,
            str,
            work,
            cache=Silent(None),
            workers=Workers(2, index),
            group_of=lambda key: key[0],
        )
        assert seen == [key for key in keys if key[0] % 2 == index]


def test_process_0_works_before_the_others():
    calls = []
    first = Workers(2, 0, lambda _: calls.append("barrier"))
    second = Workers(2, 1, lambda _: calls.append("barrier"))
    for workers in (first, second):
        assert workers.first_alone(lambda: calls.append("work") or 7, "x") == 7
    assert calls == ["work", "barrier", "barrier", "work"]


def test_processes_without_a_common_folder_are_refused(tmp_path):
    with pytest.raises(UserError, match="share"):
        ResultCache(tmp_path).wait_for("x", patience_s=0.01)


def test_a_folder_of_other_inputs_is_refused_by_their_names(tmp_path):
    out, inputs = tmp_path / "a", {"seed": 0, "clips": 3, "shown": 1}
    store.require_same_inputs(out, inputs, "decisions", ignored=("shown",))
    store.require_same_inputs(out, {**inputs, "shown": 2}, "decisions", ignored=("shown",))
    with pytest.raises(UserError, match=r"decisions of other settings \(clips\)"):
        store.require_same_inputs(out, {**inputs, "clips": 4}, "decisions", ignored=("shown",))
    (out / store.SETTINGS).write_text('{"seed":')
    with pytest.raises(UserError, match="damaged"):
        store.require_same_inputs(out, inputs, "decisions", ignored=("shown",))
    with pytest.raises(UserError, match="is a file"):
        store.require_same_inputs(out / store.SETTINGS, inputs, "decisions")


def test_make_once_makes_again_for_other_inputs(tmp_path):
    mark, calls = tmp_path / "made_from.json", []
    for inputs in (("a", "b"), ["a", "b"], ["a", "c"], ["a", "c"]):
        store.make_once(mark, inputs, lambda inputs=inputs: calls.append(inputs))
    mark.write_text("[")
    store.make_once(mark, ["a", "c"], lambda: calls.append("again"))
    assert calls == [("a", "b"), ["a", "c"], "again"]
    assert json.loads(mark.read_text()) == ["a", "c"]


def test_what_fails_is_not_marked_as_made(tmp_path):
    def fail():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.make_once(tmp_path / "mark", 1, fail)
    assert not (tmp_path / "mark").exists()


def test_a_search_resumes_its_own_state_and_no_other(tmp_path):
    path = tmp_path / "rounds.npz"
    own = store.ProgressFile(path, "x" * 64, "a search")
    assert own.read() is None
    own.write({"round": np.array(3)})
    found = own.read()
    assert found is not None
    assert list(found) == ["round"]
    with pytest.raises(UserError, match="other inputs"):
        store.ProgressFile(path, "y" * 64, "a search").read()
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match="damaged"):
        own.read()


def test_equal_inputs_have_equal_hashes():
    assert store.inputs_hash({"a": 1, "b": [2]}) == store.inputs_hash({"b": [2], "a": 1})
    assert store.inputs_hash({"a": 1}) != store.inputs_hash({"a": 2})
