"""Train a world model: ``python train.py PRESET``, the same as ``pewm-jax train PRESET``."""

import sys

from pewm_jax.cli import main, parser

if __name__ == "__main__":
    sys.exit(parser.run(lambda argv: main.execute(["train", *argv], "python train.py")))
