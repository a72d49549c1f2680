"""``pewm-jax table2``: does a world model help to decide, and does its memory?"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from pewm_jax import registry as kinds
from pewm_jax.cli import plugins as imports
from pewm_jax.config import command_line as cli

ABOUT = (
    "Let a policy alone, its proposals ranked by a world model, one plan (open loop) and plans in "
    "a closed loop (MPC) decide the same tasks in held-out houses, each with an empty memory, by "
    "reprojection without a network, with the memory, and with the renderer itself as the model, "
    "and write a table, a plot and videos. Decisions are kept: the same command resumes."
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is decided, and how."""

    model: str = "small"
    """A run's folder, or a model that comes with the library."""
    out: Path = Path("runs/table2")
    """Folder that everything is kept in."""
    tasks: int = 48
    """Tasks; they take the houses in turn."""
    houses: int = 24
    """Held-out houses."""
    proposals: tuple[int, ...] = (8, 16)
    """Numbers of a policy's proposals that are ranked."""
    candidates: int = 60
    """Candidates of a round of planning."""
    elites: int = 18
    """The best of them, which the next round is drawn from."""
    rounds: int = 12
    """Rounds of planning."""
    horizon: int = 8
    """Actions of the shortest walk to a goal, a multiple of what the model imagines at once."""
    multiples: tuple[int, ...] = (1, 2, 3)
    """Goals are so many times --horizon actions away, and plans are as long."""
    none: str = ""
    """A run that was trained without memory (`pewm-jax train small --train.stage2.steps 0
    --train.joint.steps 0 --train.gate.steps 0 …`), which gets rows of its own."""
    policy: str = "wander"
    """`wander` (walks that know nothing), the folder of a trained NoMaD (`runs/nomad`), or
    MODULE:FUNCTION, see `studies.deciders.Policy`."""
    cost: Literal["lpips", "pixels"] = "lpips"
    """How far the last frame is from the goal's picture."""
    videos: int = 3
    """Tasks whose plan is shown beside what happened."""


def main(argv: Sequence[str], prog: str = "pewm-jax table2") -> int:
    """Make the table and print its path.

    Args:
        argv: the arguments.
        prog: the words that the command was called by, for help and refusals.

    Returns:
        The exit code.
    """
    argv = imports.take(argv)
    about = f"{ABOUT} Beside these settings:\n{imports.HELP}"
    settings = cli.parse(Settings, argv, default=Settings(), prog=prog, description=about)
    for name in ("tasks", "houses", "videos"):
        if getattr(settings, name) < (name != "videos"):
            raise cli.ConfigError(f"--{name} is {getattr(settings, name)}: give at least 1.")
    counts = settings.proposals
    if not counts or min(counts) < 1 or len(set(counts)) < len(counts):
        raise cli.ConfigError(
            "--proposals needs different numbers from 1 on, such as --proposals 8 16."
        )
    far = settings.multiples
    if not far or far[0] != 1 or min(far) < 1 or list(far) != sorted(set(far)):
        raise cli.ConfigError("--multiples needs growing numbers from 1 on, such as 1 2 3.")
    # Imported here and not above: help and refusals come at once.
    from pewm_jax.planning import costs
    from pewm_jax.planning.settings import PlanConfig
    from pewm_jax.studies import table2

    plan = PlanConfig(
        horizon=settings.horizon,
        candidates=settings.candidates,
        elites=settings.elites,
        rounds=settings.rounds,
    )
    shared = ("tasks", "houses", "proposals", "policy", "cost", "videos", "multiples", "none")
    chosen = {name: getattr(settings, name) for name in shared}
    chosen["policy"], policy = _policy(settings.policy)
    errand = table2.Table2Config(plan=plan, **chosen)
    cost = costs.perceptual() if settings.cost == "lpips" else costs.Pixels()
    cli.cache_compilation(settings.out)
    page = table2.run(settings.model, settings.out, errand, policy, cost)
    print(f"table: {page}")
    return 0


def _policy(name: str) -> tuple[str, Callable[..., Any]]:
    """Return what the decisions of a policy are kept under, and the policy."""
    from pewm_jax.studies import deciders

    if name in deciders.POLICIES:
        return name, deciders.POLICIES[name]
    if deciders.is_run(name):
        opened = deciders.open_policy(name)
        propose = deciders.nomad(opened.config.model.policy, opened.weights, opened.motion)
        return f"{Path(name).name}-{opened.digest[:8]}", propose
    module, _, function = name.partition(":")
    if not function.isidentifier() or not all(part.isidentifier() for part in module.split(".")):
        raise cli.ConfigError(
            f"--policy {name} is neither one of {', '.join(deciders.POLICIES)}, nor the folder of "
            "a trained NoMaD (pewm-jax train nomad), nor MODULE:FUNCTION."
        )
    imports.look_here()
    found = getattr(kinds.imported(module, "--policy"), function, None)
    if not callable(found):
        raise cli.ConfigError(f"--policy {name}: {module} has no function {function}.")
    return name, found
