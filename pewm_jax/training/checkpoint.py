"""Checkpoints by Orbax: written in the background, whole or not at all.

One folder per stage. Each checkpoint has three items: ``weights``, what inference uses, complete
and loadable on its own; ``state``, what training needs besides (the trained parameters and the
optimizer's moments; frozen leaves are already in ``weights``); ``position``, a few words of JSON.
Arrays restore to any number of devices.
"""

from __future__ import annotations

import contextlib
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import jax
import orbax.checkpoint as ocp

from pewm_jax import tree
from pewm_jax.config import Config, UserError
from pewm_jax.training import runs
from pewm_jax.training.stages import Stage
from pewm_jax.training.state import TrainState, inference_params
from pewm_jax.types import Params

FOLDER = "checkpoints"


class Checkpoints:
    """The checkpoints of one stage of one run; a context manager that waits for writes.

    Args:
        run: the run's folder.
        config: the experiment, remembered in each checkpoint.
        stage: the stage.
    """

    def __init__(self, run: Path, config: Config, stage: Stage):
        self.folder = (run / FOLDER / stage.name).resolve()
        self.config = config
        self.stage = stage
        self._manager = ocp.CheckpointManager(
            self.folder,
            item_names=("weights", "state", "position"),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=config.train.keep, create=True, enable_async_checkpointing=True
            ),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: types.TracebackType | None,
    ) -> None:
        with self._writing():
            self._manager.close()

    def latest(self) -> int | None:
        """Return the step of the newest complete checkpoint, if there is any."""
        return self._manager.latest_step()

    def save(self, state: TrainState) -> None:
        """Copy the state off the devices and write it in the background.

        Raises:
            UserError: this checkpoint, or the one before in the background, cannot be written.
        """
        step = int(state.step)
        if step == self.latest():
            return
        position = {
            "stage": self.stage.number,
            "step": step,
            "config": runs.identity(self.config),
        }
        items = {
            "weights": ocp.args.StandardSave(inference_params(self.stage, state)),
            "state": ocp.args.StandardSave(_rest(self.stage, state)),
            "position": ocp.args.JsonSave(position),
        }
        with self._writing():
            self._manager.save(step, args=ocp.args.Composite(**items))

    def wait(self) -> None:
        """Block until everything is on disk; raises as ``save`` does."""
        with self._writing():
            self._manager.wait_until_finished()

    def restore(self, like: TrainState) -> TrainState:
        """Read the newest checkpoint.

        Args:
            like: the abstract state; arrays come back with its shardings.

        Raises:
            UserError: the checkpoint is of another configuration, or damaged.
        """
        step = self._require_step()
        items = {
            "weights": ocp.args.StandardRestore(inference_params(self.stage, like)),
            "state": ocp.args.StandardRestore(_rest(self.stage, like)),
        }
        read = self._read(step, items)
        ema, frozen = tree.split(read["weights"], self.stage.trained)
        rest = read["state"]
        return TrainState(
            params=tree.merge(rest["trained"], frozen),
            ema=ema,
            opt_state=rest["opt_state"],
            step=rest["step"],
        )

    def restore_weights(self, like: TrainState) -> Params:
        """Read only the inference weights of the newest checkpoint; see ``restore``."""
        items = {"weights": ocp.args.StandardRestore(inference_params(self.stage, like))}
        return self._read(self._require_step(), items)["weights"]

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn what goes wrong in writing into a sentence that says what is kept."""
        try:
            yield
        except (OSError, ValueError, RuntimeError) as error:
            whole = [int(path.name) for path in self.folder.glob("[0-9]*") if path.name.isdigit()]
            kept = f"that of step {max(whole)} is kept" if whole else "none was written before"
            reason = " ".join(str(error).split())[:160]
            raise UserError(
                f"A checkpoint in {self.folder} cannot be written ({reason}); {kept}: free space "
                "or allow writing there, then run the same command again to go on."
            ) from None

    def _require_step(self) -> int:
        step = self.latest()
        if step is None:
            raise UserError(f"{self.folder} holds no complete checkpoint; train this stage first.")
        return step

    def _read(self, step: int, items: dict[str, Any]) -> Any:
        """Read items of a checkpoint after making sure that it is of this configuration."""
        folder = self.folder / str(step)
        position = self._restore(step, {"position": ocp.args.JsonRestore()})["position"]
        wrong = runs.differences(position["config"], runs.identity(self.config))
        if wrong:
            raise UserError(
                f"{folder} is a checkpoint of another configuration ({runs.phrase(wrong)}): "
                "give this one its own folder with --train.run, or put the settings back."
            )
        return self._restore(step, items)

    def _restore(self, step: int, items: dict[str, Any]) -> Any:
        try:
            return self._manager.restore(step, args=ocp.args.Composite(**items))
        except (ValueError, KeyError, TypeError, OSError) as error:
            reason = " ".join(str(error).split())[:160]
            raise UserError(
                f"{self.folder / str(step)} cannot be read ({reason}): it is damaged; delete that "
                "folder to go on from the checkpoint before it."
            ) from None


def _rest(stage: Stage, state: TrainState) -> dict[str, Any]:
    """Return what ``weights`` does not hold."""
    return {
        "trained": tree.select(state.params, stage.trained),
        "opt_state": state.opt_state,
        "step": jax.tree.map(lambda leaf: leaf, state.step),
    }
