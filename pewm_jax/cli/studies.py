"""Run the studies: ``pewm-jax table1``, ``table2``, ``practice`` and ``conditioning``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from pewm_jax import presets, registry
from pewm_jax.cli import parser, plugins
from pewm_jax.errors import ConfigError
from pewm_jax.io import runtime


@dataclasses.dataclass(frozen=True)
class Table1Settings:
    """Train and evaluate every memory with every applicable reader: the paper's Table 1.

    All start from the same backbones and train for equal time; all are evaluated on the same
    held-out clips. Writes a table (Markdown, LaTeX, CSV) and a plot. If interrupted, run it again:
    it resumes. More seeds are added to the existing results.
    """

    out: Path = Path("runs/table1")
    """Folder of the results."""
    data: Path | None = None
    """Folder of the data set; by default the preset's."""
    preset: str = "table1"
    """Settings that all rows share; its memory is the paper's map."""
    minutes: tuple[float, float] = (8.0, 6.0)
    """Processor minutes of training steps: for the backbone of each seed, and for each row."""
    steps: tuple[int, int] | None = None
    """Numbers of steps instead: equal steps instead of equal time."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Training seeds."""
    rows: tuple[str, ...] = ()
    """Only these rows, such as --rows none voxel-attend."""
    ablate: Literal["cell", "extent", "tokens", "features", "time"] | None = None
    """Vary a setting of the voxel map read by attention instead: side of a cell on the ground, m;
    side of the map, m; tokens that condition a clip; content of a cell (colours, latents, points,
    or dinov2=FOLDER of `convert import dinov2`); or train the paper's own form longer (multiples of
    the others' time)."""
    values: tuple[str, ...] = ()
    """Values to try instead of the ablation's own."""
    clips: int | None = None
    """Number of held-out clips; by default the preset's."""
    dreamsim: Path | None = None
    """Folder with the weights of DreamSim 0.2 (ensemble), which ship with no package."""


def table1(settings: Table1Settings) -> None:
    """Write the table and print its path."""
    config = presets.load(parser.choose(settings.preset, presets.names(), "preset"))
    if settings.data is not None:
        data = dataclasses.replace(config.data, path=str(settings.data))
        config = dataclasses.replace(config, data=data)
    if settings.clips is not None:
        evaluate = dataclasses.replace(config.evaluate, clips=settings.clips)
        config = dataclasses.replace(config, evaluate=evaluate)
    runtime.keep_large()
    # Imported lazily: help and errors are fast.
    from pewm_jax.studies import table1 as study

    runtime.cache_compilation(settings.out)
    page = study.run(
        config,
        settings.out,
        minutes=settings.minutes,
        steps=settings.steps,
        seeds=settings.seeds,
        only=settings.rows,
        ablation=settings.ablate or "",
        values=settings.values,
        weights={"dreamsim": settings.dreamsim} if settings.dreamsim else None,
    )
    print(f"table: {page}")


