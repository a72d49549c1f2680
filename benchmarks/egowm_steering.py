"""Do a run's actions steer it? True, shuffled and no actions, paired over houses.

`python benchmarks/egowm_steering.py runs/egowm` prints the means with 95 % intervals over the
houses of the run's held-out split, and how much better the true actions are: PSNR, LPIPS, SCS with
exact masks of the true clips, and for an agent with a body the IoU of its arms with the truth. The
last lines compare them: LPIPS with copying the observed frame at frames 4, 8 and 16, SCS and the
arms with another clip's actions.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import pewm_jax
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval import steering
from pewm_jax.report.labels import compare_steering


def main() -> None:
    """Measure a run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", help="folder of a finished training")
    parser.add_argument("--data", help="data folder; by default the run's")
    parser.add_argument("--split", help="folder inside it; by default the run's evaluate.split")
    parser.add_argument("--clips", type=int, default=96, help="the most clips to imagine")
    parser.add_argument("--chain", type=int, default=2, help="clips of the model in each")
    parser.add_argument("--steps", type=int, help="steps of the sampler; by default the run's")
    parser.add_argument("--seed", type=int, default=0, help="of the sampling noise")
    parser.add_argument("--colours", action="store_true", help="PSNR alone, which is faster")
    given = parser.parse_args()
    config, params = pewm_jax.load(given.run)
    evaluate = dataclasses.replace(config.evaluate, chain=given.chain)
    config = dataclasses.replace(config, evaluate=evaluate)
    if given.steps is not None:
        model = config.model.with_sample_steps(given.steps)
        config = dataclasses.replace(config, model=model)
    episodes = EpisodeSource(
        Path(given.data or config.data.path) / (given.split or config.evaluate.split)
    )
    measures = steering.Measures() if given.colours else steering.Measures.chosen(config, episodes)
    found = steering.measure(
        config, params, episodes, given.clips, seed=given.seed, measures=measures
    )
    print("\n".join([*found.lines(), *compare_steering(found.facts())]))


if __name__ == "__main__":
    main()
