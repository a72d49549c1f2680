"""Chapter 8: how it decides.

An agent chooses actions by what a world model imagines of them. This chapter has the places where
it acts, and how it chooses.

Places, in reading order:

* ``house_config``, ``tasks``, ``house``: the environment ``pewm_jax/House-v0``, a Gymnasium
  environment over the library's renderer, with goals; ``oracle`` knows the way;
* ``observations``: what environments show, and observations as the frames that worlds take;
* ``imagined``, ``imagined_env``: any world as an environment, as pure functions and as a Gymnasium
  environment that looks like a house;
* ``nomad_policy``: ways to go on, proposed by a learned policy (``models.nomad``);
* ``scores``: how near an agent came, and by which way.

How it chooses:

* ``settings``, ``planners``, ``plan``: CEM, MPPI and random shooting, apart from model and cost;
* ``costs``, ``candidates``: what is imagined of many actions, and how far that is from the goal;
* ``mpc``, ``ranking``: acting and planning in turn; which of a policy's proposals is best.

Importing this chapter registers ``pewm_jax/House-v0`` where Gymnasium is installed
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
