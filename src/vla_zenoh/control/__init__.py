"""From action chunks to a smooth, bounded stream of poses. Pure: no Zenoh, no clock, no threads.

actions     what the numbers of a chunk mean          -> waypoints
compose     which goal was in force when              -> plans on a time axis
limits      step, workspace, leash                    -> the same, bounded, and told
smoothing   Ruckig on translation and SO(3)           -> pose, twist, acceleration
gripper     absolute widths, newest wins              -> one command in flight
states      the state machine as a table
preflight   every reason not to activate
commander   all of the above, one `step` per tick
reference   the robot's side: refuses jumps, brakes when the stream falls silent
impedance   Cartesian impedance law of the simulated robot
"""
