"""What several tests plan in: a grid with walls, of which everything is known."""

import collections

import jax
import jax.numpy as jnp
import numpy as np

AHEAD = np.array([[-1, 0], [0, -1], [1, 0], [0, 1]])  # up, left, down, right: turning left adds 1


class Grid:
    """An agent on cells (row, column) that steps forward or turns left or right; walls stop it."""

    def __init__(self, seed=0, side=9, walls=0.2):
        rng = np.random.default_rng(seed)
        self.free = np.pad(rng.random((side - 2, side - 2)) > walls, 1)
        self.starts = np.argwhere(self.free)

    def step(self, place, action):
        """NumPy's: (row, column, heading) after one action."""
        row, column, heading = place
        if action:
            return row, column, (heading + (1 if action == 1 else 3)) % 4
        down, across = AHEAD[heading]
        ahead = (row + down, column + across)
        return (*ahead, heading) if self.free[ahead] else place

    def reached(self, start, most):
        """All places that at most so many actions lead to, with the fewest that do."""
        found, edge = {start: 0}, collections.deque([start])
        while edge:
            here = edge.popleft()
            if found[here] == most:
                continue
            for action in range(3):
                there = self.step(here, action)
                if there not in found:
                    found[there] = found[here] + 1
                    edge.append(there)
        return found

    def distances(self, goal):
        """(Y, X, 4) the fewest actions from every place to a cell, inf where there is no way."""
        places = [(*map(int, cell), heading) for cell in self.starts for heading in range(4)]
        out = np.full((*self.free.shape, 4), np.inf, np.float32)
        out[goal], before = 0, None
        while before is None or not np.array_equal(out, before):
            before = out.copy()
            for place in places:
                ahead = min(before[self.step(place, action)] for action in range(3))
                out[place] = min(out[place], 1 + ahead)
        return out

    def ends(self, start_3, actions_KN):
        """JAX's: the (K, 3) places to which actions lead."""
        free, moves = jnp.asarray(self.free), jnp.asarray(AHEAD)

        def step(place, action):
            turned = (place[2] + jnp.asarray([0, 1, 3])[action]) % 4
            ahead = place[:2] + moves[place[2]]
            goes = (action == 0) & free[ahead[0], ahead[1]]
            return jnp.concatenate([jnp.where(goes, ahead, place[:2]), turned[None]]), None

        return jax.vmap(lambda actions: jax.lax.scan(step, start_3, actions)[0])(actions_KN)

    def tasks(self, count, horizon, seed=0):
        """Starts, goals that lie within the horizon but not at the start, distances to them."""
        rng = np.random.default_rng(seed)
        found = []
        while len(found) < count:
            start = (*map(int, rng.choice(self.starts)), int(rng.integers(4)))
            cells = {place[:2] for place in self.reached(start, horizon)} - {start[:2]}
            if cells:
                goal = sorted(cells)[rng.integers(len(cells))]
                found.append((start, goal, self.distances(goal)))
        return tuple(np.array(x) for x in zip(*found, strict=True))
