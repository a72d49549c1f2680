"""Train a world model: `python train.py demo` is `pewm-jax train demo` from a checkout."""

import sys

from pewm_jax.cli.train import main
from pewm_jax.config import command_line as cli

if __name__ == "__main__":
    sys.exit(cli.run(main))
