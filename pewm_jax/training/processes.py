"""The processes of one job: who writes, and how they agree."""

from __future__ import annotations

import json
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from pewm_jax.config import Launch, UserError


def start(launch: Launch) -> None:
    """Join the other processes of the job, if the launch asks for it; before any device is used.

    Where the launch names no coordinator, JAX finds out from the environment (SLURM, Kubernetes,
    Cloud TPU, Open MPI). Without ``--distributed`` nothing is tried.

    Raises:
        UserError: there is nothing to join.
    """
    if not launch.distributed:
        return
    given = {}
    if launch.coordinator:
        given = {
            "coordinator_address": launch.coordinator,
            "num_processes": launch.processes,
            "process_id": launch.process,
        }
    try:
        jax.distributed.initialize(**given)
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:160]
        raise UserError(
            f"--distributed found no processes to join ({reason}): name them with --coordinator, "
            "--processes and --process, or train without --distributed."
        ) from None


def is_primary() -> bool:
    """Tell whether this process is the one that writes logs, pictures and what is not sharded."""
    return jax.process_index() == 0


def wait(name: str) -> None:
    """Wait until all processes have come to the place of this name."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def agree(value: Any) -> Any:
    """Return what the first process holds, in all of them.

    Args:
        value: anything that JSON holds; other processes' values do not count.
    """
    if jax.process_count() == 1:
        return value
    text = json.dumps(value).encode() if is_primary() else b""
    size = multihost_utils.broadcast_one_to_all(np.asarray(len(text), np.int32))
    padded = np.frombuffer(text.ljust(int(size), b" "), np.uint8)
    return json.loads(bytes(multihost_utils.broadcast_one_to_all(padded)))
