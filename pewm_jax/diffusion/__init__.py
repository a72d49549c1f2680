"""Chapter 5, how the model imagines: noise schedule, objective, solver, sampler."""
