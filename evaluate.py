"""Score a run: ``python evaluate.py RUN``, the same as ``pewm-jax evaluate RUN``."""

import sys

from pewm_jax.cli import main

if __name__ == "__main__":
    sys.exit(main.main(["evaluate", *sys.argv[1:]], "python evaluate.py"))
