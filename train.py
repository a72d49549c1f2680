"""Train a world model: `python train.py demo` is `pewm-jax train demo` from a checkout."""

import sys

from pewm_jax import cli
from pewm_jax.commands.train import main

if __name__ == "__main__":
    sys.exit(cli.run(main))
