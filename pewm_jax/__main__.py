"""``python -m pewm_jax`` is the command ``pewm-jax``."""

import sys

from pewm_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
