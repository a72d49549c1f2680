"""Planning: environments to act in, and planners that choose actions by imagined frames.

Environments:

* ``house_config``, ``house``: ``pewm_jax/House-v0``, a Gymnasium environment over the library's
  renderer, with goals; ``oracle`` follows the shortest path;
* ``observations``: observation spaces, and observations as the frames that worlds take;
* ``imagined``, ``imagined_env``: any world as an environment, as pure functions and as a Gymnasium
  environment with the interface of a house;
* ``nomad_policy``: trajectories proposed by a learned policy (``models.nomad``); ``practice``:
  walks of a policy inside a world, to learn from;
* ``scores``: trajectory errors, success and SPL.

Planners:

* ``settings``, ``planners``, ``plan``: CEM, MPPI and random shooting, for any model and cost;
* ``costs``, ``candidates``: frames of many candidates, their costs and their ranking;
* ``mpc``: acting and planning in turn.

Importing this package registers ``pewm_jax/House-v0`` where Gymnasium is installed
(``pip install 'pewm-jax[planning]'``)::

    import gymnasium
    import pewm_jax.planning

    env = gymnasium.make("pewm_jax/House-v0", task="point")
    observation, info = env.reset(seed=0)
"""

from __future__ import annotations

import importlib.util

HOUSE_ID = "pewm_jax/House-v0"
"""The name of the house among Gymnasium's environments."""


def register() -> None:
    """Make the house known to Gymnasium; nothing happens if it is known already.

    Raises:
        UserError: Gymnasium is not installed.
    """
    # Imported here: planners, scores and the functional environment do without Gymnasium.
    from pewm_jax.planning.extra import gymnasium  # noqa: PLC0415

    if HOUSE_ID not in gymnasium.registry:
        gymnasium.register(HOUSE_ID, entry_point="pewm_jax.planning.house:HouseEnv")


if importlib.util.find_spec("gymnasium") is not None:
    register()
