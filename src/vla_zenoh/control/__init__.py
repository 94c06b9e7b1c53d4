"""From action chunks to a smooth, bounded command stream. Pure: no Zenoh, no clock, no threads.

In the order in which a chunk passes them, with what each uses below it:

commander          state machine and settings, one `step` per tick
  commander_io     its inputs and outputs, and earlier states of the robot
  states           what it may do in each state
  commanded_part   one arm of it: states, plans, motion, monitors
  part_spacing     two arms stay apart
  lateness         ticks that were missed
policy_check       every reason against a model's spec or a chunk
chunk_planner      validate, plan, bound and enqueue chunks
  step_space       what steps are added up in: poses of the TCP, or joints
  actions          what the numbers of a step mean
  limits           steps, leash and box; slowdowns
  reachability     steps within what the arm can do
plan_timeline      plans on a time axis: which goal was in force when, and where plans overlap
motion_pipeline    goals to commands: leash, smoothing, joints, braking
  step_timing      how fast to go to a goal
  smoothing        the motion of poses
  joint_space      that of joints
  axis_smoothing   that of n axes, by Ruckig
  pose_to_joint    joints for an arm that takes them
  joint_follower   differential inverse kinematics
monitor            what may refuse an activation, slow an arm down or make it brake
  state_monitor    measured states
  watchdog         overdue chunks, nodes, measured joints, deadman
  tracking         distance from the command
  contact          forces, and the retreat from them
preflight          reasons against an activation
"""
