"""Chapter 10, studies: questions that many trainings answer, each by one command.

``table1`` asks which memory works: it trains and scores them all, as the paper's Table 1 does.
``table2`` asks whether a world model helps to decide, and what its memory adds to that.
"""
