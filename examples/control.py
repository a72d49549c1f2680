"""A control in one file: actions are added to the time embedding of the frames they lead to.

::

    pewm-jax train tiny --plugin control.py --control.kind push --train.run runs/mine
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from pewm_jax.config.parts import Conditioner
from pewm_jax.models.interface import Conditioning
from pewm_jax.registry import register


@register("control", "push")
@dataclasses.dataclass(frozen=True)
class PushConfig(Conditioner):
    MODULATES: ClassVar[bool] = True
    SHARDING: ClassVar = ((r"control/project", P(None, "fsdp")),)

    width: int = 3

    actions = property(lambda self: self.width)

    def init(self, model, key):
        shape = (model.codec.temporal * self.width, model.backbone.places.time)
        return {"project": 0.1 * jax.random.normal(key, shape)}

    def condition(self, model, params, observed, control):
        t = model.latent_shape[0]
        actions = control.actions_TA.reshape(len(control.actions_TA), t - 1, -1)
        led = actions @ params["project"]
        return Conditioning(modulation_BtE=jnp.pad(led, ((0, 0), (1, 0), (0, 0))))
