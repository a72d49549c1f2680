"""Score a trained run: `python evaluate.py runs/demo` is `pewm-jax evaluate runs/demo`."""

import sys

from pewm_jax import cli
from pewm_jax.commands.evaluate import main

if __name__ == "__main__":
    sys.exit(cli.run(main))
