"""Planning: environments to act in, and planners that choose actions by imagined frames.

Environments:

* ``house_config``, ``house``: ``pewm_jax/House-v0``, a Gymnasium environment based on the library's
  renderer, with goals; ``oracle`` follows the shortest path;
* ``observations``: observation spaces, and conversion of observations to the frames that worlds
  take;
* ``imagined``, ``imagined_env``: any world as an environment, as pure functions and as a Gymnasium
  environment with the interface of a house; ``imagined_vector``: many of them, imagined in one
  call; ``stable_baselines``: these for Stable-Baselines3;
* ``nomad_policy``: trajectories proposed by a learned policy (``models.nomad``); ``practice``:
  walks of a policy inside a world, as training data;
* ``scores``: trajectory errors, success and SPL.

Planners:

* ``settings``, ``planners``, ``plan``: CEM, MPPI and random shooting, for any model and cost;
* ``costs``, ``candidates``: frames of many candidates, their costs and their ranking;
* ``mpc``: model predictive control.

Importing this package registers ``pewm_jax/House-v0`` if Gymnasium is installed (``pip install
'pewm-jax[planning]'``)::

    import gymnasium
    import pewm_jax.planning

    env = gymnasium.make("pewm_jax/House-v0", task="point")
    observation, info = env.reset(seed=0)
"""

from __future__ import annotations

import importlib.util

HOUSE_ID = "pewm_jax/House-v0"
"""Name of the house environment in Gymnasium's registry."""


def register() -> None:
    """Register the house with Gymnasium, unless it is registered already.

    Raises:
        UserError: Gymnasium is not installed.
    """
    # Imported lazily: planners, scores and the functional environment do not need Gymnasium.
    from pewm_jax.planning.observations import gymnasium  # noqa: PLC0415

    if HOUSE_ID not in gymnasium.registry:
        gymnasium.register(HOUSE_ID, entry_point="pewm_jax.planning.house:HouseEnv")


if importlib.util.find_spec("gymnasium") is not None:
    register()
