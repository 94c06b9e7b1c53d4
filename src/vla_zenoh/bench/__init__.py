"""Measuring the chain against other ways of serving a policy: statistics, report, the other ways.

The measuring itself needs clocks, processes and Zenoh, and is in `vla_zenoh.nodes`.
"""
