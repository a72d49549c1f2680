"""One of several processes that score together, for ``test_processes``.

Arguments: a folder with the data set, and the flags of ``Join``. The first process writes what all
found to ``found.npz`` there.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pewm_jax.cli import main as program
from pewm_jax.cli import parser as cli
from tests.eval.scene import knowing_rollout, tiny


def score(folder, devices):
    """Return all scores of a model that knows the room, as arrays by name."""
    from pewm_jax.data.dataset import EpisodeSource
    from pewm_jax.eval import runner
    from pewm_jax.eval.long_rollouts import roll_long
    from pewm_jax.eval.reproject import ReprojectSettings
    from pewm_jax.eval.runner import Methods, workers
    from pewm_jax.eval.scoring import score_table
    from pewm_jax.io.store import ResultCache

    config = tiny(folder, batch=4, clips=6)
    episodes = EpisodeSource(folder / "data" / "revisit")
    runner.rollout = knowing_rollout
    params = {"offset": np.float32(0)}
    context = config.data.context
    model = runner.ModelRunner(config, params, 4, context, lambda _: None, devices=devices)
    methods = Methods(model, ReprojectSettings())
    place = folder / f"partial-{len(devices)}"
    partials = workers().first_alone(
        lambda: ResultCache.for_weights(place, "e" * 64, "f" * 64), "folder"
    )
    scored = score_table(config, episodes, methods, partials)
    long = roll_long(config, episodes, methods, partials)
    found = {f"table/{name}": array for name, array in scored.sums.items()}
    found |= {f"long/{name}": array for name, array in long.scored.sums.items()}
    return found | {"occupied": long.kept["memory"]["occupied"]}


def main(argv):
    """Join, score, and write."""
    settings = program.read("evaluate", argv, "processes.py")[0]
    join, folder = settings.join, settings.run
    from pewm_jax.train import processes

    with processes.joined(join):
        import jax

        found = score(Path(folder), jax.local_devices())
        if processes.is_primary():
            np.savez(Path(folder) / "found.npz", **found)
        print(f"{jax.process_count()} processes, {len(jax.devices())} devices")
    return 0


if __name__ == "__main__":
    sys.exit(cli.run(main))
