"""Training.

Read in this order: ``stages`` (what trains when), ``optimizer``, ``state``, ``sharding``,
``step`` (one pure function), ``checkpoint``, ``log``, ``loop`` (the only part with side effects
and a clock).
"""
