"""Studies that combine many trainings or decisions; each is one resumable command.

``table1`` trains and evaluates all memories, as in the paper's Table 1. ``table2`` measures whether
a world model improves decisions, and what its memory adds. ``practice`` measures what a policy
learns by practice in imagination.
"""
