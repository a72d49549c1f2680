"""Do a run's actions steer it? PSNR with true, shuffled and no actions, paired over houses.

`python benchmarks/egowm_steering.py runs/egowm_tiny` prints the means with 95 % intervals over the
houses of the run's held-out split, and how much better the true actions are.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pewm_jax
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval import steering


def main() -> None:
    """Measure a run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", help="folder of a finished training")
    parser.add_argument("--data", help="data folder; by default the run's")
    parser.add_argument("--split", help="folder inside it; by default the run's evaluate.split")
    parser.add_argument("--clips", type=int, default=96, help="the most clips to imagine")
    parser.add_argument("--seed", type=int, default=0, help="of the sampling noise")
    given = parser.parse_args()
    config, params = pewm_jax.load(given.run)
    episodes = EpisodeSource(
        Path(given.data or config.data.path) / (given.split or config.evaluate.split)
    )
    found = steering.measure(config, params, episodes, given.clips, seed=given.seed)
    print("\n".join(found.lines()))


if __name__ == "__main__":
    main()
