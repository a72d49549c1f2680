"""Training.

Reading order: ``stages`` (what is trained when), ``optimizer``, ``sharding``, ``step`` (one pure
function), ``checkpoint``, ``log``, ``loop`` (the only module with side effects and a clock).
"""
