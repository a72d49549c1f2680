"""Train a world model: ``python train.py PRESET``, the same as ``pewm-jax train PRESET``."""

import sys

from pewm_jax.cli import main

if __name__ == "__main__":
    sys.exit(main.main(["train", *sys.argv[1:]], "python train.py"))
