"""Videos and pictures of a steered world, of clips chosen by their index, not by their look.

`python benchmarks/egowm_videos.py runs/egowm_humanoid --out runs/egowm_humanoid/videos` imagines
the first clips of `benchmarks/egowm_steering.py` with the true actions and with another clip's, and
for an agent with a body with its arms alone (it stands still, and all other joints keep their
angles) and with its walking alone (no joint moves). Each clip becomes an MP4 and a PNG.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import pewm_jax
from pewm_jax import worlds
from pewm_jax.bodies.humanoid import BODIES
from pewm_jax.config import Config
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.data.episodes import Episode
from pewm_jax.eval.clips import load_clip
from pewm_jax.eval.steering import with_actions
from pewm_jax.eval.walks import choose_walks
from pewm_jax.io import atomic
from pewm_jax.report.pictures import as_bytes, grid, picture_steps, save_png
from pewm_jax.report.video import encode_h264, small_frames
from pewm_jax.types import Control

ARMS = ("left_", "right_")
"""Beginnings of the names of the joints of arms and hands."""


def main() -> None:
    """Imagine clips and write them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", help="folder of a finished training, or shipped weights")
    parser.add_argument("--out", type=Path, required=True, help="folder of the files")
    parser.add_argument("--name", default="clip", help="beginning of the files' names")
    parser.add_argument("--data", help="data folder; by default the run's")
    parser.add_argument("--split", help="folder inside it; by default the run's evaluate.split")
    parser.add_argument("--clips", type=int, default=4, help="the first clips, by index")
    parser.add_argument("--chain", type=int, default=2, help="clips of the model in each")
    parser.add_argument("--seed", type=int, default=0, help="of the sampling noise")
    given = parser.parse_args()
    config, params = pewm_jax.load(given.run)
    data = dataclasses.replace(config.data, path=given.data or config.data.path)
    split = given.split or config.evaluate.split
    evaluate = dataclasses.replace(config.evaluate, chain=given.chain, split=split)
    config = dataclasses.replace(config, data=data, evaluate=evaluate)
    episodes = EpisodeSource(Path(data.path) / split)
    walks = choose_walks(config, episodes, given.clips, given.chain)
    imagine = jax.jit(worlds.imagine, static_argnums=0)
    for number, choice in enumerate(walks.choices):
        context, truth, control = load_clip(config, episodes, choice)
        other = load_clip(config, episodes, walks.others[number])[2]
        state = worlds.start(config, params, context)
        rows = {"truth": truth.rgb_THWC}
        episode = episodes[choice.episode]
        for name, steps in controls(config, episode, choice.start, control, other).items():
            key = jax.random.fold_in(jax.random.key(given.seed), number)
            frames = imagine(config, params, state, steps, key)[1]
            rows[name] = as_bytes(np.asarray(frames.rgb_THWC))
        first = np.asarray(context.rgb_THWC[-1:])
        rows = {name: np.concatenate([first, rgb]) for name, rgb in rows.items()}
        title = f"clip {number}: {choice.name}, from frame {choice.start}"
        times = picture_steps(len(truth.rgb_THWC))
        strip = [(name, [rgb[t] for t in times]) for name, rgb in rows.items()]
        captions = [f"frame {t}" if t else "observed" for t in times]
        save_png(given.out / f"{given.name}{number:02d}.png", grid(strip, captions, title=title))
        film = encode_h264(small_frames(list(rows.items()), cell=192))
        atomic.write_bytes(given.out / f"{given.name}{number:02d}.mp4", film)
        print(title)


def controls(
    config: Config, episode: Episode, start: int, own: Any, other: Any
) -> Mapping[str, Any]:
    """Return the controls of a clip by caption."""
    if not isinstance(own, Control):
        return {"true actions": own, "another clip's": other}
    actions = {"another clip's": np.asarray(other.actions_TA)}
    body = BODIES.get(config.model.control.body)
    if body is not None:
        arms = np.array([one.name.startswith(ARMS) for one in body.freedoms])
        walking = np.arange(body.size) >= body.size - 2
        still = np.where(walking, 0.0, np.asarray(own.state_A))
        for name, moves in (("arms alone", arms), ("walking alone", walking)):
            moved = np.where(moves, np.asarray(own.actions_TA), still)
            actions[name] = moved.astype(np.float32)
    changed = {
        name: with_actions(config, episode, start, own, each) for name, each in actions.items()
    }
    return {"true actions": own} | changed


if __name__ == "__main__":
    main()
