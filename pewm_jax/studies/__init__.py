"""Chapter 10, studies: questions that many trainings answer, each by one command.

``table1`` asks which memory works: it trains and scores them all, as the paper's Table 1 does.
"""
