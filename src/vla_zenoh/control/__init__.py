"""From action chunks to a smooth, bounded command stream. Pure: no Zenoh, no clock, no threads.

commander          state machine and settings, one `step` per tick
policy_check       every reason against a model's spec or a chunk
chunk_planner      validate, plan, bound and enqueue chunks
plan_timeline      plans on a time axis: which goal was in force when, and where plans overlap
step_timing        how fast to go to a goal
motion_pipeline    goals to commands: leash, smoothing, joints, braking
step_space         what steps are added up in: poses of the TCP, or joints
monitor            what may refuse an activation, slow an arm down or make it brake
preflight          reasons against an activation
"""
