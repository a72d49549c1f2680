"""What a plan costs: the paper's 60 candidates × 8 frames × 12 rounds, with the model that ships.

`python benchmarks/planning.py` prints the time of one plan by the cross-entropy method, where it
went, and what imagining the same candidates one by one takes. Houses are made on the way; nothing
is read from disk but the weights. With ``--record`` the section of ``RESULTS.md`` is rewritten.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from record import machine, record, table

import pewm_jax
from pewm_jax import worlds
from pewm_jax.codecs import rgbd
from pewm_jax.data.collect import CollectConfig
from pewm_jax.data.episodes import read_episode
from pewm_jax.data.make_episode import make_episode
from pewm_jax.memory import interface as memories
from pewm_jax.planning import costs
from pewm_jax.planning.candidates import CandidateCost, ImaginedRollout
from pewm_jax.planning.plan import plan
from pewm_jax.planning.settings import CEM, PlanConfig
from pewm_jax.types import Control, Frames, MemoryReadout
from pewm_jax.worlds import world_model
from pewm_jax.worlds import world_model as sampling
from pewm_jax.worlds.control import control_of
from pewm_jax.worlds.pewm import candidates as pewm_many

CONTEXT = 24
"""Frames that are seen before; the goal is 8 frames on."""


class Clock:
    """Seconds on the wall and of the processors, summed over calls of one thing."""

    def __init__(self) -> None:
        self.wall = self.cpu = 0.0
        self.calls = 0

    def __call__(self, run: Callable[[], Any]) -> Any:
        """Run something to its end and add its time."""
        wall, cpu = time.perf_counter(), time.process_time()
        out = jax.block_until_ready(run())
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu
        self.calls += 1
        return out


def scene(config, params) -> tuple[Any, Frames]:
    """Return a state in a house that the model has never seen, and a goal 8 frames on."""
    from pathlib import Path

    size = config.model.clip.height
    settings = CollectConfig(Path("unused"), frames=CONTEXT + 8, size=size)
    episode = read_episode(make_episode(settings, "revisit", 0))
    state = jax.jit(worlds.start, static_argnums=0)(config, params, episode.frames(range(CONTEXT)))
    return state, episode.frames([CONTEXT + 7])


def parts(model, params, state, actions_KN, key) -> dict[str, Clock]:
    """Time the parts of imagining one batch: as ``pewm_many`` does it, in pieces."""
    count = len(actions_KN)
    keys = jnp.stack([key] * count)

    def cameras(actions):
        asked = jax.vmap(lambda a: control_of(model, state.frame.camera, a))(actions)
        first = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state.frame.camera)
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b], 1), first, asked.camera)

    def look(params, memory, actions):
        return pewm_many.read_memory(model, memory, cameras(actions), params)

    def condition(params, frame, actions):
        def one(camera):
            given = jax.tree.map(lambda x: x[None], (frame, Control(camera)))
            return world_model.condition(model, params, *given)

        return jax.vmap(one)(cameras(actions))

    def draw(params, conditioning, readout, keys):
        batched = jax.tree.map(lambda x: x[:, None], readout)
        one = functools.partial(sampling.draw, model, params)
        return jax.vmap(one)(conditioning, batched, keys)[:, 0]

    def decode(params, latents, readout):
        rgb, depth = rgbd.decode_rgbd(model, params, latents[:, -1:])
        if memories.gated(model):
            view = jax.tree.map(lambda x: x[:, -1:], readout.view)
            rgb, depth = rgbd.mix(model, params, rgb, depth, view)
        return rgb, depth

    looking, conditioning, drawing, decoding = (jax.jit(f) for f in (look, condition, draw, decode))
    clocks: dict[str, Clock] = {}
    readout: MemoryReadout = jax.block_until_ready(looking(params, state.map, actions_KN))
    given = jax.block_until_ready(conditioning(params, state.frame, actions_KN))
    latents = jax.block_until_ready(drawing(params, given, readout, keys))
    for name, run in {
        "the sampler (denoiser, 2 steps)": lambda: drawing(params, given, readout, keys),
        "the present frame and the rays": lambda: conditioning(params, state.frame, actions_KN),
        "decoding and the gate, last frame": lambda: decoding(params, latents, readout),
    }.items():
        jax.block_until_ready(run())
        clocks[name] = Clock()
        for _ in range(3):
            clocks[name](run)
    return clocks


def one_by_one(model, params, state, actions_KN, key, cost) -> tuple[Clock, np.ndarray]:
    """Imagine candidates alone, as a loop would, and return the time and the costs."""
    one = jax.jit(functools.partial(worlds.imagine, remember=False), static_argnums=0)

    def judged(actions):
        frames = one(model, params, state, actions, key)[1]
        return cost(jax.tree.map(lambda x: x[None], frames))[0]

    jax.block_until_ready(judged(actions_KN[0]))
    clock = Clock()
    return clock, np.array([clock(lambda a=actions: judged(a)) for actions in actions_KN])


def shares(each: dict[str, float]) -> list[list[str]]:
    """Return rows: seconds of each part, and their share of all."""
    spent = sum(each.values())
    return [
        [name, f"{seconds * 1e3:.1f} ms", f"{seconds / spent:.0%}"]
        for name, seconds in each.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--batch", type=int, default=6)
    parser.add_argument("--alone", type=int, default=48, help="candidates imagined one by one")
    parser.add_argument("--record", action="store_true", help="rewrite this section of RESULTS.md")
    chosen = parser.parse_args()
    config, params = pewm_jax.load("small")
    params = jax.device_put(params)
    model, settings = config.model, PlanConfig(rounds=chosen.rounds)
    state, goal = scene(config, params)
    cost, key = costs.perceptual(), jax.random.key(0)

    imagining, rendering, whole = Clock(), Clock(), Clock()

    def fresh():
        """A rollout that has rendered nothing yet."""
        return ImaginedRollout(config, params, state, key, chosen.batch)

    rollout = fresh()
    asked: list[np.ndarray] = []

    def rolled(actions):
        asked.append(np.asarray(actions))
        return imagining(lambda: rollout(actions))

    begun = np.random.default_rng(0).integers(0, 3, (settings.candidates, settings.horizon))
    jax.block_until_ready(cost(rollout(begun), goal))  # compiles
    rollout._views(np.ones((1, 1), int))  # one camera alone is another program
    judged = CandidateCost(rolled, cost, goal)
    plan(CEM(), settings, lambda *_: np.zeros(settings.candidates), key, progress=False)  # too
    rollout, imagining = fresh(), Clock()
    asked.clear()
    found = whole(lambda: plan(CEM(), settings, judged, jax.random.key(1)))
    views = fresh()._views
    for actions in asked:  # again, and alone: in a plan it goes on while others are imagined
        order = np.lexsort(actions.T[::-1])
        for first in range(0, len(order), chosen.batch):
            part = actions[np.resize(order[first : first + chosen.batch], chosen.batch)]
            rendering(functools.partial(views, part))
    drawn, drawing = views.rendered, rendering.cpu

    tried = np.concatenate(asked)
    some = tried[np.random.default_rng(1).permutation(len(tried))[: chosen.alone]]
    alone, last = one_by_one(model, params, state, some, key, lambda frames: cost(frames, goal))
    together = np.array([judged(actions[None])[0] for actions in some])
    apart = np.abs(together - last).max()

    clocks = parts(model, params, state, tried[: chosen.batch], key)
    total = settings.rounds * settings.candidates
    wall, cpu = alone.wall / len(some) * total, alone.cpu / len(some) * total
    rows = [
        [f"a plan: {total} candidates, {judged.rolled_out} different", whole.wall, whole.cpu],
        ["— of it imagining", imagining.wall, imagining.cpu],
        ["— of it LPIPS and the planner", whole.wall - imagining.wall, whole.cpu - imagining.cpu],
        [f"the {total} one by one, from {len(some)}", wall, cpu],
    ]
    each = {name: clock.cpu / 3 / chosen.batch for name, clock in clocks.items()}
    each[f"rendering the memory, {drawn} cameras"] = drawing / judged.rolled_out
    text = [
        table(
            ["what", "seconds", "processor seconds"],
            [[a, f"{b:.1f}", f"{c:.1f}"] for a, b, c in rows],
        ),
        table(["imagining a candidate", "processor time", "share"], shares(each)),
    ]
    per = whole.wall / judged.rolled_out, wall / total
    text.append(
        f"The plan is {wall / whole.wall:.1f} times as fast as one candidate after the other "
        f"({cpu / whole.cpu:.1f} times by processor time), {per[1] / per[0]:.1f} times for each "
        f"candidate that is imagined. The costs differ by at most {apart:.1e}. LPIPS "
        f"{float(found.rounds.least_R[0]):.3f} after the first round and {float(found.cost):.3f} "
        "after the last."
    )
    print("\n\n".join(text), flush=True)
    if chosen.record:
        how = f"`python benchmarks/planning.py --record`: the model `small`. {machine('jax')}."
        record("planning", "\n\n".join(["## A plan by the cross-entropy method", how, *text]))


if __name__ == "__main__":
    main()
