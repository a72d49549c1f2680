"""Score a run: ``python evaluate.py RUN``, the same as ``pewm-jax evaluate RUN``."""

import sys

from pewm_jax.cli import main, parser

if __name__ == "__main__":
    sys.exit(parser.run(lambda argv: main.execute(["evaluate", *argv], "python evaluate.py")))
