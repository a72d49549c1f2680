"""Studies that combine many trainings or decisions; each is one command that can be resumed.

``table1`` trains and scores all memories, as the paper's Table 1 does. ``table2`` measures whether
a world model helps to decide, and what its memory adds. ``practice`` measures what a policy learns
by practice in imagination.
"""
