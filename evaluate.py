"""Score a trained run: `python evaluate.py runs/demo` is `pewm-jax evaluate runs/demo`."""

import sys

from pewm_jax.cli.evaluate import main
from pewm_jax.config import command_line as cli

if __name__ == "__main__":
    sys.exit(cli.run(main))
