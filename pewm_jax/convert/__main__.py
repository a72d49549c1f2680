"""``python -m pewm_jax.convert``: the deprecated name of ``pewm-jax convert``."""

import sys

from pewm_jax.cli import main

if __name__ == "__main__":
    sys.exit(main.deprecated("convert"))
