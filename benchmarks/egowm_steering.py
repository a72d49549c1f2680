"""Do a run's actions steer it? True, shuffled and no actions, paired over houses.

`python benchmarks/egowm_steering.py runs/egowm` prints the means with 95 % intervals over the
houses of the run's held-out split, and how much better the true actions are: PSNR, LPIPS, SCS with
exact masks of the true clips, and for an agent with a body the IoU of its arms with the truth. The
last lines compare them: LPIPS with copying the observed frame at frames 4, 8 and 16, and the true
actions with another clip's.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pewm_jax
from pewm_jax.data.dataset import EpisodeSource
from pewm_jax.eval import steering
from pewm_jax.eval.metrics.selection import select_lpips, select_scs


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
    measures = steering.Measures()
    if not given.colours:
        clip = config.model.clip
        ids = all(episodes[k].has_ids for k in range(len(episodes)))
        measures = steering.Measures(
            select_lpips(config.evaluate.lpips, clip.height, clip.width)[0],
            select_scs(config.evaluate.scs, ids=ids)[0],
            steering.shows_arms(episodes),
        )
    found = steering.measure(
        config, params, episodes, given.clips, seed=given.seed, measures=measures
    )
    print("\n".join([*found.lines(), *compared(found.facts())]))


def compared(facts: Mapping[str, Any]) -> list[str]:
    """Return lines that compare true actions with copying and with another clip's."""
    lines = []
    scores = facts["scores"]
    if "lpips" in scores:
        true, copy = (scores["lpips"]["per_frame"][kind]["mean"] for kind in ("true", "copy"))
        at = [t for t in steering.AT if t <= len(true)]
        said = ", ".join(f"frame {t}: {100 * (true[t - 1] / copy[t - 1] - 1):+.1f} %" for t in at)
        lines.append(f"LPIPS against copying: {said}")
    lines.append(f"PSNR, true - another clip's: {facts['all']['true - shuffled']['mean']:+.2f} dB")
    for name in ("scs", "arms"):
        if name in scores:
            true, other = (scores[name]["all"][kind]["mean"] for kind in ("true", "shuffled"))
            lines.append(f"{scores[name]['name']}, true / another clip's: {true / other:.2f}")
    return lines


if __name__ == "__main__":
    main()
