"""Evaluation of trained runs: protocol, scoring, metrics, intervals, reports and comparisons.

``evaluate.evaluate`` writes a run's report. It chooses clips (``clips``, ``protocol``), imagines
them (``runner``), scores them (``scoring``, ``long_rollouts``, ``mirror``, ``steering``,
``coverage``) and summarizes the errors (``statistics``, ``intervals``, ``results``). Metrics are
defined in ``metrics``.
"""