@dataclasses.dataclass(frozen=True)
class Table2Settings:
    """Decide tasks in held-out houses by policies, rankings and plans: the paper's Table 2.

    All methods get the same tasks: a policy alone, its proposals ranked by a world model, one plan
    (open loop) and plans in a closed loop (MPC). Each uses an empty memory, reprojection without a
    network, the memory, or the renderer itself as the model. Writes a table, a plot and videos.
    If interrupted, run it again: it resumes.
    """

    model: str = "small"
    """A run's folder, or a model that ships with the library."""
    out: Path = Path("runs/table2")
    """Folder of the results."""
    tasks: tuple[int, ...] = (48,)
    """Number of tasks, spread evenly over the houses: one, or one for each of --multiples."""
    houses: int = 24
    """Number of held-out houses."""
    proposals: tuple[int, ...] = (8, 16)
    """Numbers of a policy's proposals that are ranked."""
    candidates: int = 60
    """Candidates per round of planning."""
    elites: int = 18
    """Number of best candidates to which the next round is fitted."""
    rounds: int = 12
    """Number of rounds of planning."""
    horizon: int = 8
    """Number of actions of the shortest walk to a goal, a multiple of the model's clip length."""
    multiples: tuple[int, ...] = (1, 2, 3)
    """Distances of goals and lengths of plans, in multiples of --horizon."""
    none: str = ""
    """A run that was trained without memory (`pewm-jax train small --train.stage2.steps 0
    --train.joint.steps 0 --train.gate.steps 0 …`), which gets its own rows."""
    policy: str = "wander"
    """`wander` (random walks), the folder of a trained NoMaD (`runs/nomad`), or
    MODULE:FUNCTION, see `studies.deciders.Policy`."""
    cost: Literal["lpips", "pixels"] = "lpips"
    """Distance of the last frame from the goal image."""
    videos: int = 3
    """Number of tasks with a video of the plan next to the real frames."""


def table2(settings: Table2Settings) -> None:
    """Write the table and print its path."""
    for name, least in (("houses", 1), ("videos", 0)):
        if (value := getattr(settings, name)) < least:
            raise ConfigError(f"--{name} is {value}: give at least {least}.")
    if min(settings.tasks, default=0) < 1 or len(settings.tasks) not in (
        1,
        len(settings.multiples),
    ):
        raise ConfigError(
            "--tasks needs one number of 1 or more, or one for each of --multiples, such as 48 8 8."
        )
    counts = settings.proposals
    if not counts or min(counts) < 1 or len(set(counts)) < len(counts):
        raise ConfigError(
            "--proposals needs distinct numbers of 1 or more, such as --proposals 8 16."
        )
    far = settings.multiples
    if not far or far[0] != 1 or min(far) < 1 or list(far) != sorted(set(far)):
        raise ConfigError("--multiples needs increasing numbers of 1 or more, such as 1 2 3.")
    # Imported lazily: help and errors are fast.
    from pewm_jax.planning import costs
    from pewm_jax.planning.settings import PlanConfig
    from pewm_jax.studies import table2 as study

    plan = PlanConfig(
        horizon=settings.horizon,
        candidates=settings.candidates,
        elites=settings.elites,
        rounds=settings.rounds,
    )
    shared = ("tasks", "houses", "proposals", "policy", "cost", "videos", "multiples", "none")
    chosen = {name: getattr(settings, name) for name in shared}
    chosen["policy"], policy = _policy(settings.policy)
    study_config = study.Table2Config(plan=plan, **chosen)
    cost = costs.perceptual() if settings.cost == "lpips" else costs.Pixels()
    runtime.cache_compilation(settings.out)
    page = study.run(settings.model, settings.out, study_config, policy, cost)
    print(f"table: {page}")


def _policy(name: str) -> tuple[str, Callable[..., Any]]:
    """Return the name for a policy's stored decisions, and the policy."""
    from pewm_jax.studies import deciders

    if name in deciders.POLICIES:
        return name, deciders.POLICIES[name]
    if deciders.is_run(name):
        opened = deciders.open_policy(name)
        propose = deciders.nomad(opened.config.model.policy, opened.weights, opened.motion)
        return f"{Path(name).name}-{opened.digest[:8]}", propose
    module, _, function = name.partition(":")
    if not function.isidentifier() or not all(part.isidentifier() for part in module.split(".")):
        raise ConfigError(
            f"--policy {name} is neither one of {', '.join(deciders.POLICIES)}, nor the folder of "
            "a trained NoMaD (pewm-jax train nomad), nor MODULE:FUNCTION."
        )
    plugins.look_here()
    found = getattr(registry.imported(module, "--policy"), function, None)
    if not callable(found):
        raise ConfigError(f"--policy {name}: {module} has no function {function}.")
    return name, found


