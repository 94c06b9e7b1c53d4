"""Whether a model keeps its contract, found out without a robot.

`examples` makes observations from a spec, `fit` holds a spec against a profile, `plausible` looks
at the numbers a model answers with, `examine` does all of it to a loaded model, and `judge` says
what its answers mean. Needs nothing beyond what every model's own environment has.
"""
