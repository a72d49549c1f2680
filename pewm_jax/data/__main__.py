"""``python -m pewm_jax.data``: the former name of ``pewm-jax data``."""

import sys

from pewm_jax.cli import data

if __name__ == "__main__":
    sys.exit(data.main())