@dataclasses.dataclass(frozen=True)
class PracticeSettings:
    """Train a policy (NoMaD) in imagination, from a few images of held-out houses.

    It practises in the world started from these images, with its memory and without, and in the
    house itself, and is then sent to goals there. Writes a table and an image. If interrupted, run
    it again: it resumes.
    """

    policy: Path = Path("runs/nomad")
    """The run of a NoMaD (pewm-jax train nomad)."""
    model: str = "small"
    """A run's folder, or a model that ships with the library."""
    out: Path = Path("runs/practice")
    """Folder of the results."""
    houses: int = 12
    """Number of held-out houses."""
    tasks: int = 12
    """Number of goals in each house."""
    walks: int = 32
    """Number of walks per practice."""
    blocks: int = 4
    """Number of consecutive proposals executed in a walk."""
    steps: int = 150
    """Number of training steps on the walks."""
    learning_rate: float = 2e-4
    """Learning rate of that training."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of practice and training."""


def practice(settings: PracticeSettings) -> None:
    """Run the study and print the path of its table."""
    # Imported lazily: help and errors are fast.
    from pewm_jax.planning.practice import Practice
    from pewm_jax.studies import practice as study
    from pewm_jax.studies.practice_piece import PracticeConfig

    study_config = PracticeConfig(
        houses=settings.houses,
        tasks=settings.tasks,
        practice=Practice(walks=settings.walks, blocks=settings.blocks),
        steps=settings.steps,
        learning_rate=settings.learning_rate,
        seeds=settings.seeds,
    )
    runtime.cache_compilation(settings.out)
    page = study.run(settings.model, settings.policy, settings.out, study_config)
    print(f"table: {page}")


@dataclasses.dataclass(frozen=True)
class ConditioningSettings:
    """Train and score every way of giving actions to a network: EgoWM's ablation.

    The actions are added to the time embedding (the paper), attended to as tokens, or joined to the
    input channels; one row is trained without actions. All train for equal time and are scored on
    the same held-out clips: PSNR, LPIPS, SCS with exact masks of the true clips, IoU of the arms of
    an agent with a body. If interrupted, run it again: it resumes.
    """

    out: Path = Path("runs/conditioning")
    """Folder of the results."""
    preset: str = "egowm"
    """Settings that all rows share: `egowm` or `egowm_humanoid` (25 degrees of freedom), which need
    the most time, or `egowm_tiny` or `egowm_humanoid_tiny`."""
    data: Path | None = None
    """Folder of the data set; by default the preset's."""
    minutes: float = 30.0
    """Minutes of training steps of each row; processor time on a CPU."""
    steps: int = 0
    """Number of steps of each row instead: equal steps instead of equal time."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds."""
    rows: tuple[str, ...] = ()
    """Only these rows: timestep, attention, channels, none."""
    clips: int = 96
    """Number of held-out clips."""
    prepared: int | None = None
    """Clips that are prepared once (`data.prepared`); by default the preset's. They stay in main
    memory."""


def conditioning(settings: ConditioningSettings) -> None:
    """Write the table and print its path."""
    config = presets.load(parser.choose(settings.preset, presets.names(), "preset"))
    changes: dict[str, Any] = {}
    if settings.data is not None:
        changes |= {"path": str(settings.data), "prepared_path": ""}
    if settings.prepared is not None:
        changes |= {"prepared": settings.prepared, "prepared_path": ""}
        changes |= {"refresh": config.data.refresh if settings.prepared else 0}
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, **changes))
    runtime.keep_large()
    # Imported lazily: help and errors are fast.
    from pewm_jax.studies import conditioning as study

    runtime.cache_compilation(settings.out)
    asked = study.Study(
        config,
        settings.out,
        minutes=settings.minutes,
        steps=settings.steps,
        seeds=settings.seeds,
        rows=settings.rows or study.ROWS,
        clips=settings.clips,
    )
    print(f"table: {study.run(asked)}")
