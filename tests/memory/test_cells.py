"""A map's sorted list of cells."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pewm_jax.memory import cells
from tests.properties import examples

CAPACITY, NO_CELL = 8, 20
admit = jax.jit(cells.admit, static_argnums=2)
numbers = st.lists(st.integers(0, NO_CELL), min_size=6, max_size=6)


@examples(60)
@given(older=st.sets(st.integers(0, NO_CELL - 1), max_size=CAPACITY), new=numbers)
def test_new_cells_are_added_in_order_while_there_is_room(older, new):
    free = CAPACITY - len(older)
    list_V = np.array(sorted(older) + [NO_CELL] * free, np.int32)
    found_V, dropped = admit(jnp.asarray(list_V), jnp.asarray(new, jnp.int32), NO_CELL)
    wanted = sorted(set(new) - older - {NO_CELL})
    kept = sorted(older | set(wanted[:free]))
    np.testing.assert_array_equal(found_V, kept + [NO_CELL] * (CAPACITY - len(kept)))
    assert dropped == max(len(wanted) - free, 0)
