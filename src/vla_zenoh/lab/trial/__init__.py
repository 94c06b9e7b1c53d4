"""Models tried on a real arm, where a person says whether an episode succeeded.

`plan` is what is to be done, in which order; `conduct` how one episode goes, as a state machine;
`judged` what became of one; `folder` keeps all of it on the disk; `score` adds it up. What carries
it out is `vla_zenoh.lab.trial.runner`.
"""

from __future__ import annotations
